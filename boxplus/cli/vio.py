"""`boxplus vio`: a recording of cameras and an IMU in, a trajectory, landmarks and a report out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus.cli.options import takes_options
from boxplus.recordings.cameras.options import CameraRecordingOptions

if TYPE_CHECKING:
    from boxplus.evaluation.evaluation import Evaluation
    from boxplus.formats.trajectory import Trajectory
    from boxplus.runs.visual_inertial.config import VioRunConfig
    from boxplus.runs.visual_inertial.summary import VioSummary


@takes_options(CameraRecordingOptions)
def vio(
    recording: Annotated[Path, typer.Argument(help="ROS 1 bag, ROS 2 folder or file, EuRoC folder, or images with an IMU.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for the results; default: RECORDING_boxplus here.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", help="YAML file with settings, e.g. the config.yaml of a run.")
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="One setting, e.g. features=200; may be repeated.", metavar="KEY=VALUE")
    ] = None,
    mono: Annotated[bool, typer.Option("--mono", help="Use the first camera alone; the accelerometer gives the scale.")] = False,
    ground_truth: Annotated[
        Path | None, typer.Option("--gt", help="Ground truth to compare with: TUM, KITTI, EuRoC or boxplus CSV.")
    ] = None,
    no_report: Annotated[bool, typer.Option("--no-report", help="Draw no report.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the results of an earlier run.")] = False,
    *,
    options: CameraRecordingOptions,
) -> None:
    """Turn a recording of one or more cameras and an IMU into a trajectory, landmarks and a report.

    Calibration comes from the recording or from --calibration, and is never guessed. Exit codes: 0 done, 1 the results
    could not be written, 2 bad input, 3 finished, but not to be trusted (the sensors contradict each other), 130
    interrupted (results up to there are complete).
    """
    from boxplus.cli import EXIT_INTERRUPTED, EXIT_UNTRUSTED
    from boxplus.runs.settings_file import load_settings
    from boxplus.runs.visual_inertial.config import VioRunConfig

    overrides: dict[str, dict[str, object]] = {
        "recording": options.model_dump(exclude_defaults=True),
        "odometry": {"cameras": "first"} if mono else {},
    }
    run_config = load_settings(VioRunConfig, config, settings or (), overrides)
    folder = output or Path(f"{recording.resolve().stem}_boxplus")
    summary = run(recording, folder, run_config, overwrite=overwrite, ground_truth=ground_truth, report=not no_report)
    if summary.state == "interrupted":
        raise typer.Exit(EXIT_INTERRUPTED)
    if summary.contradiction is not None:
        raise typer.Exit(EXIT_UNTRUSTED)


def run(
    recording: Path,
    folder: Path,
    config: VioRunConfig,
    *,
    overwrite: bool = False,
    ground_truth: Path | None = None,
    report: bool = True,
) -> VioSummary:
    """Run the odometry with everything a terminal shows: evidence, progress, results.

    Raises:
        BoxplusError: bad input, or results that cannot be written.
    """
    from boxplus.cli.run_terminal import RunTerminal, stop_on_interrupt
    from boxplus.formats.trajectory import read_trajectory
    from boxplus.recordings.cameras.open import open_camera_recording
    from boxplus.runs.visual_inertial.vio_folder import claim_vio_folder
    from boxplus.runs.visual_inertial.visual_run import run_visual_odometry

    terminal = RunTerminal()
    truth = None if ground_truth is None else read_trajectory(ground_truth)  # a wrong file is better refused before the run
    with (
        stop_on_interrupt(terminal.announce_stop) as should_stop,
        open_camera_recording(recording, config.recording) as opened,
        claim_vio_folder(folder, overwrite=overwrite) as claimed,
    ):
        info = opened.info
        facts = f"{info.format}, {info.duration_s:.1f} s, {info.message_count} messages"
        terminal.print_evidence(info.path, facts, info.evidence)
        with terminal.progress() as progress:
            summary = run_visual_odometry(opened, claimed, config, progress=progress, should_stop=should_stop)
        rows = _rows(summary)
        if truth is not None and summary.frames:
            evaluation = _compared(claimed.trajectory, truth)
            rows.append(("against --gt", f"{evaluation.title}: {evaluation.ate.line('m')}"))
            _write_json(claimed.evaluation, evaluation)
        if report and summary.frames:
            from boxplus.report import write_report

            with terminal.status("drawing the report"):
                write_report(folder)
    files = ("report.html", "trajectory.tum", "trajectory.csv", "frames.csv", "landmarks.ply", "evaluation.json", "run.json")
    terminal.print_results(summary, rows, folder, files)
    return summary


def _compared(trajectory: Path, truth: Trajectory) -> Evaluation:
    """Position and yaw aligned, which is what an estimator with gravity leaves open."""
    from boxplus.evaluation.evaluation import evaluate
    from boxplus.formats.trajectory import read_trajectory

    return evaluate(read_trajectory(trajectory), truth, alignment="yaw", method="interpolate")


def _write_json(path: Path, evaluation: Evaluation) -> None:
    from boxplus.formats.output import atomic_file

    with atomic_file(path) as file:
        file.write(f"{json.dumps(evaluation.to_dict(), indent=2)}\n".encode())


def _rows(summary: VioSummary) -> list[tuple[str, str]]:
    """What the terminal shows of a run of cameras and IMU."""
    from boxplus.cli.run_terminal import speed_text

    timing, rows = summary.timing, []
    if summary.frames_before_start:
        rows.append(("before the start", f"{summary.frames_before_start} frames without a state"))
    if timing.frame_ms is not None:
        rows.append(("per frame", f"median {timing.frame_ms.median:.1f} ms, 99th percentile {timing.frame_ms.p99:.1f} ms"))
    rows.append(("speed", speed_text(timing.real_time_factor, timing.total_s, timing.compiled_kernels)))
    rows.append(("landmarks", f"{summary.landmarks:,} of {summary.keyframes} keyframes"))
    return rows
