"""Straight lines around a simulated flight, seen as segments without images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.systems.visual_inertial_odometry import Rig, VioConfig, VioEstimate, VisualInertialOdometry
from boxplus.systems.visual_inertial_odometry.lines.tracks import LineTracks
from tests.systems.visual_inertial_odometry.simulated_rays import Flight, SimulatedTracker, run

LINE_SIGMA = 0.3  # px
_POINTS = 30


class SimulatedLines:
    """Sees segments of a room around the origin: `LineTracker` without images.

    Args:
        corners: is asked where in the flight it is.
        moving: share of the lines that move on their own from 3 s on, at 0.5 m/s.
    """

    seconds = 0.0

    def __init__(self, corners: SimulatedTracker, its: Rig, *, most: int = 20, moving: float = 0.0) -> None:
        self._corners, self._rig, self._most = corners, its, most
        flight = corners._flight
        self._rng = np.random.default_rng([flight.seed, 7])
        direction = self._rng.normal(size=(400, 3)) * [1.0, 1.0, 0.4]
        middle = direction / np.linalg.norm(direction, axis=1)[:, None] * self._rng.uniform(3.0, 8.0, (400, 1))
        along = self._rng.normal(size=(400, 3))
        half = along / np.linalg.norm(along, axis=1)[:, None] * self._rng.uniform(0.3, 1.5, (400, 1))
        self.ends = np.stack([middle - half, middle + half], axis=1)
        self._moves = self._rng.random(400) < moving
        self._followed: dict[int, int] = {}  # line → id
        self._next_id = 0
        self.given_up: list[int] = []

    def _segments(self, camera: int, which: NDArray[np.int64]) -> NDArray[np.float64]:
        """(n, 4) of rays, with noise across; NaN where less than 40 px are in the image."""
        flight, mounted, at = self._corners._flight, self._rig.cameras[camera], self._corners._at
        late = max(0.0, at / 200 - 3.0)
        ends = self.ends[which] + np.where(self._moves[which], 0.5 * late, 0.0)[:, None, None] * [0.0, 1.0, 0.0]
        share = np.linspace(0.0, 1.0, _POINTS)[:, None]
        points = ends[:, None, 0] * (1.0 - share) + ends[:, None, 1] * share
        body = (points - flight.p[at]) @ flight.R[at]
        p_camera = (body - mounted.T_imu_camera[:3, 3]) @ mounted.T_imu_camera[:3, :3]
        pixels, seen = mounted.model.project(p_camera.reshape(-1, 3))
        inside = seen & ((pixels > 8.0) & (pixels < [mounted.width - 9.0, mounted.height - 9.0])).all(axis=1)
        inside = inside.reshape(len(which), _POINTS)
        first, last = inside.argmax(axis=1), _POINTS - 1 - inside[:, ::-1].argmax(axis=1)
        n = np.arange(len(which))
        rays = p_camera[..., :2] / np.maximum(p_camera[..., 2:], 0.1)
        a, b = rays[n, first], rays[n, last]
        length = np.linalg.norm(b - a, axis=1)
        visible = inside[n, first] & inside[n, last] & (length * mounted.model.fx > 40.0)
        d = (b - a) / np.maximum(length, 1e-9)[:, None]
        across = np.column_stack([-d[:, 1], d[:, 0]])
        noise = np.random.default_rng([flight.seed, 8, at, camera]).normal(size=(len(self.ends), 2))[which]
        noise *= LINE_SIGMA / self._rig.cameras[0].model.fx
        segments = np.hstack([a + noise[:, :1] * across, b + noise[:, 1:] * across])
        return np.where(visible[:, None], segments, np.nan)

    def track(self, _: object, __: NDArray[np.float64], ___: NDArray[np.float64], *, wants_new: bool = False) -> LineTracks:
        """See `LineTracker.track`."""
        which = np.array(list(self._followed), dtype=np.int64)
        lost = ~np.isfinite(self._segments(0, which)[:, 0]) | (self._rng.random(len(which)) < 0.01)
        for k in which[lost]:
            del self._followed[int(k)]
        if wants_new:
            candidates = self._rng.permutation(len(self.ends))
            new = np.isfinite(self._segments(0, candidates)[:, 0]) & ~np.isin(candidates, list(self._followed))
            for k in candidates[new][: max(self._most - len(self._followed), 0)]:
                self._followed[int(k)] = self._next_id
                self._next_id += 1
        which = np.array(sorted(self._followed, key=self._followed.__getitem__), dtype=np.int64)
        ids = np.array([self._followed[int(k)] for k in which], dtype=np.int64)
        segments = np.stack([self._segments(camera, which) for camera in range(len(self._rig.cameras))], axis=1)
        return LineTracks(ids, segments, {})

    def forget(self, ids: NDArray[np.int64]) -> None:
        """See `LineTracker.forget`."""
        self.given_up += ids.tolist()
        for k in [k for k, n in self._followed.items() if n in set(ids.tolist())]:
            del self._followed[k]


def run_with_lines(
    flight: Flight, its: Rig, config: VioConfig, *, features: int = 25, most: int = 20, moving: float = 0.0
) -> tuple[VisualInertialOdometry, list[VioEstimate], SimulatedLines]:
    """A flight through odometry with few corners, and lines."""
    corners = SimulatedTracker(flight, its, features=features)
    lines = SimulatedLines(corners, its, most=most, moving=moving)
    return *run(flight, its, config, corners, line_tracker=lines), lines
