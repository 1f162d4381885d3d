"""Trajectories that are splines on the manifold, with exact derivatives.

Position is a uniform cubic B-spline; rotation is a cumulative uniform cubic B-spline on SO(3) (Kim, Kim and Shin, SIGGRAPH
1995; derivatives after Sommer et al., CVPR 2020). Acceleration and angular velocity are continuous.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.manifolds import so3
from boxplus.manifolds.so3 import exp_into, product_into

Floats = NDArray[np.float64]


class Motion(NamedTuple):
    """Exact motion at N instants.

    Attributes:
        R_world_imu: (N, 3, 3) rotation, IMU to world.
        p_world_imu: (N, 3) position of the IMU in the world [m].
        v_world_imu: (N, 3) velocity in the world frame [m/s].
        a_world_imu: (N, 3) acceleration in the world frame [m/s²].
        omega_imu: (N, 3) angular velocity in the IMU frame [rad/s].
    """

    R_world_imu: Floats
    p_world_imu: Floats
    v_world_imu: Floats
    a_world_imu: Floats
    omega_imu: Floats


class Trajectory(Protocol):
    """A motion of the IMU with exact derivatives, on `[start_ns, end_ns]`."""

    start_ns: int
    end_ns: int

    @property
    def duration_s(self) -> float:
        """Length of the motion [s]."""

    def evaluate(self, time_ns: ArrayLike) -> Motion:
        """Exact motion at `time_ns` (N,) integers [ns]."""


def span_of(trajectory: Trajectory, name: str, duration_s: float | None) -> tuple[int, int, float]:
    """First and last instant [ns] and length [s] of the beginning of a motion, all of it without `duration_s`.

    Raises:
        InputError: the motion, that of the scenario `name`, is not so long.
    """
    duration = trajectory.duration_s if duration_s is None else float(duration_s)
    if not 0 < duration <= trajectory.duration_s:
        raise InputError(
            f"a duration of at most {trajectory.duration_s:.1f} s, the length of the motion of {name!r}",
            f"{duration:g} s",
            "ask for less, or give a scenario with a longer trajectory",
        )
    return trajectory.start_ns, min(trajectory.start_ns + round(duration * 1e9), trajectory.end_ns), duration


@kernel
def _evaluate(
    offset_s: Floats,
    knot_s: float,
    R_control: Floats,
    step_control: Floats,
    p_control: Floats,
    R: Floats,
    p: Floats,
    v: Floats,
    a: Floats,
    omega: Floats,
) -> None:
    """Pose and derivatives at `offset_s` (N,) seconds after the first instant; `step_control[i] = Log(R_iᵀ R_{i+1})`."""
    E = np.empty((3, 3))
    A = np.empty((3, 3))
    B = np.empty((3, 3))
    weight = np.empty(3)
    rate = np.empty(3)
    last = p_control.shape[0] - 4
    for n in range(offset_s.shape[0]):
        i = min(max(int(np.floor(offset_s[n] / knot_s)), 0), last)
        u = offset_s[n] / knot_s - i
        u2 = u * u
        u3 = u2 * u
        for k in range(3):
            p0, p1, p2, p3 = p_control[i, k], p_control[i + 1, k], p_control[i + 2, k], p_control[i + 3, k]
            c1 = 0.5 * (p2 - p0)
            c2 = 0.5 * (p0 - 2.0 * p1 + p2)
            c3 = (p3 - 3.0 * p2 + 3.0 * p1 - p0) / 6.0
            p[n, k] = (p0 + 4.0 * p1 + p2) / 6.0 + c1 * u + c2 * u2 + c3 * u3
            v[n, k] = (c1 + 2.0 * c2 * u + 3.0 * c3 * u2) / knot_s
            a[n, k] = (2.0 * c2 + 6.0 * c3 * u) / (knot_s * knot_s)
        weight[0] = (5.0 + 3.0 * u - 3.0 * u2 + u3) / 6.0
        weight[1] = (1.0 + 3.0 * u + 3.0 * u2 - 2.0 * u3) / 6.0
        weight[2] = u3 / 6.0
        rate[0] = 0.5 * (1.0 - 2.0 * u + u2) / knot_s
        rate[1] = 0.5 * (1.0 + 2.0 * u - 2.0 * u2) / knot_s
        rate[2] = 0.5 * u2 / knot_s
        for k in range(3):
            for m in range(3):
                A[k, m] = R_control[i, k, m]
        wx, wy, wz = 0.0, 0.0, 0.0
        for j in range(3):
            sx, sy, sz = step_control[i + j, 0], step_control[i + j, 1], step_control[i + j, 2]
            exp_into(weight[j] * sx, weight[j] * sy, weight[j] * sz, E)
            product_into(A, E, B)
            for k in range(3):
                for m in range(3):
                    A[k, m] = B[k, m]
            tx = E[0, 0] * wx + E[1, 0] * wy + E[2, 0] * wz + rate[j] * sx
            ty = E[0, 1] * wx + E[1, 1] * wy + E[2, 1] * wz + rate[j] * sy
            wz = E[0, 2] * wx + E[1, 2] * wy + E[2, 2] * wz + rate[j] * sz
            wx, wy = tx, ty
        for k in range(3):
            for m in range(3):
                R[n, k, m] = A[k, m]
        omega[n, 0], omega[n, 1], omega[n, 2] = wx, wy, wz


def checked_times(time_ns: ArrayLike, start_ns: int, end_ns: int) -> NDArray[np.int64]:
    """`time_ns` as (N,) int64 within `[start_ns, end_ns]`.

    Raises:
        InputError: a time outside, or times that are not integers.
    """
    time = np.atleast_1d(np.asarray(time_ns))
    if time.ndim != 1 or time.dtype.kind not in "iu":
        raise InputError(
            "time_ns as integer nanoseconds of shape (N,)",
            f"{time.dtype} of shape {time.shape}",
            "convert seconds with np.round(seconds * 1e9).astype(np.int64)",
        )
    if len(time) and not (start_ns <= time.min() and time.max() <= end_ns):
        raise InputError(
            f"times within [{start_ns}, {end_ns}] ns, the span of the trajectory",
            f"times from {time.min()} to {time.max()}",
            "ask for instants of the motion only",
        )
    return time.astype(np.int64)


class SplineTrajectory:
    """A smooth motion of the IMU through the world.

    Args:
        start_ns: first instant [ns].
        knot_s: time between control poses [s].
        R_control: (K, 3, 3) control rotations, K ≥ 4; neighbours less than π apart.
        p_control: (K, 3) control positions [m]. The curve follows the control poses smoothly without passing through them;
            four equal control poses in a row are an exact standstill.

    The motion is defined on `[start_ns, end_ns]`, K − 3 knot intervals.

    Raises:
        InputError: wrong shapes, or matrices that are not rotations.
    """

    def __init__(self, start_ns: int, knot_s: float, R_control: ArrayLike, p_control: ArrayLike) -> None:
        R = np.ascontiguousarray(R_control, dtype=np.float64)
        p = np.ascontiguousarray(p_control, dtype=np.float64)
        if R.ndim != 3 or R.shape[1:] != (3, 3) or p.shape != (len(R), 3) or len(R) < 4:
            raise InputError(
                "K ≥ 4 control poses: R_control (K, 3, 3) and p_control (K, 3)",
                f"shapes {R.shape} and {p.shape}",
                "give one rotation and one position a knot",
            )
        if not so3.is_rotation(R):
            raise InputError("R_control of rotation matrices", "a matrix that is not one", "orthonormalise it, determinant +1")
        if not knot_s > 0:
            raise InputError("a positive time between knots [s]", f"{knot_s}", "use for example 0.1")
        self.start_ns = int(start_ns)
        self.knot_s = float(knot_s)
        self.end_ns = self.start_ns + round((len(R) - 3) * knot_s * 1e9)
        self._R_control = R
        self._p_control = p
        self._step_control = so3.log(np.swapaxes(R[:-1], 1, 2) @ R[1:])

    @property
    def duration_s(self) -> float:
        """Length of the motion [s]."""
        return (self.end_ns - self.start_ns) * 1e-9

    def evaluate(self, time_ns: ArrayLike) -> Motion:
        """Exact motion at `time_ns` (N,) integers, absolute nanoseconds, in any order.

        Raises:
            InputError: a time outside of `[start_ns, end_ns]`, or times that are not integers.
        """
        time = checked_times(time_ns, self.start_ns, self.end_ns)
        offset_s = (time - self.start_ns) * 1e-9
        count = len(time)
        motion = Motion(np.empty((count, 3, 3)), *(np.empty((count, 3)) for _ in range(4)))
        _evaluate(offset_s, self.knot_s, self._R_control, self._step_control, self._p_control, *motion)
        return motion

    def starting_at(self, start_s: float) -> SplineTrajectory:
        """The same motion without its first `start_s` seconds (rounded to whole knots); it keeps its `start_ns`."""
        first = round(start_s / self.knot_s)
        return SplineTrajectory(self.start_ns, self.knot_s, self._R_control[first:], self._p_control[first:])
