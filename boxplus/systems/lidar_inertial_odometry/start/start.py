"""The first state: at rest, or moving, from the LiDAR's own motion compared with the IMU (docs/agreement.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus._words import signed
from boxplus.errors import InputError
from boxplus.filtering.nav_state import T_V, NavState
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.sequencer import Frame
from boxplus.systems.lidar_inertial_agreement.agreement import gyro_guesses
from boxplus.systems.lidar_inertial_agreement.lidar_path.changes.common_motion import speaks_against
from boxplus.systems.lidar_inertial_agreement.lidar_path.other_speeds import (
    least_known_axis,
    mean_velocity,
    one_speed,
    other_speed,
    well_known,
)
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.lidar_path.path_drift import path_drift
from boxplus.systems.lidar_inertial_agreement.lidar_path.shown_turns import shown_turns, turned_by_gyroscope
from boxplus.systems.lidar_inertial_agreement.rest import Rest, faces, judge_rest
from boxplus.systems.lidar_inertial_agreement.translation import TranslationFit
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.start.beginning import WAITING, Beginning, NotYet, broken
from boxplus.systems.lidar_inertial_odometry.start.changes import (
    RESTING_M_S,
    Common,
    following_changes,
    held_path,
    undecided,
    weighed_rest,
)
from boxplus.systems.lidar_inertial_odometry.start.first_state import gyro_bias, moving_fit, moving_state, static_state
from boxplus.systems.lidar_inertial_odometry.start.grown_paths import GrownPaths

_REST_ACCEL_NORM = (9.0, 10.6)  # m/s²
_NO_GRAVITY = 0.5  # m/s²: less on average than any start but free fall
_IN_G = (0.8, 1.25)
_STANDARD_G = 9.80665
_MIN_MOVING_SCANS = 8
_FIRST = 3  # intervals between scans, of which the velocity is taken that undistorts the first one
_MUCH_SHORTER = 0.8
_FEWEST_SAMPLES = 5
_LARGEST_BIAS = 0.12  # rad/s, of a gyroscope that works
_AS_FAST = 0.1  # share of a turn rate
_CANCELLED = 0.3  # of the difference of two turns is left of their sum, where one is the other reversed: a tilt is not mirrored
_LARGEST_MISFIT_M = 0.05  # of the batch over a moving start
_GOOD_FIT_M, _MUCH_BETTER = 0.01, 0.3  # a misfit beyond which the opposite sign is tried, and its share that speaks for that
_LARGEST_ACCEL_BIAS = 0.4  # m/s²: what an accelerometer in order has, as a path does not bend for no reason
_COMMON_M_S = 0.2  # standard deviation of a speed that what changes from scan to scan shows
_STEADY_M = 0.01  # rms about a straight line; of paths along smooth tunnels, with 3 cm of noise, up to 0.007
_ABOUT_RAD_S = 0.3  # standard deviation of a gyroscope that is carried about
_MIRRORED = "the points are mirrored (one axis has the wrong sign, or two are swapped)"
_UNKNOWN_SPEED = 3.0  # m/s: standard deviation beyond which the velocity was not found


@dataclass(frozen=True, slots=True)
class Start:
    """How the odometry began.

    Attributes:
        kind: "static" or "moving".
        time_ns: the instant of `state`: the end of the first scan.
        state, covariance: first state and its (24, 24) covariance, tangent as in `NavState`.
        duration_s: how long the start was observed.
        text: one sentence with the evidence.
        warning: what could not be decided, a sentence; empty when all was.
        unshown_axes: (K, 3) unit axes in the world along which rest was taken for granted.
        doubted: whether something speaks against that rest.
    """

    kind: Literal["static", "moving"]
    time_ns: int
    state: NavState
    covariance: NDArray[np.float64]
    duration_s: float
    text: str
    warning: str = ""
    unshown_axes: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    doubted: bool = False


def find_start(frames: Sequence[Frame], config: LioConfig, grown: GrownPaths | None = None) -> Start | str:
    """Decide between the static and the moving start over `frames`; a sentence when neither is possible yet.

    At rest means that the LiDAR does not move against what it sees, however much the IMU is shaken; only along what the scene
    does not determine a quiet IMU has to do. Moving, velocity and gravity come from a batch over the LiDAR's path and the
    accelerometer. A path that has once gone astray stays so: where there is no start over all scans, it is sought over the
    newest of them, and `Start.time_ns` says with which scan it begins.

    Args:
        frames: consecutive scans with the IMU samples around them.
        config: of the odometry.
        grown: paths of the tries before with these scans, which go on.

    Raises:
        InputError: the accelerometer reports in g, was taken for one that does, or shows no gravity.
    """
    seen = Beginning(frames, config)
    _check_accelerometer(seen.accel_norm)
    grown = GrownPaths() if grown is None else grown
    try:
        return _start(seen, grown)
    except NotYet as reason:
        refusal = str(reason)
    newest = _newest(frames, config.start_duration)
    if len(newest) < _MUCH_SHORTER * len(frames):
        try:
            return _start(Beginning(newest, config), grown)
        except NotYet as reason:
            if not grown.is_whole_from(frames[0].scan):  # then that says nothing of the newest
                refusal = str(reason)
    return refusal


def _start(seen: Beginning, grown: GrownPaths) -> Start:
    """The start that fits all that has been seen."""
    path = grown.through(seen)
    motion = following_changes(seen, path)
    if motion is not None and not motion.shown:
        return _moving_start(seen, held_path(seen, seen.guesses, motion.twists), grown, motion)
    _check_path(seen, path)
    rest = judge_rest(path, seen.scans, seen.registration)
    seen.note(rest)
    _check_gyroscope(seen, path, rest)
    if not rest.at_rest or motion is not None:  # along what the scene leaves open, what changes may show a motion
        return _moving_start(seen, path, grown, motion)
    rest, doubt = weighed_rest(seen, path, rest)
    if rest.determined or seen.imu_is_quiet(rest):
        return _static_start(seen, rest, doubt)
    axes = seen.level(rest.open_axes)
    if len(axes):
        raise NotYet(f"{undecided(axes)}, and the IMU is not quiet ({seen.evidence}){WAITING}")
    return _moving_start(seen, path, grown, motion)


def _newest(frames: Sequence[Frame], seconds: float) -> Sequence[Frame]:
    """The last frames, just enough of them for a start."""
    times = np.array([frame.scan.start_ns for frame in frames])
    enough = int(np.searchsorted(times, frames[-1].scan.end_ns - round(seconds * 1e9), side="right")) - 1
    return frames[max(min(enough, len(frames) - _MIN_MOVING_SCANS), 0) :]


def _check_accelerometer(norm: float) -> None:
    """Whether the mean specific force (its norm, m/s²) can be one gravity in m/s²."""
    if norm < _NO_GRAVITY:
        raise InputError(
            "accelerations with gravity, about 9.8 m/s² on average at the start",
            f"{norm:.2f} m/s²",
            "the accelerometer delivers nothing, or its driver takes gravity out: give what it measures",
        )
    if _IN_G[0] < norm < _IN_G[1]:
        raise InputError(
            "accelerations in m/s², about 9.8 on average at the start",
            f"{norm:.2f}",
            f"the accelerometer reports in g: multiply by {_STANDARD_G} (reading a recording: --accel-unit g)",
        )
    if _IN_G[0] < norm / _STANDARD_G**2 < _IN_G[1]:
        raise InputError(
            "accelerations in m/s², about 9.8 on average at the start",
            f"{norm:.1f}",
            "the accelerometer reports in m/s² and was taken for one in g (reading a recording: --accel-unit m/s2)",
        )


def _check_path(seen: Beginning, path: LidarPath) -> None:
    """Whether the scans show how the LiDAR moved, unbroken, and the IMU was there."""
    if broken(path) or len(path) < min(len(seen.frames), 3):
        raise seen.torn()
    time_ns = seen.imu.time_ns
    within = int(np.count_nonzero((time_ns >= path.time_ns[0]) & (time_ns <= path.time_ns[-1])))
    if len(path) < 2 or within < _FEWEST_SAMPLES:
        raise NotYet(f"{len(path)} scans and {within} IMU samples between them are not enough for a start{WAITING}")


def _check_gyroscope(seen: Beginning, path: LidarPath, rest: Rest) -> None:
    """Whether the gyroscope turns as the LiDAR does, but for a bias, about the axes where the scene shows how it does.

    At rest it is to show nothing; a LiDAR that sees little may turn on its own.
    """
    turn = seen.imu.gyro.mean(axis=0)
    off = turn if rest.at_rest else gyro_bias(path, seen.imu, seen.extrinsic)
    not_shown = rest.open_turns @ seen.extrinsic.R_imu_lidar.T
    turn, off = (rates - not_shown.T @ (not_shown @ rates) for rates in (turn, off))
    bias = float(np.linalg.norm(off))
    if bias <= _LARGEST_BIAS:
        return
    raise NotYet(
        f"the gyroscope turns by {np.degrees(bias):.1f} deg/s more than the LiDAR, which no bias explains: "
        f"{_why_turns_differ(turn, turn - off)}{WAITING}"
    )


def _why_turns_differ(gyro: NDArray[np.float64], lidar: NDArray[np.float64]) -> str:
    """What may be wrong where gyroscope and LiDAR turn with these rates (3,) [rad/s], along the same axes as far as is known."""
    fast, seen = float(np.linalg.norm(gyro)), float(np.linalg.norm(lidar))
    # Opposite and as fast, both cancel.
    if float(np.linalg.norm(gyro + lidar)) < _CANCELLED * float(np.linalg.norm(gyro - lidar)):
        return (
            f"they turn alike but in opposite senses, so the gyroscope's sign is flipped, {_MIRRORED}, "
            "or T_imu_lidar is half a turn off"
        )
    if abs(fast - seen) < _AS_FAST * fast:
        apart = np.degrees(np.arccos(np.clip(gyro @ lidar / (fast * seen), -1.0, 1.0)))
        return f"they turn as fast, but about axes {apart:.0f} deg apart, so T_imu_lidar is wrong or missing, or {_MIRRORED}"
    return "its unit, its sign, T_imu_lidar or the topics are wrong, or the LiDAR sees too little"


def _static_start(seen: Beginning, rest: Rest, doubt: str) -> Start:
    low, high = _REST_ACCEL_NORM
    if not low <= seen.accel_norm <= high:
        raise NotYet(
            f"at rest, but the accelerometer shows {seen.accel_norm:.2f} m/s², not one gravity: check its unit and scale"
        )
    state, covariance = static_state(seen.imu, seen.extrinsic, seen.config)
    R_imu_lidar = seen.extrinsic.R_imu_lidar
    axes = seen.level(rest.open_axes)
    return Start(
        "static",
        seen.scans[0].end_ns,
        state,
        covariance,
        seen.duration_s,
        f"at rest: {seen.evidence}",
        _undecided(axes, doubt),
        axes @ (state.R_world_imu @ R_imu_lidar).T,
        bool(doubt),
    )


def _moving_start(
    seen: Beginning, path: LidarPath, grown: GrownPaths, motion: Common | None = None, follow: bool = False
) -> Start:
    """The start of a platform in motion, on a path that follows `motion` where that and not the registrations show its speed."""
    if len(seen.frames) < _MIN_MOVING_SCANS:
        raise seen.not_moving(f"{len(seen.frames)} scans are not enough for a moving start")
    # Once more, each scan undistorted with the gyroscope instead of a constant rate.
    imu, scans = seen.imu, seen.scans
    bias = gyro_bias(path, imu, seen.extrinsic)
    steady = ImuSamples(imu.time_ns, imu.gyro - bias, imu.accel)
    guesses, first = gyro_guesses(steady, seen.extrinsic.R_imu_lidar), path
    if not follow:
        path = grown.steady(seen, bias, mean_velocity(first, _FIRST))
        follow = motion is not None and (broken(path) or not one_speed(path, first))
    if motion is not None and follow:
        path = held_path(seen, guesses, motion.twists)
    if broken(path):
        raise seen.not_moving("the first scans do not overlap enough for a moving start")
    drift = path_drift(path, scans, seen.registration, guesses[0]) if not follow else None
    if drift is not None:
        raise seen.not_moving(
            f"the path of the LiDAR drifts: one of its last scans lies {np.linalg.norm(drift[3:]) * 100:.0f} cm and "
            f"{np.degrees(np.linalg.norm(drift[:3])):.1f} deg off where its first ones want it (few rings, a repeating pattern, "
            "foliage, or moving things)"
        )
    if not follow:
        _check_slowness(seen, path)
    not_shown = shown_turns(path)[1]
    if seen.config.extrinsic_estimation == "off":  # it is known how the gyroscope lies: it shows what the surroundings do not
        path = turned_by_gyroscope(path, imu, seen.extrinsic.R_imu_lidar, gyro_bias(path, imu, seen.extrinsic))
    fit = _checked_fit(seen, path)
    state, covariance = moving_state(seen.frames, path, not_shown, imu, fit, seen.extrinsic, seen.config)
    if follow:  # what is wrong with the speed is wrong with it all the time
        along = state.v_world_imu / np.linalg.norm(state.v_world_imu)
        covariance[T_V : T_V + 3, T_V : T_V + 3] += _COMMON_M_S**2 * np.outer(along, along)
    sigma = _checked_speed(seen, state, covariance)
    speed = float(np.linalg.norm(state.v_world_imu))
    other = other_speed(path, scans, seen.registration, guesses) if not follow else None
    if other is not None and motion is not None:
        return _moving_start(seen, first, grown, motion, follow=True)
    if other is not None:
        raise seen.not_moving(
            "the surroundings do not show how fast the platform moves: the scans fit about as "
            f"well at {np.linalg.norm(other):.1f} m/s as at {speed:.1f} m/s"
        )
    misfit = f"batch over {len(scans)} scans fits to {fit.sigma * 100:.1f} cm"
    doubt = speaks_against(path, scans, guesses[0], seen.up_lidar) if not follow else ""
    if doubt:
        raise seen.not_moving(f"the surroundings do not show how fast the platform moves: {doubt}")
    text = f"moving at {speed:.2f} ± {sigma:.2f} m/s: {seen.evidence}; {misfit}"
    return Start("moving", scans[0].end_ns, state, covariance, seen.duration_s, text)


def _check_slowness(seen: Beginning, path: LidarPath) -> None:
    """Whether something faces the axis that is known least, where the path hardly moves along it, and steadily.

    Along a smooth tunnel a path stays where it is, however fast the platform drives, and creeps where others overtake it. One
    that a hand swings has seen what it swings against, and what turns about is no vehicle on its way.
    """
    axes = seen.level(least_known_axis(path)[None])
    slow = len(axes) > 0 and abs(float(axes[0] @ mean_velocity(path))) < RESTING_M_S
    if not slow or well_known(path) or seen.gyro_std > _ABOUT_RAD_S:
        return
    seconds, along = (path.time_ns - path.time_ns[0]) * 1e-9, path.p_path_lidar @ axes[0]
    if float(np.std(along - np.polyval(np.polyfit(seconds, along, 1), seconds))) > _STEADY_M:
        return
    if not faces(path, seen.scans, seen.registration, axes[:1]).all():
        raise seen.not_moving(undecided(axes))


def _checked_fit(seen: Beginning, path: LidarPath) -> TranslationFit:
    """Velocity, gravity and bias from path and accelerometer, where both fit each other."""
    fit = moving_fit(seen.frames, path, seen.imu, seen.extrinsic, seen.config)
    if fit is None:
        raise seen.not_moving("the surroundings do not show how the platform turns")
    # A long lever arm that nobody gave can turn accelerations round: only with a mounting that is known the sign is in question.
    if fit.sigma > _GOOD_FIT_M and seen.config.extrinsic_estimation == "off":
        _check_sign(seen, path, fit)
    if fit.sigma > _LARGEST_MISFIT_M:
        raise seen.not_moving(f"LiDAR and IMU do not fit better than {fit.sigma * 100:.1f} cm")
    bias = float(np.linalg.norm(fit.bias))
    if bias > _LARGEST_ACCEL_BIAS:
        raise seen.not_moving(
            f"the path of the LiDAR asks for a bias of the accelerometer of {bias:.2f} m/s²: it sees too little, or the "
            "accelerometer is bad"
        )
    return fit


def _check_sign(seen: Beginning, path: LidarPath, fit: TranslationFit) -> None:
    """Whether the path fits the accelerometer much better with the opposite sign."""
    opposite = replace(seen.imu, accel=-seen.imu.accel)
    flipped = moving_fit(seen.frames, path, opposite, seen.extrinsic, seen.config)
    if flipped is not None and flipped.sigma < _MUCH_BETTER * fit.sigma:
        raise seen.not_moving(
            f"LiDAR and IMU fit to {flipped.sigma * 100:.1f} cm with the accelerometer's sign flipped, and to no more than "
            f"{fit.sigma * 100:.1f} cm as it is: its sign is wrong (at rest it is to show +9.8 m/s² upwards)"
        )


def _checked_speed(seen: Beginning, state: NavState, covariance: NDArray[np.float64]) -> float:
    """The largest standard deviation of the velocity [m/s], where that was found."""
    variances, axes = np.linalg.eigh(covariance[T_V : T_V + 3, T_V : T_V + 3])
    sigma = float(np.sqrt(variances[-1]))
    if sigma > _UNKNOWN_SPEED:
        axis = (state.R_world_imu @ seen.extrinsic.R_imu_lidar).T @ axes[:, -1]
        raise seen.not_moving(
            f"the surroundings do not show how fast the platform moves along {signed(axis, 2)} (LiDAR axes): {sigma:.0f} m/s "
            "more or less"
        )
    return sigma


def _undecided(axes: NDArray[np.float64], doubt: str) -> str:
    """A sentence about the axes along which nothing shows rest, and what speaks against it."""
    if not len(axes):
        return ""
    return (
        f"{undecided(axes)}{f' – {doubt}' if doubt else ''}: taken as at rest, "
        "because the IMU is quiet; "
        "at a constant speed it would be as quiet, so the position along it is called weak and its standard deviation grows by "
        "10 m/s until something shows the speed"
    )
