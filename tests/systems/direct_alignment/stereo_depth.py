"""Depth from a rectified stereo pair, for tests: block matching with a check from the other side."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter


def stereo_depth(
    left: NDArray[np.float32], right: NDArray[np.float32], focal_px: float, baseline_m: float, disparities: int = 80
) -> NDArray[np.float64]:
    """z of the left image's pixels (H, W) [m], 0 where left and right do not agree or nothing can be told apart."""
    window = 9
    cost = np.full((disparities, *left.shape), np.inf, dtype=np.float32)
    for d in range(disparities):
        difference = np.minimum(np.abs(left[:, d:] - right[:, : left.shape[1] - d]), 30.0)
        cost[d, :, d:] = uniform_filter(difference, window, mode="nearest")
    best = cost[1:-1].argmin(axis=0) + 1
    rows, columns = np.indices(left.shape)
    # The right image's best match for the pixel that the left one found.
    of_right = np.stack([np.pad(cost[d, :, d:], ((0, 0), (0, d)), constant_values=np.inf) for d in range(disparities)])
    back = of_right.argmin(axis=0)[rows, np.clip(columns - best, 0, None)]
    before, at, after = cost[best - 1, rows, columns], cost[best, rows, columns], cost[best + 1, rows, columns]
    with np.errstate(invalid="ignore", divide="ignore"):
        curvature = before - 2.0 * at + after
        shift = np.where(curvature > 0.0, 0.5 * (before - after) / curvature, 0.0)
    good = (np.abs(back - best) <= 1) & np.isfinite(curvature) & (curvature > 0.5) & (np.abs(shift) <= 1.0) & (at < 4.0)
    return np.where(good, focal_px * baseline_m / (best + shift), 0.0)
