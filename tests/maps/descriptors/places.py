"""Made-up places: walls on the ground, visited under any heading."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def walls(seed: int, count: int = 40) -> NDArray[np.float64]:
    """Points (N, 3) on upright walls within 45 m [m]."""
    random = np.random.default_rng(seed)
    parts = []
    for _ in range(count):
        centre, turn = random.uniform(-45.0, 45.0, 2), random.choice([0.0, np.pi / 2]) + random.normal(0.0, 0.05)
        length, height = random.uniform(4.0, 18.0), random.uniform(2.0, 10.0)
        n = int(length * height * 6)
        along = random.uniform(-0.5 * length, 0.5 * length, n)
        parts.append(
            np.column_stack([centre[0] + np.cos(turn) * along, centre[1] + np.sin(turn) * along, random.uniform(0.0, height, n)])
        )
    return np.concatenate(parts)


def visited(points: NDArray[np.float64], seed: int) -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
    """What is seen of a place from somewhere near its middle, in a frame there; with yaw and t (2,) of T_place_visit."""
    random = np.random.default_rng(seed)
    yaw, t = float(random.uniform(-np.pi, np.pi)), random.uniform(-8.0, 8.0, 2)
    near = points[np.linalg.norm(points[:, :2] - t, axis=1) < 40.0]
    c, s = np.cos(yaw), np.sin(yaw)
    xy = (near[:, :2] + random.normal(0.0, 0.03, (len(near), 2)) - t) @ np.array([[c, -s], [s, c]])
    return np.column_stack([xy, near[:, 2]]), yaw, t
