"""A pose graph that winds: odometry errs, and every loop closure is true."""

from __future__ import annotations

import numpy as np

from boxplus import PoseGraph
from boxplus.manifolds import se2
from boxplus.manifolds.se2 import SE2


def laps(sigma_rotation: float, seed: int) -> PoseGraph:
    """Six laps of a circle, 400 poses, each joined to that of the lap before; turns are noisy [rad], and nothing is false."""
    rng = np.random.default_rng(seed)
    angle = 2.0 * np.pi * np.arange(400) / 66.0
    truth = np.column_stack([angle + 0.5 * np.pi, 10.0 * np.cos(angle), 10.0 * np.sin(angle)])
    edges = np.array([[k, k + 1] for k in range(399)] + [[k - 66, k] for k in range(66, 400)])
    sigma = np.array([sigma_rotation, 0.02, 0.02])
    exact = se2.compose(se2.inverse(truth[edges[:, 0]]), truth[edges[:, 1]])
    measured = SE2.boxplus(exact, sigma * rng.standard_normal((len(edges), 3)))
    information = np.tile(np.diag(sigma**-2.0), (len(edges), 1, 1))
    return PoseGraph(2, np.arange(400), None, edges, measured, information, np.zeros(0, dtype=np.int64))
