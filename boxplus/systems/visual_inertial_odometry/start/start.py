"""The start: attitude, velocity, biases and, with one camera, scale, from the first frames; or why there is none yet.

At rest: the mean angular rate is the gyroscope's bias, the mean specific force points up.

Moving: the gyroscope's bias from how rays turn between frames (`gyro_bias`); with the rotations known, velocity, gravity and
depths at once, linear (`linear_motion`); then the best states that fit all images and the IMU, with their covariance
(`refinement`). With several cameras depth is seen, with one the accelerometer gives the scale, and only where the
acceleration changes.

Nothing is guessed: a start is given when all of its tests are passed, each with a number. Otherwise the sentence says which one
is not, and more frames may pass it.

Source: Qin, Li and Shen, VINS-Mono, TRO 2018; Campos, Montiel and Tardós, Inertial-only optimization, ICRA 2020; Martinelli,
IJCV 2014.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.manifolds import quaternion, so3, sphere
from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.residuals.inertial.imu_preintegration import Preintegration
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.inertial.imu_noise import sample_noise
from boxplus.systems.visual_inertial_odometry.config import VioConfig
from boxplus.systems.visual_inertial_odometry.corners.partners import swapped
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks
from boxplus.systems.visual_inertial_odometry.health import FEWEST_SEEN
from boxplus.systems.visual_inertial_odometry.rig import Rig
from boxplus.systems.visual_inertial_odometry.start.gyro_bias import estimate_gyro_bias, stereo_points
from boxplus.systems.visual_inertial_odometry.start.linear_motion import solve_motion
from boxplus.systems.visual_inertial_odometry.start.ray_tracks import Floats, RayTracks
from boxplus.systems.visual_inertial_odometry.start.refinement import Refined, refine
from boxplus.systems.visual_inertial_odometry.start.rest import judge_rest, shortest_turn

_GYRO_BIAS = 0.2  # rad/s, standard deviation beforehand
_SPACING_S = 0.2  # between keyframes
_FEWEST_FRAMES, _MOST_FRAMES = 10, 16
_FEWEST_TRACKS = 20
_FEWEST_SAMPLES = 10
_FEWEST_SIGHTINGS = 3  # of a track
_CHI2, _BEHIND = 3.0, 10.0
_BIAS_SIGMAS = 2.5
_CAUTION = 2.0  # how many times as noisy as it was seen to be the IMU is taken for
_TILT_DEG, _TILT_MONO_DEG, _SCALE = 0.8, 0.45, 5.0  # deg beside what the accelerometer's bias does, %
_JUMPS = 0.3, 5.0  # rad/s, m/s²: standard deviations
_EXCITATION = 0.3  # m/s²
_NO_EXCITATION = "the acceleration varies by {:.2f} m/s² ({:g} are needed to see the scale)"
_ANY = 10.0  # rad, m, m/s
_GAP_GYRO, _GAP_ACCEL = 1.2, 4.0  # rad/s/√s, m/s²/√s: of the most restless bodies, in a hand and on stairs


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """The states that the window begins with.

    The window takes all measurements from `time_ns[0]` on into account itself: the tracks of these frames, and the IMU samples
    between them. What the states are worth beside them, because of what was measured before, is `covariance`.

    Attributes:
        kind: how it was found.
        frames: (k,) which of the frames given became keyframes, ascending; one at least.
        time_ns: (k,) of them.
        T_world_imu: (k, 7) wxyz and xyz, z up, the first one at the origin and turned from the world the shortest way.
        velocity_world: (k, 3) [m/s].
        gyro_bias: (3,) [rad/s]; accel_bias: (3,) [m/s²].
        covariance: (15, 15) of the first state before anything is measured from its time on, in the order
            `[θ, p, v, b_ω, b_a]`; position and yaw are made known by definition, whatever stands here.
        bias_before: (6,) the biases `[b_ω, b_a]` that `covariance` is about: at rest what was found, in motion zero.
        last_covariance: (15, 15) of the last state after all that was measured, relative to position and yaw of the first.
        facts: the numbers of the tests it passed, by name and unit, for the report.

    Example:
        >>> from boxplus.simulation.cameras import as_camera_recording, make_rig, simulate_cameras
        >>> simulation = simulate_cameras("room", duration_s=2.0, rig=make_rig("stereo", scale=0.25, rate_hz=8.0))
        >>> recording = as_camera_recording(simulation)
        >>> cams = [stream.calibrated() for stream in recording.info.cameras]
        >>> rig = bp.Rig.of([c.model for c in cams], [c.T_body_camera for c in cams], [(c.width, c.height) for c in cams])
        >>> odometry, estimates = bp.VisualInertialOdometry(None, rig), []
        >>> for event in recording:
        ...     estimates += odometry.push_image(event) if isinstance(event, bp.CameraImage) else odometry.push_imu(event)
        >>> odometry.start.kind, odometry.start.gyro_bias.shape
        ('at rest', (3,))
    """

    kind: Literal["at rest", "moving stereo", "moving mono"]
    frames: NDArray[np.intp]
    time_ns: NDArray[np.int64]
    T_world_imu: NDArray[np.float64]
    velocity_world: NDArray[np.float64]
    gyro_bias: NDArray[np.float64]
    accel_bias: NDArray[np.float64]
    covariance: NDArray[np.float64]
    bias_before: NDArray[np.float64]
    last_covariance: NDArray[np.float64]
    facts: Mapping[str, float]

    @property
    def sigma(self) -> NDArray[np.float64]:
        """(15,) standard deviations, of `covariance`."""
        deviations: NDArray[np.float64] = np.sqrt(np.diag(self.covariance))
        return deviations


def find_rest(seen: Sequence[Tracks], imu: ImuSamples, rig: Rig, config: VioConfig) -> Start | str:
    """The start of a body that rests over all frames or the newest, or a sentence that says why it does not, with a number.

    Args:
        seen: of the last seconds, in order of time; at least two.
        imu: strictly increasing samples that cover them, from before the first to the last.
        rig: one camera stands for mono.
    """
    time_ns = np.array([tracks.time_ns for tracks in seen], dtype=np.int64)
    duration = (time_ns[-1] - time_ns[0]) * 1e-9
    noise = shaken(imu_noise(rig, config), imu)
    recent = max(int(np.searchsorted(time_ns, time_ns[-1] - round(config.start_duration * 1e9), side="right")) - 1, 0)
    for first in dict.fromkeys((0, recent)):
        within = (imu.time_ns >= time_ns[first]) & (imu.time_ns <= time_ns[-1])
        if np.count_nonzero(within) < _FEWEST_SAMPLES:
            return f"{np.count_nonzero(within)} IMU samples in {duration:.2f} s ({_FEWEST_SAMPLES} are needed)"
        samples = imu.where(within)
        rest = judge_rest(seen[first:], samples, noise, config.gravity, config.accel_bias_sigma)
        if not rest.problem:
            break
    if rest.problem:
        return rest.problem
    pose = np.concatenate([quaternion.from_matrix(rest.R_world_imu), np.zeros(3)])
    return Start(
        kind="at rest",
        frames=np.array([len(seen) - 1], dtype=np.intp),
        time_ns=time_ns[[-1]],
        T_world_imu=pose[None],
        velocity_world=np.zeros((1, 3)),
        gyro_bias=rest.gyro_bias,
        accel_bias=rest.accel_bias,
        covariance=rest.covariance,
        bias_before=np.concatenate([rest.gyro_bias, rest.accel_bias]),
        last_covariance=rest.covariance,
        facts=rest.facts,
    )


def imu_noise(rig: Rig, config: VioConfig) -> ImuNoise:
    """What the settings state, and where they do not, the rig."""
    given = (config.gyro_noise, config.accel_noise, config.gyro_bias_walk, config.accel_bias_walk)
    stated = (rig.noise.gyro, rig.noise.accel, rig.noise.gyro_walk, rig.noise.accel_walk)
    gyro, accel, gyro_walk, accel_walk = (mine if mine is not None else its for mine, its in zip(given, stated, strict=True))
    return ImuNoise(gyro, accel, gyro_walk, accel_walk, _GAP_GYRO, _GAP_ACCEL)


def shaken(noise: ImuNoise, imu: ImuSamples) -> ImuNoise:
    """The noise stated, or what the samples show from one to the next where that is more: motors shake an IMU."""
    gyro, accel = sample_noise(imu).max(axis=1).tolist()
    return replace(noise, gyro=max(noise.gyro, gyro), accel=max(noise.accel, accel))


def moving_start(seen: Sequence[Tracks], imu: ImuSamples, rig: Rig, config: VioConfig) -> Start | str:
    """As `find_rest`, of a body that moves."""
    is_mono = len(rig.cameras) == 1
    first_ns, last_ns = seen[0].time_ns, seen[-1].time_ns
    wanted = round((last_ns - first_ns) * 1e-9 / _SPACING_S) + 1
    wanted = min(max(wanted, _FEWEST_FRAMES), _MOST_FRAMES, len(seen))
    if wanted < _FEWEST_FRAMES:
        return f"{wanted} frames were seen ({_FEWEST_FRAMES} are needed)"
    frames = np.unique(np.round(np.linspace(0, len(seen) - 1, wanted)).astype(np.intp))
    tracks = RayTracks.of([seen[k] for k in frames], rig.mountings)
    tracks = _often_seen(tracks)
    count = len(np.unique(tracks.track_of))
    if count < _FEWEST_TRACKS:
        return f"{count} corners were followed through {_FEWEST_SIGHTINGS} keyframes ({_FEWEST_TRACKS} are needed)"
    # Of fewer the newest frame is blind, and nothing holds the pose from there on.
    at_the_end = len(np.unique(tracks.track_of[tracks.frame_of == len(frames) - 1]))
    if at_the_end < FEWEST_SEEN:
        return f"{at_the_end} of the {count} corners are in the newest frame ({FEWEST_SEEN} are needed): it is blind"
    exchange = swapped(frame.partners for frame in seen)
    if exchange is not None:
        return exchange

    pixel = 1.0 / float(rig.cameras[0].model.parameters[0])
    stated = imu_noise(rig, config)
    noise = shaken(stated, imu)
    rate_hz = 1e9 / float(np.median(np.diff(imu.time_ns)))
    jumps = noise.gyro * np.sqrt(rate_hz), noise.accel * np.sqrt(rate_hz)
    if jumps[0] > _JUMPS[0] or jumps[1] > _JUMPS[1]:
        return (
            f"the IMU jumps by {jumps[0]:.2f} rad/s and {jumps[1]:.1f} m/s² from sample to sample, as a saturated or loose one "
            f"does (at most {_JUMPS[0]:g} and {_JUMPS[1]:g})"
        )
    every = RayTracks.of(seen, rig.mountings)
    steps = _between(every.time_ns, imu, noise)
    if len(steps.gaps):
        return f"a gap of {steps.longest_gap_s.max():.2f} s between IMU samples"
    turn = estimate_gyro_bias(every, steps, pixel, None if is_mono else stereo_points(every))
    if turn is None:
        return "too few corners connect neighbouring frames"
    times = tracks.time_ns
    points = None if is_mono else stereo_points(tracks)
    since_first = Preintegration.integrate(
        imu.time_ns,
        imu.gyro,
        imu.accel,
        noise=noise,
        intervals_ns=np.stack([np.full(len(times) - 1, times[0]), times[1:]], axis=1),
        bias_gyro=turn.bias,
    )
    between = _between(times, imu, noise, turn.bias)
    R = np.concatenate([np.eye(3)[None], quaternion.to_matrix(since_first.gamma_wxyz[:-1])])
    variation = _variation(R, between.beta, between.duration_s)
    if is_mono and variation < _EXCITATION:
        return _NO_EXCITATION.format(variation, _EXCITATION)
    motion = solve_motion(tracks, since_first, config.gravity, pixel, points)
    if motion is None:
        return "the corners show no motion that fits the accelerometer"
    between = _between(times, imu, noise, turn.bias, motion.accel_bias)
    bias_sigma = _GYRO_BIAS, config.accel_bias_sigma
    found = refine(tracks, motion, between, config.gravity, pixel, config.pixel_sigma, bias_sigma)
    share = 1.0 if isinstance(found, str) else _CAUTION * found.imu_share
    if not isinstance(found, str) and share < 1.0:
        # Motors shake an IMU from sample to sample, but hardly from keyframe to keyframe, which is what counts.
        calm = replace(noise, gyro=max(stated.gyro, share * noise.gyro), accel=max(stated.accel, share * noise.accel))
        between = _between(times, imu, calm, turn.bias, motion.accel_bias)
        found = refine(tracks, found.as_motion(motion, tracks), between, config.gravity, pixel, config.pixel_sigma, bias_sigma)
    if isinstance(found, str):
        return found
    if not found.converged:
        return "no motion that fits corners and IMU was found: the search for it did not end"
    facts = _facts(found, between, is_mono)
    problem = _problem(facts, is_mono, config)
    if problem:
        return problem
    return _moving(found, frames, times, is_mono, facts, bias_sigma)


def _between(
    time_ns: NDArray[np.int64],
    imu: ImuSamples,
    noise: ImuNoise,
    bias_gyro: ArrayLike = (0.0, 0.0, 0.0),
    bias_accel: ArrayLike = (0.0, 0.0, 0.0),
) -> Preintegration:
    """The intervals between neighbours in `time_ns` (K,), K − 1."""
    return Preintegration.integrate(
        imu.time_ns,
        imu.gyro,
        imu.accel,
        noise=noise,
        intervals_ns=np.stack([time_ns[:-1], time_ns[1:]], axis=1),
        bias_gyro=bias_gyro,
        bias_accel=bias_accel,
    )


def _often_seen(tracks: RayTracks) -> RayTracks:
    """Without tracks that were seen in fewer keyframes than a point needs."""
    key = np.unique(np.stack([tracks.track_of, tracks.frame_of]), axis=1)
    names, seen = np.unique(key[0], return_counts=True)
    kept = names[seen >= _FEWEST_SIGHTINGS]
    return tracks.of_rows(np.isin(tracks.track_of, kept))


def _variation(R: Floats, beta: Floats, duration_s: Floats) -> float:
    """Standard deviation of the acceleration over the keyframes, in fixed axes; gravity, being constant, has none [m/s²]."""
    force = np.einsum("nij,nj->ni", R, beta) / duration_s[:, None]
    return float(np.sqrt(force.var(axis=0).sum()))


def _facts(found: Refined, between: Preintegration, is_mono: bool) -> dict[str, float]:
    R = quaternion.to_matrix(found.poses[:-1, :4])
    _, _, beta = between.corrected(found.velocity_bias[:-1, 3:6], found.velocity_bias[:-1, 6:])
    variation = _variation(R, beta, between.duration_s)
    p = found.poses[:, 4:]
    arm = p - p.mean(axis=0)
    size = float((arm**2).sum())
    by_scale = np.zeros(len(found.covariance))  # of the size of the way
    for k in range(len(p)):
        by_scale[2 + 15 * k + 3 : 2 + 15 * k + 6] = arm[k] / max(size, 1e-12)
    scale = max(float(by_scale @ found.covariance @ by_scale), 0.0) ** 0.5
    tilt, beside = _tilt(found.covariance)
    facts = {
        "duration [s]": float(between.duration_s.sum()),
        "acceleration, variation [m/s²]": variation,
        "gyroscope bias [rad/s]": float(np.linalg.norm(found.velocity_bias[0, 6:])),
        "accelerometer bias [m/s²]": float(np.linalg.norm(found.velocity_bias[0, 3:6])),
        "sightings that do not agree [%]": 100.0 * float(np.mean(~found.used)),
        "sightings, deviation [px]": found.pixel_sigma,
        "χ² of the images per degree of freedom": found.chi2_images,
        "χ² of the IMU per degree of freedom": found.chi2_imu,
        "gravity, deviation [deg]": tilt,
        "gravity, deviation beside the bias [deg]": beside,
        "travelled [m]": float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum()),
        "points behind the cameras [%]": 100.0 * float(np.mean(found.inverse_depth < 0.0)),
    }
    if is_mono:
        facts["scale, deviation [%]"] = 100.0 * scale
    return facts


def _tilt(covariance: Floats) -> tuple[float, float]:
    """Largest standard deviation of gravity's direction [deg], in all and if the accelerometer's bias were known."""
    tilt, bias = slice(0, 2), slice(2 + 9, 2 + 12)
    by_bias = covariance[tilt, bias] @ np.linalg.solve(covariance[bias, bias], covariance[bias, tilt])
    whole, beside = (float(np.linalg.eigvalsh(P)[-1]) for P in (covariance[tilt, tilt], covariance[tilt, tilt] - by_bias))
    return float(np.rad2deg(np.sqrt(max(whole, 0.0)))), float(np.rad2deg(np.sqrt(max(beside, 0.0))))


def _problem(facts: Mapping[str, float], is_mono: bool, config: VioConfig) -> str:
    """The first test that is not passed, as a sentence."""
    tests: list[tuple[str, float, str]] = [
        ("χ² of the images per degree of freedom", _CHI2, "χ² of the images is {:.1f} per degree of freedom (at most {:g})"),
        ("χ² of the IMU per degree of freedom", _CHI2, "χ² of the IMU is {:.1f} per degree of freedom (at most {:g})"),
        ("points behind the cameras [%]", _BEHIND, "{:.0f} % of the points lie behind the cameras (at most {:g})"),
        ("gyroscope bias [rad/s]", 0.5, "the gyroscope's bias would be {:.2f} rad/s (at most {:g})"),
        (
            "accelerometer bias [m/s²]",
            _BIAS_SIGMAS * config.accel_bias_sigma,
            "the accelerometer's bias would be {:.2f} m/s² (at most {:g}): its scale or the mounting may be wrong",
        ),
        (
            "gravity, deviation beside the bias [deg]",
            _TILT_MONO_DEG if is_mono else _TILT_DEG,
            "gravity is known to {:.2f} deg beside what the accelerometer's bias does ({:g} are needed)",
        ),
    ]
    for name, most, text in tests:
        if not facts[name] < most:
            return text.format(facts[name], most)
    if is_mono and not facts["acceleration, variation [m/s²]"] > _EXCITATION:
        return _NO_EXCITATION.format(facts["acceleration, variation [m/s²]"], _EXCITATION)
    if is_mono and not facts["scale, deviation [%]"] < _SCALE:
        return f"the scale is known to {facts['scale, deviation [%]']:.1f} % ({_SCALE:g} are needed)"
    return ""


def _moving(
    found: Refined,
    frames: NDArray[np.intp],
    time_ns: NDArray[np.int64],
    is_mono: bool,
    facts: Mapping[str, float],
    bias_sigma: tuple[float, float],
) -> Start:
    """In a world whose z is up; `bias_sigma` of the biases beforehand, gyroscope and accelerometer."""
    u = found.gravity_direction
    Q = shortest_turn(u, np.array([0.0, 0.0, -1.0]))
    R = Q @ quaternion.to_matrix(found.poses[:, :4])
    p, v = found.poses[:, 4:] @ Q.T, found.velocity_bias[:, :3] @ Q.T
    # A change h of gravity's direction, seen in the world, turns the world by z × h.
    z = np.array([0.0, 0.0, 1.0])
    turn = so3.hat(z) @ Q @ sphere.tangent_basis(u)
    k = len(R) - 1
    J = np.zeros((15, len(found.covariance)))
    at = 2 + 15 * k
    J[0:3, :2], J[0:3, at : at + 3] = R[k].T @ turn, np.eye(3)
    J[3:6, :2], J[3:6, at + 3 : at + 6] = -so3.hat(p[k]) @ turn, Q
    J[6:9, :2], J[6:9, at + 6 : at + 9] = -so3.hat(v[k]) @ turn, Q
    J[9:12, at + 12 : at + 15] = np.eye(3)
    J[12:15, at + 9 : at + 12] = np.eye(3)
    before = np.diag(np.repeat([_ANY, _ANY, _ANY, *bias_sigma], 3) ** 2)
    return Start(
        kind="moving mono" if is_mono else "moving stereo",
        frames=frames,
        time_ns=time_ns,
        T_world_imu=np.hstack([quaternion.from_matrix(R), p]),
        velocity_world=v,
        gyro_bias=found.velocity_bias[-1, 6:],
        accel_bias=found.velocity_bias[-1, 3:6],
        covariance=before,
        bias_before=np.zeros(6),
        last_covariance=J @ found.covariance @ J.T,
        facts=facts,
    )
