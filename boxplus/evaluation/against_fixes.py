"""A trajectory against positions by satellite: places only, at the antenna."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_floats
from boxplus.errors import InputError
from boxplus.evaluation.alignment import Alignment, PositionAlignment, align
from boxplus.evaluation.statistics import Statistics
from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import quaternion
from boxplus.sensors.satellites.geodesy import EnuFrame
from boxplus.sensors.satellites.gnss import GnssFixes
from boxplus.systems.georeference.attachment import poses_between
from boxplus.systems.georeference.held import HELD, held, longest_hold
from boxplus.systems.georeference.start import extent_of, find_start

_KINDS = {
    "none": "no alignment: the trajectory is in ENU of the origin",
    "yaw": "heading and place aligned",
    "se3": "SE(3) alignment",
    "sim3": "Sim(3) alignment (and scale)",
}
_SIGMAS, _LEAST_SIGMA, _DRIFT = 3.0, 1.0, 0.01  # of fixes that agree: standard deviations, [m], share of the extent
_FAR = 6.0  # times the median, an error that is rather the receiver's


@dataclass(frozen=True, slots=True, eq=False)
class FixComparison:
    """The result of `compare_with_fixes`.

    Attributes:
        frame: the origin of the comparison. alignment: that brought the antenna's path into it.
        time_ns: (M,) of the fixes compared; error_enu: (M, 3) trajectory less fix, east, north, up [m].
        unmatched: fixes outside of the trajectory's time or in its gaps. rejected: fixes that are no position, or that of some
            time ago, by reason.
        sigma_m: median of the standard deviations stated, of a horizontal axis; None where none is.
        warnings: what to doubt about the numbers.
    """

    frame: EnuFrame
    alignment: Alignment
    time_ns: NDArray[np.int64]
    error_enu: NDArray[np.float64]
    unmatched: int
    rejected: dict[str, int]
    sigma_m: float | None
    warnings: tuple[str, ...]

    @property
    def horizontal(self) -> Statistics:
        """Figures of the distances on the ground [m]."""
        return Statistics.of(np.linalg.norm(self.error_enu[:, :2], axis=1))

    @property
    def vertical(self) -> Statistics:
        """Figures of the differences of height, without sign [m]."""
        return Statistics.of(np.abs(self.error_enu[:, 2]))

    def summary(self) -> str:
        """The report as text."""
        rejected = "".join(f", {count} {reason}" for reason, count in self.rejected.items())
        stated = "no standard deviation stated" if self.sigma_m is None else f"stated to {self.sigma_m:.3g} m (median)"
        lines = [
            f"Positions by satellite: {len(self.time_ns)} compared, {self.unmatched} outside of its time{rejected}; {stated}",
            f"Alignment: {_KINDS[self.alignment.kind]}",
            f"Origin: {self.frame.latitude:.7f} deg, {self.frame.longitude:.7f} deg, {self.frame.altitude:.2f} m",
            "",
            "Absolute position error at the antenna",
            f"on the ground: {self.horizontal.line('m')}",
            f"height: {self.vertical.line('m')}",
        ]
        if self.warnings:
            lines += ["", "Warnings", *(f"- {warning}" for warning in self.warnings)]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, object]:
        """All figures as plain numbers, for JSON."""
        return {
            "fixes": len(self.time_ns),
            "unmatched": self.unmatched,
            "rejected": self.rejected,
            "sigma_m": self.sigma_m,
            "origin": asdict(self.frame),
            "alignment": {
                "kind": self.alignment.kind,
                "R_world_estimate": self.alignment.R_world_estimate.tolist(),
                "p_world_estimate": self.alignment.p_world_estimate.tolist(),
                "scale": self.alignment.scale,
            },
            "horizontal_m": asdict(self.horizontal),
            "vertical_m": asdict(self.vertical),
            "warnings": list(self.warnings),
        }


def compare_with_fixes(
    estimate: Trajectory,
    fixes: GnssFixes,
    *,
    alignment: PositionAlignment = "yaw",
    lever_arm: ArrayLike | None = None,
    frame: EnuFrame | None = None,
    offset_s: float = 0.0,
    min_matches: int = 10,
) -> FixComparison:
    """Compare the path of an antenna with what a receiver says.

    Args:
        estimate: poses of a body.
        fixes: of the receiver, taken as they are: errors of it count as the estimate's. Only those are left out that repeat the
            position before while the trajectory moves: they say where the antenna was some time ago.
        alignment: `yaw` (heading and place, by fixes most others agree with), `se3`, `sim3`, or `none` for a
            trajectory that is in ENU of `frame`.
        lever_arm: (3,) the antenna in the body's frame [m]; zero where left out, with a warning.
        frame: origin; the first fix where left out.
        offset_s: added to the stamps of the estimate [s].
        min_matches: refuse to compare fewer fixes.

    Raises:
        InputError: a trajectory without times, too few fixes within its time, no origin for `none`, or positions that do not
            determine the alignment.
    """
    if estimate.time_ns is None:
        raise InputError("a trajectory with times", f"none in {estimate.source}", "give a TUM, EuRoC or CSV file")
    if alignment == "none" and frame is None:
        raise InputError(
            'the origin of a trajectory in ENU, for alignment="none"',
            "none",
            "give a run of 'boxplus slam' with georeference.yaml",
        )
    lever = np.zeros(3) if lever_arm is None else as_floats(lever_arm, "lever_arm")
    if lever.shape != (3,):
        raise InputError("lever_arm of shape (3,)", f"shape {lever.shape}", "give metres in the body's frame")
    T = np.hstack([estimate.q_wxyz, estimate.p])
    inside, follows, poses, _ = poses_between(estimate.time_ns + round(offset_s * 1e9), T, fixes.time_ns)
    within = np.flatnonzero(inside & follows)
    if len(within) < max(min_matches, 1):
        raise InputError(
            f"at least {min_matches} fixes within the time of the trajectory", f"{len(within)} of {len(fixes)}",
            "check that both have the same clock; offset_s shifts the estimate",
        )  # fmt: skip
    is_held = held(fixes.lat_lon_alt[within], poses[within, 4:])
    matched = within[~is_held]
    if len(matched) < max(min_matches, 1):
        raise InputError(
            f"at least {min_matches} positions of the receiver",
            f"{len(matched)}; the other {int(is_held.sum())} fixes repeat the position before while the path goes on",
            "look at the receiver and its driver: it hangs",
        )
    hold = longest_hold(fixes.time_ns[within], fixes.lat_lon_alt[within], poses[within, 4:], is_held)
    hung = (hold.text,) if hold is not None and hold.lasts else ()
    rejected = dict(fixes.rejected) | ({HELD: int(is_held.sum())} if is_held.any() else {})
    poses = poses[matched]
    p = poses[:, 4:] + quaternion.to_matrix(poses[:, :4]) @ lever
    frame = frame if frame is not None else EnuFrame(*fixes.lat_lon_alt[matched[0]].tolist())
    p_enu = frame.to_enu(fixes.lat_lon_alt[matched])
    known = fixes.has_covariance[matched]
    variance = fixes.covariance[matched][known]
    sigma = float(np.sqrt(np.median(0.5 * (variance[:, 0, 0] + variance[:, 1, 1])))) if known.any() else None
    heard = _agreeing(p, p_enu, sigma) if alignment == "yaw" else np.ones(len(p), dtype=np.bool_)
    found = align(p[heard], p_enu[heard], alignment)
    error = found.scale * p @ found.R_world_estimate.T + found.p_world_estimate - p_enu
    return FixComparison(
        frame, found, fixes.time_ns[matched], error, len(fixes) - len(within), rejected, sigma,
        tuple(_doubts(error, sigma, lever_arm is not None, (*estimate.warnings, *hung))),
    )  # fmt: skip


def _agreeing(p: NDArray[np.float64], p_enu: NDArray[np.float64], sigma: float | None) -> NDArray[np.bool_]:
    """(M,) fixes to align by: those that most others agree with, so that multipath turns nothing; all where there are none."""
    tolerance = _SIGMAS * max(sigma if sigma is not None else 0.0, _LEAST_SIGMA) + _DRIFT * extent_of(p)
    start = find_start(p, p_enu, np.full(len(p), tolerance))
    return start.inliers if start is not None and start.share > 0.5 else np.ones(len(p), dtype=np.bool_)


def _doubts(error: NDArray[np.float64], sigma: float | None, has_lever: bool, before: tuple[str, ...]) -> list[str]:
    doubts = list(before)
    distance = np.linalg.norm(error[:, :2], axis=1)
    if not has_lever:
        doubts.append("no lever arm was given: the body's path is compared with the antenna's")
    far = int((distance > _FAR * np.median(distance)).sum())
    if far:
        doubts.append(f"{far} fixes are more than {_FAR:g} times the median off: multipath counts as an error here")
    if sigma is not None and np.median(distance) < sigma:
        doubts.append(
            f"half of the fixes agree to better than the {sigma:.2g} m they are stated to: it is their noise that is seen"
        )
    return doubts
