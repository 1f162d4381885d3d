"""`boxplus vio`: a recording of cameras and an IMU in, a trajectory, landmarks and a report out."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus.cli.model_options import takes_options
from boxplus.cli.options import (
    SETTINGS,
    ConfigOption,
    GroundTruthOption,
    JsonOption,
    NoReportOption,
    OutputOption,
    OverwriteOption,
    QuietOption,
    ResumeOption,
)
from boxplus.cli.terminal.viewing import ViewOption, viewing
from boxplus.recordings.cameras.options import CameraRecordingOptions

if TYPE_CHECKING:
    from boxplus.runs.visual_inertial.summary import VioSummary


@takes_options(CameraRecordingOptions)
def vio(
    recording: Annotated[
        Path, typer.Argument(help="ROS 1 bag, ROS 2 folder or file, EuRoC folder, or images with an IMU.", metavar="RECORDING")
    ],
    output: OutputOption = None,
    config: ConfigOption = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", help="One setting, e.g. features=200; may be repeated.", metavar="KEY=VALUE", rich_help_panel=SETTINGS
        ),
    ] = None,
    mono: Annotated[bool, typer.Option("--mono", help="Use the first camera alone; the accelerometer gives the scale.")] = False,
    lines: Annotated[
        bool,
        typer.Option("--lines", help="Follow straight lines too: where walls are bare. Takes longer."),
    ] = False,
    ground_truth: GroundTruthOption = None,
    view: ViewOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
    no_report: NoReportOption = False,
    overwrite: OverwriteOption = False,
    resume: ResumeOption = False,
    *,
    options: CameraRecordingOptions,
) -> None:
    """Turn a recording of one or more cameras and an IMU into a trajectory, landmarks and a report.

    Calibration comes from the recording or from --calibration, and is never guessed. Exit codes: 0 done, 1 the results
    could not be written, 2 bad input, 3 finished, but not to be trusted (the sensors contradict each other), 130
    interrupted (results up to there are complete).
    """
    from boxplus.cli.cameras.camera_run import run_cameras
    from boxplus.cli.terminal.outcome import reported
    from boxplus.cli.terminal.run_terminal import RunTerminal
    from boxplus.recordings.cameras.open import has_no_imu
    from boxplus.runs.cameras.folder import VioFolder
    from boxplus.runs.settings_file import load_settings
    from boxplus.runs.visual_inertial.config import VioRunConfig
    from boxplus.runs.visual_inertial.rig_of_recording import cameras_alone
    from boxplus.runs.visual_inertial.visual_run import run_visual_odometry

    overrides: dict[str, dict[str, object]] = {
        "recording": options.model_dump(exclude_defaults=True),
        "odometry": ({"cameras": "first"} if mono else {}) | ({"lines": True} if lines else {}),
    }
    run_config = load_settings(VioRunConfig, config, settings or (), overrides)
    folder = VioFolder(output or Path(f"{recording.resolve().stem}_boxplus"))
    terminal = RunTerminal(quiet=quiet, as_json=as_json)
    with ExitStack() as stack:
        outcome = stack.enter_context(reported(recording, folder.path, as_json=as_json))
        if has_no_imu(recording):
            raise cameras_alone(recording)
        shown = stack.enter_context(viewing("LiveCameraView", recording.name, view))
        run_cameras(
            recording,
            run_config.recording,
            folder,
            partial(run_visual_odometry, folder=folder, config=run_config, view=shown),
            _rows,
            lambda _: "yaw",  # position and yaw are what an estimator with gravity leaves open
            terminal=terminal,
            outcome=outcome,
            overwrite=overwrite,
            resume=resume,
            ground_truth=ground_truth,
            report=not no_report,
        )


def _rows(summary: VioSummary) -> list[tuple[str, str]]:
    """What the terminal shows of a run of cameras and IMU."""
    from boxplus.cli.cameras.camera_run import timing_rows

    rows = []
    if summary.frames_before_start:
        rows.append(("before the start", f"{summary.frames_before_start} frames without a state"))
    rows += timing_rows(summary.timing)
    if summary.lengths is not None:
        rows.append(("lengths", summary.lengths.text))
    rows.append(("landmarks", f"{summary.landmarks:,} of {summary.keyframes} keyframes"))
    if summary.lines:
        rows.append(("lines", f"{summary.lines:,}"))
    return rows
