"""Relative pose error: drift over a fixed distance or time, which no alignment can hide."""

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


@dataclass(frozen=True, slots=True)
class RelativeErrors:
    """Errors of the motion between pairs of poses.

    Attributes:
        delta: the distance or time between the poses of a pair.
        unit: `m` or `s`, of `delta`.
        pairs: (K, 2) rows of the matched poses.
        translation_m: (K,) ‖trans E‖ with E = (T_gt,i⁻¹ T_gt,j)⁻¹ (T_est,i⁻¹ T_est,j) [m].
        rotation_deg: (K,) angle of E [degrees].
    """

    delta: float
    unit: Literal["m", "s"]
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
    """(K, 2) rows (i, j): j is the first pose with at least `delta_m` of travelled path after i.

    `consecutive` pairs follow each other, the next beginning where the last ended; `all` begins one at every pose.

    Args:
        p: (M, 3) positions whose path counts [m].
        delta_m: travelled distance [m].
        pairs: see above.
    """
    steps = np.linalg.norm(np.diff(p, axis=0), axis=1)
    if pairs == "all":
        path = np.concatenate([[0.0], np.cumsum(steps)])
        return _reached(np.searchsorted(path, path + delta_m, side="left"), len(p))
    found, begin, travelled = [], 0, 0.0
    for row, step in enumerate(steps.tolist(), 1):
        travelled += step
        if travelled >= delta_m:
            found.append((begin, row))
            begin, travelled = row, 0.0
    return np.array(found, dtype=np.intp).reshape(-1, 2)


def pairs_by_time(time_ns: NDArray[np.int64], delta_s: float, pairs: Pairs = "consecutive") -> NDArray[np.intp]:
    """(K, 2) rows (i, j): j is the pose nearest to `delta_s` after i; pairs that are off by a tenth or more (gaps) are left out.

    Args:
        time_ns: (M,) increasing stamps [ns].
        delta_s: time between the poses [s].
        pairs: `consecutive` or `all`, as in `pairs_by_distance`.
    """
    delta = round(delta_s * 1e9)
    after = np.clip(np.searchsorted(time_ns, time_ns + delta), 1, len(time_ns) - 1)
    end = after - ((time_ns + delta) - time_ns[after - 1] < time_ns[after] - (time_ns + delta))
    good = (np.abs(time_ns[end] - time_ns - delta) < 0.1 * delta) & (end > np.arange(len(end)))
    if pairs == "all":
        return np.stack([np.flatnonzero(good), end[good]], axis=1)
    found, begin = [], 0
    while begin < len(end):
        if good[begin]:
            found.append((begin, int(end[begin])))
            begin = int(end[begin])
        else:
            begin += 1
    return np.array(found, dtype=np.intp).reshape(-1, 2)


def _reached(end: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    begin = np.flatnonzero(end < count)
    return np.stack([begin, end[begin]], axis=1)


def relative_errors(
    estimate: Trajectory,
    ground_truth: Trajectory,
    *,
    distance_m: float | None = None,
    time_s: float | None = None,
    pairs: Pairs = "consecutive",
) -> RelativeErrors:
    """Relative pose errors of matched trajectories (Sturm et al. 2012) over a distance or a time.

    Distances are those of the estimate's path, so that pairs end where the estimate says they do.

    Args:
        estimate, ground_truth: M matched poses each, the same rows belonging together.
        distance_m, time_s: exactly one of them, positive.
        pairs: `consecutive` or `all`.

    Raises:
        InputError: trajectories of different length, not exactly one positive delta, or no pair that far apart.
    """
    deltas = [delta for delta in (distance_m, time_s) if delta is not None]
    if len(estimate) != len(ground_truth) or len(deltas) != 1 or not 0 < deltas[0] < 1e9:
        raise InputError(
            "matched trajectories of the same length and one positive distance_m or time_s",
            f"{len(estimate)} and {len(ground_truth)} poses, distance {distance_m} and time {time_s}",
            "associate the trajectories first, and name one delta",
        )
    if distance_m is not None:
        rows = pairs_by_distance(estimate.p, distance_m, pairs)
    else:
        rows = pairs_by_time(estimate.times, deltas[0], pairs)
    if not len(rows):
        whole = f"{estimate.path_length_m:.3f} m" if distance_m is not None else f"{estimate.duration_s:.3f} s"
        raise InputError(
            f"poses {deltas[0]:g} {'m' if distance_m is not None else 's'} apart",
            f"a matched trajectory of {whole}",
            "use a smaller delta",
        )
    i, j = rows.T
    t_est, R_est = _relative(estimate, i, j)
    t_gt, R_gt = _relative(ground_truth, i, j)
    p_error = np.einsum("kba,kb->ka", R_gt, t_est - t_gt)
    return RelativeErrors(
        delta=deltas[0],
        unit="m" if distance_m is not None else "s",
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
