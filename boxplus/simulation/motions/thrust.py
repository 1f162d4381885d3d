"""The motion of a multicopter: it pushes along its own z axis and nowhere else, so its attitude follows from its acceleration.

An accelerometer on board then reads nothing but ‖a − g‖ along z, however it flies (Mellinger and Kumar, ICRA 2011, differential
flatness: attitude and angular velocity of a quadrotor from the derivatives of its position).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline

from boxplus.errors import InputError
from boxplus.simulation.imu import GRAVITY
from boxplus.simulation.motions.spline import Motion, checked_times

_DEGREE = 5


class ThrustTrajectory:
    """A flight whose specific force lies exactly along +z of the IMU.

    Position and heading are uniform quintic B-splines: jerk and angular velocity are continuous. The body's z axis is the
    direction of a − g; its x axis is as near to the heading as that allows.

    Args:
        start_ns: first instant [ns].
        knot_s: time between control points [s].
        p_control: (K, 3) control positions [m], K ≥ 6; six equal ones in a row are an exact standstill, level.
        yaw_control: (K,) control headings [rad].

    The motion is defined on `[start_ns, end_ns]`, K − 5 knot intervals.

    Raises:
        InputError: wrong shapes, or values that are not finite.
    """

    def __init__(self, start_ns: int, knot_s: float, p_control: ArrayLike, yaw_control: ArrayLike) -> None:
        p, yaw = np.asarray(p_control, dtype=np.float64), np.asarray(yaw_control, dtype=np.float64)
        if p.ndim != 2 or p.shape[1:] != (3,) or yaw.shape != p.shape[:1] or len(p) <= _DEGREE or not np.isfinite(p).all():
            raise InputError(
                "K ≥ 6 control points: p_control (K, 3) and yaw_control (K,), finite",
                f"shapes {p.shape} and {yaw.shape}",
                "give one position and one heading a knot",
            )
        if not knot_s > 0:
            raise InputError("a positive time between knots [s]", f"{knot_s}", "use for example 0.1")
        self.start_ns, self.knot_s = int(start_ns), float(knot_s)
        self.end_ns = self.start_ns + round((len(p) - _DEGREE) * knot_s * 1e9)
        knots = (np.arange(len(p) + _DEGREE + 1) - _DEGREE) * self.knot_s
        flat = BSpline(knots, np.column_stack([p, yaw]), _DEGREE)
        self._derivatives = [flat, *(flat.derivative(order) for order in (1, 2, 3))]

    @property
    def duration_s(self) -> float:
        """Length of the motion [s]."""
        return (self.end_ns - self.start_ns) * 1e-9

    def evaluate(self, time_ns: ArrayLike) -> Motion:
        """Exact motion at `time_ns` (N,) integers, absolute nanoseconds, in any order.

        Raises:
            InputError: a time outside of `[start_ns, end_ns]`, or times that are not integers.
        """
        offset_s = (checked_times(time_ns, self.start_ns, self.end_ns) - self.start_ns) * 1e-9
        value, first, second, third = (np.asarray(derivative(offset_s)) for derivative in self._derivatives)
        thrust = second[:, :3] + np.array([0.0, 0.0, GRAVITY])
        z, z_rate = _unit(thrust, third[:, :3])
        ahead = np.stack([np.cos(value[:, 3]), np.sin(value[:, 3]), np.zeros(len(value))], axis=1)
        ahead_rate = first[:, 3:4] * np.stack([-ahead[:, 1], ahead[:, 0], ahead[:, 2]], axis=1)
        y, y_rate = _unit(np.cross(z, ahead), np.cross(z_rate, ahead) + np.cross(z, ahead_rate))
        x, x_rate = np.cross(y, z), np.cross(y_rate, z) + np.cross(y, z_rate)
        R, R_rate = np.stack([x, y, z], axis=2), np.stack([x_rate, y_rate, z_rate], axis=2)
        spin = np.swapaxes(R, 1, 2) @ R_rate  # [ω]×
        omega = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
        return Motion(R, value[:, :3], first[:, :3], second[:, :3], omega)


def _unit(v: NDArray[np.float64], v_rate: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Directions (N, 3) of vectors (N, 3) and their rates of change, from those of the vectors."""
    norm = np.linalg.norm(v, axis=1, keepdims=True)
    unit = v / norm
    rate = (v_rate - unit * np.sum(unit * v_rate, axis=1, keepdims=True)) / norm
    return unit, rate
