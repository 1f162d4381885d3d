"""Pictures and the HTML report of a run, drawn from its output folder; and the live view."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from boxplus._extras import require
from boxplus.errors import InputError

if TYPE_CHECKING:
    from boxplus.report.cameras.visual_data import VisualData
    from boxplus.report.run_data import RunData
    from boxplus.runs.direct.summary import DirectSummary
    from boxplus.runs.slam.result import SlamResult
    from boxplus.runs.visual_inertial.summary import VioSummary

    AnyRun = RunData | VisualData[VioSummary] | VisualData[DirectSummary] | SlamResult


def write_report(run: str | Path | AnyRun) -> Path:
    """Draw `report.html` and the pictures in `plots/` from the output folder of a run, finished or not.

    Args:
        run: the folder, or what `load_report` read from it.

    Returns:
        The path of the report.

    Raises:
        InputError: no run's folder, or a run without a single estimate; matplotlib or plotly is not installed.
        OutputError: the files cannot be written.
    """
    for library in ("matplotlib", "plotly"):
        require(library, "which draws reports")
    from boxplus.report.cameras.direct_page import write_direct_report
    from boxplus.report.cameras.visual_page import write_visual_report
    from boxplus.report.page import write_page
    from boxplus.report.plots import write_plots
    from boxplus.report.run_data import RunData
    from boxplus.report.slam_page import write_slam_report
    from boxplus.runs.slam.result import SlamResult

    data = load_report(run) if isinstance(run, (str, Path)) else run
    if isinstance(data, RunData):
        write_plots(data)
        return write_page(data)
    if isinstance(data, SlamResult):
        write_report(data.folder.odometry.path)
        return write_slam_report(data)
    if data.summary.program == "boxplus vo":
        return write_direct_report(data)
    return write_visual_report(data)


def load_report(folder: str | Path) -> AnyRun:
    """What the report of a run shows, of any kind of odometry, and of one with loop closure.

    Raises:
        InputError: no run's folder, a run without a single estimate, or one whose loops are not closed yet.
    """
    from boxplus.report.cameras.visual_data import load_direct_run, load_visual_run
    from boxplus.report.run_data import load_run
    from boxplus.runs.slam.result import load_slam_result
    from boxplus.runs.storage.output_folder import SUMMARY, program_of

    with suppress(OSError):
        program = program_of(Path(folder) / SUMMARY)
        if program == "boxplus vio":
            return load_visual_run(folder)
        if program == "boxplus vo":
            return load_direct_run(folder)
        if program == "boxplus slam":
            return load_slam_result(folder)
        if program not in (None, "boxplus lio"):
            raise _of_another(Path(folder), program)
    return load_run(folder)


def _of_another(folder: Path, program: str) -> InputError:
    """What to do about the folder of a command whose report is drawn once."""
    page, odometry = folder / "report.html", folder / "odometry"
    advice = "it has no report; run.json has the facts"
    if page.is_file():
        advice = f"open {page}, which that command has drawn"
    elif (odometry / "run.json").is_file():
        advice = f"draw that of its odometry: 'boxplus report {odometry}'"
    elif program in ("boxplus ba", "boxplus pgo"):
        advice = "its command draws its report: run it again, without --no-report"
    return InputError("the output folder of 'boxplus lio', 'slam', 'vio' or 'vo'", f"one of {program!r} ({folder})", advice)
