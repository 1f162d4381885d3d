"""Scans cut into slices, each seen from where the LiDAR was at one instant, with half of its points before that and half after.

Between the poses of an odometry the gyroscope alone says how a scan was bent, and its noise bends every scan anew. Slices of some
milliseconds are bent less, and each gets a pose of its own. With the pose in the middle of its points, what noise turns them by
has a quarter of the variance that it has about either end (docs/refinement.md).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import TANGENT, NavState
from boxplus.filtering.propagation import NODE, propagate_interval
from boxplus.manifolds import quaternion, se3, so3
from boxplus.sensors.lidar.deskew import deskew_into
from boxplus.sensors.sequencer import Frame

Floats = NDArray[np.float64]

_STEPS = 2.2  # samples of the IMU in a slice, at least
_NO_NOISE = np.zeros(4)
_BACKWARD_STEP_S = 0.005


@dataclass(frozen=True, slots=True, eq=False)
class Slice:
    """Part of a scan.

    Attributes:
        time_ns: of its pose.
        T_world_imu: (7,), v_world: (3,) then.
        p_lidar: (n, 3) float32, the points up to then in the LiDAR frame then.
        p_lidar_before: (m, 3) float32, those that are nearer to the pose of the slice before, in the LiDAR frame of that one.
        is_end: the slice is the last one of its scan: the pose is the odometry's.
    """

    time_ns: int
    T_world_imu: Floats
    v_world: Floats
    p_lidar: NDArray[np.float32]
    p_lidar_before: NDArray[np.float32]
    is_end: bool


def slices_that_fit(imu_time_ns: NDArray[np.int64], scan_s: float, wanted: int) -> int:
    """How many slices a scan of this length can be cut into, at most `wanted`: each takes a few samples of the IMU."""
    if len(imu_time_ns) < 2:
        return 1
    step_s = float(np.median(np.diff(imu_time_ns))) * 1e-9
    return int(np.clip(scan_s / (_STEPS * step_s), 1, wanted))


def cut(
    frame: Frame, before: NavState | None, after: NavState, count: int, max_gap_s: float, most_points: int
) -> Iterator[Slice]:
    """The slices of a scan, in order.

    Args:
        frame: the scan and its IMU samples.
        before: the odometry's state at the end of the scan before; None for the first scan, of which there is one slice.
        after: at the end of this scan.
        count: slices.
        max_gap_s: longest interval between samples that is integrated over.
        most_points: of the scan that are kept, evenly.
    """
    scan = frame.scan
    kept = np.arange(len(scan)) if len(scan) <= most_points else np.linspace(0, len(scan) - 1, most_points).astype(np.int64)
    points, time_ns = scan.p_lidar[kept], scan.time_ns[kept]
    T_after = _pose(after)
    half_ns = (scan.end_ns - max(frame.begin_ns, scan.start_ns)) // (2 * count)
    is_first = before is None
    if before is None:
        # Where it began is told by going back from its end, with a velocity that the odometry has hardly found yet: of its points
        # those take part that are as near to its pose as those of other slices are to theirs.
        before, count = _back(frame, after), 1
        near_end = time_ns >= scan.end_ns - half_ns
        points, time_ns = points[near_end], time_ns[near_end]
    motion = _Motion(frame, before, max_gap_s)
    first_ns = max(frame.begin_ns, scan.start_ns) if scan.start_ns < scan.end_ns else frame.begin_ns
    ends = [first_ns + (scan.end_ns - first_ns) * (number + 1) // count for number in range(count)]
    predicted: list[tuple[int, Floats, Floats, NDArray[np.float32], NDArray[np.float32]]] = []
    T_imu_lidar = np.concatenate([quaternion.from_matrix(after.R_imu_lidar[None])[0], after.p_imu_lidar])
    start_ns = frame.begin_ns
    for number, end_ns in enumerate(ends):
        # Nobody was where the first scan began, nor where one begins that began after the last one had ended.
        halves = not is_first and (number > 0 or 2 * (first_ns - frame.begin_ns) <= end_ns - first_ns)
        T_start, middle_ns = _pose(motion.state), (start_ns + end_ns) // 2 if halves else start_ns
        late, early = number + 1 == count, number == 0
        to_end = (late | (time_ns <= end_ns)) & ((early and not halves) | (time_ns > middle_ns))
        near = points[:0]
        if halves:
            to_start = (early | (time_ns > start_ns)) & (time_ns <= middle_ns)
            there = motion.on_to(middle_ns, points, time_ns, to_start)
            T_back = se3.compose(se3.inverse(se3.compose(T_start, T_imu_lidar)), se3.compose(_pose(motion.state), T_imu_lidar))
            near = se3.act(T_back, there.astype(np.float64)).astype(np.float32).reshape(-1, 3)
        moved = motion.on_to(end_ns, points, time_ns, to_end)
        predicted.append((end_ns, _pose(motion.state), motion.state.v_world_imu, moved, near))
        start_ns = end_ns
    # What the odometry has corrected at the end is spread over the slices.
    correction = se3.log(se3.compose(se3.inverse(predicted[-1][1]), T_after))
    pushed = after.v_world_imu - predicted[-1][2]
    for number, (end_ns, T, v, moved, near) in enumerate(predicted):
        share = (number + 1) / count
        is_end = number + 1 == count
        pose = T_after if is_end else se3.compose(T, se3.exp(share * correction))
        yield Slice(end_ns, pose, v + share * pushed, moved, near, is_end)


class _Motion:
    """Where the IMU's samples carry a state to, instant by instant, and the points on the way."""

    def __init__(self, frame: Frame, before: NavState, max_gap_s: float) -> None:
        self._imu, self._time_ns, self._max_gap_s = frame.imu, frame.begin_ns, max_gap_s
        self._x, self._covariance = before.pack(), np.zeros((TANGENT, TANGENT))

    @property
    def state(self) -> NavState:
        return NavState.unpack(self._x)

    def on_to(
        self, end_ns: int, points: NDArray[np.float32], time_ns: NDArray[np.int64], chosen: NDArray[np.bool_]
    ) -> NDArray[np.float32]:
        """Carry the state to an instant; the chosen points (n, 3), each seen at its own time, in the LiDAR frame then."""
        nodes, start_ns = np.zeros((len(self._imu) + 3, NODE)), self._time_ns
        steps = propagate_interval(
            self._x, self._covariance, (self._imu.time_ns - start_ns) * 1e-9, self._imu.gyro, self._imu.accel,
            (end_ns - start_ns) * 1e-9, _NO_NOISE, self._max_gap_s, _NO_NOISE, nodes,
        )  # fmt: skip
        mine = np.flatnonzero(chosen)
        moved = np.empty((len(mine), 3), dtype=np.float32)
        deskew_into(
            np.ascontiguousarray(points[mine]), np.ascontiguousarray(time_ns[mine]), start_ns, nodes, steps, self._x, moved
        )
        self._time_ns = end_ns
        return moved


def _pose(state: NavState) -> Floats:
    return np.concatenate([quaternion.from_matrix(state.R_world_imu[None])[0], state.p_world_imu])


def _back(frame: Frame, after: NavState) -> NavState:
    """The state at the begin of a frame from that at its end, by the samples between."""
    imu, x = frame.imu, after.pack()
    duration_s = frame.duration_s
    steps = max(int(np.ceil(duration_s / _BACKWARD_STEP_S)), 1)
    times = np.linspace(duration_s, 0.0, steps + 1)
    imu_s = (imu.time_ns - frame.begin_ns) * 1e-9
    state = NavState.unpack(x)
    R, p, v = state.R_world_imu.copy(), state.p_world_imu.copy(), state.v_world_imu.copy()
    for late, early in pairwise(times.tolist()):
        middle, dt = 0.5 * (late + early), late - early
        w = np.array([np.interp(middle, imu_s, imu.gyro[:, k]) for k in range(3)]) - state.bias_gyro
        a = np.array([np.interp(middle, imu_s, imu.accel[:, k]) for k in range(3)]) - state.bias_accel
        R = R @ so3.exp(-w * dt)
        push = R @ a + state.gravity_world
        v = v - push * dt
        p = p - v * dt - 0.5 * push * dt * dt
    return NavState(
        R, p, v, state.bias_gyro, state.bias_accel, state.gravity_world, state.R_imu_lidar, state.p_imu_lidar
    )  # fmt: skip
