"""A whole comparison of an estimate with the ground truth: association, alignment, ATE, RPE and what to doubt."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import choice, shown
from boxplus._numbers import is_finite
from boxplus.errors import InputError
from boxplus.evaluation.alignment import Alignment, AlignmentKind, align, align_origin, principal_spread
from boxplus.evaluation.association import Association, associate
from boxplus.evaluation.ate import rotation_differences, translation_errors
from boxplus.evaluation.doubts.clocks import clock_doubts
from boxplus.evaluation.doubts.incidents import incident_doubts, jump_doubts
from boxplus.evaluation.doubts.other_meanings import alignment_doubts, reading_doubts
from boxplus.evaluation.doubts.rounded_positions import rounded_position_doubts
from boxplus.evaluation.doubts.rounded_stamps import rounding_doubts
from boxplus.evaluation.frames import Plane, projected
from boxplus.evaluation.rpe import Delta, Pairs, RelativeErrors, relative_errors
from boxplus.evaluation.statistics import Statistics, rms
from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import so3

DELTAS = (Delta(10.0, "m"), Delta(1.0, "s"))
"""The deltas of relative errors that are computed where nothing else is asked for."""

_KINDS = {
    "none": "no alignment",
    "yaw": "yaw alignment (rotation about z and translation)",
    "se3": "SE(3) alignment (rotation and translation)",
    "sim3": "Sim(3) alignment (and scale)",
    "origin": "alignment of the first poses",
}
_NAMED_TRUTH = re.compile(r"(^|[^a-z])(gt|ground_?-?truth|truth)([^a-z]|$)", re.IGNORECASE)
_NAMES_OF_RUNS = ("trajectory.tum", "trajectory.csv", "trajectory.kitti.txt")


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The result of `evaluate`.

    Attributes:
        association: which poses were compared, and how they were matched.
        alignment: the transform that was applied to the estimate.
        aligned_by: of how many matched poses, from the first, the alignment was found; None: of all.
        plane: that both were projected into after the alignment, or None.
        aligned: (M) matched poses of the estimate, in the frame of the ground truth (and in the plane).
        truth: (M) the poses of the ground truth that belong to them, likewise.
        translation_error_m: (M,) absolute translation errors [m].
        rotation_error_deg: (M,) absolute rotation errors [degrees].
        relative: relative pose errors, one for every delta that the trajectory is long enough for.
        warnings: what to doubt about the numbers, one sentence each.

    Example:
        >>> truth = bp.read_trajectory("flight.gt.tum")
        >>> result = bp.evaluate(truth, truth, alignment="none")
        >>> result.ate.rmse, float(result.translation_error_m.max())
        (0.0, 0.0)
    """

    association: Association
    alignment: Alignment
    aligned_by: int | None
    plane: Plane | None
    aligned: Trajectory
    truth: Trajectory
    translation_error_m: NDArray[np.float64]
    rotation_error_deg: NDArray[np.float64]
    relative: tuple[RelativeErrors, ...]
    warnings: tuple[str, ...]

    @property
    def ate(self) -> Statistics:
        """Figures of the absolute translation errors [m]."""
        return Statistics.of(self.translation_error_m)

    @property
    def ate_rotation(self) -> Statistics:
        """Figures of the absolute rotation errors [degrees]."""
        return Statistics.of(self.rotation_error_deg)

    @property
    def title(self) -> str:
        """How the numbers came about, in one line: to stand above every table and plot of them."""
        matched = {"nearest": "nearest stamps", "interpolate": "interpolated ground truth", "index": "by index"}
        return f"{len(self.association)} poses ({matched[self.association.method]}), {self._how}"

    @property
    def _how(self) -> str:
        first = f" by the first {self.aligned_by} poses" if self.aligned_by is not None else ""
        return _KINDS[self.alignment.kind] + first + (f", in the {self.plane} plane" if self.plane is not None else "")

    def brought(self, trajectory: Trajectory) -> Trajectory:
        """Other poses of the estimate, matched or not, as `aligned` has them: on clock and in frame of the ground truth."""
        if trajectory.time_ns is not None:
            trajectory = replace(trajectory, time_ns=trajectory.time_ns + round(self.association.offset_s * 1e9), lines=None)
        return projected(self.alignment.apply(trajectory), self.plane)

    def summary(self) -> str:
        """The report as text: association first, then alignment, errors and warnings."""
        lines = ["Association", *self.association.lines(), "", f"Alignment: {self._how}"]
        if self.alignment.kind != "none":
            turn = float(np.degrees(np.linalg.norm(so3.log(self.alignment.R_world_estimate))))
            p = ", ".join(f"{value:.4f}" for value in self.alignment.p_world_estimate)
            scale = f", scale {self.alignment.scale:.6f}" if self.alignment.kind == "sim3" else ""
            lines.append(f"rotation {turn:.4f}°, translation ({p}) m{scale}")
        lines += ["", f"Absolute trajectory error: {self.title}"]
        lines += [f"translation: {self.ate.line('m')}", f"rotation: {self.ate_rotation.line('°')}"]
        for errors in self.relative:
            rate = errors.translation.mean / errors.delta.value
            per = {"m": f", mean {100.0 * rate:.3f} % of the distance", "s": f", mean {rate:.6f} m/s"}.get(errors.delta.unit, "")
            lines += [
                "",
                f"Relative pose error over {errors.delta}: {len(errors.pairs)} pairs{per}",
                f"translation: {errors.translation.line('m')}",
                f"rotation: {errors.rotation.line('°')}",
            ]
        if self.warnings:
            lines += ["", "Warnings", *(f"- {warning}" for warning in self.warnings)]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, object]:
        """All figures as plain numbers, for JSON; lengths in metres, angles in degrees, times in seconds."""
        a = self.association
        return {
            "association": {
                "method": a.method,
                "matches": len(a),
                "repeated": a.repeated,
                "unmatched_estimate": a.unmatched_estimate,
                "unmatched_ground_truth": a.unmatched_ground_truth,
                "outside": a.outside,
                "overlap_s": a.overlap_s,
                "largest_stamp_difference_s": float(a.difference_s.max()),
                "gaps_s": [list(gap) for gap in a.gaps],
                "applied_offset_s": a.offset_s,
                "time_offset": None
                if a.time_offset is None
                else asdict(a.time_offset) | {"others_s": list(a.time_offset.others_s)},
            },
            "alignment": {
                "kind": self.alignment.kind,
                "R_world_estimate": self.alignment.R_world_estimate.tolist(),
                "p_world_estimate": self.alignment.p_world_estimate.tolist(),
                "scale": self.alignment.scale,
                "by_first_poses": self.aligned_by,
            },
            "plane": self.plane,
            "ate_translation_m": asdict(self.ate),
            "ate_rotation_deg": asdict(self.ate_rotation),
            "rpe": [
                {
                    "delta": errors.delta.value,
                    "unit": errors.delta.unit,
                    "pairs": len(errors.pairs),
                    "translation_m": asdict(errors.translation),
                    "rotation_deg": asdict(errors.rotation),
                }
                for errors in self.relative
            ],
            "warnings": list(self.warnings),
        }


def evaluate(
    estimate: Trajectory,
    ground_truth: Trajectory,
    *,
    alignment: AlignmentKind = "se3",
    method: Literal["nearest", "interpolate"] = "nearest",
    max_difference_s: float = 0.02,
    offset_s: float = 0.0,
    max_gap_s: float = 0.25,
    min_matches: int = 10,
    align_by_first: int | None = None,
    plane: Plane | None = None,
    deltas: Sequence[Delta] = DELTAS,
    rpe_pairs: Pairs = "consecutive",
    rpe_path_of: Literal["estimate", "ground_truth"] = "estimate",
) -> Evaluation:
    """Compare an estimate with the ground truth. Neither argument is changed.

    Args:
        estimate, ground_truth: the trajectories.
        alignment: `se3`, `sim3`, `yaw` or `none`, from the matched positions (`align`), or `origin`, from the first matched pose.
        method, max_difference_s, offset_s, max_gap_s, min_matches: see `associate`.
        align_by_first: find the alignment from so many matched poses at the beginning only; None: from all.
        plane: project both into this plane of the ground truth's frame, after the alignment.
        deltas: of the relative errors; where the trajectory is too short for one (or has no time), a warning says so.
        rpe_pairs: `consecutive` or `all`. rpe_path_of: whose path says where a pair ends.

    Raises:
        InputError: a comparison that would mean nothing: no overlap in time, too few matches, another unit of time or
            length, positions that do not determine the alignment.

    Example:
        >>> truth = bp.read_trajectory("flight.gt.tum")
        >>> result = bp.evaluate(truth, truth, alignment="none")
        >>> result.ate.rmse
        0.0
    """

    choice(alignment, _KINDS, "alignment")
    choice(rpe_pairs, ("consecutive", "all"), "rpe_pairs")
    choice(rpe_path_of, ("estimate", "ground_truth"), "rpe_path_of")
    if plane is not None:
        choice(plane, ("xy", "xz", "yz"), "None or a plane")
    if not (isinstance(deltas, Sequence) and all(isinstance(delta, Delta) for delta in deltas)):
        raise InputError("deltas as a list of Delta", shown(deltas), 'write e.g. [Delta(10.0, "m")]')

    def matches(estimate: Trajectory, offset_s: float, *, tell_offset: bool = False) -> Association:
        return associate(
            estimate,
            ground_truth,
            method,
            max_difference_s,
            offset_s=offset_s,
            max_gap_s=max_gap_s,
            min_matches=min_matches,
            tell_offset=tell_offset,
        )

    def error_with(estimate: Trajectory, offset_s: float) -> float | None:
        """The ATE with other stamps; None where they cannot be compared."""
        with suppress(InputError):
            other = matches(estimate, offset_s)
            moved = _find_alignment(other, alignment, align_by_first).apply(other.estimate)
            return rms(translation_errors(projected(moved, plane), projected(other.ground_truth, plane)))
        return None

    association = matches(estimate, offset_s, tell_offset=True)
    matched = association.estimate
    if alignment != "sim3":
        _refuse_other_unit(matched, association.ground_truth)
    transform = _find_alignment(association, alignment, align_by_first)
    aligned, truth = (projected(poses, plane) for poses in (transform.apply(matched), association.ground_truth))
    translation = translation_errors(aligned, truth)
    rotation = rotation_differences(aligned, truth)
    warnings = [*_order_doubts(estimate, ground_truth), *estimate.warnings, *ground_truth.warnings]
    warnings += _association_doubts(association, estimate, ground_truth)
    warnings += jump_doubts(estimate, ground_truth)
    warnings += [
        *clock_doubts(association, estimate, ground_truth, rms(translation), error_with),
        *alignment_doubts(association, transform, translation, rotation),
        *reading_doubts(association, transform, translation),
        *incident_doubts(aligned, truth, translation),
        *rounded_position_doubts(estimate, ground_truth, rms(translation)),
    ]
    if association.method != "index":
        on_clock = replace(estimate, time_ns=estimate.times + round(offset_s * 1e9), lines=None)
        moved = projected(transform.apply(on_clock), plane), projected(ground_truth, plane)
        warnings += rounding_doubts(aligned, truth, (estimate, ground_truth), moved)
    relative = []
    for delta in deltas:
        try:
            relative.append(relative_errors(aligned, truth, delta, pairs=rpe_pairs, path_of=rpe_path_of))
        except InputError as error:
            warnings.append(f"no relative error over {delta}: {error}")
    return Evaluation(
        association=association,
        alignment=transform,
        aligned_by=align_by_first,
        plane=plane,
        aligned=aligned,
        truth=truth,
        translation_error_m=translation,
        rotation_error_deg=np.degrees(np.linalg.norm(rotation, axis=1)),
        relative=tuple(relative),
        warnings=tuple(warnings),
    )


def _find_alignment(association: Association, kind: AlignmentKind, first: int | None) -> Alignment:
    estimate, truth = association.estimate, association.ground_truth
    if kind == "origin":
        return align_origin(estimate, truth)
    if first is not None and not (is_finite(first) and first == int(first) and 3 <= first <= len(association)):
        raise InputError(
            f"3 to {len(association)} matched poses to align by", shown(first), "choose another align_by_first, or leave it out"
        )
    return align(estimate.p[:first], truth.p[:first], kind)


def _order_doubts(estimate: Trajectory, ground_truth: Trajectory) -> list[str]:
    """Whether names or contents of the files speak for the two being swapped: the field's tools have the other order."""
    first, second = (Path(trajectory.source).name for trajectory in (estimate, ground_truth))
    truths = [_NAMED_TRUTH.search(name) is not None for name in (first, second)]
    runs = [name in _NAMES_OF_RUNS for name in (first, second)]
    if truths[0] > truths[1] or runs[1] > runs[0]:
        return [
            f"by their names, {first} is the ground truth and {second} the estimate: are they swapped? The ground truth is last"
        ]
    if ground_truth.covariance is not None and estimate.covariance is None and not truths[1]:
        return [
            f"{second} says how well each pose is known, as estimates do, and {first} does not: are they swapped? The ground "
            "truth is last"
        ]
    return []


def _refuse_other_unit(estimate: Trajectory, ground_truth: Trajectory) -> None:
    """A size that differs by a power of ten of metric units, to within 5 %, is taken for a unit and not for an error."""
    sizes = [float(np.linalg.norm(principal_spread(trajectory.p))) for trajectory in (estimate, ground_truth)]
    if min(sizes) <= 0.0:
        return
    ratio = sizes[0] / sizes[1]
    power = round(float(np.log10(ratio)))
    if abs(power) in (2, 3, 6) and abs(ratio / 10.0**power - 1.0) < 0.05:
        raise InputError(
            "positions in metres in both files",
            f"an estimate 10^{power} times the size of the ground truth ({sizes[0]:.4g} and {sizes[1]:.4g}, standard deviations)",
            'convert the one in centimetres, millimetres or kilometres, or compare with alignment="sim3"',
        )


def _association_doubts(association: Association, estimate: Trajectory, ground_truth: Trajectory) -> list[str]:
    doubts = []
    if association.method != "index":
        inside = len(estimate) - association.outside
        if len(association) < 0.8 * inside and not _is_of_sparse_truth(association, ground_truth):
            doubts.append(
                f"only {len(association)} of the {inside} poses within the ground truth's time were matched: the numbers "
                "speak for these alone"
            )
        covered = association.overlap_s / max(ground_truth.duration_s, 1e-9)
        if covered < 0.8:
            doubts.append(
                f"the estimate covers {100 * covered:.0f} % of the ground truth's time: the rest counts as neither good nor bad"
            )
        if association.repeated:
            doubts.append(
                f"{association.repeated} of the {len(association)} matches repeat a pose, and charge the estimate with the "
                "motion between the stamps: --interpolate does not"
            )
    return doubts


def _is_of_sparse_truth(association: Association, ground_truth: Trajectory) -> bool:
    """Whether poses are unmatched only because the ground truth has fewer, evenly over the time of the estimate."""
    if association.method != "nearest" or association.unmatched_ground_truth > 0.2 * len(association):
        return False
    longest_s = max((end - begin for begin, end in association.gaps), default=0.0)
    return longest_s < 5.0e-9 * float(np.median(np.diff(ground_truth.times)))
