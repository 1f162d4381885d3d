"""Which pose of an estimate belongs to which pose of the ground truth, and what speaks against believing it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import choice, require
from boxplus._numbers import is_finite
from boxplus.errors import InputError
from boxplus.evaluation.time_offset import TimeOffset, estimate_time_offset
from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import quaternion, so3

Method = Literal["nearest", "interpolate", "index"]

_UNITS = {10**3: "milliseconds against seconds", 10**6: "microseconds against seconds", 10**9: "nanoseconds against seconds"}


@dataclass(frozen=True, slots=True)
class Association:
    """Matched poses, in order of time, and how they were found.

    Attributes:
        estimate: (M) the matched poses of the estimate.
        ground_truth: (M) the ground truth that belongs to each: measured poses, or interpolated ones. Both carry the stamps, on
            the clock of the ground truth, of the one that partners were looked for.
        method: `nearest` stamps, `interpolate`d ground truth, or by `index` for files without stamps.
        estimate_index: (M,) rows of the estimate that were matched.
        ground_truth_index: (M,) rows of the ground truth; when interpolating, the row before.
        difference_s: (M,) how far the matched stamps are apart; when interpolating, how far the nearer measured one is [s].
        max_difference_s: the largest difference that was allowed (nearest), or None.
        offset_s: what was added to the stamps of the estimate before matching [s].
        unmatched_estimate: poses of the estimate without a partner.
        unmatched_ground_truth: poses of the ground truth, within the time of the estimate, without a partner.
        repeated: matches whose pose, of the ground truth or of the estimate, an earlier match has as well.
        outside: poses of the estimate before the first or after the last pose of the ground truth.
        overlap_s: duration that both cover [s].
        gaps: (start, end) of stretches without matches within the overlap, in seconds after its start.
        time_offset: the clock offset that the motions suggest, or None where they do not tell any.
    """

    estimate: Trajectory
    ground_truth: Trajectory
    method: Method
    estimate_index: NDArray[np.intp]
    ground_truth_index: NDArray[np.intp]
    difference_s: NDArray[np.float64]
    max_difference_s: float | None
    offset_s: float
    unmatched_estimate: int
    unmatched_ground_truth: int
    repeated: int
    outside: int
    overlap_s: float
    gaps: tuple[tuple[float, float], ...]
    time_offset: TimeOffset | None

    def __len__(self) -> int:
        return len(self.estimate_index)

    def lines(self) -> list[str]:
        """The report, one sentence a line."""
        matched = len(np.unique(self.estimate_index))
        total = matched + self.unmatched_estimate
        if self.method == "index":
            return [f"matched {len(self)} poses by index (the files carry no time stamps)"]
        how = {"nearest": f"nearest stamps within {self.max_difference_s} s", "interpolate": "ground truth interpolated"}
        lines = [
            f"matched {matched} of {total} poses of the estimate ({how[self.method]}); {self.outside} lie outside of the "
            f"ground truth's time, {self.unmatched_ground_truth} poses of the ground truth within it are unmatched"
        ]
        if self.repeated:
            lines.append(f"{self.repeated} of the {len(self)} matches repeat a pose: the other trajectory is denser there")
        step = "stamp difference" if self.method == "nearest" else "distance to the nearest measured stamp"
        lines.append(
            f"overlap {self.overlap_s:.3f} s; {step}: median {np.median(self.difference_s) * 1e3:.3f} ms, "
            f"largest {self.difference_s.max() * 1e3:.3f} ms"
        )
        if self.gaps:
            longest = max(self.gaps, key=lambda gap: gap[1] - gap[0])
            lines.append(
                f"{len(self.gaps)} gaps without matches, together {sum(b - a for a, b in self.gaps):.3f} s, the longest "
                f"{longest[1] - longest[0]:.3f} s at {longest[0]:.3f} s"
            )
        else:
            lines.append("no gaps")
        applied = f" (after the {self.offset_s:+.6f} s that were asked for)" if self.offset_s else ""
        found = self.time_offset
        if found is None:
            lines.append(f"clock offset: the motion does not tell, none would show{applied}")
        else:
            silent = "" if found.shows else f"none shows, and none up to {found.least_s:.3g} s would; "
            lines.append(
                f"clock offset: {silent}the motions fit best with {found} added to the estimate's stamps, correlation "
                f"{found.correlation:.3f}{applied}{found.repetition}"
            )
            if found.rate is not None and found.rate.shows:
                lines.append(f"clock rate: {found.rate}")
        return lines


def associate(
    estimate: Trajectory,
    ground_truth: Trajectory,
    method: Literal["nearest", "interpolate"] = "nearest",
    max_difference_s: float = 0.02,
    *,
    offset_s: float = 0.0,
    max_gap_s: float = 0.25,
    min_matches: int = 10,
    tell_offset: bool = True,
) -> Association:
    """Find the pose of the ground truth that belongs to each pose of the estimate.

    `nearest` takes, for each pose of the trajectory that has fewer, the pose of the other with the nearest stamp (the earlier
    of two), which is what the field's tools do; where both are about as dense, a pose may be taken twice, which is counted.
    `interpolate` interpolates the ground truth at the stamps of the estimate: positions linearly, rotations along the geodesic
    of SO(3).
    Trajectories that both lack stamps (KITTI) are matched by index and must be equally long.

    Args:
        estimate, ground_truth: the two trajectories.
        method: see above.
        max_difference_s: largest stamp difference of a pair, for `nearest` [s].
        offset_s: added to the stamps of the estimate [s].
        max_gap_s: ground truth that is farther apart than this is not interpolated [s].
        min_matches: fewer matches than this are refused.
        tell_offset: look for the clock offset that the motions suggest, which takes longest.

    Raises:
        InputError: no overlap in time, too few matches, stamps that look like another unit, one trajectory with stamps and
            one without, or different lengths without stamps.
    """
    for name, poses in (("estimate", estimate), ("ground_truth", ground_truth)):
        require(poses, Trajectory, f"a Trajectory as {name}", "read it with read_trajectory, or make one from arrays")
    choice(method, ("nearest", "interpolate"), "method")
    _check_settings(max_difference_s, max_gap_s, min_matches, offset_s)
    if estimate.time_ns is None and ground_truth.time_ns is None:
        return _by_index(estimate, ground_truth, min_matches)
    t_est = estimate.times + round(offset_s * 1e9)
    t_gt = ground_truth.times
    begin, end = max(t_est[0], t_gt[0]), min(t_est[-1], t_gt[-1])
    if begin > end:
        raise _no_overlap(estimate, ground_truth, offset_s)
    if method == "nearest":
        index_est, index_gt, difference = _nearest(t_est, t_gt, round(max_difference_s * 1e9))
        time_ns = t_gt[index_gt] if len(t_gt) < len(t_est) else t_est[index_est]
        matched_gt = ground_truth.select(index_gt, time_ns)
    else:
        index_est, index_gt, difference = _bracketed(t_est, t_gt, round(max_gap_s * 1e9))
        time_ns = t_est[index_est]
        matched_gt = _interpolated(ground_truth, index_gt, time_ns)
    outside = int(((t_est < t_gt[0]) | (t_est > t_gt[-1])).sum())
    offset = estimate_time_offset(t_est, estimate, t_gt, ground_truth) if tell_offset else None
    if len(index_est) < min_matches:
        hint = ""
        if offset is not None:
            shifted = t_est + round(offset.offset_s * 1e9)
            find, limit = (_nearest, max_difference_s) if method == "nearest" else (_bracketed, max_gap_s)
            if len(find(shifted, t_gt, round(limit * 1e9))[0]) >= min_matches:
                hint = f"; the motions suggest offset_s={offset_s + offset.offset_s:.3f}"
        known = "".join(f"; {warning}" for warning in (*estimate.warnings, *ground_truth.warnings))
        raise InputError(
            f"at least {min_matches} matched poses",
            f"{len(index_est)} of {len(estimate)} ({estimate.source} against {ground_truth.source}, {method}, {outside} outside "
            f"of the ground truth's time{known})",
            f'raise max_difference_s, use method="interpolate", or correct the clocks with offset_s{hint}',
        )
    within = int(((t_gt >= t_est[0]) & (t_gt <= t_est[-1])).sum())
    used_est, used_gt = len(np.unique(index_est)), len(np.unique(index_gt))
    return Association(
        estimate=estimate.select(index_est, time_ns),
        ground_truth=matched_gt,
        method=method,
        estimate_index=index_est,
        ground_truth_index=index_gt,
        difference_s=np.asarray(difference * 1e-9, dtype=np.float64),
        max_difference_s=max_difference_s if method == "nearest" else None,
        offset_s=offset_s,
        unmatched_estimate=len(estimate) - used_est,
        unmatched_ground_truth=max(0, within - used_gt) if method == "nearest" else 0,
        repeated=len(index_est) - min(used_est, used_gt) if method == "nearest" else 0,
        outside=outside,
        overlap_s=float(end - begin) * 1e-9,
        gaps=_gaps(t_est, t_est[index_est], begin, end),
        time_offset=offset,
    )


def _check_settings(max_difference_s: float, max_gap_s: float, min_matches: int, offset_s: float) -> None:
    for name, value in (("max_difference_s [s]", max_difference_s), ("max_gap_s [s]", max_gap_s), ("min_matches", min_matches)):
        if not (is_finite(value) and value > 0 and (name != "min_matches" or value >= 1)):
            raise InputError(f"a positive {name}", f"{value}", "give another one")
    if not is_finite(offset_s):
        raise InputError("a finite offset_s [s]", f"{offset_s}", "give another one")


def _by_index(estimate: Trajectory, ground_truth: Trajectory, min_matches: int) -> Association:
    count = len(estimate)
    if count != len(ground_truth) or count < min_matches:
        raise InputError(
            f"two trajectories without stamps of the same length, at least {min_matches} poses",
            f"{count} ({estimate.source}) and {len(ground_truth)} ({ground_truth.source})",
            "give files that carry time stamps (TUM, EuRoC, CSV), or the same frames in both",
        )
    rows = np.arange(count)
    return Association(
        estimate, ground_truth, "index", rows, rows, np.zeros(count), None, 0.0, 0, 0, 0, 0, 0.0, (), None
    )  # fmt: skip


def _no_overlap(estimate: Trajectory, ground_truth: Trajectory, offset_s: float) -> InputError:
    """Say how the two stretches of time lie, and what would explain it."""
    t_est, t_gt = estimate.times, ground_truth.times
    spans = [
        f"{t[0] * 1e-9:.3f} … {t[-1] * 1e-9:.3f} s ({name})"
        for t, name in ((t_est, estimate.source), (t_gt, ground_truth.source))
    ]
    shift = float(t_gt[0] - t_est[0]) * 1e-9
    advice = f"give the clocks' difference with offset_s (equal starts: offset_s={shift:.6f})"
    longer, shorter = max(estimate.duration_s, ground_truth.duration_s), min(estimate.duration_s, ground_truth.duration_s)
    for factor, units in _UNITS.items():
        starts = sorted((abs(float(t_est[0])), abs(float(t_gt[0]))))
        by_start = starts[0] > 0 and abs(starts[1] / starts[0] / factor - 1.0) < 0.2
        by_length = shorter > 0 and 0.5 < longer / shorter / factor < 2.0
        if by_start or by_length:
            advice = f"the stamps differ by a factor of about {factor:.0e}: {units}? correct the unit of one file"
    got = " and ".join(spans) + (f", after offset_s={offset_s}" if offset_s else "")
    return InputError("two trajectories that overlap in time", got, advice)


def _nearest(
    t_est: NDArray[np.int64], t_gt: NDArray[np.int64], limit: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.int64]]:
    """Pairs of nearest stamps within `limit` ns, looked for from the shorter one: rows of both, |difference| in ns."""
    if len(t_gt) < len(t_est):
        index_gt, index_est, difference = _nearest(t_gt, t_est, limit)
        return index_est, index_gt, difference
    after = np.clip(np.searchsorted(t_gt, t_est), 0, len(t_gt) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(t_gt[before] - t_est) <= np.abs(t_gt[after] - t_est), before, after)
    difference = np.abs(t_gt[nearest] - t_est)
    rows = np.flatnonzero(difference <= limit)
    return rows, nearest[rows], difference[rows]


def _bracketed(
    t_est: NDArray[np.int64], t_gt: NDArray[np.int64], limit: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.int64]]:
    """Rows of the estimate that lie between two poses of the ground truth at most `limit` ns apart, and the row before."""
    if len(t_gt) < 2:
        return np.empty(0, np.intp), np.empty(0, np.intp), np.empty(0, np.int64)
    before = np.clip(np.searchsorted(t_gt, t_est, side="right") - 1, 0, len(t_gt) - 2)
    inside = (t_est >= t_gt[0]) & (t_est <= t_gt[-1])
    exact = (t_est == t_gt[before]) | (t_est == t_gt[before + 1])
    rows = np.flatnonzero(inside & ((t_gt[before + 1] - t_gt[before] <= limit) | exact))
    before = before[rows]
    difference = np.minimum(t_est[rows] - t_gt[before], t_gt[before + 1] - t_est[rows])
    return rows, before, difference


def _interpolated(ground_truth: Trajectory, before: NDArray[np.intp], time_ns: NDArray[np.int64]) -> Trajectory:
    """Positions linearly, rotations along the geodesic: R_0 Exp(s Log(R_0ᵀ R_1))."""
    t = ground_truth.times
    s = ((time_ns - t[before]) / (t[before + 1] - t[before]))[:, None]
    p = (1.0 - s) * ground_truth.p[before] + s * ground_truth.p[before + 1]
    R0, R1 = ground_truth.R[before], ground_truth.R[before + 1]
    R = R0 @ so3.exp(s * so3.log(R0.transpose(0, 2, 1) @ R1))
    return Trajectory(time_ns, p, quaternion.from_matrix(R), source=f"{ground_truth.source}, interpolated")


def _gaps(t_est: NDArray[np.int64], matched: NDArray[np.int64], begin: int, end: int) -> tuple[tuple[float, float], ...]:
    """Stretches of the overlap without matches that are more than five median steps of the estimate long."""
    if len(t_est) < 2:
        return ()
    limit = 5.0 * float(np.median(np.diff(t_est)))
    edges = np.concatenate([[begin], matched[(matched >= begin) & (matched <= end)], [end]])
    wide = np.flatnonzero(np.diff(edges) > limit)
    return tuple((float(edges[i] - begin) * 1e-9, float(edges[i + 1] - begin) * 1e-9) for i in wide)
