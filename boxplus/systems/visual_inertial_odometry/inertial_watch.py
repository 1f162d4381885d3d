"""Whether cameras and IMU agree on the way: where the IMU alone comes to in some seconds, and where the cameras say it is.

A baseline that is stated too long or too short makes every length of the cameras wrong by one factor, and the estimator finds a
compromise that looks well in every single frame. Over seconds it does not: from an estimate (R, p, v, b) on, with its covariance
P, the IMU alone is integrated for a time T,

    p̂ = p + v T + ½ g T² + R α

and compared with the place p_T that the window has found by then. What is not known of it has the covariance

    S = J P Jᵀ + R Σ_α Rᵀ + P_p(T) − P_p

of the begin, of the IMU's noise, and of the cameras' way. The normalised square (p_T − p̂)ᵀ S⁻¹ (p_T − p̂) / 3 is 1 in the mean. As
p_T is drawn to p̂ by the window, which believes the IMU as well, it is smaller in sound runs. A motion without acceleration tells
nothing of lengths, and does no harm.

Source: Bar-Shalom, Li and Kirubarajan, Estimation with applications to tracking and navigation, 2001, 5.4 (tests of innovations).
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion, so3
from boxplus.residuals.inertial.imu_preintegration import Preintegration

_SEGMENT_S = 2.5
_SEGMENTS, _FEWEST = 3, 2  # that are averaged: those of the newest that come apart most, and at least
_LEAST_WAY = 0.005  # m, of what is not known of the cameras' way
_MOST = 3.0  # times as far as what is known explains
_SHORT_S = 1.0  # segments that tell lengths
_FEWEST_SHORT = 5  # of them

# What a segment's d has to be of its own error, squared, to say something of lengths: that error is in `off` with the other
# sign, and looks like lengths too short by 3 over this, all of them where nothing moves.
_LEAST_SHOWN = 300.0

LEAST_LENGTH, LEAST_SIGMAS = 0.02, 4.0
"""A share of lengths and its standard deviations, both of which a contradiction of the lengths takes."""

Floats = NDArray[np.float64]


class _Gap(NamedTuple):
    """Where a segment ends: off (3,) = p_T − p̂ and d (3,) = p̂ − p − v T [m], S (3, 3) the covariance of off."""

    off: Floats
    d: Floats
    S: Floats


class _Segments:
    """Cuts the way into segments of a length in time [s]."""

    def __init__(self, duration_s: float, down: Floats) -> None:
        self._duration_s, self._down = duration_s, down
        self._begin: tuple[Floats, Floats, Floats] | None = None
        self._steps: list[Preintegration] = []  # since the begin; integrated as one when the segment is over

    def add(self, pose: Floats, state: Floats, covariance: Floats, step: Preintegration | None) -> _Gap | None:
        """The newest frame, see `InertialWatch.add`; where a segment ends at it."""
        gap = None
        if self._begin is not None and step is not None:
            self._steps.append(step)
            if 1e-9 * float(step.intervals_ns[0, 1] - self._steps[0].intervals_ns[0, 0]) < self._duration_s:
                return None
            gap = self._compare(*self._begin, _as_one(self._steps), pose, covariance)
        self._begin, self._steps = (pose.copy(), state.copy(), covariance.copy()), []
        return gap

    def _compare(self, pose_0: Floats, state_0: Floats, P: Floats, imu: Preintegration, pose: Floats, covariance: Floats) -> _Gap:
        R, T = quaternion.to_matrix(pose_0[:4]), 1e-9 * float(imu.intervals_ns[0, 1] - imu.intervals_ns[0, 0])
        by_bias = imu.bias_jacobian[0, :3]
        alpha = imu.alpha[0] + by_bias @ (state_0[3:] - np.concatenate([imu.bias_accel[0], imu.bias_gyro[0]]))
        d = 0.5 * self._down * T**2 + R @ alpha
        J = np.zeros((3, 15))
        J[:, :3], J[:, 6:9] = -R @ so3.hat(alpha), T * np.eye(3)
        J[:, 9:12], J[:, 12:] = R @ by_bias[:, 3:], R @ by_bias[:, :3]
        way = covariance[3:6, 3:6] - P[3:6, 3:6]
        value, axes = np.linalg.eigh(0.5 * (way + way.T))
        S = J @ P @ J.T + R @ imu.covariance[0, :3, :3] @ R.T + axes * np.maximum(value, _LEAST_WAY**2) @ axes.T
        return _Gap(pose[4:] - pose_0[4:] - state_0[:3] * T - d, d, S)


class InertialWatch:
    """Compares the way that the window finds with that of the IMU alone, every few seconds.

    Args:
        gravity: magnitude [m/s²].

    Attributes:
        ratio: distance between the two, by what is known of both, over the last two segments or three, whichever is more: the
            first one, of which a start knows little, is no evidence for what follows. 1 is exact, 0 before there are two.
        length: by what share lengths of the cameras are longer than those of the IMU, and the standard deviation of that.
    """

    def __init__(self, gravity: float) -> None:
        down = np.array([0.0, 0.0, -gravity])
        self._long, self._short = _Segments(_SEGMENT_S, down), _Segments(_SHORT_S, down)
        self._squares: deque[float] = deque(maxlen=_SEGMENTS)
        self._off = 0.0
        self._sums = np.zeros(4)  # of dᵀ S⁻¹ d, dᵀ S⁻¹ o, oᵀ S⁻¹ o and 1, over all short segments that show lengths

    @property
    def ratio(self) -> float:
        """See the class."""
        newest = list(self._squares)
        means = [float(np.mean(newest[-count:])) for count in range(_FEWEST, len(newest) + 1)]
        return float(np.sqrt(max(means, default=0.0)))

    @property
    def length(self) -> tuple[float, float]:
        """See the class; not a number, and infinitely uncertain, before there are enough segments."""
        dd, do, oo, segments = self._sums
        if segments < _FEWEST_SHORT or dd <= 0.0:
            return np.nan, np.inf
        left = (oo - do**2 / dd) / (3.0 * segments - 1.0)
        return float(do / dd), float(np.sqrt(max(left, 1.0) / dd))

    @property
    def contradiction(self) -> str | None:
        """What contradicts, in a sentence; None where nothing does."""
        share, sigma = self.length
        if abs(share) > max(LEAST_LENGTH, LEAST_SIGMAS * sigma):
            are = "longer" if share > 0.0 else "shorter"
            return (
                f"lengths by the cameras are {100.0 * abs(share):.1f} % {are} than by the IMU, "
                f"with a standard deviation of {100.0 * sigma:.1f} %: check the baseline of the cameras in T_imu_camera, their "
                "focal lengths, and the scale of the accelerometer"
            )
        if self.ratio < _MOST:
            return None
        return (
            f"in {_SEGMENT_S:g} s the way by the cameras and the IMU's alone come apart by {self._off:.2f} m, {self.ratio:.0f} "
            "times what is known of both: check the scale, which is the baseline of the cameras in T_imu_camera, and the IMU's "
            "clock"
        )

    def add(self, pose: Floats, state: Floats, covariance: Floats, step: Preintegration | None) -> None:
        """The newest frame.

        Args:
            pose: (7,) T_world_imu; state: (9,) [v, b_a, b_g]; covariance: (15, 15) of [θ, p, v, b_ω, b_a].
            step: what the IMU measured since the frame before, one interval; None where that is not to be relied on.
        """
        short = self._short.add(pose, state, covariance, step)
        if short is not None:
            by_d, by_off = np.linalg.solve(short.S, np.stack([short.d, short.off], axis=1)).T
            if short.d @ by_d > _LEAST_SHOWN:
                self._sums += [short.d @ by_d, short.d @ by_off, short.off @ by_off, 1.0]
        segment = self._long.add(pose, state, covariance, step)
        if segment is not None:
            self._squares.append(float(segment.off @ np.linalg.solve(segment.S, segment.off)) / 3.0)
            self._off = float(np.linalg.norm(segment.off))


def _as_one(steps: list[Preintegration]) -> Preintegration:
    """The interval from the begin of the first step to the end of the last, at the biases of the first."""
    time_ns, kept = np.unique(np.concatenate([step.time_ns for step in steps]), return_index=True)
    return Preintegration.integrate(
        time_ns,
        np.concatenate([step.gyro for step in steps])[kept],
        np.concatenate([step.accel for step in steps])[kept],
        noise=steps[0].noise,
        intervals_ns=[steps[0].intervals_ns[0, 0], steps[-1].intervals_ns[0, 1]],
        bias_accel=steps[0].bias_accel[0],
        bias_gyro=steps[0].bias_gyro[0],
    )
