"""Options that several commands share: settings, results, what is printed."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from boxplus._extras import has

if TYPE_CHECKING:
    from boxplus.runs.lidar_inertial.config import RunConfig

ConfigT = TypeVar("ConfigT", bound="RunConfig")

RESULTS, SETTINGS, PRINTING = "Results", "Settings", "On the terminal"


def without_report(wanted: bool) -> bool:
    """As asked for, and where a report cannot be drawn: that is said before the run, which is worth as much without."""
    if not wanted and not has("matplotlib", "plotly"):
        typer.echo("warning: no report is drawn, for want of matplotlib or plotly: pip install 'boxplus[report]'", err=True)
        return True
    return wanted


RecordingArgument = Annotated[
    Path, typer.Argument(help="ROS 1 bag, ROS 2 folder or file, KITTI raw folder, or pcap.", metavar="RECORDING")
]
OutputOption = Annotated[
    Path | None,
    typer.Option("--output", "-o", help="Folder for the results; default: RECORDING_boxplus here.", rich_help_panel=RESULTS),
]
ConfigOption = Annotated[
    Path | None,
    typer.Option("--config", help="YAML file with settings, e.g. the config.yaml of a run.", rich_help_panel=SETTINGS),
]
SettingsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="One setting, with its section or without: scan_voxel=0.5, map.voxel=0.2; may be repeated.",
        metavar="KEY=VALUE",
        rich_help_panel=SETTINGS,
    ),
]
MountingOption = Annotated[
    str | None,
    typer.Option(
        "--T-imu-lidar",
        help="Pose of the LiDAR in the IMU frame (p_imu = T p_lidar): 16 numbers row by row, 'xyz_qwxyz: x y z qw qx qy qz', "
        "'xyz_qxyzw: …', 'xyz_rpy_deg: x y z roll pitch yaw', or a file with one of these.",
        metavar="POSE",
        rich_help_panel=SETTINGS,
    ),
]
ThreadsOption = Annotated[
    int | None,
    typer.Option("--threads", min=1, help="Threads; default 2. The result does not depend on it.", rich_help_panel=SETTINGS),
]
NoMapOption = Annotated[bool, typer.Option("--no-map", help="Write no map.", rich_help_panel=RESULTS)]
NoReportOption = Annotated[
    bool, typer.Option("--no-report", callback=without_report, help="Draw no report.", rich_help_panel=RESULTS)
]
OverwriteOption = Annotated[
    bool, typer.Option("--overwrite", help="Replace the results of an earlier run.", rich_help_panel=RESULTS)
]
ResumeOption = Annotated[
    bool, typer.Option("--resume", help="Go on with a run that was killed or interrupted.", rich_help_panel=RESULTS)
]
JsonOption = Annotated[
    bool,
    typer.Option(
        "--json",
        help="Print run.json on the standard output, and everything else on the standard error.",
        rich_help_panel=PRINTING,
    ),
]
GroundTruthOption = Annotated[
    Path | None,
    typer.Option(
        "--gt", help="Ground truth to compare with at the end: TUM, KITTI, EuRoC or boxplus CSV.", rich_help_panel=RESULTS
    ),
]
QuietOption = Annotated[
    bool,
    typer.Option("--quiet", "-q", help="Print warnings and errors only, on the standard error.", rich_help_panel=PRINTING),
]


def odometry_overrides(T_imu_lidar: str | None, threads: int | None) -> dict[str, object]:
    """What `--T-imu-lidar` and `--threads` change of the odometry's settings.

    Raises:
        InputError: no pose, or one whose order nobody can tell.
    """
    from boxplus.runs.transform import parse_transform

    given: dict[str, object] = {} if threads is None else {"threads": threads}
    return given if T_imu_lidar is None else {**given, "T_imu_lidar": parse_transform(T_imu_lidar).tolist()}


def with_default_threads(config: ConfigT) -> ConfigT:
    """Two threads for the odometry, where the machine has them and neither an option nor a file says how many."""
    if "threads" in config.odometry.model_fields_set:
        return config
    both = {"threads": min(2, os.cpu_count() or 1)}
    return config.model_copy(update={"odometry": config.odometry.model_copy(update=both)})
