"""What a run shows while it goes on."""

from __future__ import annotations

import io
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
from rich.console import Console

from boxplus.cli.terminal.run_terminal import RunTerminal
from boxplus.runs.run_facts import RunFacts, WarningFacts
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


@pytest.mark.parametrize(
    ("doubt", "said"),
    [
        (None, "finished: 9 scans"),
        ("loops contradict", "finished: 9 scans; not to be trusted: loops contradict"),
        ("clocks differ; fixes jump", "finished: 9 scans; not to be trusted: clocks differ; fixes jump"),
    ],
)
def test_the_first_line_says_whether_a_result_is_to_be_trusted(doubt: str | None, said: str) -> None:
    """It was a green "finished" where something spoke against what was made of the odometry, and the reason stood far below.

    What speaks against the odometry alone, such as a position that satellites have shown since, is no doubt about the result.
    """
    shown, alarms = _results_shown(doubt=doubt)
    first, other = (shown, alarms) if doubt is None else (alarms, shown)
    assert first.splitlines()[0] == said and "not to be trusted" not in other
    assert alarms.count("fixes jump") == 1 and "something else" in alarms  # nothing is said twice
    assert "not have shown" not in shown + alarms


def test_what_the_motion_has_not_shown_is_said_after_the_warnings() -> None:
    shown, alarms = _results_shown(not_shown="lengths")
    said = "LiDAR and IMU would not have shown, as they moved: lengths"
    assert said in shown and "not have shown" not in alarms


def _results_shown(*, doubt: str | None = None, not_shown: str | None = None) -> tuple[str, str]:
    terminal, shown, alarms = RunTerminal(), io.StringIO(), io.StringIO()
    terminal.console, terminal.alarms = Console(file=shown, width=140), Console(file=alarms, width=140)
    warnings = [WarningFacts(text=text, count=1) for text in ("fixes jump", "something else")]
    summary = SimpleNamespace(
        state="finished", contradiction="of the odometry alone", status={}, estimates=(9, "scans"), start=None, path_length_m=1.0,
        length_unit="m", duration_s=1.0, warnings=warnings, describe_progress=lambda: "finished: 9 scans", not_shown=not_shown,
    )  # fmt: skip
    terminal.print_results(cast(RunFacts, summary), [], Path("out"), [], doubt=doubt)
    return shown.getvalue(), alarms.getvalue()
