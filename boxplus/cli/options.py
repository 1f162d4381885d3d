"""Options that several commands share: settings, results, what is printed."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from boxplus._extras import has, installation

if TYPE_CHECKING:
    from pydantic import BaseModel

    from boxplus.runs.lidar_inertial.config import RunConfig

ConfigT = TypeVar("ConfigT", bound="RunConfig")

RESULTS, SETTINGS, PRINTING = "Results", "Settings", "On the terminal"


def without_report(wanted: bool) -> bool:
    """As asked for, and where a report cannot be drawn: that is said before the run, which is worth as much without."""
    if not wanted and not has("matplotlib", "plotly"):
        typer.echo(f"warning: no report is drawn, for want of matplotlib or plotly: {installation('report')}", err=True)
        return True
    return wanted


def one_of_the_two(context: typer.Context, wanted: bool) -> bool:
    """`--overwrite` and `--resume`: whichever is read last sees the other one."""
    if wanted and (context.params.get("overwrite") or context.params.get("resume")):
        from boxplus.runs.storage.output_folder import refuse_both

        refuse_both(overwrite=True, resume=True)
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
        "'xyz_qxyzw: …', 'xyz_rpy_deg: x y z roll pitch yaw', 'xyz: x y z' without a turn, or a file with one of these.",
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
    bool,
    typer.Option("--overwrite", callback=one_of_the_two, help="Replace the results of an earlier run.", rich_help_panel=RESULTS),
]
ResumeOption = Annotated[
    bool,
    typer.Option(
        "--resume",
        callback=one_of_the_two,
        help="Go on with a run that was killed or interrupted.",
        rich_help_panel=RESULTS,
    ),
]
JsonOption = Annotated[
    bool,
    typer.Option(
        "--json",
        help="Print what became of it as a line of JSON on the standard output, and everything else on the standard error.",
        rich_help_panel=PRINTING,
    ),
]
GroundTruthOption = Annotated[
    Path | None,
    typer.Option(
        "--gt", help="Ground truth to compare with at the end: TUM, KITTI, EuRoC or boxplus CSV.", rich_help_panel=RESULTS
    ),
]


class SaveScans(StrEnum):
    """Frames of clouds of single scans."""

    body = "body"
    world = "world"


SaveScansOption = Annotated[
    SaveScans | None,
    typer.Option(
        "--save-scans",
        help="Write every scan of the odometry, corrected for motion, as a cloud of its own, scans/TIME_NS.pcd: in the frame of "
        "the body, at its pose, or of the world; other formats: --set scans.ending=ply.",
        rich_help_panel=RESULTS,
    ),
]
QuietOption = Annotated[
    bool,
    typer.Option("--quiet", "-q", help="Print warnings and errors only, on the standard error.", rich_help_panel=PRINTING),
]


def default_threads() -> int:
    """Two, where the machine has them."""
    return min(2, os.cpu_count() or 1)


def scan_settings(save_scans: SaveScans | None) -> dict[str, object]:
    """What `--save-scans` sets."""
    return {} if save_scans is None else {"frame": save_scans.value}


def lidar_settings(
    load: Callable[[Path | None, Iterable[str], dict[str, dict[str, object]]], ConfigT],
    config: Path | None,
    settings: list[str] | None,
    options: BaseModel,
    T_imu_lidar: str | None,
    threads: int | None,
    **sections: dict[str, object],
) -> ConfigT:
    """The settings of a run with a LiDAR: those of `--config`, then `--set`, then the other options.

    Args:
        load: of this kind of run.
        options: how the recording is read.
        sections: what the command's own options change.

    Raises:
        InputError: an unknown setting or value, no pose, or one whose order nobody can tell.
    """
    odometry: dict[str, object] = {} if threads is None else {"threads": threads}
    if T_imu_lidar is not None:
        from boxplus.runs.transform import parse_transform

        odometry["T_imu_lidar"] = parse_transform(T_imu_lidar).tolist()
    overrides = {"recording": options.model_dump(exclude_defaults=True), "odometry": odometry, **sections}
    found = load(config, settings or (), overrides)
    if "threads" in found.odometry.model_fields_set:
        return found
    return found.model_copy(update={"odometry": found.odometry.model_copy(update={"threads": default_threads()})})
