"""Signals that ask a command to stop."""

from __future__ import annotations

import os
import signal

import pytest

from boxplus.cli.interrupt import left_at_once, stop_on_interrupt

ASKING = (signal.SIGINT, signal.SIGTERM)


@pytest.mark.parametrize("number", ASKING)
def test_a_signal_leaves_what_may_be_left_out_and_asks_those_around(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with stop_on_interrupt(lambda: None) as should_stop:
        with pytest.raises(KeyboardInterrupt), left_at_once():
            os.kill(os.getpid(), number)
        assert should_stop()
    assert signal.getsignal(number) is before
