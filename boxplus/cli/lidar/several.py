"""Several recordings one after the other: one that fails leaves the others unharmed, and a table says how each came out."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from boxplus.cli import EXIT_INTERRUPTED, EXIT_UNTRUSTED
from boxplus.errors import BoxplusError, InputError

if TYPE_CHECKING:
    from boxplus.cli.run_terminal import RunTerminal
    from boxplus.runs.lidar_inertial.summary import RunSummary

_HEADINGS = ("recording", "came out", "scans", "weak or lost", "path length", "duration", "× real time", "folder")


def several_recordings(given: Sequence[Path]) -> dict[str, Path] | None:
    """By name: those that are given, or those in a folder that is no recording itself; None where it is one recording.

    Raises:
        InputError: one that is not there.
    """
    from boxplus.runs.fleet.recordings import find_recordings, holds_recordings, named

    if len(given) == 1:
        return find_recordings(given[0]) if holds_recordings(given[0]) else None
    if missing := [path for path in given if not path.exists()]:
        raise InputError(
            "recordings that are there", f"no file or folder {missing[0]}", "check the path; results go to -o FOLDER"
        )
    return named(given)


def run_several(
    recordings: dict[str, Path],
    output: Path | None,
    run_one: Callable[[Path, Path], RunSummary],
    terminal: RunTerminal,
    *,
    as_json: bool,
) -> int:
    """Run them and print the table; returns the exit code.

    Args:
        recordings: by name.
        output: each gets a folder with its name in it; None for NAME_boxplus here.
        run_one: runs a recording into a folder.
        as_json: print a list with the name, folder, `run.json` and error of each, too.
    """
    rows: list[tuple[str, ...]] = []
    results: list[dict[str, object]] = []
    failures: dict[str, str] = {}
    interrupted = doubted = False
    for name, recording in recordings.items():
        folder = Path(f"{name}_boxplus") if output is None else output / name
        if interrupted:
            rows.append((name, "not begun", *[""] * 6))
            continue
        result: dict[str, object] = {"recording": str(recording), "folder": str(folder), "run": None, "error": None}
        results.append(result)
        try:
            summary = run_one(recording, folder)
        except BoxplusError as error:
            failures[name] = result["error"] = str(error)
            rows.append((name, "failed", *[""] * 6))
            continue
        result["run"] = summary.model_dump(mode="json")
        interrupted = summary.state == "interrupted"
        doubted = doubted or summary.contradiction is not None
        rows.append((name, *_row(summary), str(folder)))
    terminal.print_table(_HEADINGS, rows)
    for name, text in failures.items():
        terminal.print_failure(name, text)
    if as_json:
        typer.echo(json.dumps(results, indent=2))
    if interrupted:
        return EXIT_INTERRUPTED
    return EXIT_UNTRUSTED if failures or doubted else 0


def _row(summary: RunSummary) -> tuple[str, ...]:
    bad = sum(count for status, count in summary.status.items() if status != "ok")
    return (
        "not to be trusted" if summary.contradiction is not None else summary.state,
        str(summary.scans),
        str(bad),
        f"{summary.path_length_m:.1f} {summary.length_unit}",
        f"{summary.duration_s:.1f} s",
        f"{summary.timing.real_time_factor:.1f}",
    )
