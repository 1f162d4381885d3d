"""Whether what goes by goes by as the estimate says: of a LiDAR alone, nothing else tells that it moves.

On a road between rails and walls the points look the same from every place. A registration, point to plane, stays at rest with
them while the platform drives, well determined by their ripples, and no scan is weak. What does change are posts, bushes and
signs, and they have one motion in common (`common_motion`). Where scans show a direction poorly, that motion is asked for: a
start goes by it, and an estimate that has another one later is contradicted. Nothing passes in a bare tunnel: there it is asked
whether any surface faces the way at all (`SeenSurfaces`), or the scans know of it by their own pattern only.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus._words import signed
from boxplus.filtering.degeneracy import PoseDirections
from boxplus.manifolds import so3
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.local_maps.vertical import find_vertical
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.changes.common_motion import CommonMotion, common_motion
from boxplus.systems.lidar_inertial_agreement.lidar_path.explained_scans import turning_through
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import Poses
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import Turning, middle_of
from boxplus.systems.lidar_inertial_agreement.lidar_path.surfaces import SeenSurfaces
from boxplus.systems.lidar_odometry.motion import MotionState

Floats = NDArray[np.float64]

_SCANS = 6  # in a row that are asked, as `common_motion` needs
_EVERY_S, _SELDOM_S = 3.0, 30.0  # where all is well, at first and later on: it takes the time of twenty scans
_POORLY = 12.0  # least ratio of a measured direction (`filtering.degeneracy`) below which scans are asked
_HARDLY = 6.0  # and below which what a scan says of it may be its own pattern
_POINTS = 4000  # of a scan, whose surfaces are looked at
_APART_M_S, _APART_SHARE = 2.0, 0.1  # velocities that differ by both together are two
_OF_WAY = 0.5  # share of a direction that is a shift and no turn
_LEVEL = 0.7  # cosine between a way and the LiDAR's own z axis, at most
_TOGETHER = 2  # judgements in a row that say the same


class PassingWatch:
    """Follows the scans of one run and where they were placed.

    Attributes:
        contradiction: what speaks against the estimate, a sentence; None as long as nothing does.
    """

    def __init__(self) -> None:
        self.contradiction: str | None = None
        self._scans: deque[tuple[Scan, MotionState, float]] = deque(maxlen=_SCANS)
        self._next_ns: int | None = None
        self._every_s = _EVERY_S
        self._against = 0

    def restart(self) -> None:
        """The scans to come do not belong to those before."""
        self._scans.clear()
        self._against, self._next_ns, self._every_s = 0, None, _EVERY_S

    def add(self, scan: Scan, state: MotionState, directions: PoseDirections, tree: IkdTree) -> str | None:
        """Take a scan that fitted the map; returns what speaks against the estimate, when it is found.

        Args:
            scan: as it was measured.
            state: where the LiDAR was at its end.
            directions: what it determines.
            tree: the map.
        """
        self._scans.append((scan, state, float(directions.ratios.min())))
        is_due = self._next_ns is None or scan.end_ns >= self._next_ns
        if self.contradiction is not None or len(self._scans) < _SCANS or not is_due:
            return None
        ratio = float(np.median([ratio for _, _, ratio in self._scans]))
        if ratio >= _POORLY:
            return None
        text = self._difference()
        if text is None and ratio < _HARDLY:
            text = _open_way(scan, state, directions, tree)
        self._against = 0 if text is None else self._against + 1
        self._next_ns = None
        if text is None:
            self._next_ns = scan.end_ns + round(self._every_s * 1e9)
            self._every_s = min(2.0 * self._every_s, _SELDOM_S)
        self._scans.clear()
        if self._against < _TOGETHER:
            return None
        self.contradiction = text
        return text

    def _difference(self) -> str | None:
        """The motion that what changes has in common, where the estimate has another one."""
        states = [state for _, state, _ in self._scans]
        ends, R, p = (
            np.array(part) for part in zip(*((s.time_ns, s.R_world_lidar, s.p_world_lidar) for s in states), strict=True)
        )
        scans = [scan for scan, _, _ in self._scans]
        motion = passing_motion(scans, (ends, R, p))
        if motion is None or motion.doubt:
            return None
        R_world_first = turning_along(ends, R)(np.array([middle_of(scans[0])]))[0]
        estimated = R_world_first.T @ (p[-1] - p[0]) / (float(ends[-1] - ends[0]) * 1e-9)
        apart, speed = float(np.linalg.norm(motion.velocity - estimated)), float(np.linalg.norm(motion.velocity))
        if apart < _APART_M_S + _APART_SHARE * speed:
            return None
        return (
            f"what changes from scan to scan goes by as at {signed(motion.velocity, 1)} m/s (LiDAR axes), and the estimate moves "
            f"at {signed(estimated, 1)} m/s: surroundings that look the same from every place (a road, rails, walls) went along "
            "with it, and its way is wrong; take an IMU, or begin at rest where something faces the way"
        )


def _open_way(scan: Scan, state: MotionState, directions: PoseDirections, tree: IkdTree) -> str | None:
    """That no surface faces the way that a scan knows least, though it seemed to measure it; None where one does."""
    column = directions.vectors[3:, int(directions.ratios.argmin())]
    length = float(np.linalg.norm(column))
    if length < _OF_WAY or directions.weak.any():  # a turn, or said to be open already
        return None
    axis = column / length
    if abs(axis @ state.R_world_lidar[:, 2]) > _LEVEL:  # nothing drives there, and few rings see floors that would show it
        return None
    p_lidar = scan.p_lidar[:: -(-len(scan) // _POINTS)].astype(np.float64)
    p_world = p_lidar @ state.R_world_lidar.T + state.p_world_lidar
    if SeenSurfaces(tree, p_world).face_for_rings(state.p_world_lidar, axis, float(directions.ratios.min())):
        return None
    return (
        f"nothing that the LiDAR sees faces the way along {signed(axis, 2)} (in the world frame): what its scans say of it is "
        "their own pattern, and how far it went is not known"
    )


def passing_motion(scans: Sequence[Scan], poses: Poses) -> CommonMotion | None:
    """The motion that explains what changes; None where there is none, or surfaces do not show where up is.

    Args:
        scans: consecutive sweeps, at least 6; one pose each.
        poses: of the LiDAR, which may be wrong along the way, but not in their turns.
    """
    time_ns, R, p = poses
    turning = turning_along(time_ns, R)
    R_first = turning(np.array([middle_of(scans[0])]))[0]
    p_first = [(scan.p_lidar.astype(np.float64) @ R[k].T + p[k] - p[0]) @ R_first for k, scan in enumerate(scans)]
    up_first = find_vertical(np.concatenate(p_first).astype(np.float32), np.array([0.0, 0.0, 1.0]))
    return None if up_first is None else common_motion(scans, turning, up_first)


def turning_along(time_ns: NDArray[np.int64], R: Floats) -> Turning:
    """How a LiDAR turned between some attitudes R (K, 3, 3), K at least 2, at `time_ns` (K,), and beyond them as next to them."""
    rates = so3.log(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / (np.diff(time_ns)[:, None] * 1e-9)
    return turning_through(time_ns, R, rates[np.maximum(np.arange(len(R)) - 1, 0)])
