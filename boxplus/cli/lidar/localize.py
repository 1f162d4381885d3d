"""`boxplus localize`: a recording and a saved map in, poses in the map out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus._words import counted
from boxplus.cli.lidar.mounting import find_mounting, print_evidence
from boxplus.cli.model_options import takes_recording_options
from boxplus.cli.options import (
    RESULTS,
    ConfigOption,
    JsonOption,
    MountingOption,
    NoReportOption,
    OverwriteOption,
    QuietOption,
    RecordingArgument,
    SettingsOption,
    ThreadsOption,
    lidar_settings,
)
from boxplus.recordings.options import RecordingOptions

if TYPE_CHECKING:
    from boxplus.runs.localization.localization_run import LocalizationResult


@takes_recording_options
def localize(
    recording: RecordingArgument,
    saved: Annotated[
        Path, typer.Option("--map", "-m", help="Folder of 'boxplus lio', 'slam' or 'map merge', map folder, or point cloud file.")
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Folder for the results; default: RECORDING_localized here.", rich_help_panel=RESULTS
        ),
    ] = None,
    config: ConfigOption = None,
    settings: SettingsOption = None,
    T_imu_lidar: MountingOption = None,
    threads: ThreadsOption = None,
    keep_map: Annotated[
        bool, typer.Option("--keep-map", help="Write the odometry's own map too.", rich_help_panel=RESULTS)
    ] = False,
    no_report: NoReportOption = False,
    accept_doubts: Annotated[
        bool,
        typer.Option("--accept-doubts", help="End with code 0 also where the run that wrote the map says something against it."),
    ] = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
    overwrite: OverwriteOption = False,
    *,
    options: RecordingOptions,
) -> None:
    """Find out where a recording was made in a map, and follow it there.

    The odometry of 'boxplus lio', and beside it the search for its place in the map. Poses in the map's frame are written from
    where it is found on, and never while it is searched for. Exit codes: as 'boxplus lio'; 3 also where no place was found,
    where one was and may be wrong, or where the map is not to be trusted, as the run that wrote it says.
    """
    from boxplus.runs.localization.config import load_localization_config

    run_config = lidar_settings(load_localization_config, config, settings, options, T_imu_lidar, threads, map={"save": keep_map})
    folder = output or Path(f"{recording.resolve().stem}_localized")

    from boxplus.cli.terminal.interrupt import stop_on_interrupt
    from boxplus.cli.terminal.outcome import reported
    from boxplus.cli.terminal.run_terminal import RunTerminal
    from boxplus.recordings import open_recording
    from boxplus.runs.localization.folder import claim_localization_folder
    from boxplus.runs.localization.localization_run import run_localization
    from boxplus.runs.saved_map.saved_map import open_saved_map

    terminal = RunTerminal(quiet=quiet, as_json=as_json)
    with reported(recording, folder, as_json=as_json) as outcome:
        with (
            stop_on_interrupt(terminal.announce_stop) as should_stop,
            open_recording(recording, run_config.recording) as opened,
            claim_localization_folder(folder, overwrite=overwrite) as claimed,
        ):
            with terminal.status("opening the map"):
                opened_map = open_saved_map(saved, run_config.local_maps)
            extrinsic = find_mounting(terminal, opened, run_config.odometry, should_stop)
            print_evidence(terminal, opened, extrinsic)
            with terminal.progress() as progress:
                result = run_localization(
                    opened,
                    claimed,
                    opened_map,
                    run_config,
                    extrinsic=extrinsic,
                    accept_doubts=accept_doubts,
                    progress=progress,
                    should_stop=should_stop,
                )
            if not no_report:
                with outcome.drawing(terminal):
                    from boxplus.report.localization_page import write_localization_report

                    write_localization_report(folder, result)
        summary, files = result.summary, ("report.html", "trajectory.tum", "localization.csv", "searches.csv")
        doubt = "; ".join(summary.reasons) or None
        terminal.print_results(result.odometry, _rows(result), folder, files, warnings=summary.warnings, doubt=doubt)
        outcome.end(summary, summary.state, untrusted=doubt is not None)


def _rows(result: LocalizationResult) -> list[tuple[str, str]]:
    """What the terminal shows of the place."""
    summary = result.summary
    counts = ", ".join(f"{count} {name}" for name, count in sorted(summary.status.items()))
    found = "never found" if summary.found_after_s is None else f"found after {summary.found_after_s:.1f} s"
    rows = [("map", f"{summary.map}, {counted(summary.places, 'place')}"), ("in the map", f"{found}; scans: {counts}")]
    rows += [("of the map", text) for text in summary.map_report]
    return rows + [("lost", text) for text in summary.losses]
