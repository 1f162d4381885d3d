"""Camera and IMU: mounting, clock offset, biases and the direction of gravity, in one problem with preintegrated IMU samples.

The world is the target's frame; gravity's direction in it is a variable u on S². At every frame there is a pose T_target_imu, a
velocity and two biases; T_imu_camera and the offset t_d (IMU clock minus camera clock) are one for all. Residuals: the corners,
as in `adjustment`, with intrinsics held at what was found before, and between neighbouring frames the preintegrated samples of
[t_i + t_d, t_j + t_d] (`residuals.inertial.imu`, with gravity's direction and t_d as variables).

Start. Rotations of the camera between frames and integrals of the gyroscope are compared: t_d where their speeds correlate most
(on a grid, then a parabola), R_imu_camera from both by Kabsch's method about their means, so that a bias does not matter; p = 0.

Length. The corners know the target's size only from what they were told; the accelerometer measures. The problem is solved with
the target at s = 1 and at s ± δ: the parabola through the three costs has its minimum at the size that the IMU finds, and its
curvature is 1/σ_s².

Source: Furgale, Rehder and Siegwart, Unified temporal and spatial calibration for multi-sensor systems, IROS 2013, with
preintegration (Forster et al., TRO 2017) in place of splines.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.model import CameraModel
from boxplus.errors import InputError
from boxplus.manifolds import quaternion, se3, so3
from boxplus.manifolds.body_pose import BodyPose
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.nearest_rotation import nearest_rotation
from boxplus.manifolds.sphere import S2
from boxplus.optimization import losses
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.residuals.camera.on_body import OnBody
from boxplus.residuals.camera.reprojection import Reprojection
from boxplus.residuals.inertial.imu import ImuPreintegration
from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.residuals.inertial.imu_preintegration import Preintegration
from boxplus.residuals.prior import Prior
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.camera_calibration.adjustment import OUTLIER_SIGMAS
from boxplus.systems.camera_calibration.corners import TargetCorners
from boxplus.systems.camera_calibration.start import target_pose

Floats = NDArray[np.float64]

GRAVITY = 9.81
_LARGEST_OFFSET_S, _OFFSET_STEP_S = 0.5, 0.002
_LONGEST_GAP_S = 0.6
_FEWEST_FRAMES, _MOST_FRAMES, _MOST_CORNERS = 20, 400, 36
_NEARLY_ALL = 0.95
"""Of the frames at a spacing; rather than thinning more for the last few, these are left out."""
_LEAST_TURN = math.radians(3.0)
_MARGIN_S = 0.03
_ROUNDS = 3
_BIAS_SIGMA = (1.0, 0.2)  # m/s², rad/s: what an IMU may have
_SCALE_STEP = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class CameraImuCalibration:
    """How the first camera is mounted on the IMU.

    Attributes:
        T_imu_camera: (7,).
        time_offset_s: t_imu − t_camera [s].
        gravity_target: (3,) direction of free fall in the target's frame.
        bias_gyro, bias_accel: (3,) medians over the session [rad/s], [m/s²].
        covariance: (7, 7) of the tangent [θ, p] of T_imu_camera [rad, m] and of the offset [s].
        scale, scale_sigma: size of the target as the IMU measures it, as a share of what was stated; NaN and infinite where it
            measures none.
        frames: used.
        used_s: (first, last) of them [s] after the first image that could be used.
        session_s: until the last image that could be used [s]; `used_s` ends before where more than 400 frames would be needed.
        imu_chi2: mean square of the whitened IMU residuals: about 1 or less where its noise is as stated.
        corner_chi2: that of the corners, by the standard deviation that the cameras alone have.
        unconverged: a sentence where the search ended before its minimum.
    """

    T_imu_camera: Floats
    time_offset_s: float
    gravity_target: Floats
    bias_gyro: Floats
    bias_accel: Floats
    covariance: Floats
    scale: float
    scale_sigma: float
    frames: int
    used_s: tuple[float, float]
    session_s: float
    imu_chi2: float
    corner_chi2: float
    unconverged: str | None


@dataclass(frozen=True, slots=True, eq=False)
class _Session:
    """The frames used, oldest first: their times, T_target_camera, and the corners seen in them; times of all that could be."""

    time_ns: NDArray[np.int64]
    T_target_camera: Floats
    frame_of: NDArray[np.intp]
    places: Floats
    pixels: Floats
    span_ns: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    bodies: Floats
    velocity_bias: Floats
    mounting: Floats
    gravity: Floats
    offset_s: float


def calibrate_imu(
    corners: TargetCorners, places: Floats, model: CameraModel, sigma_px: float, imu: ImuSamples, noise: ImuNoise
) -> CameraImuCalibration:
    """Find how a camera is mounted on an IMU.

    Args:
        corners: of one camera, without those that were left out, with times.
        places: (n, 3) of the target's corners [m].
        model: its calibrated lens.
        sigma_px: of a coordinate of a corner [px].
        imu: samples that cover the images.
        noise: of the IMU.

    Raises:
        InputError: no times, too few images that the samples cover, or a motion without rotation.
    """
    session = _session(corners, places, model, imu)
    offset_s, R_imu_camera = _rotation_start(session, imu)
    state = _state_at_start(session, imu, offset_s, R_imu_camera)
    solved, solution, problem = _solve(session, state, model, sigma_px, imu, noise, 1.0)
    unconverged = solution.unconverged("turn and shake faster, about all axes")
    mounting, offset = problem.blocks[2], problem.blocks[4]
    covariance = solution.joint_covariance(mounting, offset, is_determined=True)
    scale, scale_sigma = _scale(session, solved, solution.cost, (model, sigma_px, imu, noise))
    costs = [group.evaluate(list(solution.values), 1).cost for group in problem.groups]
    links = problem.groups[1].residual.count
    return CameraImuCalibration(
        T_imu_camera=solved.mounting,
        time_offset_s=solved.offset_s,
        gravity_target=solved.gravity,
        bias_gyro=np.median(solved.velocity_bias[:, 6:], axis=0),
        bias_accel=np.median(solved.velocity_bias[:, 3:6], axis=0),
        covariance=covariance,
        scale=scale,
        scale_sigma=scale_sigma,
        frames=len(session.time_ns),
        used_s=(1e-9 * int(session.time_ns[0] - session.span_ns[0]), 1e-9 * int(session.time_ns[-1] - session.span_ns[0])),
        session_s=1e-9 * (session.span_ns[1] - session.span_ns[0]),
        imu_chi2=2.0 * costs[1] / (15 * links),
        corner_chi2=2.0 * costs[0] / (2 * len(session.pixels)),
        unconverged=unconverged,
    )


def _session(corners: TargetCorners, places: Floats, model: CameraModel, imu: ImuSamples) -> _Session:
    if corners.time_ns is None:
        raise InputError(
            "times of the images, to compare them with the IMU's",
            "frame numbers alone",
            "give a corner file with times [ns], or calibrate the cameras without --imu",
        )
    frames, counts = np.unique(corners.frame_of, return_counts=True)
    margin = round((_LARGEST_OFFSET_S + _MARGIN_S) * 1e9)
    time = corners.time_ns[frames]
    covered = (time >= imu.time_ns[0] + margin) & (time <= imu.time_ns[-1] - margin) & (counts >= 8)
    frames = frames[covered]
    if len(frames) < _FEWEST_FRAMES:
        raise InputError(
            f"at least {_FEWEST_FRAMES} images of the target that the IMU samples cover",
            f"{len(frames)} of {len(covered)}, from {time[0] if len(time) else '–'} to {time[-1] if len(time) else '–'} ns, and "
            f"samples from {imu.time_ns[0]} to {imu.time_ns[-1]} ns",
            "check that both are of one recording and one clock",
        )
    usable_ns = corners.time_ns[frames]
    frames = frames[_thinned(usable_ns)]
    kept: list[int] = []
    poses, of, at, pixels = [], [], [], []
    for frame in frames:
        rows = np.flatnonzero(corners.frame_of == frame)
        rows = rows[:: -(-len(rows) // _MOST_CORNERS)]
        T = target_pose(model, corners.pixels[rows], places[corners.corner_of[rows]])
        if T is None:
            continue
        of.append(np.full(len(rows), len(kept)))
        kept.append(int(frame))
        poses.append(se3.inverse(T))
        at.append(places[corners.corner_of[rows]])
        pixels.append(corners.pixels[rows])
    if len(kept) < _FEWEST_FRAMES:
        raise InputError(
            f"at least {_FEWEST_FRAMES} images in which the corners give the pose of the target",
            f"{len(kept)} of {len(frames)}",
            "check the target, the numbering of its corners and the resolution",
        )
    return _Session(
        corners.time_ns[np.array(kept)], np.array(poses), np.concatenate(of), np.concatenate(at), np.concatenate(pixels),
        (int(usable_ns[0]), int(usable_ns[-1])),
    )  # fmt: skip


def _thinned(time_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    """At most `_MOST_FRAMES` of frames at these times, no link between two lost by what is left out.

    The whole session is thinned as far as links allow. Where that is still too much, it is the run of frames with the most links.
    """
    count = len(time_ns)
    if count <= _MOST_FRAMES:
        return np.arange(count)
    longest = round(_LONGEST_GAP_S * 1e9)
    steps = np.diff(time_ns)
    spacing = min(int(steps[steps <= longest].sum()) // (_MOST_FRAMES - 1), longest)
    kept = _at_spacing(time_ns, spacing)
    while _NEARLY_ALL * len(kept) > _MOST_FRAMES and spacing < longest:
        spacing = min(spacing + max(spacing // 20, 1), longest)
        kept = _at_spacing(time_ns, spacing)
    if len(kept) <= _MOST_FRAMES:
        return kept
    links = np.concatenate([[0], np.cumsum(np.diff(time_ns[kept]) <= longest)])
    begin = int(np.argmax(links[_MOST_FRAMES - 1 :] - links[: len(links) - _MOST_FRAMES + 1]))
    return kept[begin : begin + _MOST_FRAMES]


def _at_spacing(time_ns: NDArray[np.int64], spacing: int) -> NDArray[np.intp]:
    """Frames as far apart as they can be within `spacing` [ns]; the next one where none is within it."""
    last = np.searchsorted(time_ns, time_ns + spacing, side="right") - 1
    kept = [0]
    while kept[-1] < len(time_ns) - 1:
        kept.append(max(int(last[kept[-1]]), kept[-1] + 1))
    return np.array(kept, dtype=np.intp)


def _links(session: _Session) -> NDArray[np.intp]:
    """(L, 2) neighbouring frames that are near in time."""
    first = np.flatnonzero(np.diff(session.time_ns) <= _LONGEST_GAP_S * 1e9)
    return np.stack([first, first + 1], axis=1)


def _rotation_start(session: _Session, imu: ImuSamples) -> tuple[float, Floats]:
    """The clock offset [s], and R_imu_camera, from angular velocities."""
    links = _links(session)
    if len(links) < _FEWEST_FRAMES // 2:
        raise InputError(
            f"images of the target less than {_LONGEST_GAP_S:g} s apart",
            f"{len(links)} such pairs",
            "use a recording of the target at 4 Hz and more, not single pictures",
        )
    R = quaternion.to_matrix(np.ascontiguousarray(session.T_target_camera[:, :4]))
    seconds = np.diff(session.time_ns)[links[:, 0]] * 1e-9
    turned = so3.log(np.einsum("nji,njk->nik", R[links[:, 0]], R[links[:, 1]]))
    if np.percentile(np.linalg.norm(turned - turned.mean(axis=0), axis=1), 80) < _LEAST_TURN * float(np.median(seconds)):
        raise InputError(
            "a motion that turns cameras and IMU",
            "next to none",
            "turn them to and fro about all axes while the target is in view",
        )
    camera = turned / seconds[:, None]
    begin_s = (session.time_ns[links] - imu.time_ns[0]) * 1e-9
    at_s = (imu.time_ns - imu.time_ns[0]) * 1e-9
    steps = 0.5 * (imu.gyro[1:] + imu.gyro[:-1]) * np.diff(at_s)[:, None]
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])

    def gyro_at(offset_s: float) -> Floats:
        ends = [np.stack([np.interp(begin_s[:, k] + offset_s, at_s, column) for column in integral.T], axis=1) for k in range(2)]
        return np.asarray((ends[1] - ends[0]) / seconds[:, None])

    def misfit(offset_s: float) -> float:
        gyro = gyro_at(offset_s)
        return float(np.sum((gyro - gyro.mean(axis=0) - (camera - camera.mean(axis=0)) @ _kabsch(camera, gyro).T) ** 2))

    offsets = np.arange(-_LARGEST_OFFSET_S, _LARGEST_OFFSET_S + 1e-9, _OFFSET_STEP_S)
    costs = np.array([misfit(float(offset)) for offset in offsets])
    k = int(np.clip(np.argmin(costs), 1, len(offsets) - 2))
    bend = costs[k - 1] - 2.0 * costs[k] + costs[k + 1]
    offset_s = float(offsets[k] + (0.5 * _OFFSET_STEP_S * (costs[k - 1] - costs[k + 1]) / bend if bend > 0.0 else 0.0))
    return offset_s, _kabsch(camera, gyro_at(offset_s))


def _kabsch(camera: Floats, gyro: Floats) -> Floats:
    """R with gyro − mean ≈ R (camera − mean)."""
    return nearest_rotation((gyro - gyro.mean(axis=0)).T @ (camera - camera.mean(axis=0)))


def _state_at_start(session: _Session, imu: ImuSamples, offset_s: float, R_imu_camera: Floats) -> _State:
    mounting = np.concatenate([quaternion.from_matrix(R_imu_camera), np.zeros(3)])
    bodies = se3.compose(session.T_target_camera, se3.inverse(mounting))
    at_s = (session.time_ns - session.time_ns[0]) * 1e-9
    states = np.zeros((len(bodies), 9))
    states[:, :3] = np.gradient(bodies[:, 4:], at_s, axis=0)
    imu_s = (imu.time_ns - session.time_ns[0]) * 1e-9
    force = np.stack([np.interp(at_s + offset_s, imu_s, column) for column in imu.accel.T], axis=1)
    R = quaternion.to_matrix(np.ascontiguousarray(bodies[:, :4]))
    up = np.einsum("nij,nj->i", R, force)
    return _State(bodies, states, mounting, -up / np.linalg.norm(up), offset_s)


def _solve(
    session: _Session,
    start: _State,
    model: CameraModel,
    sigma_px: float,
    imu: ImuSamples,
    noise: ImuNoise,
    scale: float,
    rounds: int = _ROUNDS,
) -> tuple[_State, Solution, Problem]:
    links, problem = _links(session), Problem()
    bodies = problem.add_variables(BodyPose, start.bodies, name="T_target_imu")
    states = problem.add_variables(Euclidean(9), start.velocity_bias, name="velocity_bias")
    mounting = problem.add_variables(BodyPose, start.mounting, name="T_imu_camera")
    gravity = problem.add_variables(S2, start.gravity, name="gravity_direction")
    offset = problem.add_variables(Euclidean(1), [start.offset_s], name="time_offset")
    points = problem.add_variables(Euclidean(3), scale * session.places, name="corners of the target")
    problem.fix(points)
    seen = OnBody(Reprojection(model, session.pixels, sigma=sigma_px))
    every = np.zeros(len(session.pixels), dtype=np.intp)
    problem.add_residuals(
        seen, bodies[session.frame_of], mounting[every], points, loss=losses.Huber(OUTLIER_SIGMAS), name="corners"
    )  # fmt: skip
    i, j = links.T
    shift = round(start.offset_s * 1e9)
    samples = Preintegration.integrate(
        imu.time_ns, imu.gyro, imu.accel, noise=noise, intervals_ns=session.time_ns[links] + shift,
        bias_accel=start.velocity_bias[i, 3:6], bias_gyro=start.velocity_bias[i, 6:],
    )  # fmt: skip
    between = ImuPreintegration(
        samples, gravity=(0.0, 0.0, -GRAVITY), gravity_direction=True, time_offset=True, time_offset_s=1e-9 * shift
    )
    once = np.zeros(len(links), dtype=np.intp)
    problem.add_residuals(between, bodies[i], states[i], bodies[j], states[j], gravity[once], offset[once], name="imu")
    # Two frames between gaps do not determine their velocities and biases, a frame without a link has no IMU at all: a prior
    # holds the first frame of every chain.
    wide = np.repeat([10.0, *_BIAS_SIGMA], 3)
    held = np.setdiff1d(np.arange(len(bodies)), j)
    problem.add_residuals(Prior(Euclidean(9), np.zeros((len(held), 9)), sigma=wide), states[held], name="biases")
    solution = problem.solve(examine=False, max_iterations=40)
    for _ in range(rounds - 1):
        between.refresh(solution[states][i], float(solution[offset][0, 0]))
        problem.set_values(solution)
        solution = problem.solve(examine=False, max_iterations=40)
    solved = _State(
        solution[bodies], solution[states], solution[mounting][0], solution[gravity][0], float(solution[offset][0, 0])
    )
    return solved, solution, problem


def _scale(
    session: _Session, solved: _State, cost: float, rest: tuple[CameraModel, float, ImuSamples, ImuNoise]
) -> tuple[float, float]:
    """Size of the target by the IMU and its standard deviation, as shares of what was stated; NaN and ∞ without a minimum."""
    costs = []
    for scale in (1.0 - _SCALE_STEP, 1.0 + _SCALE_STEP):
        bodies = solved.bodies.copy()
        R = quaternion.to_matrix(np.ascontiguousarray(bodies[:, :4]))
        arm = np.einsum("nij,j->ni", R, solved.mounting[4:])
        bodies[:, 4:] = scale * (bodies[:, 4:] + arm) - arm
        moved = _State(bodies, solved.velocity_bias, solved.mounting, solved.gravity, solved.offset_s)
        costs.append(_solve(session, moved, *rest, scale, rounds=1)[1].cost)
    bend = (costs[0] - 2.0 * cost + costs[1]) / _SCALE_STEP**2
    if not bend > 0.0:
        return math.nan, math.inf
    return 1.0 + 0.5 * (costs[0] - costs[1]) / _SCALE_STEP / bend, 1.0 / math.sqrt(bend)
