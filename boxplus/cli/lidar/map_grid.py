"""`boxplus map grid` and `boxplus map height`: the map of a run from above."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from boxplus.errors import InputError

_Run = Annotated[Path, typer.Argument(help="The output folder of 'boxplus lio', 'slam' or 'map merge'.", metavar="DIR")]
_Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace files that exist.")]
_Slope = Annotated[float, typer.Option(help="Steepest ground, rise by distance.", min=0.01)]
_Z = Annotated[
    tuple[float, float] | None, typer.Option("--z", help="One storey: lowest and highest z of the path [m].", metavar="LOW HIGH")
]


def grid(
    folder: _Run,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Files to write, without ending; default: DIR/grid.")
    ] = None,
    resolution: Annotated[float, typer.Option(help="Side of a cell [m].", min=0.01)] = 0.1,
    heights: Annotated[
        tuple[float, float], typer.Option(help="What stands between these heights above the ground is an obstacle [m].")
    ] = (0.2, 1.8),
    slope: _Slope = 0.3,
    z: _Z = None,
    overwrite: _Overwrite = False,
) -> None:
    """Write a floor plan as the image and YAML file of ROS map_server: occupied, free, unknown.

    Free is what lies between the path and something that stands there, and ground that was seen. Steps down and holes are no
    obstacles.
    """
    from boxplus.formats.ros_map import write_ros_map
    from boxplus.maps.floor_plan.occupancy import FREE, OCCUPIED, FloorPlanConfig
    from boxplus.runs.map_from_above import MapFromAbove
    from boxplus.runs.run_folder import doubts_of_map

    if not 0.0 < heights[0] < heights[1]:
        raise InputError("heights that ascend from above 0 m", f"{heights[0]:g} and {heights[1]:g}", "correct --heights")
    stem = (output or folder / "grid").with_suffix("")
    _check_new([stem.with_name(f"{stem.name}.{ending}") for ending in ("pgm", "yaml")], overwrite)
    config = FloorPlanConfig(resolution=resolution, least_height=heights[0], largest_height=heights[1], slope=slope)
    above = MapFromAbove(folder, config, z)
    _warn([*above.store.report, *doubts_of_map(above.store.folder)])
    voxel = above.store.manifest.voxel_m
    if voxel is not None and resolution < voxel:
        _warn([f"cells of {resolution:g} m are smaller than the map's voxels of {voxel:g} m: walls may have holes"])
    cells, raster = above.floor_plan()
    image, text = write_ros_map(stem, cells == OCCUPIED, cells == FREE, raster.cell, (raster.x, raster.y))
    shares = [
        f"{(cells == kind).sum() * raster.cell**2:.1f} m² {name}" for kind, name in ((FREE, "free"), (OCCUPIED, "occupied"))
    ]
    typer.echo(f"{raster.columns} × {raster.rows} cells of {raster.cell:g} m: {', '.join(shares)} → {image} and {text}")


def height(
    folder: _Run,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="GeoTIFF to write; default: DIR/height.tif.")] = None,
    resolution: Annotated[float, typer.Option(help="Side of a cell [m].", min=0.05)] = 0.5,
    surface: Annotated[bool, typer.Option("--surface", help="Of what is highest instead of the ground.")] = False,
    slope: _Slope = 0.3,
    z: _Z = None,
    overwrite: _Overwrite = False,
) -> None:
    """Write the heights of the ground, or of what stands on it, as a GeoTIFF (needs: pip install rasterio).

    In the map's own frame; of a run of 'boxplus slam' with positions by satellite with its place on the Earth and heights
    above the ellipsoid of WGS84.
    """
    import numpy as np

    from boxplus.formats.geotiff import require_rasterio, write_geotiff
    from boxplus.maps.floor_plan.occupancy import FloorPlanConfig
    from boxplus.runs.map_from_above import MapFromAbove
    from boxplus.runs.run_folder import doubts_of_map

    path = output or folder / "height.tif"
    _check_new([path], overwrite)
    require_rasterio()
    above = MapFromAbove(folder, FloorPlanConfig(ground_cell=resolution, slope=slope), z)
    _warn([*above.store.report, *doubts_of_map(above.store.folder)])
    heights, raster = above.surface() if surface else above.ground()
    projection = None if above.frame is None else above.frame.projection
    heights = above.above_ellipsoid(heights)
    what = "height [m]" if above.frame is None else "height above the ellipsoid of WGS84 [m]"
    write_geotiff(path, heights, raster.cell, (raster.x, raster.y), projection=projection, description=what)
    known = np.isfinite(heights)
    extent = f"{np.nanmin(heights):.2f} to {np.nanmax(heights):.2f} m" if known.any() else "no ground"
    typer.echo(f"{raster.columns} × {raster.rows} cells of {raster.cell:g} m, {known.mean():.0%} known, {extent} → {path}")


def _check_new(paths: list[Path], overwrite: bool) -> None:
    for path in paths:
        if path.exists() and not overwrite:
            raise InputError("a new file", f"{path}, which exists", "give another path, or --overwrite")


def _warn(sentences: list[str]) -> None:
    for sentence in sentences:
        typer.echo(f"warning: {sentence}", err=True)
