"""Signals that ask a command to stop, and those that whoever started it had it ignore."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest

from boxplus.cli.interrupt import left_at_once, stop_on_interrupt

ASKING = (signal.SIGINT, signal.SIGTERM)


@pytest.fixture(params=ASKING)
def ignored(request: pytest.FixtureRequest) -> Iterator[signal.Signals]:
    """A signal that is ignored, as SIGINT is of what a shell runs in the background."""
    before = signal.signal(request.param, signal.SIG_IGN)
    yield request.param
    signal.signal(request.param, before)


def test_what_was_ignored_stays_ignored(ignored: signal.Signals) -> None:
    with stop_on_interrupt(lambda: None) as should_stop:
        for _ in range(2):
            os.kill(os.getpid(), ignored)
        assert not should_stop()
        with left_at_once():
            os.kill(os.getpid(), ignored)
        assert not should_stop()
    assert signal.getsignal(ignored) is signal.SIG_IGN


@pytest.mark.parametrize("number", ASKING)
def test_a_signal_leaves_what_may_be_left_out_and_asks_those_around(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with stop_on_interrupt(lambda: None) as should_stop:
        with pytest.raises(KeyboardInterrupt), left_at_once():
            os.kill(os.getpid(), number)
        assert should_stop()
    assert signal.getsignal(number) is before
