"""`boxplus lio`: recordings in, of each a trajectory, a map and a report out."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus.cli.lidar.mounting import find_mounting, print_evidence
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
    SaveScansOption,
    SettingsOption,
    ThreadsOption,
    lidar_settings,
    scan_settings,
)
from boxplus.cli.terminal.viewing import ViewOption, viewing
from boxplus.errors import InputError
from boxplus.recordings.options import RecordingOptions

if TYPE_CHECKING:
    from boxplus.cli.ground_truth import Comparison
    from boxplus.cli.terminal.outcome import Outcome
    from boxplus.cli.terminal.run_terminal import RunTerminal
    from boxplus.formats.trajectory import Trajectory
    from boxplus.runs.lidar_inertial.config import RunConfig
    from boxplus.runs.lidar_inertial.earlier_run import Standing
    from boxplus.runs.lidar_inertial.summary import RunSummary

_KNOWN_DEG, _KNOWN_M = 1.0, 0.05  # as well as a mounting has to be known to be given to another recording


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
    save_scans: SaveScansOption = None,
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
    could not be written, 2 bad input, 3 finished, but not to be trusted (the sensors contradict each other, nobody gave the
    mounting and the motion never bore it out, a long gap; of several recordings, one failed or is not to be trusted), 130
    interrupted (results up to there are complete).
    """
    from boxplus.cli.ground_truth import read_ground_truth
    from boxplus.cli.lidar.several import run_several, several_recordings
    from boxplus.cli.terminal.outcome import reported
    from boxplus.cli.terminal.run_terminal import RunTerminal
    from boxplus.runs.lidar_inertial.config import load_run_config
    from boxplus.runs.lidar_inertial.earlier_run import standing
    from boxplus.runs.run_folder import RunFolder

    kept: dict[str, object] = {"save": False} if no_map else {}
    run_config = lidar_settings(
        load_run_config, config, settings, options, T_imu_lidar, threads, map=kept, scans=scan_settings(save_scans)
    )
    terminal = RunTerminal(quiet=quiet, as_json=as_json)

    def run_one(
        recording: Path,
        folder: Path,
        outcome: Outcome,
        should_stop: Callable[[], bool] | None = None,
    ) -> None:
        truth = read_ground_truth(ground_truth)
        summary, comparison = run(
            recording,
            folder,
            run_config,
            outcome,
            terminal=terminal,
            ground_truth=truth,
            overwrite=overwrite,
            standing=standing(RunFolder(folder)) if resume else None,
            view=view,
            report=not no_report,
            should_stop=should_stop,
        )
        outcome.end(summary, summary.state, untrusted=summary.contradiction is not None)
        outcome.compare(comparison)

    several = several_recordings(recordings)
    if several is not None:
        if len(several) > 1 and (view is not None or ground_truth is not None):
            raise InputError("one recording with --view or --gt", f"{len(several)}", "run them one by one, or leave it out")
        raise typer.Exit(run_several(several, output, run_one, terminal, as_json=as_json))
    recording = recordings[0]
    folder = output or Path(f"{recording.resolve().stem}_boxplus")
    with reported(recording, folder, as_json=as_json) as outcome:
        run_one(recording, folder, outcome)


def run(
    recording: Path,
    folder: Path,
    config: RunConfig,
    outcome: Outcome,
    *,
    terminal: RunTerminal | None = None,
    ground_truth: Trajectory | None = None,
    overwrite: bool = False,
    standing: Standing | None = None,
    view: str | None = None,
    report: bool = True,
    should_stop: Callable[[], bool] | None = None,
) -> tuple[RunSummary, Comparison | None]:
    """Run the odometry with everything a terminal shows: evidence, progress, results.

    Args:
        outcome: takes down a report that could not be drawn; the caller ends it.
        standing: how far an earlier run came in `folder`, where one is to go on; it decides in place of `overwrite`.
        should_stop: None lets Ctrl-C end the run in good order.

    Raises:
        BoxplusError: bad input, or results that cannot be written.
    """
    from boxplus.cli.ground_truth import compare_with
    from boxplus.cli.terminal.interrupt import stop_on_interrupt
    from boxplus.cli.terminal.run_terminal import RunTerminal
    from boxplus.recordings import open_recording
    from boxplus.runs.lidar_inertial.earlier_run import finished_run
    from boxplus.runs.lidar_inertial.odometry_run import run_odometry
    from boxplus.runs.run_folder import RunFolder, claim_run_folder

    terminal = terminal or RunTerminal()
    resume = standing == "stopped"
    if standing is not None:
        overwrite = standing in ("stopped before its first checkpoint", "stopped under another boxplus")
    if standing == "stopped under another boxplus":
        terminal.warn(f"{folder.name}: its checkpoint is damaged or of another version of boxplus: the run begins anew")
    with ExitStack() as stack:
        shown = stack.enter_context(viewing("LiveView", recording.name, view))
        asked = should_stop or stack.enter_context(stop_on_interrupt(terminal.announce_stop))
        opened = stack.enter_context(open_recording(recording, config.recording))
        own = RunFolder(folder)
        if standing != "finished":
            own = stack.enter_context(claim_run_folder(folder, overwrite=overwrite, resume=resume))
        began = time.perf_counter()
        extrinsic = find_mounting(terminal, opened, config.odometry, asked)
        mounting_s = time.perf_counter() - began
        if standing == "finished":
            summary = finished_run(own, opened, config, extrinsic)
            terminal.say(f"{folder.name}: finished before, and left as it is")
        else:
            print_evidence(terminal, opened, extrinsic)
            with terminal.progress() as progress:
                summary = run_odometry(
                    opened,
                    own,
                    config,
                    extrinsic=extrinsic,
                    resume=resume,
                    progress=progress,
                    view=shown,
                    should_stop=asked,
                )
            if report and summary.scans:
                with outcome.drawing(terminal):
                    from boxplus.report import write_report

                    write_report(folder)
        comparison, rows = None, _rows(summary, mounting_s)
        if ground_truth is not None and summary.scans:
            comparison = compare_with(ground_truth, own.trajectory, own.evaluation, "se3")
            rows.append(comparison.row)
    files = ("report.html", "trajectory.tum", "trajectory.csv", "map.ply", "evaluation.json", "run.json")
    terminal.print_results(summary, rows, folder, files, doubt=summary.contradiction)
    if found := _found_mounting(summary):
        terminal.say(found[0])
        terminal.say(found[1], copied=True)
    return summary, comparison


def _found_mounting(summary: RunSummary) -> tuple[str, str] | None:
    """How well a run has found its mounting, and the option that gives it to another; None where it is not to be relied on."""
    import numpy as np

    from boxplus.runs.transform import transform_text

    extrinsic = summary.extrinsic
    trusted = summary.state == "finished" and summary.contradiction is None and extrinsic.estimation != "off"
    deg, m = extrinsic.sigma_end_deg, extrinsic.sigma_end_m
    if not trusted or extrinsic.source not in ("estimated", "identity") or deg is None or m is None:
        return None
    if deg > _KNOWN_DEG or m > _KNOWN_M:
        return None
    found = transform_text(np.array(extrinsic.T_imu_lidar_end))
    known = f"mounting at the end, ± {deg:.2g} deg and {m * 100.0:.2g} cm, for other recordings of these sensors"
    return f"{known}:", f"  --T-imu-lidar '{found}'"


def _rows(summary: RunSummary, mounting_s: float) -> list[tuple[str, str]]:
    """What the terminal shows of a run of LiDAR and IMU, before which `mounting_s` seconds went into its mounting."""
    from boxplus._words import counted
    from boxplus.cli.terminal.run_terminal import speed_text
    from boxplus.sensors.sequencer import BEFORE_START

    timing, rows = summary.timing, []
    if unstarted := summary.rejected["odometry"].get(BEFORE_START):
        rows.append(("before the start", f"{counted(unstarted, 'scan')} without a pose"))
    if timing.scan_ms is not None:
        rows.append(("per scan", f"median {timing.scan_ms.median:.1f} ms, 99th percentile {timing.scan_ms.p99:.1f} ms"))
    speed = speed_text(timing.real_time_factor, timing.total_s, timing.compiled_kernels)
    if summary.extrinsic.source == "estimated":
        speed += f", after {mounting_s:.1f} s for the mounting"
    rows.append(("speed", speed))
    for lidar in summary.lidars[1:]:
        rows.append((f"LiDAR {lidar.topic}", f"{lidar.merged_points:,} points merged; against the first: {lidar.checked}"))
    rows.append(("map", f"{summary.map.stored_points:,} points" if summary.map.stored_points else "not kept"))
    return rows
