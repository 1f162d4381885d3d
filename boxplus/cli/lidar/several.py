"""Several recordings one after the other: one that fails leaves the others unharmed, and a table says how each came out."""

from __future__ import annotations

import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, cast

from boxplus.cli import EXIT_INTERRUPTED, EXIT_UNTRUSTED
from boxplus.cli.terminal.interrupt import stop_on_interrupt
from boxplus.cli.terminal.outcome import Outcome
from boxplus.errors import BoxplusError, InputError

if TYPE_CHECKING:
    from boxplus.cli.terminal.run_terminal import RunTerminal
    from boxplus.runs.lidar_inertial.summary import RunSummary

    RunOne = Callable[[Path, Path, Outcome, Callable[[], bool]], None]

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
        listed = " and no ".join(map(str, missing))
        raise InputError(
            "recordings that are there", f"no file or folder {listed}", "check the path, nothing was run; results go to -o FOLDER"
        )
    return named(given)


def run_several(
    recordings: dict[str, Path],
    output: Path | None,
    run_one: RunOne,
    terminal: RunTerminal,
    *,
    as_json: bool,
) -> int:
    """Run them and print the table; returns the exit code.

    Args:
        recordings: by name.
        output: each gets a folder with its name in it; None for NAME_boxplus here.
        run_one: runs a recording into a folder and says what became of it; it asks whether to stop.
        as_json: print a line for each as it ends, and for those that were not begun.
    """
    outcomes: dict[str, Outcome] = {}
    with stop_on_interrupt(terminal.announce_stop) as should_stop:
        for name, recording in recordings.items():
            folder = Path(f"{name}_boxplus") if output is None else output / name
            outcome = outcomes[name] = Outcome(input=str(recording), output=str(folder))
            if not should_stop():
                _run(recording, folder, run_one, outcome, should_stop)
            if as_json:
                outcome.print_json()
        stopped = should_stop()
    terminal.print_table(_HEADINGS, [(name, *_row(outcome)) for name, outcome in outcomes.items()])
    for name, outcome in outcomes.items():
        if outcome.error is not None:
            terminal.print_failure(name, outcome.error)
    if stopped:
        return EXIT_INTERRUPTED
    return EXIT_UNTRUSTED if any(outcome.exit_code for outcome in outcomes.values()) else 0


def _run(
    recording: Path,
    folder: Path,
    run_one: RunOne,
    outcome: Outcome,
    should_stop: Callable[[], bool],
) -> None:
    """One of them, whatever becomes of it."""
    log = folder.with_name(f"{folder.name}.traceback.txt")
    try:
        log.unlink(missing_ok=True)  # of an earlier run
        run_one(recording, folder, outcome, should_stop)
    except (BoxplusError, KeyboardInterrupt) as error:
        outcome.stop(error)
    except Exception as error:  # noqa: BLE001 - nobody foresaw it: the others have nothing to do with it
        outcome.stop(error)
        where = "its traceback could not be written"
        with suppress(OSError):
            folder.parent.mkdir(parents=True, exist_ok=True)
            log.write_text(traceback.format_exc(), encoding="utf-8")
            where = f"{log} says where"
        outcome.error = f"{outcome.error} (an error of boxplus: {where})"


def _row(outcome: Outcome) -> tuple[str, ...]:
    if outcome.run is None:
        return outcome.outcome, *[""] * 6
    summary = cast("RunSummary", outcome.run)
    bad = sum(count for status, count in summary.status.items() if status != "ok")
    return (
        outcome.outcome,
        str(summary.scans),
        str(bad),
        f"{summary.path_length_m:.1f} {summary.length_unit}",
        f"{summary.duration_s:.1f} s",
        f"{summary.timing.real_time_factor:.1f}",
        str(outcome.output),
    )
