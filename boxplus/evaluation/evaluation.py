"""A whole comparison of an estimate with the ground truth: association, alignment, ATE, RPE and what to doubt."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.evaluation.alignment import Alignment, AlignmentKind, align, principal_spread
from boxplus.evaluation.association import Association, associate
from boxplus.evaluation.ate import rotation_differences, translation_errors
from boxplus.evaluation.rpe import Pairs, RelativeErrors, relative_errors
from boxplus.evaluation.statistics import Statistics
from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import so3

_KINDS = {
    "none": "no alignment",
    "yaw": "yaw alignment (rotation about z and translation)",
    "se3": "SE(3) alignment (rotation and translation)",
    "sim3": "Sim(3) alignment (and scale)",
}


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The result of `evaluate`.

    Attributes:
        association: which poses were compared, and how they were matched.
        alignment: the transform that was applied to the estimate.
        aligned: (M) matched poses of the estimate, in the frame of the ground truth.
        translation_error_m: (M,) absolute translation errors [m].
        rotation_error_deg: (M,) absolute rotation errors [degrees].
        relative: relative pose errors, by distance and by time, as far as the trajectory is long enough.
        warnings: what to doubt about the numbers, one sentence each.
    """

    association: Association
    alignment: Alignment
    aligned: Trajectory
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
        return f"{len(self.association)} poses ({matched[self.association.method]}), {_KINDS[self.alignment.kind]}"

    def summary(self) -> str:
        """The report as text: association first, then alignment, errors and warnings."""
        lines = ["Association", *self.association.lines(), "", f"Alignment: {_KINDS[self.alignment.kind]}"]
        if self.alignment.kind != "none":
            turn = float(np.degrees(np.linalg.norm(so3.log(self.alignment.R_world_estimate))))
            p = ", ".join(f"{value:.4f}" for value in self.alignment.p_world_estimate)
            scale = f", scale {self.alignment.scale:.6f}" if self.alignment.kind == "sim3" else ""
            lines.append(f"rotation {turn:.4f}°, translation ({p}) m{scale}")
        lines += ["", f"Absolute trajectory error: {self.title}"]
        lines += [f"translation: {self.ate.line('m')}", f"rotation: {self.ate_rotation.line('°')}"]
        for errors in self.relative:
            share = 100.0 * errors.translation.mean / errors.delta
            per = f"{share:.3f} % of the distance" if errors.unit == "m" else f"{errors.translation.mean / errors.delta:.6f} m/s"
            lines += [
                "",
                f"Relative pose error over {errors.delta:g} {errors.unit}: {len(errors.pairs)} pairs, mean {per}",
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
                "unmatched_estimate": a.unmatched_estimate,
                "unmatched_ground_truth": a.unmatched_ground_truth,
                "outside": a.outside,
                "overlap_s": a.overlap_s,
                "largest_stamp_difference_s": float(a.difference_s.max()),
                "gaps_s": [list(gap) for gap in a.gaps],
                "applied_offset_s": a.offset_s,
                "time_offset": None if a.time_offset is None else asdict(a.time_offset),
            },
            "alignment": {
                "kind": self.alignment.kind,
                "R_world_estimate": self.alignment.R_world_estimate.tolist(),
                "p_world_estimate": self.alignment.p_world_estimate.tolist(),
                "scale": self.alignment.scale,
            },
            "ate_translation_m": asdict(self.ate),
            "ate_rotation_deg": asdict(self.ate_rotation),
            "rpe": [
                {
                    "delta": errors.delta,
                    "unit": errors.unit,
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
    rpe_distance_m: float | None = 10.0,
    rpe_time_s: float | None = 1.0,
    rpe_pairs: Pairs = "consecutive",
) -> Evaluation:
    """Compare an estimate with the ground truth. Neither argument is changed.

    Args:
        estimate, ground_truth: the trajectories.
        alignment: `se3`, `sim3`, `yaw` or `none`, from the matched positions (`align`).
        method, max_difference_s, offset_s, max_gap_s, min_matches: see `associate`.
        rpe_distance_m, rpe_time_s: deltas of the relative errors, or None to leave them out; where the trajectory is too
            short for one (or has no time), a warning says so.
        rpe_pairs: `consecutive` or `all`.

    Raises:
        InputError: a comparison that would mean nothing: no overlap in time, too few matches, another unit of time or
            length, positions that do not determine the alignment.
    """
    association = associate(
        estimate, ground_truth, method, max_difference_s, offset_s=offset_s, max_gap_s=max_gap_s, min_matches=min_matches
    )
    matched, truth = association.estimate, association.ground_truth
    if alignment != "sim3":
        _refuse_other_unit(matched, truth)
    transform = align(matched.p, truth.p, alignment)
    aligned = transform.apply(matched)
    translation = translation_errors(aligned, truth)
    rotation = rotation_differences(aligned, truth)
    warnings = [*estimate.warnings, *ground_truth.warnings]
    warnings += _association_doubts(association, estimate, ground_truth)
    warnings += _alignment_doubts(transform, translation, rotation)
    relative = []
    if rpe_time_s is not None and aligned.time_ns is None:
        rpe_time_s = None
        warnings.append("no relative error by time: the files carry no time stamps")
    for distance_m, time_s in ((rpe_distance_m, None), (None, rpe_time_s)):
        if distance_m is not None or time_s is not None:
            try:
                relative.append(relative_errors(aligned, truth, distance_m=distance_m, time_s=time_s, pairs=rpe_pairs))
            except InputError as error:
                warnings.append(f"no relative error by {'time' if distance_m is None else 'distance'}: {error}")
    return Evaluation(
        association=association,
        alignment=transform,
        aligned=aligned,
        translation_error_m=translation,
        rotation_error_deg=np.degrees(np.linalg.norm(rotation, axis=1)),
        relative=tuple(relative),
        warnings=tuple(warnings),
    )


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
            "convert the one in centimetres, millimetres or kilometres, or compare with --align sim3",
        )


def _association_doubts(association: Association, estimate: Trajectory, ground_truth: Trajectory) -> list[str]:
    doubts = []
    if association.method != "index":
        inside = len(estimate) - association.outside
        if len(association) < 0.8 * inside:
            doubts.append(
                f"only {len(association)} of the {inside} poses within the ground truth's time were matched: the numbers "
                "speak for these alone"
            )
        covered = association.overlap_s / max(ground_truth.duration_s, 1e-9)
        if covered < 0.8:
            doubts.append(
                f"the estimate covers {100 * covered:.0f} % of the ground truth's time: the rest counts as neither good nor bad"
            )
        offset = association.time_offset
        if offset is not None and abs(offset.offset_s) > 0.02:
            doubts.append(
                f"the clocks may differ by {offset.offset_s:+.3f} s (correlation {offset.correlation:.3f}); try --offset "
                f"{association.offset_s + offset.offset_s:.3f}"
            )
    return doubts


def _alignment_doubts(alignment: Alignment, translation: NDArray[np.float64], rotation: NDArray[np.float64]) -> list[str]:
    doubts = []
    rmse = float(np.sqrt(np.mean(translation**2)))
    if alignment.kind in ("se3", "sim3") and alignment.spread_m[1] < rmse:
        doubts.append(
            f"the path strays {alignment.spread_m[1]:.3g} m from a straight line, less than the error of {rmse:.3g} m: the "
            "rotation of the alignment about that line is mostly noise"
        )
    if alignment.mirrored:
        doubts.append("a mirror image would fit better than any rotation: does one of the files have a flipped axis?")
    mean = rotation.mean(axis=0)
    constant = float(np.degrees(np.linalg.norm(mean)))
    scatter = float(np.degrees(np.sqrt(np.mean(np.sum((rotation - mean) ** 2, axis=1)))))
    if constant > 2.0 and scatter < 0.5 * constant:
        doubts.append(
            f"the orientations differ by a constant {constant:.1f}° (scatter {scatter:.1f}°): the body frames are not the same, "
            "and the rotation error and the relative errors contain that"
        )
    return doubts
