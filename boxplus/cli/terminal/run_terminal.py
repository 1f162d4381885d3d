"""What a run shows on a terminal: evidence before, progress while it goes on, results at the end."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich import box
from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar
from rich.table import Table
from rich.text import Text

from boxplus.cli.terminal.terminal import Terminal
from boxplus.errors import printable

if TYPE_CHECKING:
    from boxplus.recordings.cameras.info import CameraRecordingInfo
    from boxplus.recordings.info import Evidence, RecordingInfo
    from boxplus.runs.run_facts import RunFacts
    from boxplus.runs.run_loop import Progress

_STYLE = {"ok": "green", "warning": "yellow", "error": "bold red", "weak": "yellow", "lost": "bold red"}
_SHOWN_WARNINGS = 8


class RunTerminal(Terminal):
    """Prints a run; without a terminal the progress bar is left out."""

    def print_evidence(self, info: RecordingInfo | CameraRecordingInfo, evidence: Iterable[Evidence]) -> None:
        """How the recording is read, and why."""
        facts = f"{info.format}, {info.duration_s:.1f} s, {info.message_count} messages"
        self.console.print(Text.assemble((printable(info.path.name), "bold"), f": {facts}"))
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
        for heading in ("reading", "found", "", "evidence"):
            table.add_column(heading, overflow="fold")
        for entry in evidence:
            table.add_row(entry.key, Text(entry.value), Text(entry.verdict, _STYLE[entry.verdict]), Text(entry.text))
        self.console.print(table)

    @contextmanager
    def progress(self) -> Iterator[Callable[[Progress], None]]:
        """A bar with the rate of estimates; yields what a run calls."""
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TextColumn("{task.fields[text]}"),
            TimeElapsedColumn(),
            TextColumn("elapsed,"),
            TimeRemainingColumn(),
            TextColumn("to go"),
        )
        with ProgressBar(*columns, console=self.console, disable=not self.console.is_terminal) as bar:
            task = bar.add_task("odometry", total=1.0, text="")
            rate = _Rate()
            compiling, stage = False, ""

            def show(progress: Progress) -> None:
                nonlocal compiling, stage
                if progress.compiling is not None:
                    if not compiling:
                        compiling = True
                        self.console.print("compiling kernels (first use only) …")
                    bar.update(task, text=f"compiling {progress.compiling}")
                elif progress.stage != stage or rate.due():  # a stage may be told once, and last for minutes
                    stage = progress.stage
                    counted = f"{progress.count} {progress.unit}, {rate(progress.count):.0f}/s, "
                    text = (counted if progress.count else "") + progress.status
                    bar.update(task, completed=progress.share, description=stage, text=text)

            yield show
            bar.update(task, completed=bar.tasks[0].total if bar.tasks[0].completed > 0.999 else bar.tasks[0].completed)

    def print_results(
        self,
        summary: RunFacts,
        rows: Sequence[tuple[str, str]],
        folder: Path,
        files: Sequence[str],
        *,
        warnings: Iterable[str] = (),
        doubt: str | None,
    ) -> None:
        """The facts of the run, its warnings and its files.

        Args:
            summary: of the odometry.
            rows: name and value, after the counts and the start.
            files: names of those that may be there.
            warnings: of what was made of the odometry.
            doubt: why the results are not to be trusted; None where they are.
        """
        console = self.console
        good = summary.state == "finished" and doubt is None
        told = summary.describe_progress() + ("" if doubt is None else f"; not to be trusted: {doubt}")
        (console if good else self.alarms).print(Text(printable(told), "green" if good else "yellow"))
        table = Table(box=None, show_header=False, pad_edge=False)
        table.add_column(style="bold")
        table.add_column()
        counts = Text(", ").join(Text(f"{count} {name}", _STYLE[name]) for name, count in sorted(summary.status.items()))
        count, unit = summary.estimates
        table.add_row(unit, Text.assemble(f"{count} (", counts, ")"))
        if summary.start is not None:
            table.add_row("start", Text(f"{summary.start.kind}: {summary.start.text}"))
        table.add_row("path length", f"{summary.path_length_m:.2f} {summary.length_unit} in {summary.duration_s:.1f} s")
        for name, value in rows:
            table.add_row(name, Text(value))
        console.print(table)
        untold = [warning for warning in summary.warnings if warning.text not in (doubt or "")]
        for warning in untold[:_SHOWN_WARNINGS]:
            self.warn(warning.text + (f" ({warning.count} times)" if warning.count > 1 else ""))
        if len(untold) > _SHOWN_WARNINGS:
            self.alarms.print(f"… and {len(untold) - _SHOWN_WARNINGS} more warnings in run.json")
        for text in warnings:
            self.warn(text)
        if summary.not_shown is not None:
            self.say(f"LiDAR and IMU would not have shown, as they moved: {summary.not_shown}")
        self.print_files(folder, files)

    def print_table(self, headings: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        """A table with a row for each of several things."""
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
        for heading in headings:
            table.add_column(heading, overflow="fold")
        for row in rows:
            table.add_row(*(Text(printable(cell)) for cell in row))
        self.console.print(table)


class _Rate:
    """Estimates per second over the last few seconds, asked at most ten times a second."""

    def __init__(self) -> None:
        self._last = 0.0
        self._seen: deque[tuple[float, int]] = deque(maxlen=30)

    def due(self) -> bool:
        return time.monotonic() - self._last > 0.1

    def __call__(self, scans: int) -> float:
        self._last = now = time.monotonic()
        self._seen.append((now, scans))
        begin, first = self._seen[0]
        return (scans - first) / (now - begin) if now > begin else 0.0


def speed_text(real_time_factor: float, total_s: float, compiled: int) -> str:
    """How fast a run was."""
    first = " (with compilation)" if compiled else ""
    return f"{real_time_factor:.1f} × real time{first}, reading included; {total_s:.1f} s in all"
