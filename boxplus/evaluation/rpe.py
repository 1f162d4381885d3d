"""Relative pose error: drift over a fixed distance, turn, time or number of poses, which no alignment can hide."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.evaluation.statistics import Statistics
from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import so3

Pairs = Literal["consecutive", "all"]
Unit = Literal["m", "deg", "s", "frames"]

TOLERANCE = 0.1
"""Share of the delta by which a pair may miss it, where every pose begins one, and by time."""
_MOST_PAIRS = 20_000_000  # of turns: every two poses that far apart are one


@dataclass(frozen=True, slots=True)
class Delta:
    """How far apart the poses of a pair are.

    Attributes:
        value: positive; a whole number of frames.
        unit: `m` travelled, `deg` turned, `s`, or `frames` (matched poses).

    Raises:
        InputError: a value that is not positive, not finite, or not whole for frames.
    """

    value: float
    unit: Unit

    def __post_init__(self) -> None:
        if not 0 < self.value < 1e9 or (self.unit == "frames" and self.value != int(self.value)):
            number = "whole number" if self.unit == "frames" else "number"
            expected = f'a positive {number} in Delta(value, "{self.unit}")'
            raise InputError(expected, str(self), "choose another one, or leave it out")

    def __str__(self) -> str:
        return f"{self.value:g}°" if self.unit == "deg" else f"{self.value:g} {self.unit}"


@dataclass(frozen=True, slots=True)
class RelativeErrors:
    """Errors of the motion between pairs of poses.

    Attributes:
        delta: how far apart the poses of a pair are.
        pairs: (K, 2) rows of the matched poses.
        translation_m: (K,) ‖trans E‖ with E = (T_gt,i⁻¹ T_gt,j)⁻¹ (T_est,i⁻¹ T_est,j) [m].
        rotation_deg: (K,) angle of E [degrees].
    """

    delta: Delta
    pairs: NDArray[np.intp]
    translation_m: NDArray[np.float64]
    rotation_deg: NDArray[np.float64]

    @property
    def translation(self) -> Statistics:
        """Figures of the translation errors [m]."""
        return Statistics.of(self.translation_m)

    @property
    def rotation(self) -> Statistics:
        """Figures of the rotation errors [degrees]."""
        return Statistics.of(self.rotation_deg)


def pairs_by_distance(p: NDArray[np.float64], delta_m: float, pairs: Pairs = "consecutive") -> NDArray[np.intp]:
    """(K, 2) rows (i, j) of poses `delta_m` of travelled path apart.

    `consecutive` pairs follow each other: j is the first pose with at least `delta_m` of path after i, and begins the next.
    `all` begins one at every pose: j is the pose whose path is nearest to `delta_m` after i (the earlier of two), and pairs that
    miss it by more than a tenth are left out.

    Args:
        p: (M, 3) positions whose path counts [m].
        delta_m: travelled distance [m].
        pairs: see above.
    """
    steps = np.linalg.norm(np.diff(p, axis=0), axis=1)
    if pairs == "consecutive":
        return _chained(steps, delta_m)
    path = np.concatenate([[0.0], np.cumsum(steps)])
    return _nearest(path, delta_m)


def pairs_by_turn(R: NDArray[np.float64], delta_rad: float, pairs: Pairs = "consecutive") -> NDArray[np.intp]:
    """(K, 2) rows (i, j) of poses turned by `delta_rad` against each other.

    `consecutive` pairs follow each other: the angles from pose to pose are added up. `all` are any two poses whose rotation
    against each other is within a tenth of `delta_rad`.

    Args:
        R: (M, 3, 3) rotations whose angles count.
        delta_rad: angle [rad].
        pairs: see above.

    Raises:
        InputError: more than 20 million pairs.
    """
    if pairs == "consecutive":
        return _chained(np.linalg.norm(so3.log(R[:-1].transpose(0, 2, 1) @ R[1:]), axis=1), delta_rad)
    flat = R.reshape(-1, 9)
    low, high = (np.cos(np.clip(delta_rad * (1.0 + side * TOLERANCE), 0.0, np.pi)) for side in (1.0, -1.0))
    found, count = [], 0
    for i in range(len(R) - 1):
        cosine = 0.5 * (flat[i + 1 :] @ flat[i] - 1.0)  # tr(R_iᵀ R_j) = 1 + 2 cos
        j = np.flatnonzero((cosine >= low) & (cosine <= high)) + (i + 1)
        count += len(j)
        if count > _MOST_PAIRS:
            raise InputError(
                f"at most {_MOST_PAIRS:,} pairs of poses {delta_rad:g} rad apart",
                "more",
                'use pairs="consecutive", or fewer poses',
            )
        found.append(np.stack([np.full(len(j), i), j], axis=1))
    return np.concatenate([np.empty((0, 2), np.intp), *found])


def pairs_by_time(time_ns: NDArray[np.int64], delta_s: float, pairs: Pairs = "consecutive") -> NDArray[np.intp]:
    """(K, 2) rows (i, j): j is the pose nearest to `delta_s` after i; pairs that miss it by a tenth or more (gaps) are left out.

    Args:
        time_ns: (M,) increasing stamps [ns].
        delta_s: time between the poses [s].
        pairs: `consecutive`, the next beginning where the last ended, or `all`, one from every pose.
    """
    delta = round(delta_s * 1e9)
    found = _nearest(time_ns - time_ns[0], delta)
    found = found[np.flatnonzero(np.abs(time_ns[found[:, 1]] - time_ns[found[:, 0]] - delta) < TOLERANCE * delta)]
    if pairs == "all":
        return np.asarray(found, dtype=np.intp)
    chain, begin = [], 0
    for i, j in found.tolist():
        if i >= begin:
            chain.append((i, j))
            begin = j
    return np.array(chain, dtype=np.intp).reshape(-1, 2)


def pairs_by_frames(count: int, delta: int, pairs: Pairs = "consecutive") -> NDArray[np.intp]:
    """(K, 2) rows (i, i + delta) of `count` poses: one after the other, or one from every pose."""
    begin = np.arange(0, count - delta, delta if pairs == "consecutive" else 1)
    return np.stack([begin, begin + delta], axis=1)


def _chained(steps: NDArray[np.float64], delta: float) -> NDArray[np.intp]:
    """Pairs of which each begins where the last ended, ending as soon as the steps since add up to `delta`."""
    found, begin, travelled = [], 0, 0.0
    for row, step in enumerate(steps.tolist(), 1):
        travelled += step
        if travelled >= delta:
            found.append((begin, row))
            begin, travelled = row, 0.0
    return np.array(found, dtype=np.intp).reshape(-1, 2)


def _nearest(at: NDArray[np.float64] | NDArray[np.int64], delta: float) -> NDArray[np.intp]:
    """From every row i of the increasing `at`, the row whose value is nearest to at[i] + delta, within a tenth of delta."""
    wanted = at + delta
    after = np.clip(np.searchsorted(at, wanted), 1, len(at) - 1) if len(at) > 1 else np.zeros(len(at), np.intp)
    end = after - (wanted - at[after - 1] <= at[after] - wanted)
    end = np.searchsorted(at, at[end])  # of equal ones, the first
    good = np.flatnonzero(np.abs(at[end] - at - delta) <= TOLERANCE * delta)
    return np.stack([good, end[good]], axis=1)


def relative_errors(
    estimate: Trajectory,
    ground_truth: Trajectory,
    delta: Delta,
    *,
    pairs: Pairs = "consecutive",
    path_of: Literal["estimate", "ground_truth"] = "estimate",
) -> RelativeErrors:
    """Relative pose errors of matched trajectories (Sturm et al., IROS 2012) over a distance, a turn, a time or frames.

    Args:
        estimate, ground_truth: M matched poses each, the same rows belonging together.
        delta: how far apart the poses of a pair are.
        pairs: `consecutive` or `all`.
        path_of: whose path and turns say where a pair ends.

    Raises:
        InputError: trajectories of different length, no time stamps for a time, or no pair that far apart.

    Example:
        >>> relative_errors(estimate, truth, Delta(10.0, "m")).translation.rmse  # doctest: +SKIP
    """
    if len(estimate) != len(ground_truth):
        raise InputError(
            "matched trajectories of the same length",
            f"{len(estimate)} and {len(ground_truth)} poses",
            "associate the trajectories first",
        )
    measured = estimate if path_of == "estimate" else ground_truth
    if delta.unit == "m":
        rows, whole = pairs_by_distance(measured.p, delta.value, pairs), f"{measured.path_length_m:.3f} m"
    elif delta.unit == "deg":
        rows, whole = pairs_by_turn(measured.R, float(np.radians(delta.value)), pairs), f"{len(measured)} poses that turn less"
    elif delta.unit == "s":
        rows, whole = pairs_by_time(measured.times, delta.value, pairs), f"{measured.duration_s:.3f} s"
    else:
        rows, whole = pairs_by_frames(len(measured), int(delta.value), pairs), f"{len(measured)} poses"
    if not len(rows):
        smaller = f'use a smaller Delta(value, "{delta.unit}")'
        raise InputError(f"poses {delta} apart", f"a matched trajectory of {whole}", smaller)
    i, j = rows.T
    t_est, R_est = _relative(estimate, i, j)
    t_gt, R_gt = _relative(ground_truth, i, j)
    p_error = np.einsum("kba,kb->ka", R_gt, t_est - t_gt)
    return RelativeErrors(
        delta=delta,
        pairs=rows,
        translation_m=np.asarray(np.linalg.norm(p_error, axis=1)),
        rotation_deg=np.degrees(np.linalg.norm(so3.log(R_gt.transpose(0, 2, 1) @ R_est), axis=1)),
    )


def _relative(
    trajectory: Trajectory, i: NDArray[np.intp], j: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Translation (K, 3) and rotation (K, 3, 3) of T_i⁻¹ T_j."""
    R = trajectory.R
    back = R[i].transpose(0, 2, 1)
    return np.einsum("kab,kb->ka", back, trajectory.p[j] - trajectory.p[i]), back @ R[j]
