"""`boxplus map`: join runs into one map, look into a map folder, and write its tiles as one file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus.cli.lidar.map_grid import grid, height
from boxplus.cli.options import RESULTS, ConfigOption, JsonOption, OverwriteOption, QuietOption, SettingsOption
from boxplus.cli.terminal.help import Command
from boxplus.errors import InputError
from boxplus.formats.output import advice_to_put_back
from boxplus.maps.tiles.layout import MANIFEST

if TYPE_CHECKING:
    from boxplus.cli.terminal.terminal import Terminal
    from boxplus.runs.sessions.summary import MergeSummary

map_app = typer.Typer(
    name="map",
    help="Join runs into one map, look into a map folder, or write its tiles as one file.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)

_Folder = Annotated[Path, typer.Argument(help="The map folder a run wrote, or the output folder of the run.", metavar="FOLDER")]
_AcceptDoubts = Annotated[
    bool,
    typer.Option(
        "--accept-doubts",
        help="Replace an earlier joint map, and end with code 0, also where something speaks against the new one.",
    ),
]


def _tiles(folder: Path) -> Path:
    """The map folder: the one given, or the one inside the output folder of a run."""
    inner = folder / "map"
    if not (folder / MANIFEST).is_file() and (advice := advice_to_put_back(folder, folder.absolute().parent, inner)):
        raise InputError("a map folder", f"no map in {folder}: a process was killed as it replaced one", advice)
    return inner if (folder / "run.json").is_file() and inner.is_dir() else folder


@map_app.command("info", cls=Command)
def info_command(folder: _Folder) -> None:
    """Say how many points and tiles a map has, where it lies, what of it is incomplete, and what its run says against it."""
    from boxplus.maps.tiles.store import TileStore
    from boxplus.runs.run_folder import doubts_of_map

    tiles = _tiles(folder)
    store = TileStore.open(tiles)
    size = store.manifest.tile_size_m
    thinning = "every point" if store.manifest.voxel_m is None else f"one point per {store.manifest.voxel_m:g} m voxel"
    typer.echo(f"{folder}: {store.point_count:,} points in {len(store.counts)} tiles of {size:g} m, {thinning}")
    if store.counts:
        low = [min(index[axis] for index in store.counts) * size for axis in range(3)]
        high = [(max(index[axis] for index in store.counts) + 1) * size for axis in range(3)]
        extent = ", ".join(f"{name} {a:g} … {b:g} m" for name, a, b in zip("xyz", low, high, strict=True))
        typer.echo(f"tiles span {extent}")
    for sentence in store.report or ("whole: the run that wrote it closed it, and every file is complete",):
        typer.echo(sentence)
    for sentence in doubts_of_map(tiles):
        typer.echo(sentence)


@map_app.command("export", cls=Command)
def export_command(
    folder: _Folder,
    output: Annotated[
        list[Path] | None,
        typer.Option(
            "--output",
            "-o",
            help="File to write, .ply, .pcd, .las, .laz or .e57; may be repeated; default: FOLDER.ply.",
            metavar="FILE",
        ),
    ] = None,
    voxel: Annotated[float | None, typer.Option(help="Keep one point per voxel of this edge [m].")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files that exist.")] = False,
) -> None:
    """Write all tiles of a map into one file: PLY or PCD, LAS or LAZ (pip install laspy lazrs), E57 (pip install pye57)."""
    from boxplus.maps.tiles.store import TileStore, merge
    from boxplus.runs.run_folder import doubts_of_map

    tiles = _tiles(folder)
    for sentence in (*TileStore.open(tiles).report, *doubts_of_map(tiles)):
        typer.echo(f"warning: {sentence}", err=True)
    outputs = output or [tiles.resolve().parent / f"{tiles.resolve().name}.ply"]
    for path in outputs:
        if path.exists() and not overwrite:
            raise InputError("a new file", f"{path}, which exists", "give another path, or --overwrite")
    count = merge(tiles, outputs, voxel)
    typer.echo(f"{count:,} points → {' and '.join(str(path) for path in outputs)}")


map_app.command("grid", cls=Command)(grid)
map_app.command("height", cls=Command)(height)


@map_app.command("merge", cls=Command)
def merge_command(
    runs: Annotated[list[Path], typer.Argument(help="Output folders of 'boxplus slam', in the order of time.", metavar="RUN…")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the joint map.", rich_help_panel=RESULTS)] = Path(
        "merged"
    ),
    remove_dynamic: Annotated[
        bool, typer.Option("--remove-dynamic", help="Leave out what was seen through, and report what changed.")
    ] = False,
    config: ConfigOption = None,
    settings: SettingsOption = None,
    accept_doubts: _AcceptDoubts = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
    overwrite: OverwriteOption = False,
) -> None:
    """Join runs whose start poses nobody knows into one map, and say which of them did not meet.

    Exit code 3: no two of the runs met, and there is no joint map; or something speaks against it (two places of a kind, another
    scale, a run that is not to be trusted itself). Such a one replaces no earlier joint map.
    """
    from boxplus.cli.terminal.outcome import reported
    from boxplus.cli.terminal.terminal import Terminal
    from boxplus.runs.sessions.config import MergeConfig
    from boxplus.runs.sessions.merge_run import WorseMapError, merge_runs
    from boxplus.runs.settings_file import load_settings

    terminal = Terminal(quiet=quiet, as_json=as_json)
    with reported(_given(runs), output, as_json=as_json) as outcome:
        chosen = load_settings(MergeConfig, config, settings or ())
        try:
            result = merge_runs(
                runs, output, chosen, remove_dynamic=remove_dynamic, overwrite=overwrite, accept_doubts=accept_doubts
            )
        except WorseMapError as error:
            outcome.hold_back(str(error))
            return
        summary = result.summary
        _show(terminal, summary)
        met = bool(summary.joined)
        if met:
            terminal.say(f"{_counts(summary)} → {output}")
        else:
            terminal.doubt(f"no two of the runs met: there is no joint map; what was looked at is in {output / 'encounters.csv'}")
        outcome.end(summary, untrusted=not met or bool(summary.unaccepted))


@map_app.command("update", cls=Command)
def update_command(
    merged: Annotated[Path, typer.Argument(help="Output folder of 'boxplus map merge'.", metavar="MAP")],
    runs: Annotated[list[Path], typer.Argument(help="Output folders of 'boxplus slam', later ones.", metavar="RUN…")],
    accept_doubts: _AcceptDoubts = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Go on with a joint map: join further runs with it, in its frame and with its settings.

    Exit code 3: the map stays as it was, as none of the runs met it, one of its own would no longer fit, or something speaks
    against a new run in it (see 'map merge'); or it went on, and has a doubt of before that nobody accepted.
    """
    from boxplus.cli.terminal.outcome import reported
    from boxplus.cli.terminal.terminal import Terminal
    from boxplus.runs.sessions.update_run import update_map

    terminal = Terminal(quiet=quiet, as_json=as_json)
    with reported(_given(runs), merged, as_json=as_json) as outcome:
        result = update_map(merged, runs, accept_doubts=accept_doubts)
        if result.merged is None:
            advice = "--accept-doubts replaces it all the same" if result.doubts else "the map cannot go on with any of the runs"
            because = "\n".join(result.doubts or result.left_because)
            outcome.hold_back(f"{merged} stays as it was: {advice}\n{because}")
            return
        _show(terminal, result.merged.summary)
        terminal.say(f"{_counts(result.merged.summary)} → {merged}")
        outcome.end(result.merged.summary, untrusted=bool(result.merged.summary.unaccepted))


def _given(runs: list[Path]) -> str:
    return " ".join(map(str, runs))


def _show(terminal: Terminal, summary: MergeSummary) -> None:
    """Where each session is, or why it is apart."""
    for session in summary.sessions:
        if session.T_world_session is not None and session.sigma is not None:
            x, y, z = session.T_world_session[4:]
            terminal.say(f"{session.name}: joined, at ({x:.2f}, {y:.2f}, {z:.2f}) m ± {100.0 * max(session.sigma[3:]):.0f} cm")
        else:
            terminal.say(f"{session.name}: apart" + "".join(f"\n  {text}" for text in session.apart_because))
    for text in summary.warnings:
        terminal.warn(text)
    for text in summary.doubts:
        terminal.doubt(f"{text}; look at the map before you trust it")


def _counts(summary: MergeSummary) -> str:
    removed = "" if summary.removed_points is None else f", {summary.removed_points:,} seen through and kept in removed.ply"
    changes = "" if summary.changes is None else f", {summary.changes} places changed"
    return f"{summary.map_points:,} points{removed}{changes}"
