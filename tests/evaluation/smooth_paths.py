"""Random smooth trajectories for the tests of the evaluation."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from boxplus.formats.trajectory import Trajectory


class SmoothPath:
    """A spline through random positions and rotations, to be sampled at any time within [0, duration]."""

    def __init__(self, seed: int, duration_s: float = 30.0, size_m: float = 10.0) -> None:
        rng = np.random.default_rng(seed)
        knots = np.arange(0.0, duration_s + 2.0, 1.0)
        self._p = CubicSpline(knots, np.cumsum(rng.normal(scale=size_m / 10.0, size=(len(knots), 3)), axis=0))
        turns = Rotation.from_rotvec(np.cumsum(rng.normal(scale=0.3, size=(len(knots), 3)), axis=0))
        self._R = RotationSpline(knots, turns)

    def sample(self, t: np.ndarray, start_ns: int = 1_500_000_000_000_000_000) -> Trajectory:
        time_ns = start_ns + np.round(t * 1e9).astype(np.int64)
        return Trajectory(time_ns, self._p(t), self._R(t).as_quat()[:, [3, 0, 1, 2]], source="path")


def moved(trajectory: Trajectory, rotation: Rotation, translation: np.ndarray, scale: float = 1.0) -> Trajectory:
    """The trajectory seen from another world frame."""
    q = (rotation * Rotation.from_quat(trajectory.q_wxyz[:, [1, 2, 3, 0]])).as_quat()[:, [3, 0, 1, 2]]
    return Trajectory(trajectory.time_ns, scale * rotation.apply(trajectory.p) + translation, q, source="moved")


def disturbed(trajectory: Trajectory, seed: int, sigma_m: float = 0.05, sigma_rad: float = 0.01) -> Trajectory:
    """The trajectory with white noise on positions and rotations."""
    rng = np.random.default_rng(seed)
    noise = Rotation.from_rotvec(rng.normal(scale=sigma_rad, size=(len(trajectory), 3)))
    q = (Rotation.from_quat(trajectory.q_wxyz[:, [1, 2, 3, 0]]) * noise).as_quat()[:, [3, 0, 1, 2]]
    p = trajectory.p + rng.normal(scale=sigma_m, size=trajectory.p.shape)
    return Trajectory(trajectory.time_ns, p, q, source="disturbed")
