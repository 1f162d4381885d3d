"""A run with cameras on a terminal: evidence, progress, comparison with a ground truth, report, results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeVar

if TYPE_CHECKING:
    from boxplus.cli.terminal.outcome import Outcome
    from boxplus.cli.terminal.run_terminal import RunTerminal
    from boxplus.evaluation.alignment import AlignmentKind
    from boxplus.recordings.cameras.events import CameraRecording
    from boxplus.recordings.cameras.options import CameraRecordingOptions
    from boxplus.runs.cameras.facts import FrameTiming
    from boxplus.runs.cameras.folder import CameraRunFolder
    from boxplus.runs.run_facts import RunFacts
    from boxplus.runs.run_loop import Progress

    SummaryT = TypeVar("SummaryT", bound=RunFacts)
    SummaryT_co = TypeVar("SummaryT_co", bound=RunFacts, covariant=True)

    class Odometry(Protocol[SummaryT_co]):
        """Runs over an opened recording."""

        def __call__(
            self,
            recording: CameraRecording,
            *,
            resume: bool,
            progress: Callable[[Progress], None],
            should_stop: Callable[[], bool],
        ) -> SummaryT_co: ...


FILES = ("report.html", "trajectory.tum", "trajectory.csv", "frames.csv", "landmarks.ply", "evaluation.json", "run.json")


def run_cameras(
    recording: Path,
    options: CameraRecordingOptions,
    folder: CameraRunFolder,
    odometry: Odometry[SummaryT],
    rows: Callable[[SummaryT], Sequence[tuple[str, str]]],
    alignment: Callable[[SummaryT], AlignmentKind],
    *,
    terminal: RunTerminal,
    outcome: Outcome,
    overwrite: bool,
    resume: bool,
    ground_truth: Path | None,
    report: bool,
) -> None:
    """Run an odometry with everything a terminal shows.

    Args:
        odometry: writes into `folder`, which is claimed while it runs.
        rows: name and value of what is shown of its results.
        alignment: what the odometry leaves open, for the comparison with the ground truth.
        outcome: of the run, to be filled in.

    Raises:
        BoxplusError: bad input, or results that cannot be written.
    """
    from boxplus.cli.ground_truth import compare_with, read_ground_truth
    from boxplus.cli.terminal.interrupt import stop_on_interrupt
    from boxplus.recordings.cameras.open import open_camera_recording
    from boxplus.runs.cameras.folder import claim_camera_folder

    truth = read_ground_truth(ground_truth)
    with (
        stop_on_interrupt(terminal.announce_stop) as should_stop,
        open_camera_recording(recording, options) as opened,
        claim_camera_folder(folder, overwrite=overwrite, resume=resume),
    ):
        terminal.print_evidence(opened.info, opened.info.evidence)
        with terminal.progress() as progress:
            summary = odometry(opened, resume=resume, progress=progress, should_stop=should_stop)
        comparison, shown, frames = None, list(rows(summary)), summary.estimates[0]
        if truth is not None and frames:
            comparison = compare_with(truth, folder.trajectory, folder.evaluation, alignment(summary))
            shown.append(comparison.row)
        if report and frames:
            with outcome.drawing(terminal):
                from boxplus.report import write_report

                write_report(folder.path)
    terminal.print_results(summary, shown, folder.path, FILES, doubt=summary.contradiction)
    outcome.end(summary, summary.state, untrusted=summary.contradiction is not None)
    outcome.compare(comparison)


def timing_rows(timing: FrameTiming) -> list[tuple[str, str]]:
    """How long it took."""
    from boxplus.cli.terminal.run_terminal import speed_text

    rows = []
    if timing.frame_ms is not None:
        ms = timing.frame_ms
        text = f"median {ms.median:.1f} ms, mean {ms.mean:.1f} ms, 99th percentile {ms.p99:.1f} ms"
        rows.append(("per frame", text))
    rows.append(("speed", speed_text(timing.real_time_factor, timing.total_s, timing.compiled_kernels)))
    return rows
