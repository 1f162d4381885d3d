"""Scans cut into slices, each seen from where the LiDAR was at the slice's end.

Between the poses of an odometry the gyroscope alone says how a scan was bent, and its noise bends every scan anew. Slices of some
milliseconds are bent less, and each gets a pose of its own.
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
from boxplus.sensors.deskew import deskew_into
from boxplus.sensors.sequencer import Frame

Floats = NDArray[np.float64]

_STEPS = 2.2  # samples of the IMU in a slice, at least
_NO_NOISE = np.zeros(4)
_BACKWARD_STEP_S = 0.005


@dataclass(frozen=True, slots=True, eq=False)
class Slice:
    """Part of a scan.

    Attributes:
        time_ns: its end.
        T_world_imu: (7,), v_world: (3,) then.
        p_lidar: (n, 3) float32, its points in the LiDAR frame at its end.
        is_end: the slice is the last one of its scan: the pose is the odometry's.
    """

    time_ns: int
    T_world_imu: Floats
    v_world: Floats
    p_lidar: NDArray[np.float32]
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
        before: the odometry's state at the end of the scan before; None for the first scan, which is one slice.
        after: at the end of this scan.
        count: slices.
        max_gap_s: longest interval between samples that is integrated over.
        most_points: of the scan that are kept, evenly.
    """
    scan = frame.scan
    kept = np.arange(len(scan)) if len(scan) <= most_points else np.linspace(0, len(scan) - 1, most_points).astype(np.int64)
    points, time_ns = scan.p_lidar[kept], scan.time_ns[kept]
    T_after = _pose(after)
    if before is None:
        before, start_ns, count = _back(frame, after), frame.begin_ns, 1
    start_ns = frame.begin_ns
    x, cov = before.pack(), np.zeros((TANGENT, TANGENT))
    first_ns = max(start_ns, scan.start_ns) if scan.start_ns < scan.end_ns else start_ns
    ends = [first_ns + (scan.end_ns - first_ns) * (number + 1) // count for number in range(count)]
    predicted: list[tuple[int, Floats, Floats, NDArray[np.float32]]] = []
    for number, end_ns in enumerate(ends):
        nodes = np.zeros((len(frame.imu) + 3, NODE))
        steps = propagate_interval(
            x, cov, (frame.imu.time_ns - start_ns) * 1e-9, frame.imu.gyro, frame.imu.accel, (end_ns - start_ns) * 1e-9,
            _NO_NOISE, max_gap_s, _NO_NOISE, nodes,
        )  # fmt: skip
        late, early = number + 1 == count, number == 0
        mine = np.flatnonzero((late | (time_ns <= end_ns)) & (early | (time_ns > start_ns)))
        moved = np.empty((len(mine), 3), dtype=np.float32)
        deskew_into(np.ascontiguousarray(points[mine]), np.ascontiguousarray(time_ns[mine]), start_ns, nodes, steps, x, moved)
        state = NavState.unpack(x)
        predicted.append((end_ns, _pose(state), state.v_world_imu, moved))
        start_ns = end_ns
    # What the odometry has corrected at the end is spread over the slices.
    correction = se3.log(se3.compose(se3.inverse(predicted[-1][1]), T_after))
    pushed = after.v_world_imu - predicted[-1][2]
    for number, (end_ns, T, v, moved) in enumerate(predicted):
        share = (number + 1) / count
        is_end = number + 1 == count
        pose = T_after if is_end else se3.compose(T, se3.exp(share * correction))
        yield Slice(end_ns, pose, v + share * pushed, moved, is_end)


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
