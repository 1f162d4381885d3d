"""Signals that ask a command to stop."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from boxplus.cli.terminal.interrupt import left_at_once, stop_on_interrupt

ROOT = Path(__file__).resolve().parents[3]
ASKING = (signal.SIGINT, signal.SIGTERM)
PATHS = {**os.environ, "PYTHONPATH": str(ROOT)}


@pytest.mark.parametrize("number", ASKING)
def test_a_signal_leaves_what_may_be_left_out_and_asks_those_around(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with stop_on_interrupt(lambda: None) as should_stop:
        with pytest.raises(KeyboardInterrupt), left_at_once():
            os.kill(os.getpid(), number)
        assert should_stop()
    assert signal.getsignal(number) is before


@pytest.mark.skipif(os.name == "nt", reason="SIGTERM ends a process at once on Windows")
@pytest.mark.parametrize("number", ASKING)
def test_a_signal_while_a_command_is_imported_is_an_interruption(number: signal.Signals, tmp_path: Path) -> None:
    code = f"""
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # which what runs in the background may have off
class Interrupted:
    def find_spec(self, name, path=None, target=None):
        if name == "boxplus.cli.lidar.lio":
            os.kill(os.getpid(), {int(number)})
sys.meta_path.insert(0, Interrupted())
from boxplus.cli import main
main()
"""
    command = [sys.executable, "-c", code, "lio", "recording.bag", "-o", "out"]
    done = subprocess.run(command, cwd=tmp_path, env=PATHS, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr.strip()) == (130, "", "interrupted")
    assert not any(tmp_path.iterdir())
