"""How far corners that two cameras see lie off their epipolar lines, and what moves them there.

A ray m of the first camera, turned into the axes of the other one, and the baseline t span a plane with normal n = t × R m. The
ray y of the other camera lies off it, across the epipolar line, by e = n · y / |n_xy|. A focal length of the other camera that is
1 + ε times what it was calibrated for, and a mounting that is turned by θ, move it by

    e ≈ ε (n_xy · y_xy) / |n_xy| + θ · (y × n) / |n_xy|

Source: docs/visual_inertial_odometry.md, "What counts as a contradiction".
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks
from boxplus.systems.visual_inertial_odometry.rig import Rig

TURN_SIGMA = 0.05
"""rad: standard deviation of the mounting beforehand."""

Floats = NDArray[np.float64]


def offset_sigmas(rig: Rig, pixel_sigma: float) -> list[float]:
    """Standard deviation of e for every camera but the first, by that of a corner along each axis [px]."""
    first, *others = (camera.model.fx for camera in rig.cameras)
    return [pixel_sigma * math.hypot(1.0 / first, 1.0 / fx) for fx in others]


def pairs_of_rays(tracks: Tracks, camera: int, T_other_first: Floats) -> tuple[Floats, Floats, Floats, int]:
    """What the first camera and another one both see.

    Returns:
        R m (n, 3), y (n, 3) and n / |n_xy| (n, 3) of corners that do not lie along the baseline, and how many both see.
    """
    both = np.isfinite(tracks.rays[:, camera, 0])
    turned, rays = tracks.rays[both, 0] @ T_other_first[:3, :3].T, tracks.rays[both, camera]
    normals = np.cross(T_other_first[:3, 3], turned)
    length = np.linalg.norm(normals[:, :2], axis=1)
    seen = length > 0.0
    return turned[seen], rays[seen], normals[seen] / length[seen, None], int(np.count_nonzero(both))


def offsets(rays: Floats, normals: Floats) -> tuple[Floats, Floats]:
    """Slopes (n, 4) of e by ε and θ, and e (n,), of rays y and n / |n_xy| (n, 3)."""
    longer = (normals[:, :2] * rays[:, :2]).sum(axis=1)
    return np.column_stack([longer, np.cross(rays, normals)]), np.asarray((normals * rays).sum(axis=1))
