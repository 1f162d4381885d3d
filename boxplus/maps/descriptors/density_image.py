"""A local map from above: how many points stand on each cell of the ground (docs/slam.md).

Gravity leaves a place three degrees of freedom on the ground, x, y and yaw; walls, which are dense seen from above, are what two
visits have in common.

Source: Gupta, Guadagnino, Mersch, Vizzo and Stachniss, Effectively Detecting Loop Closures using Point Cloud Density
Maps, ICRA 2024.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_numbers
from boxplus.errors import InputError

_FULL = 0.99  # quantile of the cells that are not empty which counts as full
_EMPTY = 0.05  # of it; less is noise
_LARGEST = 4096  # pixels along a side


@dataclass(frozen=True, slots=True, eq=False)
class DensityImage:
    """An image of the ground.

    Attributes:
        pixels: (H, W) uint8, row v along y, column u along x; 255 is the 0.99 quantile of the occupied cells.
        origin: (2,) x and y of the outer corner of pixel (0, 0) in the map's frame [m].
        cell: side of a pixel [m].
    """

    pixels: NDArray[np.uint8]
    origin: NDArray[np.float64]
    cell: float

    def to_map(self, uv: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 2) [m] of pixels (N, 2), whole numbers being the middles of pixels."""
        return self.origin + (uv + 0.5) * self.cell


def density_image(points: ArrayLike, cell: float) -> DensityImage:
    """Count points (N, 3) [m], z up, over cells of side `cell` [m].

    Raises:
        InputError: no points, coordinates that are not finite, an extent of more than 4,096 cells.
    """
    xyz = as_numbers(points, "points")
    if xyz.ndim != 2 or xyz.shape[1] != 3 or not len(xyz) or not np.isfinite(xyz).all():
        raise InputError("points (N, 3), at least one, finite", f"shape {xyz.shape}", "give the points of a local map [m]")
    uv = np.floor(xyz[:, :2].astype(np.float64) / cell).astype(np.int64)
    low = uv.min(axis=0)
    uv -= low
    width, height = (int(n) + 1 for n in uv.max(axis=0))
    if max(width, height) > _LARGEST:
        raise InputError(
            f"an extent of {_LARGEST} cells at most", f"{width} × {height}", f"leave out far points, or enlarge cell = {cell} m"
        )
    counts = np.bincount(uv[:, 1] * width + uv[:, 0], minlength=width * height).astype(np.float64)
    full = max(float(np.quantile(counts[counts > 0], _FULL)), 1.0)
    share = np.minimum(counts / full, 1.0)
    share[share < _EMPTY] = 0.0
    pixels = np.rint(255.0 * share).astype(np.uint8).reshape(height, width)
    return DensityImage(pixels, low * cell, float(cell))
