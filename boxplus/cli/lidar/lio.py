"""`boxplus lio`: a recording in, a trajectory, a map and a report out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus.cli.options import takes_recording_options, with_default_threads
from boxplus.cli.viewing import ViewOption, viewing
from boxplus.recordings.options import RecordingOptions

if TYPE_CHECKING:
    from boxplus.runs.lidar_inertial.config import RunConfig
    from boxplus.runs.lidar_inertial.summary import RunSummary


@takes_recording_options
def lio(
    recording: Annotated[Path, typer.Argument(help="ROS 1 bag, ROS 2 folder or file, KITTI raw folder, or pcap.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for the results; default: RECORDING_boxplus here.")
    ] = None,
    config: Annotated[
        Path | None, typer.Option("--config", help="YAML file with settings, e.g. the config.yaml of a run.")
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="One setting, e.g. scan_voxel=0.5; may be repeated.", metavar="KEY=VALUE")
    ] = None,
    T_imu_lidar: Annotated[
        str | None,
        typer.Option(
            "--T-imu-lidar",
            help="Pose of the LiDAR in the IMU frame (p_imu = T p_lidar): 16 numbers row by row, 'xyz_qwxyz: x y z qw qx qy qz', "
            "'xyz_qxyzw: …', 'xyz_rpy_deg: x y z roll pitch yaw', or a file with one of these.",
        ),
    ] = None,
    threads: Annotated[
        int | None, typer.Option("--threads", min=1, help="Threads; default 2. The result does not depend on it.")
    ] = None,
    view: ViewOption = None,
    no_map: Annotated[bool, typer.Option("--no-map", help="Write no map.")] = False,
    no_report: Annotated[bool, typer.Option("--no-report", help="Draw no report.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the results of an earlier run.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a run that was killed or interrupted.")] = False,
    *,
    options: RecordingOptions,
) -> None:
    """Turn a recording into a trajectory, a map and a report.

    No configuration is needed: topics, times and units are found from the data, with the evidence printed. Exit codes: 0 done,
    1 the results could not be written, 2 bad input, 3 finished, but not to be trusted (the sensors contradict each other), 130
    interrupted (results up to there are complete).
    """
    from boxplus.runs.lidar_inertial.config import load_run_config
    from boxplus.runs.transform import parse_transform

    odometry: dict[str, object] = {}
    if T_imu_lidar is not None:
        odometry["T_imu_lidar"] = parse_transform(T_imu_lidar).tolist()
    if threads is not None:
        odometry["threads"] = threads
    overrides: dict[str, dict[str, object]] = {
        "recording": options.model_dump(exclude_defaults=True),
        "odometry": odometry,
        "map": {"save": False} if no_map else {},
    }
    run_config = with_default_threads(load_run_config(config, settings or (), overrides))
    folder = output or Path(f"{recording.resolve().stem}_boxplus")
    summary = run(recording, folder, run_config, overwrite=overwrite, resume=resume, view=view, report=not no_report)
    if summary.state == "interrupted":
        raise typer.Exit(130)
    if summary.contradiction is not None:
        raise typer.Exit(3)


def run(
    recording: Path,
    folder: Path,
    config: RunConfig,
    *,
    overwrite: bool = False,
    resume: bool = False,
    view: str | None = None,
    report: bool = True,
) -> RunSummary:
    """Run the odometry with everything a terminal shows: evidence, progress, results.

    Raises:
        BoxplusError: bad input, or results that cannot be written.
    """
    from boxplus.cli.run_terminal import RunTerminal, stop_on_interrupt
    from boxplus.recordings import open_recording
    from boxplus.recordings.info import Evidence
    from boxplus.runs.lidar_inertial.extrinsic import choose_extrinsic
    from boxplus.runs.lidar_inertial.odometry_run import run_odometry
    from boxplus.runs.run_folder import claim_run_folder

    terminal = RunTerminal()
    with (
        viewing("LiveView", recording.name, view) as shown,
        stop_on_interrupt(terminal.announce_stop) as should_stop,
        open_recording(recording, config.recording) as opened,
        claim_run_folder(folder, overwrite=overwrite, resume=resume) as claimed,
    ):
        with terminal.status("comparing gyroscope and LiDAR to find the extrinsic"):
            extrinsic = choose_extrinsic(opened, config.odometry)
        info = opened.info
        mounting = Evidence(
            "T_imu_lidar", extrinsic.source, "warning" if extrinsic.warning else "ok", extrinsic.warning or extrinsic.text
        )
        terminal.print_evidence(
            info.path,
            f"{info.format}, {info.duration_s:.1f} s, {info.message_count} messages",
            [*(entry for entry in info.evidence if entry.key != "T_imu_lidar"), mounting],
        )
        with terminal.progress() as progress:
            summary = run_odometry(
                opened,
                claimed,
                config,
                extrinsic=extrinsic,
                resume=resume,
                progress=progress,
                view=shown,
                should_stop=should_stop,
            )
        if report and summary.scans:
            from boxplus.report import write_report

            with terminal.status("drawing the report"):
                write_report(folder)
    files = ("report.html", "trajectory.tum", "trajectory.csv", "map.ply", "run.json")
    terminal.print_results(summary, _rows(summary), folder, files)
    return summary


def _rows(summary: RunSummary) -> list[tuple[str, str]]:
    """What the terminal shows of a run of LiDAR and IMU."""
    from boxplus.cli.run_terminal import speed_text

    timing, rows = summary.timing, []
    if timing.scan_ms is not None:
        rows.append(("per scan", f"median {timing.scan_ms.median:.1f} ms, 99th percentile {timing.scan_ms.p99:.1f} ms"))
    rows.append(("speed", speed_text(timing.real_time_factor, timing.total_s, timing.compiled_kernels)))
    for lidar in summary.lidars[1:]:
        rows.append((f"LiDAR {lidar.topic}", f"{lidar.merged_points:,} points merged; against the first: {lidar.checked}"))
    rows.append(("map", f"{summary.map.stored_points:,} points" if summary.map.stored_points else "not kept"))
    return rows
