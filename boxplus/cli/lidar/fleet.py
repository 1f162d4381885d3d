"""`boxplus fleet run`: many recordings in, a run of each and one map of those that met out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus.cli import EXIT_UNTRUSTED
from boxplus.cli.help import Command

if TYPE_CHECKING:
    from boxplus.runs.fleet.status import FleetStatus

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
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder that every worker can write to.")] = Path("fleet"),
    address: Annotated[
        str | None, typer.Option("--address", help="Address of a Ray cluster that runs; default: one is started here.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option("--workers", min=1, help="Tasks at a time on this machine; default: its cores.")
    ] = None,
    remove_dynamic: Annotated[
        bool, typer.Option("--remove-dynamic", help="Leave out of the joint map what was seen through.")
    ] = False,
    neighbours: Annotated[
        int, typer.Option("--neighbours", min=1, help="Other recordings that each one is compared with, the most alike first.")
    ] = 6,
    config: Annotated[Path | None, typer.Option("--config", help="YAML file with settings of 'boxplus slam'.")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="One setting of 'boxplus slam'; may be repeated.", metavar="KEY=VALUE")
    ] = None,
    merge_config: Annotated[
        Path | None, typer.Option("--merge-config", help="YAML file with settings of 'boxplus map merge'.")
    ] = None,
) -> None:
    """Run 'boxplus slam' on every recording and join those that met, wherever each began.

    What is finished in the output folder is kept: the same command goes on with a fleet that was stopped. Needs
    pip install 'boxplus[fleet]'. Exit code 3: some recordings failed, and are named.
    """
    from boxplus.runs.fleet.executor import RayExecutor
    from boxplus.runs.fleet.fleet_run import FleetFolder, run_fleet
    from boxplus.runs.fleet.recordings import find_recordings
    from boxplus.runs.sessions.config import MergeConfig
    from boxplus.runs.settings_file import load_settings
    from boxplus.runs.slam.config import load_slam_config

    found = find_recordings(recordings)
    slam = load_slam_config(config, settings or (), {"odometry": {"threads": 1}})
    merging = load_settings(MergeConfig, merge_config)
    shown: set[str] = set()

    def report(status: FleetStatus) -> None:
        for own in status.recordings:
            if own.state != "waiting" and own.name not in shown:
                shown.add(own.name)
                facts = f"{own.path_length_m:.0f} m, {own.loops} loops" if own.error is None else own.error
                done = f"{len(shown)}/{len(status.recordings)}"
                typer.echo(f"{done} {own.name}: {own.state}, {own.seconds:.0f} s: {facts}")

    with RayExecutor(address, workers) as executor:
        status = run_fleet(
            found, output, executor, slam, merging, remove_dynamic=remove_dynamic, neighbours=neighbours, report=report
        )
    typer.echo(
        f"{len(status.joined)} of {len(found)} recordings in one map, "
        f"{status.pairs_joined} of {status.pairs_looked_at} pairs met → {FleetFolder(output).merged}"
    )
    for text in status.pairs_failed:
        typer.echo(f"warning: {text}", err=True)
    for own in status.failed:
        typer.echo(f"failed: {own.name}: {own.error}", err=True)
    if status.failed:
        raise typer.Exit(EXIT_UNTRUSTED)
