"""The verdict on a run: right, flagged with the right cause, flagged, or silently wrong.

Everything a user sees of a run is its exit code, its headline (`describe_state`), its warnings and, when it refuses, its message;
the verdict looks at nothing else. What counts as naming the cause is fixed below, a fault at a time, before any result is seen.

**Error.** Against the exact ground truth at the time of every estimate. The first estimate is laid upon the truth, then position
and rotation of every other one are compared: e_p = p_est − p_true [m] in the estimate's world, e_R = Log(R_trueᵀ R_est). A run is
right when at every scan

- ‖e_p‖ ≤ max(5 cm, 2 % of the true way so far), and ‖e_R‖ ≤ 2 deg;
- both lie within 5 σ of the covariance the run states for the pose (Mahalanobis distance of three components, with the
  probability of 5 σ of one), or are below 3 cm and 0.3 deg, which nobody minds. For 2 s after the ground truth of a real flight
  jumps, along which the scans were cast, it is the first that counts: no IMU felt it.

That scans are `weak` or `lost` counts as a flag when at least half of the error arose in such scans, and not otherwise.

Where a place is featureless, nothing tells rest from a constant speed. That a run says so is no false alarm as long as it says
nothing else, and as what it does not know shows: its error arose in weak scans, or its covariance covers it. Nor is it one
that a run refuses there because the surroundings do not show how the platform moves.

Nor is it one where the exact geometry of the weak scans that are looked at does leave a direction open.

Where nobody gave the mounting, it is no news that it is unknown, nor how much of the position is for that reason; and a run that
takes the identity for it because no motion shows it, says so and is wrong for it, has not raised a false alarm. A sound one that
says how well it knows the mounting, and whose covariance covers an error beyond what is right, has told of it: `flagged`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import quaternion, so3
from boxplus.runs.lidar_inertial.summary import RunSummary
from boxplus.simulation import Motion

FLOOR_M, SHARE_OF_WAY, LIMIT_DEG = 0.05, 0.02, 2.0
NOBODY_MINDS_M, NOBODY_MINDS_DEG = 0.03, 0.3
FIVE_SIGMA = 5.64
"""√χ²₃ whose probability is that of 5 σ in one dimension, 5.7e-7."""
_STRETCH_SCANS = 10
_JUMP_LASTS_NS = 2_000_000_000
NO_JUMPS: NDArray[np.int64] = np.empty(0, dtype=np.int64)

_CLOCKS = r"clock|time offset|synchron|stamps?\b.*(early|late|apart|shift)|(early|late|apart|offset).* ms\b"
_MOUNTING = r"T_imu_lidar|extrinsic|mount"
CAUSES: dict[str, str] = {
    "gyro_unit": r"deg/s|gyro.unit|unit of the gyro",
    "accel_unit": r"accel.unit|in g\b|\(g\)|m/s2 or g|unit of the accel",
    "time_unit": r"unit of the point times|point.time|points of a scan span|times in the field",
    "gyro_sign": r"gyro\w*\b.*(sign|negat|invert|opposite|mirror|handed)|(sign|negat|invert|opposite|mirror|handed).*gyro",
    "accel_sign": r"accel\w*\b.*(sign|negat|invert|opposite|gravity instead)|(sign|negat|invert|opposite).*accel|upside down",
    "clock_offset": _CLOCKS,
    "clock_drift": _CLOCKS + r"|drift",
    "other_imu": r"imu.topic|another (body|imu|platform)|other imu|different bod|same body|unrelated|no rotation fits|"
    r"not the one of this lidar",
    "other_lidar": _MOUNTING + r"|lidar.topic|another lidar",
    "point_scale": r"\bscale\b|feet|metres|unit of the (points|coordinates|ranges)",
    "mirrored": r"mirror|handed|reflect|sign of",
    "imu_gap": r"IMU gap|without IMU|no IMU sample|IMU samples? (is|are) missing|gaps?\b.*IMU",
    "nan_burst": r"not finite|NaN|IMU gap|dropped",
    "inverted_extrinsic": _MOUNTING,
    "extrinsic_off": _MOUNTING,
}
"""Fault → what a message must say to name its cause (searched in every message, upper or lower case)."""
_OPTION_CAUSES = {
    "gyro_unit": r"gyro.unit|deg/s",
    "accel_unit": r"accel.unit",
    "point_time_unit": r"point.time|unit of the point times|points of a scan span",
    "point_time_reference": r"point.time|scan_end|scan_start|reference|" + _CLOCKS,
}
_UNKNOWN_MOUNTING = re.compile(
    r"^neither --T-imu-lidar|^by its own covariance the run knows its last.*: T_imu_lidar was known to [^,]* at first \([^,]*\)$"
)
_WEAK = re.compile(r"scans are weak|scans that were read have no pose")
_NOT_SHOWN = re.compile(
    r"^the surroundings do not show whether the platform moves along|^by its own covariance the run knows its last"
)
_REFUSED_FOR_IT = re.compile(r"the surroundings do not show (how (fast )?the platform (moves|turns)|whether the platform moves)")


class Truth(Protocol):
    """The exact motion of the IMU over `[start_ns, end_ns]`."""

    start_ns: int
    end_ns: int

    def ground_truth(self, time_ns: NDArray[np.int64]) -> Motion:
        """At `time_ns` (N,)."""


class Drawn(Protocol):
    """What the verdict needs to know about a recording; `kinds` has its `extrinsic` and its `fault`, see draws.py."""

    kinds: Any
    featureless: bool
    recording_options: dict[str, Any]


@dataclass
class Outcome:
    """What a user gets from a run.

    Attributes:
        exit_code: of the command line.
        error: the message of a run that refused or failed.
        summary: `run.json`; None when there is none.
        estimate: `trajectory.csv`; None when it is missing or empty.
        cpu_s: processor time of simulation, odometry and all.
    """

    exit_code: int
    error: str | None = None
    summary: RunSummary | None = None
    estimate: Trajectory | None = None
    cpu_s: float = 0.0


@dataclass
class Errors:
    """Errors of every scan; see the top of the file.

    Attributes:
        e_p, R_error: (N, 3) position error [m] and (N, 3, 3) rotation error, in the world of the estimate.
        position_m, rotation_deg, position_sigmas, rotation_sigmas, limit_m: (N,) each.
        jumped: (N,) shortly after the ground truth itself jumped.
        way_m: true length of the way.
        nees: normalised estimation error squared of the pose, mean over scans after the first that have not `jumped`, per degree
            of freedom.
    """

    e_p: NDArray[np.float64]
    R_error: NDArray[np.float64]
    position_m: NDArray[np.float64]
    rotation_deg: NDArray[np.float64]
    position_sigmas: NDArray[np.float64]
    rotation_sigmas: NDArray[np.float64]
    limit_m: NDArray[np.float64]
    jumped: NDArray[np.bool_]
    way_m: float
    nees: float

    @property
    def too_far(self) -> NDArray[np.bool_]:
        """(N,) beyond what is right, whatever the covariance says."""
        return (self.position_m > self.limit_m) | (self.rotation_deg > LIMIT_DEG)

    @property
    def too_sure(self) -> NDArray[np.bool_]:
        """(N,) beyond 5 σ of the covariance."""
        position = (self.position_sigmas > FIVE_SIGMA) & (self.position_m > NOBODY_MINDS_M)
        rotation = (self.rotation_sigmas > FIVE_SIGMA) & (self.rotation_deg > NOBODY_MINDS_DEG)
        return (position | rotation) & ~self.jumped


@dataclass
class Verdict:
    """How a run ended.

    Attributes:
        verdict: "right", "right cause", "flagged" or "silent".
        reasons: why it is not right: "error", "covariance", "no estimate".
        flags: what warned the user, a sentence each.
        false_alarm: of a sound run: "flagged" (or refused) without the reason that nothing is to be seen, "weak" when nothing but
            scans were called weak where the LiDAR saw enough, else empty.
    """

    verdict: str
    reasons: list[str] = field(default_factory=list)
    flags: list[str] = field(default_factory=list)
    false_alarm: str = ""


def errors_of(estimate: Trajectory, truth: Truth, jumps_ns: NDArray[np.int64] = NO_JUMPS) -> Errors:
    """Compare every pose with the truth, the first one laid upon it; `jumps_ns` (J,) are when the truth itself jumps."""
    assert estimate.time_ns is not None and estimate.covariance is not None
    time_ns = np.clip(estimate.time_ns, truth.start_ns, truth.end_ns)
    true = truth.ground_truth(time_ns)
    R = quaternion.to_matrix(estimate.q_wxyz)
    R_world_truth = R[0] @ true.R_world_imu[0].T
    R_true = R_world_truth @ true.R_world_imu
    p_true = (true.p_world_imu - true.p_world_imu[0]) @ R_world_truth.T + estimate.p[0]
    e_p, e_R = estimate.p - p_true, so3.log(np.swapaxes(R_true, 1, 2) @ R)
    every = np.arange(time_ns[0], max(time_ns[-1], time_ns[0] + 1), 20_000_000)
    steps = np.linalg.norm(np.diff(truth.ground_truth(every).p_world_imu, axis=0), axis=1)
    way = np.interp(time_ns, every, np.concatenate([[0.0], np.cumsum(steps)]))
    P = estimate.covariance
    squared = _mahalanobis(np.concatenate([e_R, e_p], axis=1), P)
    jumped = np.any((time_ns[:, None] >= jumps_ns) & (time_ns[:, None] < jumps_ns + _JUMP_LASTS_NS), axis=1)
    counted = squared[1:][~jumped[1:]]
    return Errors(
        e_p=e_p,
        R_error=R @ np.swapaxes(R_true, 1, 2),
        position_m=np.linalg.norm(e_p, axis=1),
        rotation_deg=np.rad2deg(np.linalg.norm(e_R, axis=1)),
        position_sigmas=np.sqrt(_mahalanobis(e_p, P[:, 3:, 3:])),
        rotation_sigmas=np.sqrt(_mahalanobis(e_R, P[:, :3, :3])),
        limit_m=np.maximum(FLOOR_M, SHARE_OF_WAY * way),
        jumped=jumped,
        way_m=float(way[-1]),
        nees=float(counted.mean() / 6.0) if len(counted) else 0.0,
    )


def _mahalanobis(e: NDArray[np.float64], P: NDArray[np.float64]) -> NDArray[np.float64]:
    """eᵀ P⁻¹ e (N,); a variance below (1 µm)² or (1 µrad)² is lifted to it, the first pose is exact by definition."""
    lifted = P + 1e-12 * np.eye(P.shape[1])
    squared: NDArray[np.float64] = np.einsum("ni,ni->n", e, np.linalg.solve(lifted, e[..., None])[..., 0])
    return np.maximum(squared, 0.0)


def flags_of(outcome: Outcome, draw: Drawn) -> list[str]:
    """What tells the user that something is wrong.

    That the mounting is unknown is no news to one who did not give it; that some scans are weak, or before a start, says
    something about these only.
    """
    flags = [outcome.error] if outcome.error else []
    summary = outcome.summary
    if summary is not None:
        if summary.contradiction:
            flags.append(summary.contradiction)
        for warning in summary.warnings:
            expected = draw.kinds.extrinsic == "absent" and _UNKNOWN_MOUNTING.search(warning.text) is not None
            if not expected and not _WEAK.search(warning.text):
                flags.append(warning.text)
    if outcome.exit_code != 0 and not flags:
        flags.append(f"exit code {outcome.exit_code}")
    return flags


def names_cause(flags: list[str], draw: Drawn) -> bool:
    """Whether one of the messages names what is wrong with the recording."""
    if draw.kinds.fault == "option":
        pattern = _OPTION_CAUSES[next(iter(draw.recording_options))]
    elif draw.kinds.fault == "none":
        return False
    else:
        pattern = CAUSES[draw.kinds.fault]
    return any(re.search(pattern, text, re.IGNORECASE) for text in flags)


def judge(
    outcome: Outcome, errors: Errors | None, draw: Drawn, *, falsely_weak: bool = False, truly_weak: bool = False
) -> Verdict:
    """The verdict on a run.

    Args:
        outcome: what the user got.
        errors: of its trajectory; None without one.
        draw: what the recording was.
        falsely_weak: scans were called weak although the LiDAR saw enough (see `run.falsely_weak`).
        truly_weak: scans were called weak, and in none of those looked at the LiDAR saw enough.
    """
    flags = flags_of(outcome, draw)
    reasons: list[str] = []
    if errors is None:
        reasons.append("no estimate")
    else:
        reasons += ["error"] * bool(errors.too_far.any()) + ["covariance"] * bool(errors.too_sure.any())
    sound = draw.kinds.fault == "none"
    weak = errors is not None and outcome.estimate is not None and weak_share_of_error(outcome.estimate, errors) >= 0.5
    said = _NOT_SHOWN if outcome.error is None else _REFUSED_FOR_IT
    nothing_shown = (
        (draw.featureless or truly_weak) and all(said.search(text) for text in flags) and (weak or "covariance" not in reasons)
    )
    guessed = draw.kinds.extrinsic == "absent" and outcome.summary is not None and outcome.summary.extrinsic.source == "identity"
    with_reason = nothing_shown or (guessed and bool(reasons))
    false_alarm = "" if not sound else "flagged" if flags and not with_reason else "weak" if falsely_weak else ""
    if not reasons and outcome.exit_code in (0, 3):
        return Verdict("right", reasons, flags, false_alarm)
    told = sound and draw.kinds.extrinsic == "absent" and reasons == ["error"] and _says_mounting_is_unknown(outcome)
    if names_cause(flags, draw) or (sound and ((weak and draw.featureless) or guessed)):
        return Verdict("right cause", reasons, flags, false_alarm)
    if flags or weak or guessed or told:
        return Verdict("flagged", reasons, flags, false_alarm)
    return Verdict("silent", reasons, flags, false_alarm)


def _says_mounting_is_unknown(outcome: Outcome) -> bool:
    return outcome.summary is not None and any(_UNKNOWN_MOUNTING.search(warning.text) for warning in outcome.summary.warnings)


def weak_share_of_error(estimate: Trajectory, errors: Errors) -> float:
    """How much of the error arose while most scans were weak or lost, 0 to 1.

    Over stretches of ten scans: how far the error moved in each, in units of the limits. An error that arose in a weak stretch
    and is carried on through good scans lies in the weak stretch; one that grows through good scans does not.
    """
    assert estimate.status is not None
    begins = np.arange(0, len(errors.position_m) - 1, _STRETCH_SCANS)
    ends = np.minimum(begins + _STRETCH_SCANS, len(errors.position_m) - 1)
    moved = np.linalg.norm(errors.e_p[ends] - errors.e_p[begins], axis=1) / FLOOR_M
    turned = np.linalg.norm(so3.log(np.swapaxes(errors.R_error[begins], 1, 2) @ errors.R_error[ends]), axis=1)
    moved += np.rad2deg(turned) / LIMIT_DEG
    bad = np.concatenate([[0], np.cumsum([status != "ok" for status in estimate.status])])
    weak = bad[ends + 1] - bad[begins + 1] >= 0.5 * (ends - begins)
    return float(moved[weak].sum() / max(moved.sum(), 1e-12))
