"""`boxplus fleet run`: many recordings in, a run of each and one map of those that met out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus.cli.options import RESULTS, SETTINGS, ConfigOption, JsonOption, QuietOption, SettingsOption
from boxplus.cli.terminal.help import Command

if TYPE_CHECKING:
    from boxplus.cli.terminal.run_terminal import RunTerminal
    from boxplus.runs.fleet.status import FleetStatus, RecordingStatus

_HEADINGS = ("recording", "came out", "scans", "path length", "loops", "in the joint map")
_STAGES = {"pairs": "looking for recordings that met", "map": "writing the joint map"}
_REASONS = 3  # against joining a recording that are shown; fleet.json has all of them

app = typer.Typer(
    name="fleet",
    help="Run many recordings, on this machine or a cluster, and join those that met.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)


@app.callback()
def _group() -> None:
    """A group of commands, of which there is one."""


@app.command("run", cls=Command)
def run_command(
    recordings: Annotated[
        Path, typer.Argument(help="Folder with recordings, or a .txt file with one path a line.", metavar="FOLDER_OR_LIST")
    ],
    output: Annotated[
        str,
        typer.Option(
            "--output",
            "-o",
            help="Folder that every worker can write to, or the URL of an object store: s3://bucket/fleet.",
            metavar="FOLDER_OR_URL",
            rich_help_panel=RESULTS,
        ),
    ] = "fleet",
    address: Annotated[
        str | None, typer.Option("--address", help="Address of a Ray cluster that runs; default: one is started here.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, help="Tasks at a time on this machine; default: its cores.")
    ] = None,
    remove_dynamic: Annotated[
        bool, typer.Option("--remove-dynamic", help="Leave out of the joint map what was seen through; not with a URL.")
    ] = False,
    neighbours: Annotated[
        int, typer.Option("--neighbours", min=1, help="Other recordings that each one is compared with, the most alike first.")
    ] = 6,
    config: ConfigOption = None,
    settings: SettingsOption = None,
    merge_config: Annotated[
        Path | None,
        typer.Option("--merge-config", help="YAML file with settings of 'boxplus map merge'.", rich_help_panel=SETTINGS),
    ] = None,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Run 'boxplus slam' on every recording and join those that met, wherever each began.

    --config and --set are settings of 'boxplus slam'. What is finished in the output folder is kept: the same command goes on
    with a fleet that was stopped. Needs pip install ray fsspec. Exit codes: 0 done, 1 the results could not be written,
    2 bad input, 3 not all of it is to be trusted (a recording failed or is not to be trusted itself, recordings contradict each
    other or are joined in doubt only, no two of them met, or something speaks against their joint map, which then takes the place
    of no sound one that is there), 130 interrupted.
    """
    from boxplus.cli.terminal.outcome import reported
    from boxplus.cli.terminal.run_terminal import RunTerminal
    from boxplus.runs.fleet.executor import RayExecutor
    from boxplus.runs.fleet.fleet_run import run_fleet
    from boxplus.runs.fleet.recordings import find_recordings
    from boxplus.runs.fleet.store import MERGED, open_store
    from boxplus.runs.sessions.config import MergeConfig
    from boxplus.runs.settings_file import load_settings
    from boxplus.runs.slam.config import load_slam_config

    terminal = RunTerminal(quiet=quiet, as_json=as_json)
    with reported(recordings, output, as_json=as_json) as outcome:
        found = find_recordings(recordings)
        slam = load_slam_config(config, settings or (), {"odometry": {"threads": 1}})
        merging = load_settings(MergeConfig, merge_config)
        place = open_store(output)
        report = _Reporter(terminal, len(found))
        with RayExecutor(address, workers) as executor:
            status = run_fleet(
                found, output, executor, slam, merging, remove_dynamic=remove_dynamic, neighbours=neighbours, report=report
            )
        _show(terminal, status, place / MERGED)
        outcome.end(status, untrusted=bool(status.doubts))


class _Reporter:
    """A line for each recording as its run ends, and for each stage after that."""

    def __init__(self, terminal: RunTerminal, count: int) -> None:
        self._terminal, self._count = terminal, count
        self._ended, self._stage = 0, "recordings"

    def __call__(self, status: FleetStatus, own: RecordingStatus | None) -> None:
        if own is not None:
            self._ended += 1
            facts = f"{own.path_length_m:.0f} m, {own.loops} loops" if own.error is None else own.error
            how = f"{own.state}, {own.seconds:.0f} s" if own.seconds or own.state == "failed" else "finished before"
            self._terminal.say(f"{min(self._ended, self._count)}/{self._count} {own.name}: {how}: {facts}")
        if status.stage != self._stage:
            self._stage = status.stage
            if self._stage in _STAGES:
                self._terminal.say(f"{_STAGES[self._stage]} …")


def _show(terminal: RunTerminal, status: FleetStatus, merged: str) -> None:
    """A table of the recordings, what keeps them apart, and why not all is to be trusted."""
    rows = []
    for own in status.recordings:
        came_out = own.state if own.doubt is None else "not to be trusted"
        where = "yes" if own.joined else "no"
        rows.append((own.name, came_out, f"{own.scans}", f"{own.path_length_m:.1f} m", f"{own.loops}", where))
    terminal.print_table(_HEADINGS, rows)
    for own in status.recordings:
        if own.apart_because:
            more = len(own.apart_because) - _REASONS
            shown = [*own.apart_because[:_REASONS], *([f"… and {more} more in fleet.json"] if more > 0 else [])]
            terminal.say(f"{own.name}: apart" + "".join(f"\n  {text}" for text in shown))
    for text in status.warnings:
        terminal.warn(text)
    for text in status.doubts:
        terminal.doubt(text)
    if status.joined and not status.earlier_map_kept:
        terminal.say(
            f"{len(status.joined)} of {len(status.recordings)} recordings in one map, {status.map_points:,} points; "
            f"{status.pairs_joined} of {status.pairs_looked_at} pairs met → {merged}"
        )
