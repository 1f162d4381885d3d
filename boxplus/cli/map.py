"""`boxplus map`: look into a map folder, and write its tiles as one file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boxplus.cli.map_grid import grid, height
from boxplus.errors import InputError

map_app = typer.Typer(
    name="map",
    help="Look into a map folder, or write its tiles as one file.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)

_Folder = Annotated[Path, typer.Argument(help="The map folder a run wrote, or the output folder of the run.", metavar="FOLDER")]


def _tiles(folder: Path) -> Path:
    """The map folder: the one given, or the one inside the output folder of a run."""
    inner = folder / "map"
    return inner if (folder / "run.json").is_file() and inner.is_dir() else folder


@map_app.command("info")
def info_command(folder: _Folder) -> None:
    """Say how many points and tiles a map has, where it lies, and what of it is incomplete."""
    from boxplus.maps.tiles.store import TileStore

    store = TileStore.open(_tiles(folder))
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


@map_app.command("export")
def export_command(
    folder: _Folder,
    ply: Annotated[Path | None, typer.Option(help="PLY file to write; default without --pcd: FOLDER.ply.")] = None,
    pcd: Annotated[Path | None, typer.Option(help="PCD file to write.")] = None,
    voxel: Annotated[float | None, typer.Option(help="Keep one point per voxel of this edge [m].")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files that exist.")] = False,
) -> None:
    """Write all tiles of a map into one PLY and/or PCD file."""
    from boxplus.maps.tiles.store import TileStore, merge

    tiles = _tiles(folder)
    for sentence in TileStore.open(tiles).report:
        typer.echo(f"warning: {sentence}", err=True)
    if ply is None and pcd is None:
        ply = tiles.resolve().parent / f"{tiles.resolve().name}.ply"
    for path in (ply, pcd):
        if path is not None and path.exists() and not overwrite:
            raise InputError("a new file", f"{path}, which exists", "give another path, or --overwrite")
    count = merge(tiles, ply, pcd, voxel)
    typer.echo(f"{count:,} points → {' and '.join(str(path) for path in (ply, pcd) if path is not None)}")


map_app.command("grid")(grid)
map_app.command("height")(height)
