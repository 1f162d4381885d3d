"""Do LiDAR and IMU agree, and how are they mounted, timed and scaled? One estimate that everything which has to know stands on.

The start of the odometry, the extrinsic where none is given, the evidence of `boxplus inspect`, the calibration and the watch
while running ask the same question. It is answered once:

    path         how the LiDAR moved, from its scans alone
    rotation     against the gyroscope: mounting, clocks, unit, sign
    translation  against the accelerometer: gravity, velocity, bias, lever arm, sign and scale
    planes       against gravity: how far what stands around is from upright, and the ground from level

Each with a covariance, so that what the motion does not show is left open. See docs/agreement.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.inertial.gyro_attitude import GyroAttitude
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.inertial.imu_values import beyond, empty, finite, glitches
from boxplus.sensors.lidar.scan import Scan, in_order
from boxplus.systems.lidar_inertial_agreement.corrected_points import CorrectedPoints, corrected_points
from boxplus.systems.lidar_inertial_agreement.finding import Finding
from boxplus.systems.lidar_inertial_agreement.lidar_path.backwards import surer_path
from boxplus.systems.lidar_inertial_agreement.lidar_path.explained_scans import expected_path, explained_scans
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import lidar_path
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath, Twist
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import Turning, with_cells_for_all
from boxplus.systems.lidar_inertial_agreement.planes.ground_lean import GroundLean, drives, ground_lean
from boxplus.systems.lidar_inertial_agreement.planes.plane_tilt import PlaneTilt, plane_tilt
from boxplus.systems.lidar_inertial_agreement.planes.surroundings import surroundings_of
from boxplus.systems.lidar_inertial_agreement.rotation import SCALE, RotationFit, compare_rotations
from boxplus.systems.lidar_inertial_agreement.steady_turn import SteadyTurn, steady_turn
from boxplus.systems.lidar_inertial_agreement.translation import SLOPE, TranslationFit, compare_accelerations, wide_prior

_EXPLAINED = 0.8  # of the LiDAR's rotation, before the gyroscope may help to undistort
_HALF_EXPLAINED = 0.5
_STRONG_RAD_S = np.deg2rad(4.0)  # rms of one sensor that the other should show
_OFFSET_KNOWN_S = 0.01
_WILD_RAD_S = 4.0
_SLOPE_DOUBTFUL = 0.03
_TURNS_DOUBTFUL = 0.05  # of the gyroscope's scale: a pattern that rests holds turns back as well
_SCAN_NS = 100_000_000
FEET_PER_METRE = 3.28084
_THICK_M = 0.08  # median misfit of a path: of sound ones the foliage of a forest reaches 5 cm
ROTATION_KNOWN_RAD = 0.05
LAG_RAD = float(np.deg2rad(2.5))
"""By how much a right mounting may seem turned because registrations lag, however many scans there are."""

TURNING_RAD_S = float(np.deg2rad(1.0))
"""Root mean square of the turn rate about its mean, below which rotations say nothing about unit, sign and mounting."""

_COARSELY_RAD = 0.2
_DECLARED_ARM_STD = 0.02  # m
_GLITCHES = 0.01  # share of the samples
_ENOUGH_SAMPLES = 3.0  # of the IMU from scan to scan: with fewer it misses part of the motion in between


@dataclass(frozen=True, slots=True)
class Agreement:
    """What the comparison of both sensors shows.

    Attributes:
        path: of the LiDAR.
        rotation: None where too few scans could be compared, or the path does not explain its scans.
        translation: None likewise, and where the path is too short or the mounting not known.
        R_imu_lidar: (3, 3) the mounting that the accelerations were compared under.
        imu_rate_hz: of the samples.
        gyro_power: mean square of the gyroscope's rates, averaged as between two scans, about their mean [(rad/s)²], in its own
            unit.
        steady: mean turns of both; None where the scans do not show the LiDAR's.
        planes: how upright the surroundings are under the declared mounting; None where none was declared, or nothing shows it.
        ground: how far the ground leans that the LiDAR was driven along, likewise.
        in_feet: the accelerations again with the points taken for feet; None where they are not as thick as feet would be.
        astray: that the motion an estimator expected is not the one its scans show; None where it is, or none was given.
        corrected: that the points were corrected for motion before they were recorded; None where nothing shows it.
    """

    path: LidarPath
    rotation: RotationFit | None
    translation: TranslationFit | None
    R_imu_lidar: NDArray[np.float64]
    imu_rate_hz: float
    gyro_power: float
    steady: SteadyTurn | None = None
    planes: PlaneTilt | None = None
    ground: GroundLean | None = None
    in_feet: TranslationFit | None = None
    astray: Finding | None = None
    corrected: CorrectedPoints | None = None


def compare_sensors(
    scans: Sequence[Scan],
    imu: ImuSamples,
    config: RegistrationConfig,
    *,
    T_expected: NDArray[np.float64] | None = None,
    T_declared: NDArray[np.float64] | None = None,
    refine: bool = False,
    expected: Sequence[Twist] | None = None,
) -> Agreement:
    """Compare the sensors over a stretch of a recording.

    Args:
        scans: consecutive sweeps, some seconds of them; one that is recorded twice, or comes late, is left out.
        imu: samples of the same stretch; those that are not finite are left out.
        config: of the LiDAR's noise and the sizes of cells.
        T_expected: (4, 4) T_imu_lidar that the registration may start from, a guess.
        T_declared: (4, 4) T_imu_lidar as somebody says it is; accelerations are compared under it unless rotations contradict it.
        refine: register once more with the gyroscope, where it agrees: twice the time, a third of the error.
        expected: of every scan, how an estimator believes that the LiDAR moved; a start for the registration, and what a path
            that disagrees with it is measured by: one that explains the scans worse is not compared with anything.
    """
    imu = usable(imu)
    if expected is None:  # an estimator takes scans in their order only
        scans = in_order(scans)
    found = _compare(scans, imu, with_cells_for_all(scans, config), T_expected, T_declared, refine, expected)
    if not _as_thick_as_feet(found):
        return found
    # Cells and thresholds are made for metres.
    metres = [replace(scan, p_lidar=(scan.p_lidar / FEET_PER_METRE).astype(np.float32)) for scan in scans]
    again = _compare(metres, imu, with_cells_for_all(metres, config), T_expected, T_declared, True, None)
    return replace(found, in_feet=again.translation)


def _compare(
    scans: Sequence[Scan],
    imu: ImuSamples,
    config: RegistrationConfig,
    T_expected: NDArray[np.float64] | None,
    T_declared: NDArray[np.float64] | None,
    refine: bool,
    expected: Sequence[Twist] | None,
) -> Agreement:
    """`compare_sensors` with points in metres."""
    T_guess = T_declared if T_declared is not None else T_expected
    guesses = [] if T_guess is None else gyro_guesses(imu, T_guess[:3, :3])
    path = lidar_path(scans, config, guesses, expected=expected)
    found = _compared(path, imu, T_guess, T_declared)
    surer: LidarPath | None = path
    explained = None if expected is None else explained_scans(path, scans, expected, config)
    astray = None if explained is None else explained.astray
    if explained is not None and not explained.by_path:
        surer = None
    elif _doubtful(found, T_declared):
        surer = surer_path(path, scans, config, guesses)
    elif _turns_off(found.rotation):
        surer = surer_path(path, scans, config, guesses) or path
    if surer is None:
        if T_declared is not None and explained is not None and explained.turns_alike:
            found = _with_planes(found, path, scans, imu, T_declared, config, expected)
        return replace(found, rotation=None, translation=None, astray=astray)
    if surer is not path:
        found = _compared(surer, imu, T_guess, T_declared)
    # Undistorted at constant rates, a fast turn bends the path by as much as a wrong scale.
    slope = 1.0 if found.translation is None else found.translation.slope
    bent = slope > 0.0 and abs(slope - 1.0) > _SLOPE_DOUBTFUL
    steady = found.rotation
    if (refine or bent or _turns_off(steady)) and steady is not None and steady.explained > _EXPLAINED:
        shift_ns = round(steady.offset_s * 1e9) if steady.offset_std_s < _OFFSET_KNOWN_S else 0
        corrected = GyroAttitude(imu.time_ns, (imu.gyro - steady.bias) / unit_of(steady.scale))
        refined = lidar_path(
            scans,
            config,
            [lambda time_ns: corrected.at(time_ns + shift_ns) @ steady.R_imu_lidar],
            undistort=True,
            expected=expected,
        )
        again = _compared(refined, imu, T_guess, T_declared)
        # The gyroscope agreed with the first path: where it does not agree with the second, that has gone astray.
        if again.rotation is not None and again.rotation.explained > _EXPLAINED:
            found = again
    if T_declared is not None and found.rotation is not None:
        found = _with_planes(found, found.path, scans, imu, T_declared, config, expected)
    before = corrected_points(found.path, found.rotation, scans, imu, config, guesses)
    return replace(found, astray=astray, corrected=before)


def _with_planes(
    found: Agreement,
    path: LidarPath,
    scans: Sequence[Scan],
    imu: ImuSamples,
    T_declared: NDArray[np.float64],
    config: RegistrationConfig,
    expected: Sequence[Twist] | None,
) -> Agreement:
    """With what planes say of gravity: they lean as they do however far the LiDAR went past them.

    But only what drives has a road, and a path may rest with the pattern of a LiDAR, or speed up with it: of an estimator it is
    asked what leans under the motion that it believes in.
    """
    around = surroundings_of(path, scans, imu, T_declared[:3, :3], config)
    planes = None if around is None else plane_tilt(around)
    if expected is not None:
        path = expected_path(path, scans, expected)
        around = surroundings_of(path, scans, imu, T_declared[:3, :3], config) if drives(path) else None
    return replace(found, planes=planes, ground=None if around is None else ground_lean(around))


def _as_thick_as_feet(found: Agreement) -> bool:
    """Whether points lie about their planes as those of a LiDAR in feet do, and the accelerations show no lengths."""
    thick = len(found.path) > 0 and float(np.median(found.path.misfit)) > _THICK_M
    return thick and (found.translation is None or found.translation.explained < _EXPLAINED)


def _compared(
    path: LidarPath, imu: ImuSamples, T_guess: NDArray[np.float64] | None, T_declared: NDArray[np.float64] | None
) -> Agreement:
    """Rotations and accelerations along one path."""
    R = np.eye(3) if T_guess is None else T_guess[:3, :3]
    rotation = compare_rotations(path, imu, None if T_guess is None else R) if len(imu) > 1 else None
    # What explains little of the rotation says nothing of mounting, bias and clocks either.
    fits = rotation is not None and rotation.explained > _EXPLAINED
    if rotation is not None and fits and (T_declared is None or contradicted_within(rotation, R) is not None):
        R = rotation.R_imu_lidar
    translation = None
    if len(path) > 0 and len(imu) > 1 and (fits or T_declared is not None):
        bias = rotation.bias if rotation is not None and fits else np.zeros(3)
        scale = 1.0 if rotation is None else unit_of(rotation.scale)
        offset = rotation.offset_s if rotation is not None and fits and rotation.offset_std_s < _OFFSET_KNOWN_S else 0.0
        mean, std = wide_prior()
        if T_declared is not None:
            mean[6:9], std[6:9] = T_declared[:3, 3], _DECLARED_ARM_STD
        scaled = ImuSamples(imu.time_ns, imu.gyro / scale, imu.accel)
        translation = compare_accelerations(path, scaled, R, bias / scale, offset, (mean, std))
    rate_hz = 0.0 if len(imu) < 2 else 1e9 / max(float(np.median(np.diff(imu.time_ns))), 1.0)
    if len(path) > 1 and rate_hz * float(np.median(np.diff(path.time_ns))) * 1e-9 < _ENOUGH_SAMPLES:
        if rotation is not None:
            rotation = replace(rotation, covariance=_widened(rotation.covariance, SCALE, _between(imu.gyro)))
        if translation is not None:
            unknown = translation.slope * _between(imu.accel)
            translation = replace(translation, covariance=_widened(translation.covariance, SLOPE, unknown))
    return Agreement(path, rotation, translation, R, rate_hz, _power(imu), steady_turn(path, imu))


def _between(samples: NDArray[np.float64]) -> float:
    """What share of a signal lies between its samples (N, 3): a parabola is off a chord by an eighth of its second difference."""
    bent = (np.diff(samples, 2, axis=0) ** 2).sum(axis=1) if len(samples) > 2 else np.zeros(1)
    about_mean = ((samples - samples.mean(axis=0)) ** 2).sum(axis=1)
    return float(np.sqrt(bent.mean() / max(about_mean.mean(), 1e-12))) / 8.0


def _widened(covariance: NDArray[np.float64], row: int, std: float) -> NDArray[np.float64]:
    covariance = covariance.copy()
    covariance[row, row] += std**2
    return covariance


def _doubtful(found: Agreement, T_declared: NDArray[np.float64] | None) -> bool:
    """Whether a comparison says that something is wrong: if not with the sensors, then with the path."""
    rotation, translation = found.rotation, found.translation
    if translation is not None and translation.explained > _HALF_EXPLAINED and _lengths_off(translation):
        return True
    if rotation is None:
        return False
    if rotation.explained < _EXPLAINED:
        unit = max(unit_of(rotation.scale), 1.0)
        strong = max(float(np.linalg.norm(rotation.excitation)), float(np.sqrt(found.gyro_power)) / unit)
        return strong > float(_STRONG_RAD_S)
    return T_declared is not None and contradicted_within(rotation, T_declared[:3, :3]) is not None


def _turns_off(rotation: RotationFit | None) -> bool:
    """Whether the gyroscope's scale seems to be wrong, by more than it is known to."""
    if rotation is None:
        return False
    return abs(rotation.scale / unit_of(rotation.scale) - 1.0) > max(_TURNS_DOUBTFUL, 3.0 * rotation.scale_std)


def _lengths_off(translation: TranslationFit) -> bool:
    """Whether lengths seem to be wrong, by more than they are known to."""
    return abs(translation.slope - 1.0) > max(_SLOPE_DOUBTFUL, translation.slope_std)


def _power(imu: ImuSamples) -> float:
    """Mean square of the rates about their mean, noise and vibration averaged out as between two scans."""
    if not len(imu):
        return 0.0
    _, begin = np.unique((imu.time_ns - imu.time_ns[0]) // _SCAN_NS, return_index=True)
    count = np.diff(np.append(begin, len(imu)))[:, None]
    rate = np.add.reduceat(imu.gyro, begin) / count
    mean = (count * rate).sum(axis=0) / len(imu)
    return float((count * (rate - mean) ** 2).sum() / len(imu))


def gyro_guesses(imu: ImuSamples, R_imu_lidar: NDArray[np.float64]) -> list[Turning]:
    """How the LiDAR turned if the gyroscope and this mounting (3, 3) are right; where it turns wildly, also if it is in deg/s."""
    if len(imu) < 2:
        return []
    attitude = GyroAttitude(imu.time_ns, imu.gyro)
    guesses: list[Turning] = [lambda time_ns: attitude.at(time_ns) @ R_imu_lidar]
    if float(np.median(np.linalg.norm(imu.gyro, axis=1))) > _WILD_RAD_S:
        degrees = attitude.scaled(np.pi / 180.0)
        guesses.append(lambda time_ns: degrees.at(time_ns) @ R_imu_lidar)
    return guesses


def usable(imu: ImuSamples) -> ImuSamples:
    """Samples that can be measurements, in order of time, each time once.

    Few that are larger than any sensor measures are none; where they are many, the unit is in question, and they stay. One that
    stands out from both of its neighbours is none either.
    """
    keep, too_large, zero = finite(imu), beyond(imu), empty(imu)
    if not zero.all():
        keep &= ~zero
    if np.count_nonzero(too_large) < _GLITCHES * len(imu):
        keep &= ~too_large
    imu = imu.where(keep)
    ordered = imu.where(np.unique(imu.time_ns, return_index=True)[1])
    return ordered.where(~glitches(ordered))


def unit_of(scale: float) -> float:
    """The unit that a gyroscope's scale tells: 180/π for deg/s, its inverse for rad/s taken for deg/s, else 1."""
    degrees = 180.0 / np.pi
    return degrees if 30.0 < scale < 110.0 else 1.0 / degrees if 30.0 < 1.0 / max(scale, 1e-9) < 110.0 else 1.0


def apart(
    fit: RotationFit, R_imu_lidar: NDArray[np.float64], known_rad: float = ROTATION_KNOWN_RAD
) -> tuple[float, NDArray[np.bool_]]:
    """How far a mounting is from the found one [rad], about the axes known to three degrees, or `known_rad`; which, (3,)."""
    std, axes = fit.rotation_std
    seen = std < known_rad
    angle = axes.T @ so3.log(fit.closest_to(R_imu_lidar) @ R_imu_lidar.T)
    return float(np.linalg.norm(angle[seen])), seen


def apart_allowed(fit: RotationFit, known_rad: float = ROTATION_KNOWN_RAD, deviations: float = 3.0) -> float:
    """How far a right mounting may seem to be from the found one [rad]."""
    std, _ = fit.rotation_std
    return LAG_RAD + deviations * float(np.linalg.norm(std[std < known_rad]))


def shows_turns(fit: RotationFit) -> bool:
    """Whether the turns are more than what is left of them unexplained, and more than errors of registrations look like."""
    return float(np.linalg.norm(fit.excitation)) > max(TURNING_RAD_S, 2.0 * fit.sigma)


def contradicted_within(fit: RotationFit, R_imu_lidar: NDArray[np.float64]) -> float | None:
    """Whether the mounting is another one: how well the axes are known that show it [rad]; None where it may be right.

    By the axes known to three degrees, or by those known to eleven: where all of them are known coarsely, a LiDAR that is turned
    by a quarter is turned by many standard deviations still. Where hardly anything turns but at a constant rate, which a bias
    takes up, none is contradicted: what lasers out of line make of a LiDAR's turns fits some mounting as well.
    """
    if not shows_turns(fit):
        return None
    for known_rad, deviations in ((ROTATION_KNOWN_RAD, 3.0), (_COARSELY_RAD, 5.0)):
        if apart(fit, R_imu_lidar, known_rad)[0] > apart_allowed(fit, known_rad, deviations):
            return known_rad
    return None
