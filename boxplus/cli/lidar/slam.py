"""`boxplus slam`: a recording in, a trajectory and a map with loops closed out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus.cli.lidar.mounting import find_mounting, print_evidence
from boxplus.cli.model_options import takes_recording_options
from boxplus.cli.options import (
    RESULTS,
    SETTINGS,
    ConfigOption,
    GroundTruthOption,
    JsonOption,
    MountingOption,
    NoMapOption,
    NoReportOption,
    OverwriteOption,
    QuietOption,
    RecordingArgument,
    ResumeOption,
    SaveScansOption,
    SettingsOption,
    ThreadsOption,
    lidar_settings,
    scan_settings,
)
from boxplus.cli.terminal.viewing import ViewOption, viewing
from boxplus.recordings.options import RecordingOptions

if TYPE_CHECKING:
    from boxplus.cli.ground_truth import Comparison
    from boxplus.formats.trajectory import Trajectory
    from boxplus.runs.slam.result import SlamResult
    from boxplus.runs.slam.summary import GnssFacts


@takes_recording_options
def slam(
    recording: RecordingArgument,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder for the results; default: RECORDING_slam here.", rich_help_panel=RESULTS),
    ] = None,
    loops: Annotated[
        Path | None,
        typer.Option(
            "--loops", help="YAML file of loops to forbid or to force, pairs as in loops.csv.", rich_help_panel=SETTINGS
        ),
    ] = None,
    config: ConfigOption = None,
    settings: SettingsOption = None,
    T_imu_lidar: MountingOption = None,
    threads: ThreadsOption = None,
    ground_truth: GroundTruthOption = None,
    gnss_lever_arm: Annotated[
        str | None,
        typer.Option(
            "--gnss-lever-arm",
            help="Antenna of the satellite receiver in the IMU frame, x,y,z [m].",
            metavar="X,Y,Z",
            rich_help_panel=SETTINGS,
        ),
    ] = None,
    utm: Annotated[
        bool, typer.Option("--utm", help="Write the trajectory in UTM, too (extra gnss).", rich_help_panel=RESULTS)
    ] = False,
    save_scans: SaveScansOption = None,
    no_map: NoMapOption = False,
    no_report: NoReportOption = False,
    view: ViewOption = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
    overwrite: OverwriteOption = False,
    resume: ResumeOption = False,
    *,
    options: RecordingOptions,
) -> None:
    """Turn a recording into a trajectory and a map, with loops closed.

    The odometry of 'boxplus lio', with its results in the folder odometry/, and beside it the places that were seen again:
    corrected trajectory and map, and every loop that was looked at in loops.csv and in the report. Exit codes: as 'boxplus lio',
    and 3 also where the odometry slipped between local maps, or loops that fit contradict it.
    """
    from boxplus.runs.slam.config import load_slam_config
    from boxplus.runs.slam.loop_file import read_loop_decisions
    from boxplus.sensors.satellites.gnss import antenna_offset

    gnss: dict[str, object] = {"utm": True} if utm else {}
    if gnss_lever_arm is not None:
        gnss["lever_arm"] = antenna_offset(gnss_lever_arm).tolist()
    kept: dict[str, object] = {"save": False} if no_map else {}
    run_config = lidar_settings(
        load_slam_config, config, settings, options, T_imu_lidar, threads, gnss=gnss, map=kept, scans=scan_settings(save_scans)
    )
    forbidden, forced = read_loop_decisions(loops) if loops is not None else ([], [])
    folder = output or Path(f"{recording.resolve().stem}_slam")

    from boxplus.cli.ground_truth import read_ground_truth
    from boxplus.cli.terminal.interrupt import stop_on_interrupt
    from boxplus.cli.terminal.outcome import reported
    from boxplus.cli.terminal.run_terminal import RunTerminal
    from boxplus.recordings import open_recording
    from boxplus.runs.slam.folder import claim_slam_folder
    from boxplus.runs.slam.slam_run import run_slam

    terminal = RunTerminal(quiet=quiet, as_json=as_json)
    with reported(recording, folder, as_json=as_json) as outcome:
        truth = read_ground_truth(ground_truth)
        with (
            viewing("LiveView", recording.name, view) as shown,
            stop_on_interrupt(terminal.announce_stop) as should_stop,
            open_recording(recording, run_config.recording) as opened,
            claim_slam_folder(folder, overwrite=overwrite, resume=resume) as claimed,
        ):
            if resume and not claimed.can_go_on():
                terminal.warn(f"{folder.name}: stopped before its first checkpoint: the run begins anew")
            extrinsic = None
            if resume and claimed.odometry_standing() == "finished":  # nothing is asked of its mounting any more
                terminal.print_evidence(opened.info, opened.info.evidence)
            else:
                extrinsic = find_mounting(terminal, opened, run_config.odometry, should_stop)
                print_evidence(terminal, opened, extrinsic)
            with terminal.progress() as progress:
                result = run_slam(
                    opened,
                    claimed,
                    run_config,
                    forbidden=forbidden,
                    forced=forced,
                    extrinsic=extrinsic,
                    resume=resume,
                    progress=progress,
                    view=shown,
                    loop_view=shown,
                    should_stop=should_stop,
                )
            if not no_report and result.summary.scans:
                with outcome.drawing(terminal):
                    from boxplus.report import write_report

                    write_report(result)
        summary, rows, comparison = result.summary, _rows(result), None
        if truth is not None and summary.scans:
            odometry, comparison = _compared(result, truth)
            rows += [("odometry alone", odometry.line), comparison.row]
        files = ("report.html", "trajectory.tum", "loops.csv", "map.ply", "evaluation.json")
        terminal.print_results(result.odometry, rows, folder, files, warnings=summary.warnings, doubt=summary.contradiction)
        outcome.end(summary, summary.state, untrusted=summary.contradiction is not None)
        outcome.compare(comparison)


def _compared(result: SlamResult, truth: Trajectory) -> tuple[Comparison, Comparison]:
    """The odometry, and what closing loops made of it, each with an `evaluation.json` beside its trajectory."""
    from boxplus.cli.ground_truth import compare_with

    odometry, corrected = (
        compare_with(truth, run.trajectory, run.evaluation, "se3") for run in (result.folder.odometry, result.folder)
    )
    return odometry, corrected


def _rows(result: SlamResult) -> list[tuple[str, str]]:
    """What the terminal shows of loops."""
    summary = result.summary
    forced = f", {summary.loops_forced} of them forced" if summary.loops_forced else ""
    rows = [
        (
            "loops",
            f"{summary.loops_accepted} closed{forced}, of {summary.loops_looked_at} looked at, {summary.local_maps} local maps",
        ),
        ("correction", f"{summary.largest_shift_m:.2f} m at most, {summary.last_shift_m:.2f} m at the end"),
        ("map", f"{summary.map_points:,} points" if summary.map_points else "not kept"),
    ]
    if summary.gnss is not None:
        rows.insert(2, ("on the Earth", _earth(summary.gnss)))
    return rows


def _earth(facts: GnssFacts) -> str:
    if facts.origin is None or facts.heading_sigma_deg is None:
        return "no: see the warning"
    return (
        f"origin {facts.origin[0]:.6f}°, {facts.origin[1]:.6f}°, {facts.origin[2]:.1f} m; known to "
        f"{facts.position_sigma_m:.2f} m and {facts.heading_sigma_deg:.2f}° by {facts.used} fixes"
    )
