"""`boxplus lio`: recordings in, of each a trajectory, a map and a report out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus.cli import leave
from boxplus.cli.model_options import takes_recording_options
from boxplus.cli.options import (
    RESULTS,
    ConfigOption,
    GroundTruthOption,
    JsonOption,
    MountingOption,
    NoMapOption,
    NoReportOption,
    OverwriteOption,
    QuietOption,
    ResumeOption,
    SettingsOption,
    ThreadsOption,
    odometry_overrides,
    with_default_threads,
)
from boxplus.cli.viewing import ViewOption, viewing
from boxplus.errors import InputError
from boxplus.recordings.options import RecordingOptions

if TYPE_CHECKING:
    from boxplus.cli.run_terminal import RunTerminal
    from boxplus.formats.trajectory import Trajectory
    from boxplus.runs.lidar_inertial.config import RunConfig
    from boxplus.runs.lidar_inertial.summary import RunSummary


@takes_recording_options
def lio(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            help="ROS 1 bag, ROS 2 folder or file, KITTI raw folder, or pcap; several, or a folder of them.", metavar="RECORDING"
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Folder for the results, of several recordings with one for each in it; default: RECORDING_boxplus here.",
            rich_help_panel=RESULTS,
        ),
    ] = None,
    config: ConfigOption = None,
    settings: SettingsOption = None,
    T_imu_lidar: MountingOption = None,
    threads: ThreadsOption = None,
    ground_truth: GroundTruthOption = None,
    view: ViewOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
    no_map: NoMapOption = False,
    no_report: NoReportOption = False,
    overwrite: OverwriteOption = False,
    resume: ResumeOption = False,
    *,
    options: RecordingOptions,
) -> None:
    """Turn a recording into a trajectory, a map and a report.

    No configuration is needed: topics, times and units are found from the data, with the evidence printed. Of several recordings
    one that fails leaves the others unharmed, and a table at the end says how each came out. Exit codes: 0 done, 1 the results
    could not be written, 2 bad input, 3 finished, but not to be trusted (the sensors contradict each other; of several
    recordings, one failed or is not to be trusted), 130 interrupted (results up to there are complete).
    """
    from boxplus.cli.lidar.several import run_several, several_recordings
    from boxplus.cli.run_terminal import RunTerminal
    from boxplus.formats.trajectory import read_trajectory
    from boxplus.runs.lidar_inertial.config import load_run_config

    overrides: dict[str, dict[str, object]] = {
        "recording": options.model_dump(exclude_defaults=True),
        "odometry": odometry_overrides(T_imu_lidar, threads),
        "map": {"save": False} if no_map else {},
    }
    run_config = with_default_threads(load_run_config(config, settings or (), overrides))
    truth = None if ground_truth is None else read_trajectory(ground_truth)  # a wrong file is better refused before the run
    terminal = RunTerminal(quiet=quiet, as_json=as_json)

    def run_one(recording: Path, folder: Path) -> RunSummary:
        return run(
            recording,
            folder,
            run_config,
            terminal=terminal,
            ground_truth=truth,
            overwrite=overwrite,
            resume=resume,
            view=view,
            report=not no_report,
        )

    several = several_recordings(recordings)
    if several is not None:
        if view is not None or truth is not None:
            raise InputError("one recording with --view or --gt", f"{len(several)}", "run them one by one, or leave it out")
        raise typer.Exit(run_several(several, output, run_one, terminal, as_json=as_json))
    recording = recordings[0]
    summary = run_one(recording, output or Path(f"{recording.resolve().stem}_boxplus"))
    if as_json:
        typer.echo(summary.model_dump_json(indent=2))
    leave(summary.state, untrusted=summary.contradiction is not None)


def run(
    recording: Path,
    folder: Path,
    config: RunConfig,
    *,
    terminal: RunTerminal | None = None,
    ground_truth: Trajectory | None = None,
    overwrite: bool = False,
    resume: bool = False,
    view: str | None = None,
    report: bool = True,
) -> RunSummary:
    """Run the odometry with everything a terminal shows: evidence, progress, results.

    Raises:
        BoxplusError: bad input, or results that cannot be written; after everything else, a ground truth that the trajectory
            cannot be compared with.
    """
    from boxplus.cli.ground_truth import compare_with
    from boxplus.cli.interrupt import stop_on_interrupt
    from boxplus.cli.run_terminal import RunTerminal
    from boxplus.recordings import open_recording
    from boxplus.recordings.info import Evidence
    from boxplus.runs.lidar_inertial.extrinsic import choose_extrinsic
    from boxplus.runs.lidar_inertial.odometry_run import run_odometry
    from boxplus.runs.run_folder import claim_run_folder

    terminal = terminal or RunTerminal()
    with (
        viewing("LiveView", recording.name, view) as shown,
        stop_on_interrupt(terminal.announce_stop) as should_stop,
        open_recording(recording, config.recording) as opened,
        claim_run_folder(folder, overwrite=overwrite, resume=resume) as claimed,
    ):
        with terminal.status("comparing gyroscope and LiDAR to find the extrinsic"):
            extrinsic = choose_extrinsic(opened, config.odometry)
        mounting = Evidence(
            "T_imu_lidar", extrinsic.source, "warning" if extrinsic.warning else "ok", extrinsic.warning or extrinsic.text
        )
        found = [entry for entry in opened.info.evidence if entry.key != "T_imu_lidar"]
        terminal.print_evidence(opened.info, [*found, mounting])
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
        rows, incomparable = _rows(summary), None
        if ground_truth is not None and summary.scans:
            try:
                rows.append(("against --gt", compare_with(ground_truth, claimed.trajectory, claimed.evaluation, "se3")))
            except InputError as error:  # the run is as good as without it
                incomparable = error
    files = ("report.html", "trajectory.tum", "trajectory.csv", "map.ply", "evaluation.json", "run.json")
    terminal.print_results(summary, rows, folder, files)
    if incomparable is not None:
        raise incomparable
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
