"""Inverse depths of pixels as those around them agree on: the mean by information of neighbours that are not contradicted.

Where the base between two views is short by the distance, one pixel tells its inverse depth to a fifth or worse. Chosen by how
large they turned out, such depths are too near in the mean, and a motion by them is too short (errors in variables). Surfaces
are smooth: a pixel i takes

    ρ̂ = Σ_j ρ_j/s_j² / Σ_j 1/s_j²,   s_j² = σ_j² + (0.01 ρ_i d_ij)²,   over the j with (ρ_j − ρ_i)² < 4 (σ_i² + s_j²)

in the cells around it, itself included: on a surface that is seen aslant, inverse depths change by some hundredth a pixel of
distance d. One that too few of its neighbours agree with was found where the texture repeats, and is dropped. The variance
is that of the mean, times how much the neighbours scatter beyond their own variances (it never shrinks by scattering less), times
their number up to 3, as patches overlap and err together:

    σ̂² = max(Σ_j (ρ_j − ρ̂)²/s_j² / (n − 1), 1) min(n, 3) / Σ_j 1/s_j²,   n the number of these j

Source: Engel, Sturm and Cremers, Semi-Dense Visual Odometry for a Monocular Camera, ICCV 2013, 2.4.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel

_AROUND = 2  # cells on every side
_GATE = 4.0  # squared standard deviations of a difference up to which two depths agree
_SLANT = 0.01  # share by which an inverse depth changes from a pixel to the next
_FEWEST = 3  # neighbours that agree
_LEAST_SHARE = 0.4  # of all neighbours
_ALIKE = 3.0  # patches that overlap so much that they count for one


def agreed(
    pixels: NDArray[np.int64], rho: NDArray[np.float64], sigma: NDArray[np.float64], shape: tuple[int, int], cell: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Inverse depths ρ̂ (n,) [1/m] and their standard deviations, infinite where too few agree.

    Args:
        pixels: (n, 2) u, v, about one in every cell; rho, sigma: (n,) of them [1/m].
        shape: (H, W) of the image; cell: side of the cells [pixels].
    """
    rows, columns = pixels[:, 1] // cell, pixels[:, 0] // cell
    grid = np.full((shape[0] // cell + 1, shape[1] // cell + 1), -1, np.int64)
    grid[rows, columns] = np.arange(len(pixels))
    mean, deviation = np.zeros(len(pixels)), np.full(len(pixels), np.inf)
    _agree(grid, rows, columns, pixels, rho, sigma, mean, deviation)
    return mean, deviation


@kernel
def _agree(
    grid: NDArray[np.int64],
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    pixels: NDArray[np.int64],
    rho: NDArray[np.float64],
    sigma: NDArray[np.float64],
    mean: NDArray[np.float64],
    deviation: NDArray[np.float64],
) -> None:
    for i in range(len(rho)):
        total, weights, squares, count, others = 0.0, 0.0, 0.0, 0, 0
        for r in range(max(rows[i] - _AROUND, 0), min(rows[i] + _AROUND + 1, grid.shape[0])):
            for c in range(max(columns[i] - _AROUND, 0), min(columns[i] + _AROUND + 1, grid.shape[1])):
                j = grid[r, c]
                if j < 0:
                    continue
                others += 1
                difference, du, dv = rho[j] - rho[i], pixels[j, 0] - pixels[i, 0], pixels[j, 1] - pixels[i, 1]
                slant = _SLANT * rho[i]
                variance = sigma[j] * sigma[j] + slant * slant * (du * du + dv * dv)
                if difference * difference < _GATE * (sigma[i] * sigma[i] + variance):
                    weight = 1.0 / variance
                    total += weight * difference
                    weights += weight
                    squares += weight * difference * difference
                    count += 1
        if count - 1 < _FEWEST or count - 1 < _LEAST_SHARE * (others - 1):
            continue
        change = total / weights
        spread = (squares - weights * change * change) / (count - 1)
        mean[i] = rho[i] + change
        deviation[i] = np.sqrt(max(spread, 1.0) * min(_ALIKE, count) / weights)
