"""`boxplus vo`: a recording of cameras without an IMU in, a trajectory, a sparse map and a report out."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus.cli.model_options import takes_options
from boxplus.cli.options import (
    RESULTS,
    SETTINGS,
    ConfigOption,
    JsonOption,
    NoReportOption,
    OutputOption,
    OverwriteOption,
    QuietOption,
    ResumeOption,
)
from boxplus.recordings.cameras.options import CameraRecordingOptions

if TYPE_CHECKING:
    from boxplus.runs.direct.summary import DirectSummary


@takes_options(CameraRecordingOptions)
def vo(
    recording: Annotated[
        Path, typer.Argument(help="TUM RGB-D, 7-Scenes, KITTI or EuRoC folder, ROS bag, or images.", metavar="RECORDING")
    ],
    output: OutputOption = None,
    config: ConfigOption = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", help="One setting, e.g. patches=400; may be repeated.", metavar="KEY=VALUE", rich_help_panel=SETTINGS
        ),
    ] = None,
    mono: Annotated[bool, typer.Option("--mono", help="Use the first camera alone; the scale is not known then.")] = False,
    ground_truth: Annotated[
        Path | None,
        typer.Option(
            "--gt",
            help="Trajectory of the camera to compare with: TUM, KITTI, EuRoC or boxplus CSV.",
            rich_help_panel=RESULTS,
        ),
    ] = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
    no_report: NoReportOption = False,
    overwrite: OverwriteOption = False,
    resume: ResumeOption = False,
    *,
    options: CameraRecordingOptions,
) -> None:
    """Turn a recording of an RGB-D camera, a stereo camera or one camera into its trajectory, a sparse map and a report.

    The world is the camera of the first frame; of one camera alone the scale is not known. Exit codes: 0 done, 1 the results
    could not be written, 2 bad input, 3 finished, but not to be trusted (the view was lost, or something contradicts), 130
    interrupted (results up to there are complete).
    """
    from boxplus.cli.cameras.camera_run import run_cameras
    from boxplus.cli.terminal.outcome import reported
    from boxplus.cli.terminal.run_terminal import RunTerminal
    from boxplus.runs.cameras.folder import DirectFolder
    from boxplus.runs.direct.config import DirectRunConfig
    from boxplus.runs.direct.direct_run import run_direct_odometry
    from boxplus.runs.settings_file import load_settings

    overrides: dict[str, dict[str, object]] = {
        "recording": options.model_dump(exclude_defaults=True),
        "streams": {"mono": True} if mono else {},
    }
    run_config = load_settings(DirectRunConfig, config, settings or (), overrides)
    folder = DirectFolder(output or Path(f"{recording.resolve().stem}_boxplus"))
    terminal = RunTerminal(quiet=quiet, as_json=as_json)
    with reported(recording, folder.path, as_json=as_json) as outcome:
        run_cameras(
            recording,
            run_config.recording,
            folder,
            partial(run_direct_odometry, folder=folder, config=run_config),
            _rows,
            lambda summary: "se3" if summary.scale == "metric" else "sim3",
            terminal=terminal,
            outcome=outcome,
            overwrite=overwrite,
            resume=resume,
            ground_truth=ground_truth,
            report=not no_report,
        )


def _rows(summary: DirectSummary) -> list[tuple[str, str]]:
    """What the terminal shows of a run."""
    from boxplus.cli.cameras.camera_run import timing_rows

    rows = []
    if summary.frames_before_start:
        rows.append(("before the start", f"{summary.frames_before_start} frames without a pose"))
    return [*rows, *timing_rows(summary.timing), ("landmarks", f"{summary.landmarks:,} of {summary.keyframes} keyframes")]
