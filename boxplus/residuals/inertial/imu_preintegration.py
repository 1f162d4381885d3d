"""IMU samples between keyframes, summed up once and for all keyframe states (SPEC.md 7).

Source: Forster et al., On-Manifold Preintegration, TRO 2017; Qin, Li and Shen, VINS-Mono, TRO 2018; midpoint recursion and
its exact derivatives as in SPEC.md 7.1 to 7.4.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_floats, as_numbers
from boxplus.errors import InputError
from boxplus.manifolds import quaternion, so3
from boxplus.residuals.inertial.imu_midpoint import integrate_batch

_log = logging.getLogger(__name__)

GAP_S = 0.1  # between samples; the midpoint rule is inaccurate above it (SPEC.md 7, singular cases)
REINTEGRATE_ACCEL = 0.1  # m/s², change of bias above which the linear correction is given up (SPEC.md 7.4)
REINTEGRATE_GYRO = 0.01  # rad/s

NoiseMode = Literal["merged", "independent"]


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Noise densities, as data sheets and Allan deviations give them.

    Attributes:
        gyro: rad/s/√Hz.
        accel: m/s²/√Hz.
        gyro_walk: of the gyroscope's bias, rad/s²/√Hz.
        accel_walk: of the accelerometer's bias, m/s³/√Hz.

    Raises:
        InputError: a density that is not positive and finite: the covariance would be singular.
    """

    gyro: float
    accel: float
    gyro_walk: float
    accel_walk: float

    def __post_init__(self) -> None:
        for name in ("gyro", "accel", "gyro_walk", "accel_walk"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise InputError(
                    f"the noise density {name} positive and finite",
                    f"{value}",
                    "take it from the data sheet; a bias that does not change has a small one",
                )

    @property
    def variances(self) -> NDArray[np.float64]:
        """Squared densities (4,): gyroscope, accelerometer, gyroscope bias, accelerometer bias."""
        return np.square(np.array([self.gyro, self.accel, self.gyro_walk, self.accel_walk], dtype=np.float64))


@dataclass(frozen=True, slots=True, eq=False)
class Preintegration:
    """Preintegrated motion of N intervals, each in the IMU frame at its begin, without gravity.

    With R the orientation and v the velocity at the begin, T the duration and g gravity in the world frame, the end is at
    p_j = p_i + v T + ½ g T² + R α, v_j = v + g T + R β, q_j = q_i ⊗ γ.

    Attributes:
        intervals_ns: (N, 2) int64, begin and end.
        alpha: (N, 3) [m]; beta: (N, 3) [m/s]; gamma_wxyz: (N, 4).
        covariance: (N, 15, 15), error order [α, θ, β, b_a, b_g], θ on the right of γ (SPEC.md 7.2).
        bias_jacobian: (N, 9, 6), ∂[α, θ, β]/∂[b_a, b_g].
        bias_accel: (N, 3) [m/s²] and bias_gyro: (N, 3) [rad/s] that were subtracted.
        noise, mode: what the covariance was computed with; see `integrate`.
        steps: (N,) int64, steps of the recursion.
        longest_gap_s: (N,) longest time between two samples used [s].
        time_ns, gyro, accel: (S,), (S, 3), (S, 3) the samples, for integrating anew.
    """

    intervals_ns: NDArray[np.int64]
    alpha: NDArray[np.float64]
    beta: NDArray[np.float64]
    gamma_wxyz: NDArray[np.float64]
    covariance: NDArray[np.float64]
    bias_jacobian: NDArray[np.float64]
    bias_accel: NDArray[np.float64]
    bias_gyro: NDArray[np.float64]
    noise: ImuNoise
    mode: NoiseMode
    steps: NDArray[np.int64]
    longest_gap_s: NDArray[np.float64]
    time_ns: NDArray[np.int64]
    gyro: NDArray[np.float64]
    accel: NDArray[np.float64]

    @classmethod
    def integrate(
        cls,
        time_ns: ArrayLike,
        gyro: ArrayLike,
        accel: ArrayLike,
        *,
        noise: ImuNoise,
        intervals_ns: ArrayLike | None = None,
        bias_accel: ArrayLike = (0.0, 0.0, 0.0),
        bias_gyro: ArrayLike = (0.0, 0.0, 0.0),
        mode: NoiseMode = "merged",
    ) -> Preintegration:
        """Preintegrate one stream of samples over one or many intervals, which may overlap.

        Where an interval does not begin or end at a sample, one is interpolated. A gap between samples above 0.1 s is
        logged as a warning and kept in `longest_gap_s`.

        Args:
            time_ns: (S,) int64, strictly increasing.
            gyro: (S, 3) [rad/s]; accel: (S, 3), specific force [m/s²].
            noise: densities of the sensor.
            intervals_ns: (N, 2) int64 begin and end of every interval; the whole stream when left out.
            bias_accel, bias_gyro: (3,) or (N, 3), the best guess so far.
            mode: `merged` treats the sample that two neighbouring steps share as one noise, as it is; `independent` as
                two, which makes standard deviations about √2 too small (as VINS-Mono; SPEC.md 7.3).

        Raises:
            InputError: wrong shapes or types, samples that are not finite or not in order of time, fewer than two
                samples, an interval that does not last or is not covered by the samples.
        """
        if mode not in ("merged", "independent"):
            raise InputError('mode "merged" or "independent"', repr(mode), 'leave it out for "merged"')
        time, w, a = _checked_samples(time_ns, gyro, accel)
        given = (time[0], time[-1]) if intervals_ns is None else intervals_ns
        intervals = _checked_intervals(given, time)
        count = len(intervals)
        result = cls(
            intervals_ns=intervals,
            alpha=np.zeros((count, 3)),
            beta=np.zeros((count, 3)),
            gamma_wxyz=np.zeros((count, 4)),
            covariance=np.zeros((count, 15, 15)),
            bias_jacobian=np.zeros((count, 9, 6)),
            bias_accel=_checked_bias("bias_accel", bias_accel, count),
            bias_gyro=_checked_bias("bias_gyro", bias_gyro, count),
            noise=noise,
            mode=mode,
            steps=np.zeros(count, dtype=np.int64),
            longest_gap_s=np.zeros(count),
            time_ns=time,
            gyro=w,
            accel=a,
        )
        result._integrate(np.arange(count, dtype=np.uint32))
        gaps = result.gaps
        if gaps.size:
            _log.warning(
                "%d of %d intervals contain a gap between IMU samples above %g s (the longest: %.3f s); "
                "they are less accurate than their covariance says",
                gaps.size, count, GAP_S, result.longest_gap_s.max(),
            )  # fmt: skip
        return result

    def __len__(self) -> int:
        return len(self.intervals_ns)

    @property
    def duration_s(self) -> NDArray[np.float64]:
        """T of every interval (N,) [s]."""
        seconds: NDArray[np.float64] = (self.intervals_ns[:, 1] - self.intervals_ns[:, 0]).astype(np.float64) * 1e-9
        return seconds

    @property
    def gaps(self) -> NDArray[np.intp]:
        """Intervals that contain a gap between samples above 0.1 s."""
        return np.flatnonzero(self.longest_gap_s > GAP_S)

    def corrected(
        self, bias_accel: ArrayLike, bias_gyro: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """α (N, 3), γ wxyz (N, 4) and β (N, 3) for other biases (3,) or (N, 3), to first order (SPEC.md 7.4)."""
        change_a = _checked_bias("bias_accel", bias_accel, len(self)) - self.bias_accel
        change_g = _checked_bias("bias_gyro", bias_gyro, len(self)) - self.bias_gyro
        moved = (self.bias_jacobian @ np.hstack([change_a, change_g])[:, :, None])[:, :, 0]
        turned = quaternion.multiply(self.gamma_wxyz, quaternion.from_matrix(so3.exp(moved[:, 3:6])))
        return self.alpha + moved[:, :3], turned, self.beta + moved[:, 6:]

    def is_stale(self, bias_accel: ArrayLike, bias_gyro: ArrayLike) -> NDArray[np.bool_]:
        """(N,) whether the biases moved so far (0.1 m/s², 0.01 rad/s) that the linear correction no longer does."""
        change_a = _checked_bias("bias_accel", bias_accel, len(self)) - self.bias_accel
        change_g = _checked_bias("bias_gyro", bias_gyro, len(self)) - self.bias_gyro
        far: NDArray[np.bool_] = (np.linalg.norm(change_a, axis=1) > REINTEGRATE_ACCEL) | (
            np.linalg.norm(change_g, axis=1) > REINTEGRATE_GYRO
        )
        return far

    def reintegrated(self, bias_accel: ArrayLike, bias_gyro: ArrayLike, where: NDArray[np.bool_] | None = None) -> Preintegration:
        """Integrated anew with other biases (3,) or (N, 3): the intervals `where` (N,) holds, by default those `is_stale` names.

        The others keep their biases and numbers.
        """
        ba, bg = _checked_bias("bias_accel", bias_accel, len(self)), _checked_bias("bias_gyro", bias_gyro, len(self))
        anew = self.is_stale(ba, bg) if where is None else np.asarray(where, dtype=np.bool_)
        result = replace(
            self,
            **{name: getattr(self, name).copy() for name in ("alpha", "beta", "gamma_wxyz", "covariance", "bias_jacobian")},
            bias_accel=np.where(anew[:, None], ba, self.bias_accel),
            bias_gyro=np.where(anew[:, None], bg, self.bias_gyro),
        )
        result._integrate(np.flatnonzero(anew).astype(np.uint32))
        return result

    def predict(
        self, pose_i: ArrayLike, velocity_bias_i: ArrayLike, gravity: ArrayLike = (0.0, 0.0, -9.81)
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """State at the end of every interval from that at its begin.

        Args:
            pose_i: (N, 7) or (7,) T_world_imu, wxyz and xyz.
            velocity_bias_i: (N, 9) or (9,): v_world [m/s], b_a, b_g.
            gravity: (3,) in the world frame, pointing down [m/s²].

        Returns:
            pose_j (N, 7) and velocity_bias_j (N, 9).

        Raises:
            InputError: arrays of another shape.
        """
        pose = rows_of("pose_i", pose_i, len(self), 7)
        state = rows_of("velocity_bias_i", velocity_bias_i, len(self), 9)
        alpha, gamma, beta = self.corrected(state[:, 3:6], state[:, 6:])
        R = quaternion.to_matrix(pose[:, :4])
        T, g = self.duration_s[:, None], as_floats(gravity, "gravity")
        p = pose[:, 4:] + state[:, :3] * T + 0.5 * g * T**2 + (R @ alpha[:, :, None])[:, :, 0]
        v = state[:, :3] + g * T + (R @ beta[:, :, None])[:, :, 0]
        return np.hstack([quaternion.multiply(pose[:, :4], gamma), p]), np.hstack([v, state[:, 3:]])

    def _integrate(self, rows: NDArray[np.uint32]) -> None:
        first = np.searchsorted(self.time_ns, self.intervals_ns[:, 0], side="right").astype(np.int64) - 1
        integrate_batch(
            rows, self.time_ns, self.gyro, self.accel, first, self.intervals_ns, self.bias_accel, self.bias_gyro,
            self.noise.variances, self.mode == "merged", self.alpha, self.gamma_wxyz, self.beta, self.covariance,
            self.bias_jacobian, self.steps, self.longest_gap_s,
        )  # fmt: skip


def rows_of(name: str, values: ArrayLike, count: int, size: int) -> NDArray[np.float64]:
    """`values` (size,) or (count, size) as (count, size).

    Raises:
        InputError: another shape.
    """
    array = as_floats(values, name)
    if array.shape not in ((size,), (count, size)):
        raise InputError(
            f"{name} of shape ({size},) or ({count}, {size})", f"shape {array.shape}", "give one row for each interval"
        )
    return np.broadcast_to(array, (count, size))


def _checked_samples(
    time_ns: ArrayLike, gyro: ArrayLike, accel: ArrayLike
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    time = as_numbers(time_ns, "time_ns (S,)")
    if time.ndim != 1 or time.dtype.kind not in "iu":
        raise InputError(
            "time_ns as integer nanoseconds of shape (S,)",
            f"{time.dtype} of shape {time.shape}",
            "convert seconds with np.round(seconds * 1e9).astype(np.int64)",
        )
    if time.size < 2:
        raise InputError("at least two IMU samples", f"{time.size}", "an interval without motion data gives no factor")
    time = np.ascontiguousarray(time, dtype=np.int64)
    ordered = time[1:] > time[:-1]
    if not ordered.all():
        k = int(np.argmin(ordered)) + 1
        raise InputError(
            "time_ns strictly increasing", f"{time[k]} after {time[k - 1]} at sample {k}", "sort the samples, drop doubles"
        )
    vectors = []
    for name, values in (("gyro", gyro), ("accel", accel)):
        array = np.ascontiguousarray(as_floats(values, f"{name} (S, 3)"))
        if array.shape != (time.size, 3):
            raise InputError(f"{name} of shape ({time.size}, 3)", f"shape {array.shape}", "give one row for every time stamp")
        if not np.isfinite(array).all():
            k = int(np.argmin(np.isfinite(array).all(axis=1)))
            raise InputError(f"{name} finite", f"{array[k]} at sample {k}", "drop that sample")
        vectors.append(array)
    return time, vectors[0], vectors[1]


def _checked_intervals(intervals_ns: ArrayLike, time: NDArray[np.int64]) -> NDArray[np.int64]:
    intervals = np.atleast_2d(as_numbers(intervals_ns, "intervals_ns"))
    if intervals.ndim != 2 or intervals.shape[1] != 2 or intervals.dtype.kind not in "iu":
        raise InputError(
            "intervals_ns as integer nanoseconds of shape (N, 2)",
            f"{intervals.dtype} of shape {np.shape(intervals)}",
            "give begin and end of every interval",
        )
    intervals = np.ascontiguousarray(intervals, dtype=np.int64)
    lasts = intervals[:, 1] > intervals[:, 0]
    if not lasts.all():
        n = int(np.argmin(lasts))
        raise InputError("intervals that end after they begin", f"{intervals[n]} in interval {n}", "order the keyframes by time")
    covered = (intervals[:, 0] >= time[0]) & (intervals[:, 1] <= time[-1])
    if not covered.all():
        n = int(np.argmin(covered))
        raise InputError(
            f"intervals within the samples, {time[0]} to {time[-1]} ns",
            f"{intervals[n]} in interval {n}",
            "leave out keyframes without IMU samples on both sides",
        )
    return intervals


def _checked_bias(name: str, bias: ArrayLike, count: int) -> NDArray[np.float64]:
    array = as_floats(bias, name)
    if array.shape not in ((3,), (count, 3)) or not np.isfinite(array).all():
        raise InputError(
            f"{name} finite, of shape (3,) or ({count}, 3)",
            f"{array.shape} {array.ravel()[:3]}",
            "give one bias for each interval",
        )
    return np.array(np.broadcast_to(array, (count, 3)))
