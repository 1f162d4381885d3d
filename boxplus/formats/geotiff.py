"""Heights over a grid as GeoTIFF, by rasterio (extra `geo`): one band of float32, compressed."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus._extras import require
from boxplus.errors import InputError
from boxplus.formats.output import TEMPORARY_SUFFIX, output_error

_BLOCK = 256  # cells of a tile's side


def require_rasterio() -> Any:
    """The module, asked for before a long computation whose result it has to write.

    Raises:
        InputError: it is not installed.
    """
    return require("rasterio", "which writes GeoTIFF")


def write_geotiff(
    path: str | Path,
    heights: NDArray[np.float64],
    resolution: float,
    origin: tuple[float, float],
    *,
    projection: str | None = None,
    description: str = "height [m]",
) -> None:
    """Write a raster of heights; NaN is "no data".

    Args:
        heights: (rows, columns) [m], row 0 at the bottom (smallest y).
        resolution: side of a cell [m]; origin: x, y of the lower left corner [m].
        projection: what x and y are, as a PROJ string; None: a local frame, and the file has no coordinate reference system.
        description: of the band.

    Raises:
        InputError: rasterio is not installed, or the projection is none.
        OutputError: it cannot be written.
    """
    rasterio = require_rasterio()
    target = Path(path)
    temporary = target.with_name(target.name + TEMPORARY_SUFFIX)
    try:
        crs = None if projection is None else rasterio.crs.CRS.from_proj4(projection)
    except rasterio.errors.CRSError as error:
        raise InputError("a projection that PROJ knows", f"{projection!r} ({error})", "correct it") from error
    rows, columns = heights.shape
    transform = rasterio.transform.from_origin(origin[0], origin[1] + rows * resolution, resolution, resolution)
    try:
        temporary.touch()  # says in the system's own words why a folder cannot be written to
        with rasterio.open(
            temporary, "w", driver="GTiff", height=rows, width=columns, count=1, dtype="float32", crs=crs, transform=transform,
            nodata=np.nan, compress="deflate", predictor=3, tiled=True, blockxsize=_BLOCK, blockysize=_BLOCK, BIGTIFF="IF_SAFER",
        ) as file:  # fmt: skip
            file.write(heights[::-1].astype(np.float32), 1)
            file.set_band_description(1, description)
        os.replace(temporary, target)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError):  # rasterio's own are of that kind
            raise output_error(target, error) from error
        raise
