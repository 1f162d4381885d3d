"""IMU samples between keyframes, summed up once and for all keyframe states (docs/residuals/imu_preintegration.md).

Source: Forster et al., On-Manifold Preintegration, TRO 2017; Qin, Li and Shen, VINS-Mono, TRO 2018; midpoint recursion and
its exact derivatives as in docs/residuals/imu_preintegration.md.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_floats
from boxplus.errors import InputError
from boxplus.manifolds import quaternion, so3
from boxplus.residuals.inertial.imu_midpoint import GAP_S, integrate_batch
from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.residuals.inertial.sample_checks import checked_bias, checked_intervals, checked_samples, rows_of

_log = logging.getLogger(__name__)

REINTEGRATE_ACCEL = 0.1  # m/s², change of bias above which the linear correction is given up
REINTEGRATE_GYRO = 0.01  # rad/s
SPARE_NS = 50_000_000  # of samples kept on both sides of intervals that were selected, by which they may still be shifted

NoiseMode = Literal["merged", "independent"]

# Arrays with a row for each interval, and with one for each sample.
_OF_INTERVALS = (
    *("intervals_ns", "alpha", "beta", "gamma_wxyz", "covariance", "bias_jacobian", "bias_accel", "bias_gyro"),
    *("steps", "longest_gap_s"),
)
_OF_SAMPLES = ("time_ns", "gyro", "accel")


@dataclass(frozen=True, slots=True, eq=False)
class Preintegration:
    """Preintegrated motion of N intervals, each in the IMU frame at its begin, without gravity.

    With R the orientation and v the velocity at the begin, T the duration and g gravity in the world frame, the end is at
    p_j = p_i + v T + ½ g T² + R α, v_j = v + g T + R β, q_j = q_i ⊗ γ.

    Attributes:
        intervals_ns: (N, 2) int64, begin and end.
        alpha: (N, 3) [m]; beta: (N, 3) [m/s]; gamma_wxyz: (N, 4).
        covariance: (N, 15, 15), error order [α, θ, β, b_a, b_g], θ on the right of γ (docs/residuals/imu_preintegration.md).
        bias_jacobian: (N, 9, 6), ∂[α, θ, β]/∂[b_a, b_g].
        bias_accel: (N, 3) [m/s²] and bias_gyro: (N, 3) [rad/s] that were subtracted.
        noise, mode: what the covariance was computed with; see `integrate`.
        steps: (N,) int64, steps of the recursion.
        longest_gap_s: (N,) longest time between two samples used [s].
        time_ns, gyro, accel: (S,), (S, 3), (S, 3) the samples, for integrating anew.

    Example:
        >>> noise = bp.residuals.ImuNoise(gyro=1.7e-4, accel=2e-3, gyro_walk=1.9e-5, accel_walk=3e-3)
        >>> time_ns = np.arange(0, 1_000_000_001, 5_000_000)  # a second at rest, 200 Hz
        >>> at_rest = np.zeros((201, 3)), np.tile([0.0, 0.0, 9.81], (201, 1))
        >>> between = bp.residuals.Preintegration.integrate(time_ns, *at_rest, noise=noise)
        >>> between.duration_s, between.beta.round(3) + 0.0  # the specific force, summed up
        (array([1.]), array([[0.  , 0.  , 9.81]]))
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
        kept in `longest_gap_s`, and logged as a warning where the noise does not say what may happen within it.

        Args:
            time_ns: (S,) int64, strictly increasing.
            gyro: (S, 3) [rad/s]; accel: (S, 3), specific force [m/s²].
            noise: densities of the sensor.
            intervals_ns: (N, 2) int64 begin and end of every interval; the whole stream when left out.
            bias_accel, bias_gyro: (3,) or (N, 3), the best guess so far.
            mode: `merged` treats the sample that two neighbouring steps share as one noise, as it is; `independent` as
                two, which makes standard deviations about √2 too small (as VINS-Mono; docs/residuals/imu_preintegration.md).

        Raises:
            InputError: wrong shapes or types, samples that are not finite or not in order of time, fewer than two
                samples, an interval that does not last or is not covered by the samples.
        """
        if mode not in ("merged", "independent"):
            raise InputError('mode "merged" or "independent"', repr(mode), 'leave it out for "merged"')
        time, w, a = checked_samples(time_ns, gyro, accel)
        given = (time[0], time[-1]) if intervals_ns is None else intervals_ns
        intervals = checked_intervals(given, time)
        count = len(intervals)
        result = cls(
            intervals_ns=intervals,
            alpha=np.zeros((count, 3)),
            beta=np.zeros((count, 3)),
            gamma_wxyz=np.zeros((count, 4)),
            covariance=np.zeros((count, 15, 15)),
            bias_jacobian=np.zeros((count, 9, 6)),
            bias_accel=checked_bias("bias_accel", bias_accel, count),
            bias_gyro=checked_bias("bias_gyro", bias_gyro, count),
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
        if gaps.size and not noise.gap_accel:
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
        """α (N, 3), γ wxyz (N, 4) and β (N, 3) for other biases (3,) or (N, 3), to first order."""
        change_a = checked_bias("bias_accel", bias_accel, len(self)) - self.bias_accel
        change_g = checked_bias("bias_gyro", bias_gyro, len(self)) - self.bias_gyro
        moved = (self.bias_jacobian @ np.hstack([change_a, change_g])[:, :, None])[:, :, 0]
        turned = quaternion.multiply(self.gamma_wxyz, quaternion.from_matrix(so3.exp(moved[:, 3:6])))
        return self.alpha + moved[:, :3], turned, self.beta + moved[:, 6:]

    def is_stale(self, bias_accel: ArrayLike, bias_gyro: ArrayLike) -> NDArray[np.bool_]:
        """(N,) whether the biases moved so far (0.1 m/s², 0.01 rad/s) that the linear correction no longer does."""
        change_a = checked_bias("bias_accel", bias_accel, len(self)) - self.bias_accel
        change_g = checked_bias("bias_gyro", bias_gyro, len(self)) - self.bias_gyro
        far: NDArray[np.bool_] = (np.linalg.norm(change_a, axis=1) > REINTEGRATE_ACCEL) | (
            np.linalg.norm(change_g, axis=1) > REINTEGRATE_GYRO
        )
        return far

    def reintegrated(self, bias_accel: ArrayLike, bias_gyro: ArrayLike, where: NDArray[np.bool_] | None = None) -> Preintegration:
        """Integrated anew with other biases (3,) or (N, 3): the intervals `where` (N,) holds, by default those `is_stale` names.

        The others keep their biases and numbers.
        """
        ba, bg = checked_bias("bias_accel", bias_accel, len(self)), checked_bias("bias_gyro", bias_gyro, len(self))
        anew = self.is_stale(ba, bg) if where is None else np.asarray(where, dtype=np.bool_)
        result = self._with_intervals(np.copy)
        result.bias_accel[anew], result.bias_gyro[anew] = ba[anew], bg[anew]
        result._integrate(np.flatnonzero(anew).astype(np.uint32))
        return result

    def __getitem__(self, rows: int | slice | NDArray[np.integer] | NDArray[np.bool_] | list[int]) -> Preintegration:
        """The intervals selected, with the samples they need and 50 ms on both sides.

        Raises:
            InputError: no interval is selected, or one that is not there.
        """
        try:
            chosen = np.atleast_1d(np.arange(len(self))[rows])
        except IndexError as error:
            raise InputError(f"intervals from 0 to {len(self) - 1}", repr(rows), f"select some of them ({error})") from None
        if not len(chosen):
            raise InputError("at least one interval", repr(rows), "keep what the residual is made of")
        intervals = self.intervals_ns[chosen]
        first = np.searchsorted(self.time_ns, intervals[:, 0].min() - SPARE_NS, side="right") - 1
        last = np.searchsorted(self.time_ns, intervals[:, 1].max() + SPARE_NS, side="left")
        samples = slice(max(int(first), 0), int(last) + 1)
        kept: dict[str, Any] = {name: getattr(self, name)[samples].copy() for name in _OF_SAMPLES}
        return replace(self._with_intervals(lambda array: array[chosen].copy()), **kept)

    def append(self, other: Preintegration) -> Preintegration:
        """The intervals of both, on the samples of both; nothing is integrated anew.

        Args:
            other: of the same IMU: the same noise and mode, and the same samples where both have some.

        Raises:
            InputError: another noise or mode, or samples that differ.
        """
        if other.noise != self.noise or other.mode != self.mode:
            raise InputError(
                f"{self.noise}, {self.mode}", f"{other.noise}, {other.mode}", "integrate both with the same noise and mode"
            )
        shared = [
            (p.time_ns >= max(self.time_ns[0], other.time_ns[0])) & (p.time_ns <= min(self.time_ns[-1], other.time_ns[-1]))
            for p in (self, other)
        ]
        for name in _OF_SAMPLES:
            own, its = getattr(self, name)[shared[0]], getattr(other, name)[shared[1]]
            if not np.array_equal(own, its):
                raise InputError(
                    "the same samples where both have some",
                    f"{len(own)} and {len(its)} whose {name} differ, from {max(self.time_ns[0], other.time_ns[0])} ns",
                    "append intervals of the same stream",
                )
        both: dict[str, Any] = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in _OF_INTERVALS}
        before = slice(0, int(other.time_ns.searchsorted(self.time_ns[0])))
        after = slice(int(other.time_ns.searchsorted(self.time_ns[-1], side="right")), None)
        for name in _OF_SAMPLES:
            its = getattr(other, name)
            both[name] = np.concatenate([its[before], getattr(self, name), its[after]])
        return replace(self, **both)

    def merge(self, first: int, last: int | None = None) -> Preintegration:
        """With the intervals `first` to `last` (by default the next one) as one, integrated anew from the samples.

        The result is what would have been integrated without the keyframes between them, at the biases of the first.

        Raises:
            InputError: intervals that are not there, or that do not follow each other without a break.
        """
        end = first + 1 if last is None else last
        if not 0 <= first < end < len(self):
            raise InputError(f"intervals first < last from 0 to {len(self) - 1}", f"{first} and {end}", "merge neighbours")
        joints = self.intervals_ns[first : end + 1]
        broken = np.flatnonzero(joints[1:, 0] != joints[:-1, 1])
        if len(broken):
            k = first + int(broken[0])
            raise InputError(
                "intervals that follow each other",
                f"interval {k + 1} from {self.intervals_ns[k + 1, 0]} ns, interval {k} to {self.intervals_ns[k, 1]} ns",
                "merge neighbours in time",
            )
        kept = np.ones(len(self), dtype=np.bool_)
        kept[first + 1 : end + 1] = False
        result = self._with_intervals(lambda array: array[kept])
        result.intervals_ns[first, 1] = self.intervals_ns[end, 1]
        result._integrate(np.array([first], dtype=np.uint32))
        return result

    def shifted(self, shift_ns: int) -> Preintegration:
        """Integrated anew over intervals that begin and end `shift_ns` later.

        Raises:
            InputError: the samples do not cover them.
        """
        result = self._with_intervals(np.copy)
        result.intervals_ns[:] = checked_intervals(self.intervals_ns + int(shift_ns), self.time_ns)
        result._integrate(np.arange(len(self), dtype=np.uint32))
        return result

    @property
    def time_jacobian(self) -> NDArray[np.float64]:
        """∂[α, θ, β]/∂t (N, 9) of intervals that begin and end later by t [m/s, rad/s, m/s²].

        With ω_i, a_i at the begin and ω_j, a_j at the end, biases taken off: the frame of the begin turns, what lies before it
        leaves the sums and what follows the end comes in,

            ∂α/∂t = β − ω_i × α − a_i T,    ∂θ/∂t = ω_j − γᵀ ω_i,    ∂β/∂t = γ a_j − a_i − ω_i × β
        """
        (w_i, a_i), (w_j, a_j) = (self._sample_at(self.intervals_ns[:, end]) for end in (0, 1))
        R = quaternion.to_matrix(self.gamma_wxyz)
        by_alpha = self.beta - np.cross(w_i, self.alpha) - a_i * self.duration_s[:, None]
        by_theta = w_j - np.einsum("nji,nj->ni", R, w_i)
        by_beta = np.einsum("nij,nj->ni", R, a_j) - a_i - np.cross(w_i, self.beta)
        return np.hstack([by_alpha, by_theta, by_beta])

    def _with_intervals(self, change: Callable[[NDArray[Any]], NDArray[Any]]) -> Preintegration:
        """The same samples with other arrays of the intervals, none of them shared."""
        changed: dict[str, Any] = {name: change(getattr(self, name)) for name in _OF_INTERVALS}
        return replace(self, **changed)

    def _sample_at(self, at_ns: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Angular velocity and specific force (N, 3) at one time of every interval, interpolated, without biases."""
        k = np.clip(np.searchsorted(self.time_ns, at_ns, side="right") - 1, 0, len(self.time_ns) - 2)
        share = ((at_ns - self.time_ns[k]) / (self.time_ns[k + 1] - self.time_ns[k]))[:, None]
        w, a = (values[k] + share * (values[k + 1] - values[k]) for values in (self.gyro, self.accel))
        return w - self.bias_gyro, a - self.bias_accel

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
