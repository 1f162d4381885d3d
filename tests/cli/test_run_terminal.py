"""What a run shows while it goes on."""

from __future__ import annotations

import io

from rich.console import Console

from boxplus.cli.run_terminal import RunTerminal
from boxplus.runs.run_loop import Progress


def test_every_stage_is_shown_however_quickly_it_follows_the_one_before() -> None:
    """A stage that is told once and lasts for minutes came within a tenth of a second of the last word of the one before."""
    terminal, shown = RunTerminal(), io.StringIO()
    terminal.console = Console(file=shown, force_terminal=True, width=140)
    with terminal.progress() as progress:
        for k in range(5):
            progress(Progress(0.2 * (k + 1), 0, "scans", "", stage="reading"))
        progress(Progress(0.0, 0, "scans", "", stage="finding planes"))
    text = shown.getvalue()
    assert "finding planes" in text and "/s" not in text


def test_estimates_are_counted_where_there_are_some() -> None:
    terminal, shown = RunTerminal(), io.StringIO()
    terminal.console = Console(file=shown, force_terminal=True, width=140)
    with terminal.progress() as progress:
        progress(Progress(0.5, 40, "scans", "weak"))
    assert "odometry" in shown.getvalue() and "40 scans, 0/s, weak" in shown.getvalue()
