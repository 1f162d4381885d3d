"""What is wrong, if something is: each known mistake against what the comparison of the sensors shows.

A mistake is named only where its own explanation fits and the declared one does not, with a margin; where the motion does not
decide, nothing is said. Every finding is a sentence for a user: what was seen, what it means, what to do.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.systems.lidar_inertial_agreement.agreement import (
    ROTATION_KNOWN_RAD,
    TURNING_RAD_S,
    Agreement,
    apart,
    apart_allowed,
    contradicted_within,
    shows_turns,
    unit_of,
)
from boxplus.systems.lidar_inertial_agreement.finding import Cause, Finding
from boxplus.systems.lidar_inertial_agreement.lengths import (
    MISFIT_M,
    SLOPE_FLOOR,
    SLOPE_KNOWN,
    feet_finding,
    slope_finding,
)
from boxplus.systems.lidar_inertial_agreement.planes.leaning import leaning
from boxplus.systems.lidar_inertial_agreement.rotation import RotationFit
from boxplus.systems.lidar_inertial_agreement.translation import TURN, TranslationFit

_LEAST_SEEN = 0.5  # of the pairs of scans, all three rotations
_GOOD_PATH_M = 0.15  # median misfit of registrations that can be believed
_BELONGING_RAD_S = np.deg2rad(8.0)  # rms of one sensor that the other must show
_TOGETHER = 0.5
_FITS = 0.8
_CLOSELY = 0.95
_REVERSED = 0.6  # a sign is told from its opposite by less than a scale from another
_SCALE_OFF = 0.12
_AS_WELL = 0.02  # of what is explained, by a mirror and by a mounting: turns about one axis do not tell them apart
_OFFSET_OK_S = 0.014
_SLOPE_OF_MANY_FLOOR = 0.03
_FITS_OF_MANY = 0.7
_FARTHEST_REVERSED = 4.5  # feet, and a third of it
_SAME_VALUES = 1e-12  # (rad/s)², of a gyroscope's rates about their mean
_FEWEST_POSES = 15  # compared, for lengths: of ten or eleven the errors that neighbours share are not known
_HALF_TURN_RAD = np.deg2rad(12.0)
_TURN_KNOWN_RAD, _TURN_OFF_RAD = np.deg2rad(3.0), np.deg2rad(6.0)
_TURN_OPEN_RAD = np.deg2rad(15.0)
_MUCH_NEARER = 0.5  # of the angle to the given mounting is left to its inverse, where that was meant
_MOUNTED = 0.95  # share of the turning that a mounting explains


def contradictions(agreement: Agreement, T_declared: NDArray[np.float64] | None) -> list[Finding]:
    """What the comparison contradicts; empty where the sensors agree or the motion does not decide.

    Args:
        agreement: from `compare_sensors`.
        T_declared: (4, 4) T_imu_lidar in use; None where it is an estimate of the same data.
    """
    rotation, translation = agreement.rotation, agreement.translation
    if rotation is None:
        planes = leaning(agreement.planes, agreement.ground)
        return [] if planes is None else [planes]
    if not _path_counts(agreement):
        return []
    found = (
        _of_unit(rotation)
        or _of_sign(rotation)
        or _of_steady_turn(agreement, rotation, T_declared)
        or _of_belonging(agreement, rotation)
        or _of_mirror(rotation, translation, T_declared)
        or (None if agreement.corrected is None else agreement.corrected.finding)
    )
    if found is not None:
        return [found]  # what follows from it is not worth a sentence of its own
    findings = [_of_mounting(rotation, T_declared), _of_scale(rotation), _of_clocks(rotation, agreement.imu_rate_hz)]
    if agreement.in_feet is not None:
        findings.append(feet_finding(agreement.in_feet))
    if translation is not None:
        findings.append(_of_lengths(agreement, translation, T_declared))
        findings.append(_of_turn(rotation, translation, T_declared))
    if findings[0] is None and not shows_mounting(agreement):
        findings.append(leaning(agreement.planes, agreement.ground))
    return [finding for finding in findings if finding is not None]


def _path_counts(agreement: Agreement) -> bool:
    """Whether a path can contradict anything: its scans fit one another, and the scene shows most of its rotations."""
    path, rotation = agreement.path, agreement.rotation
    if rotation is None or float(np.median(path.misfit)) > _GOOD_PATH_M:
        return False
    return rotation.covered > _LEAST_SEEN


def judges_rotation(agreement: Agreement) -> bool:
    """Whether the motion was enough for unit, sign and mounting to show, had they been wrong."""
    rotation = agreement.rotation
    if rotation is None or not _path_counts(agreement) or rotation.explained < _FITS:
        return False
    return shows_turns(rotation) and bool((rotation.rotation_std[0] < ROTATION_KNOWN_RAD).sum() >= 2)


def judges_clocks(rotation: RotationFit) -> bool:
    """Whether the motion shows the offset of the clocks."""
    return shows_turns(rotation) and rotation.explained > _CLOSELY and rotation.knows_offset


def least_offset(rotation: RotationFit, imu_rate_hz: float) -> float:
    """The smallest offset of the clocks that is named [s]."""
    return float(max(_OFFSET_OK_S, 0.5 / max(imu_rate_hz, 1.0), 4.0 * rotation.offset_std_s))


def judges_scale(rotation: RotationFit) -> bool:
    """Whether the motion shows the gyroscope's scale."""
    return shows_turns(rotation) and rotation.explained > _CLOSELY


def least_scale(rotation: RotationFit) -> float:
    """How far the gyroscope's scale is off at least where it is named."""
    return _least_scale(rotation.scale_std)


def _least_scale(std: float) -> float:
    return float(max(_SCALE_OFF, 4.0 * std))


def judges_lengths(agreement: Agreement) -> bool:
    """Whether the motion shows sign and scale of the accelerations."""
    translation = agreement.translation
    if translation is None or not _path_counts(agreement) or _lags(agreement):
        return False
    fits = translation.explained > _FITS and translation.sigma < MISFIT_M
    return fits and not _leaves_lengths_open(translation) and float(np.hypot(translation.slope_std, SLOPE_FLOOR)) < SLOPE_KNOWN


def _lags(agreement: Agreement) -> bool:
    """Whether the path misses a rotation that the gyroscope shows, then it misses accelerations as well, or knows it coarsely."""
    rotation = agreement.rotation
    if rotation is None or rotation.explained > _FITS:
        return rotation is not None and rotation.coarse
    turning = float(np.sqrt(agreement.gyro_power)) / max(unit_of(rotation.scale), 1.0)
    return turning > TURNING_RAD_S


def judges(cause: Cause, agreement: Agreement) -> bool:
    """Whether a comparison could have shown this mistake, so that saying nothing of it clears it."""
    rotation = agreement.rotation
    if rotation is None:
        return False
    if cause in ("time_offset", "clock_drift", "corrected_points", "reversed_times"):
        return _path_counts(agreement) and judges_clocks(rotation)
    if cause in ("force_sign", "length_scale"):
        return judges_lengths(agreement)
    if cause in ("extrinsic", "mirrored"):
        return shows_mounting(agreement)
    return judges_rotation(agreement)


def shows_mounting(agreement: Agreement) -> bool:
    """Whether rotations show the mounting about all axes."""
    rotation = agreement.rotation
    return rotation is not None and judges_rotation(agreement) and bool((rotation.rotation_std[0] < ROTATION_KNOWN_RAD).all())


def _of_unit(rotation: RotationFit) -> Finding | None:
    unit = unit_of(rotation.scale)
    if unit == 1.0 or not shows_turns(rotation) or max(rotation.explained, rotation.mirrored) < _FITS or rotation.scale_std > 0.2:
        return None
    if unit > 1.0:
        text = (
            f"over {rotation.intervals} scans the gyroscope turned {rotation.scale:.0f} times as far as the LiDAR: it reports "
            "deg/s; convert it to rad/s (reading a recording: --gyro-unit deg/s)"
        )
    else:
        text = (
            f"over {rotation.intervals} scans the LiDAR turned {1.0 / rotation.scale:.0f} times as far as the gyroscope: its "
            "rates were taken for deg/s and are rad/s (reading a recording: --gyro-unit rad/s)"
        )
    return Finding("gyro_unit", text)


def _of_sign(rotation: RotationFit) -> Finding | None:
    """No rotation has a determinant of −1: a gyroscope that only fits mirrored has its sign flipped.

    About a single axis a mirror and half a turn are the same: where a mounting explains nearly all, it is the mounting's to say.
    """
    if not shows_turns(rotation) or rotation.mirrored < _FITS or rotation.explained > _MOUNTED:
        return None
    if 1.0 - rotation.mirrored > 0.3 * (1.0 - rotation.explained):
        return None
    return Finding(
        "gyro_sign",
        f"gyroscope and LiDAR turn in opposite senses (mirrored they agree to {rotation.mirrored:.0%}, as they come to "
        f"{rotation.explained:.0%}): the gyroscope's sign is flipped, or one of its axes; negate its rates",
    )


def _of_steady_turn(agreement: Agreement, rotation: RotationFit, T_declared: NDArray[np.float64] | None) -> Finding | None:
    """Unit and sign by the means of both turns, where they do not change enough to show them."""
    if agreement.steady is None or shows_turns(rotation):
        return None
    return agreement.steady.finding(None if T_declared is None else T_declared[:3, :3])


def _of_belonging(agreement: Agreement, rotation: RotationFit) -> Finding | None:
    # A scale found without a common motion is no unit: it must not make a gyroscope at rest turn.
    turning = float(np.sqrt(agreement.gyro_power)) / max(unit_of(rotation.scale), 1.0)
    strong = max(float(np.linalg.norm(rotation.excitation)), turning)
    if strong < max(_BELONGING_RAD_S, 4.0 * rotation.sigma_registration) or rotation.together > _TOGETHER:
        return None
    if agreement.gyro_power < _SAME_VALUES:
        return Finding(
            "not_together",
            f"the LiDAR turns with {np.degrees(np.linalg.norm(rotation.excitation)):.1f} deg/s (rms), and the gyroscope gives "
            "the same values all the time: it has failed, or its driver leaves the rates out",
        )
    return Finding(
        "not_together",
        f"the LiDAR turns with {np.degrees(np.linalg.norm(rotation.excitation)):.1f} deg/s (rms) and the gyroscope with "
        f"{np.degrees(np.sqrt(agreement.gyro_power)):.1f} deg/s, and only {rotation.together:.0%} of it agrees, under "
        "any mounting and any clock offset up to 0.6 s: the IMU is not the one of this LiDAR (--imu-topic, "
        "--lidar-topic), or their clocks are farther apart",
    )


def _of_mirror(
    rotation: RotationFit, translation: TranslationFit | None, T_declared: NDArray[np.float64] | None
) -> Finding | None:
    """Mirrored points turn like a mounting half a turn off, and accelerate against it."""
    if T_declared is None or translation is None or rotation.explained < _FITS or not _reversed(translation):
        return None
    angle, seen = apart(rotation, T_declared[:3, :3])
    if not seen.any() or abs(angle - np.pi) > _HALF_TURN_RAD:
        return None
    return Finding(
        "mirrored",
        f"the LiDAR turns as if mounted {np.degrees(angle):.0f} deg from the given T_imu_lidar and accelerates "
        f"{translation.slope:.2f} times as the accelerometer does: the points are mirrored (one axis has the wrong sign, or two "
        "are swapped)",
    )


def _reversed(translation: TranslationFit) -> bool:
    if translation.explained < _REVERSED or translation.sigma > MISFIT_M:
        return False
    std = float(np.hypot(translation.slope_std, SLOPE_FLOOR))
    # Many times as far as anything accelerates: a path that has gone astray. A flipped sign leaves the size: half of it is a
    # motion that does not determine the mounting.
    return -_FARTHEST_REVERSED < translation.slope < -0.6 and translation.slope + 5.0 * std < 0.0


def _of_mounting(rotation: RotationFit, T_declared: NDArray[np.float64] | None) -> Finding | None:
    if T_declared is None or rotation.explained < _FITS:
        return None
    known = contradicted_within(rotation, T_declared[:3, :3])
    if known is None:
        return None
    angle, seen = apart(rotation, T_declared[:3, :3], known)
    text = (
        f"gyroscope and LiDAR turn about axes {np.degrees(angle):.0f} deg apart under the given T_imu_lidar (known to "
        f"{np.degrees(np.linalg.norm(rotation.rotation_std[0][seen])):.1f} deg)"
    )
    inverse, mirrored = apart(rotation, T_declared[:3, :3].T, known)[0], _from_mirrored(rotation, T_declared[:3, :3], known)
    if inverse < min(_MUCH_NEARER * angle, mirrored):
        advice = f"its inverse fits to {np.degrees(inverse):.1f} deg: T_imu_lidar maps LiDAR coordinates to IMU coordinates"
    elif abs(angle - np.pi) < _HALF_TURN_RAD or mirrored < apart_allowed(rotation, known):
        advice = "half a turn: the gyroscope's sign is flipped, the points are mirrored, or T_imu_lidar is of another mounting"
    else:
        advice = "check T_imu_lidar and that the topics are those of this mounting"
        if known == ROTATION_KNOWN_RAD:
            advice += f"; found R_imu_lidar = {matrix_text(rotation.closest_to(T_declared[:3, :3]))}"
            if rotation.open_axis is not None:
                advice += ", about the axis that the motion leaves open as it was given"
    return Finding("extrinsic", f"{text}; {advice}")


def _from_mirrored(rotation: RotationFit, R_imu_lidar: NDArray[np.float64], known_rad: float) -> float:
    """How far a turning is from that of points with one axis of the other sign, half a turn about it [rad]; the nearest one."""
    half_turns = [2.0 * np.outer(axis, axis) - np.eye(3) for axis in np.eye(3)]
    return min(apart(rotation, R_imu_lidar @ half_turn, known_rad)[0] for half_turn in half_turns)


def _of_turn(rotation: RotationFit, translation: TranslationFit, T_declared: NDArray[np.float64] | None) -> Finding | None:
    """Where the platform hardly turns, accelerations show the mounting: coarsely, since gravity leaks with attitude."""
    if T_declared is None or (rotation.rotation_std[0] < ROTATION_KNOWN_RAD).sum() > 1:
        return None
    if translation.explained < _FITS or translation.sigma > MISFIT_M or translation.slope < 0.0:
        return None
    variance, axes = np.linalg.eigh(translation.covariance[TURN, TURN])
    seen = np.sqrt(variance) < _TURN_KNOWN_RAD
    angle = float(np.linalg.norm((axes.T @ translation.turn)[seen]))
    if not seen.any() or angle < _TURN_OFF_RAD + 3.0 * float(np.sqrt(variance[seen].sum())):
        return None
    return Finding(
        "extrinsic",
        f"accelerometer and LiDAR accelerate in directions {np.degrees(angle):.0f} deg apart under the given T_imu_lidar: check "
        "it, and that the topics are those of this mounting",
    )


def _of_scale(rotation: RotationFit) -> Finding | None:
    # The noise of the LiDAR's rates makes a slope too small: where it counts, nothing is said.
    return scale_finding(rotation.scale, rotation.scale_std) if judges_scale(rotation) else None


def scale_finding(scale: float, std: float) -> Finding | None:
    """A gyroscope that turns by this factor farther than the LiDAR, known to `std`; None where it may be right."""
    if abs(scale - 1.0) < _least_scale(std):
        return None
    return Finding(
        "gyro_scale",
        f"the gyroscope turns {scale:.2f} ± {std:.2f} times as far as the LiDAR: its scale is wrong, or "
        "the times of one of them do not run at the right speed",
    )


def _of_clocks(rotation: RotationFit, imu_rate_hz: float) -> Finding | None:
    offset, std = rotation.offset_s, rotation.offset_std_s
    if not judges_clocks(rotation) or abs(offset) < least_offset(rotation, imu_rate_hz):
        return None
    return Finding(
        "time_offset",
        f"the LiDAR's times are {abs(offset) * 1e3:.0f} ± {std * 1e3:.0f} ms {'late' if offset < 0.0 else 'early'} on the "
        f"IMU's clock: synchronise the clocks, or give --lidar-time-offset {offset:.3f}; a whole scan period is the sign of a "
        "wrong --point-time-reference",
    )


def _of_lengths(agreement: Agreement, translation: TranslationFit, T_declared: NDArray[np.float64] | None) -> Finding | None:
    slope = translation.slope
    std = float(np.hypot(translation.slope_std, SLOPE_FLOOR))
    if _reversed(translation):
        text = (
            f"the LiDAR's accelerations are {slope:.2f} ± {std:.2f} times those of the accelerometer (1 is right): its sign is "
            "flipped, gravity instead of specific force (negate the accelerations), or the LiDAR's points are mirrored"
        )
        rotation = agreement.rotation
        if T_declared is None and rotation is not None and rotation.mirrored > rotation.explained - _AS_WELL:
            text += (
                "; or the gyroscope's sign is flipped: nobody gave T_imu_lidar, and these turns fit a mounting that is half a "
                "turn off as well"
            )
        return Finding("force_sign", text)
    if translation.explained < _FITS or translation.sigma > MISFIT_M or _lags(agreement):
        return None
    if _leaves_lengths_open(translation):
        return None
    return slope_finding(slope, float(np.hypot(translation.slope_std_alone, SLOPE_FLOOR)))


def _leaves_lengths_open(translation: TranslationFit) -> bool:
    """Whether the poses are too few, or the accelerations show the mounting about no axis: their slope says nothing of lengths.

    Of a LiDAR at 5 Hz two seconds are ten poses: sound drives came to lengths of 1.3 to 2.5 times the right ones.

    On a circle at a constant rate force, bias and a turned gravity are all constant in the IMU's frame, and none is told from
    another: a path of few rings, bent by half a centimetre, asked for lengths 2.7 times as long and a mounting turned by 24 deg,
    known to 22 deg about its best axis. Where lengths in feet were found the best axis was known to 12 deg or less.
    """
    if translation.samples < _FEWEST_POSES:
        return True
    return bool(np.linalg.eigvalsh(translation.covariance[TURN, TURN])[0] > _TURN_OPEN_RAD**2)


def slope_of(agreement: Agreement) -> tuple[float, float] | None:
    """Slope of the accelerations and its standard deviation, to be put together with those of other stretches."""
    translation = agreement.translation
    if translation is None or not _path_counts(agreement) or _lags(agreement):
        return None
    if translation.explained < _FITS_OF_MANY or translation.sigma > MISFIT_M or _leaves_lengths_open(translation):
        return None
    std = float(np.hypot(translation.slope_std, _SLOPE_OF_MANY_FLOOR))
    return (translation.slope, std) if std < SLOPE_KNOWN else None


def matrix_text(R: NDArray[np.float64]) -> str:
    """A (3, 3) matrix on one line."""
    return "[" + "; ".join(", ".join(f"{value:.4f}" for value in row) for row in R) + "]"
