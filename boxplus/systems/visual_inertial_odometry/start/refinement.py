"""The best states that fit images and IMU together, with their covariance: all poses, velocities, biases, gravity and points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.pinhole import Pinhole
from boxplus.manifolds import quaternion
from boxplus.manifolds.body_pose import BodyPose
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.sphere import S2
from boxplus.optimization.losses import Cauchy
from boxplus.optimization.problem import Problem
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.variables import VariableRows, Variables
from boxplus.residuals.camera.inverse_depth import InverseDepthReprojection
from boxplus.residuals.camera.on_body import OnBody
from boxplus.residuals.inertial.imu import ImuPreintegration
from boxplus.residuals.inertial.imu_preintegration import Preintegration
from boxplus.residuals.prior import Prior
from boxplus.systems.visual_inertial_odometry.start.linear_motion import LinearMotion
from boxplus.systems.visual_inertial_odometry.start.ray_tracks import Floats, Integers, RayTracks

_LOSS = 2.0  # standard deviations
_MISTAKE = 4.0  # standard deviations, of a sighting that is left out
_FARTHEST = 100.0  # m, of a point to begin with
_ROUNDS = (40, 30)
_COST_TOLERANCE, _DAMPING = 1e-4, 1e-9
_MISTAKEN, _NOISE = 40.0, 5.0  # %, times `pixel_sigma`: of sightings that can be believed
_WRONG_SHARE = 0.34
_FEWEST_SIGHTINGS, _FEWEST_TRACKS = 3, 15
_RAYLEIGH = 1.1774  # median length of a two-dimensional error of standard deviation 1
_ANY_VELOCITY = 30.0  # m/s
_IMU_UNKNOWNS = 12  # velocity of the last frame, biases, gravity and scale, beside a velocity for each interval
_RAYS = Pinhole(1.0, 1.0, 0.0, 0.0)


@dataclass(frozen=True)
class Refined:
    """In the axes of the first frame.

    Attributes:
        poses: (K, 7) wxyz and xyz; velocity_bias: (K, 9).
        gravity_direction: (3,) unit, down.
        covariance: (2 + 15 K, 2 + 15 K) of gravity's tangent, the poses' [θ, p] and the [v, b_a, b_ω], each frame after frame.
        inverse_depth: (T,) of the tracks that were used [1/m]; inverse_depth_sigma: (T,).
        used: (N,) sightings that agree.
        pixel_sigma: estimated from the sightings, in the unit of the rays.
        chi2_images, chi2_imu: per degree of freedom.
        imu_share: standard deviation of the IMU's errors, as a share of what it was taken for.
        converged: whether the last search was.
    """

    poses: Floats
    velocity_bias: Floats
    gravity_direction: Floats
    covariance: Floats
    inverse_depth: Floats
    used: NDArray[np.bool_]
    pixel_sigma: float
    chi2_images: float
    chi2_imu: float
    imu_share: float
    converged: bool

    def as_motion(self, motion: LinearMotion, tracks: RayTracks) -> LinearMotion:
        """Where another search may begin; `motion` and `tracks` are those that this one began with."""
        ahead = self.inverse_depth > 1.0 / _FARTHEST
        length = np.sqrt(1.0 + (tracks.rays[motion.anchors] ** 2).sum(axis=1))
        return replace(
            motion,
            R=quaternion.to_matrix(self.poses[:, :4]),
            p=self.poses[:, 4:],
            v=self.velocity_bias[:, :3],
            gravity=self.gravity_direction,
            accel_bias=self.velocity_bias[0, 3:6],
            depth=length / np.where(ahead, self.inverse_depth, 1.0 / _FARTHEST),
        )


@dataclass(frozen=True)
class _Parts:
    problem: Problem
    bodies: Variables
    states: Variables
    gravity: Variables
    points: Variables
    imu: Group
    seen: Group


def refine(
    tracks: RayTracks,
    motion: LinearMotion,
    between: Preintegration,
    magnitude: float,
    pixel: float,
    pixel_sigma: float,
    bias_sigma: tuple[float, float],
) -> Refined | str:
    """Minimise over everything, leave out sightings that do not agree, minimise again; or a sentence why the second is hopeless.

    Args:
        tracks: in K frames.
        motion: where to begin.
        between: of the K − 1 intervals between the frames.
        magnitude: of gravity [m/s²].
        pixel: a pixel, in the unit of the rays.
        pixel_sigma: of a sighting beforehand [px].
        bias_sigma: of the biases beforehand, gyroscope [rad/s] and accelerometer [m/s²].
    """
    _, track_of = np.unique(tracks.track_of, return_inverse=True)
    count = len(motion.tracks)
    poses = np.hstack([quaternion.from_matrix(motion.R), motion.p])
    states = np.hstack([motion.v, np.tile(motion.accel_bias, (len(motion.v), 1)), between.bias_gyro[[0] * len(motion.v)]])
    gravity = motion.gravity / np.linalg.norm(motion.gravity)
    anchor_rays = tracks.rays[motion.anchors]
    far = np.clip(motion.depth / np.sqrt(1.0 + (anchor_rays**2).sum(axis=1)), 0.0, _FARTHEST)
    rho = np.where(motion.depth > 0.05, 1.0 / np.maximum(far, 0.05), 1.0 / _FARTHEST)
    points = np.hstack([anchor_rays, rho[:, None]])
    used = np.ones(len(tracks.rays), dtype=np.bool_)
    sigma = pixel_sigma * pixel
    for round_, iterations in enumerate(_ROUNDS):
        parts = _build(
            tracks, track_of, motion.anchors, used, poses, states, gravity, points, between, magnitude, sigma, bias_sigma
        )
        solution = parts.problem.solve(max_iterations=iterations, cost_tolerance=_COST_TOLERANCE, initial_damping=_DAMPING)
        poses, states, gravity, points = (
            np.array(solution[block]) for block in (parts.bodies, parts.states, parts.gravity, parts.points)
        )
        gravity = gravity[0]
        squares = np.full(len(used), np.inf)
        squares[used] = parts.seen.squares(solution.values)
        if round_ == len(_ROUNDS) - 1:
            break
        sigma *= _scale(squares[used], 3 * count + 9)
        agrees = squares < _MISTAKE**2 * max(1.0, (sigma / (pixel_sigma * pixel)) ** 2)
        agrees[~used] = False
        # A track that is wrong more than now and then is wrong; one without its first sighting has no place.
        seen, wrong = np.bincount(track_of, minlength=count), np.bincount(track_of, ~agrees, count)
        lost = (wrong > _WRONG_SHARE * seen) | ~agrees[motion.anchors] | (seen - wrong < _FEWEST_SIGHTINGS)
        used = agrees & ~lost[track_of]
        if np.count_nonzero(~lost) < _FEWEST_TRACKS:
            return "too few corners agree with any one motion"
        mistaken = 100.0 * float(np.mean(~used))
        if not mistaken < _MISTAKEN:
            return f"{mistaken:.0f} % of the sightings agree with no one motion (at most {_MISTAKEN:g})"
        if not sigma < _NOISE * pixel_sigma * pixel:
            return f"corners deviate by {sigma / pixel:.2f} px (at most {_NOISE * pixel_sigma:g})"
    covariance = solution.joint_covariance(parts.gravity, *_alternating(parts))
    imu_squares = parts.imu.squares(solution.values)
    left = 2 * np.count_nonzero(used) - 3 * len(np.unique(track_of[used]))
    return Refined(
        poses=poses,
        velocity_bias=states,
        gravity_direction=gravity,
        covariance=covariance,
        inverse_depth=points[:, 2],
        used=used,
        pixel_sigma=sigma / pixel,
        chi2_images=float(np.minimum(squares[used], _MISTAKE**2).sum() / max(left, 1)),
        chi2_imu=float(imu_squares.sum() / (9 * len(imu_squares) - 5)),
        imu_share=float(np.sqrt(imu_squares.sum() / (6 * len(imu_squares) - _IMU_UNKNOWNS))),
        converged=solution.status == "converged",
    )


def _scale(squares: Floats, unknowns: int) -> float:
    """Standard deviation of the sightings, from the median length of their whitened errors; a mistake does not move it."""
    finite = squares[np.isfinite(squares)]
    free = max(1.0 - unknowns / (2.0 * len(finite)), 0.2)
    return float(np.sqrt(np.median(finite) / free)) / _RAYLEIGH


def _alternating(parts: _Parts) -> list[VariableRows]:
    return [rows for k in range(len(parts.bodies)) for rows in (parts.bodies[[k]], parts.states[[k]])]


def _build(
    tracks: RayTracks,
    track_of: Integers,
    anchors: Integers,
    used: NDArray[np.bool_],
    poses: Floats,
    states: Floats,
    gravity: Floats,
    points: Floats,
    between: Preintegration,
    magnitude: float,
    sigma: float,
    bias_sigma: tuple[float, float],
) -> _Parts:
    problem = Problem()
    bodies = problem.add_variables(BodyPose, poses, name="T_world_imu")
    state = problem.add_variables(Euclidean(9), states, name="velocity_bias")
    down = problem.add_variables(S2, gravity, name="gravity_direction")
    mountings = problem.add_variables(BodyPose, tracks.T_imu_camera, name="T_imu_camera")
    held = np.unique(track_of[used])
    point = problem.add_variables(Euclidean(3), points, name="bearing_rho")
    problem.fix(bodies[[0]])
    problem.fix(mountings)
    if len(held) < len(points):
        problem.fix(point[np.setdiff1d(np.arange(len(points)), held)])
    n = np.flatnonzero(used)
    anchor = anchors[track_of[n]]
    seen = problem.add_residuals(
        OnBody(InverseDepthReprojection(_RAYS, tracks.rays[n], sigma=sigma)),
        bodies[tracks.frame_of[anchor]],
        mountings[tracks.camera_of[anchor]],
        bodies[tracks.frame_of[n]],
        mountings[tracks.camera_of[n]],
        point[track_of[n]],
        loss=Cauchy(_LOSS),
    )
    frames = np.arange(len(poses))
    imu = problem.add_residuals(
        ImuPreintegration(between, gravity=(0.0, 0.0, -magnitude), gravity_direction=True),
        bodies[frames[:-1]],
        state[frames[:-1]],
        bodies[frames[1:]],
        state[frames[1:]],
        down[[0] * (len(frames) - 1)],
    )
    known = np.array([_ANY_VELOCITY] * 3 + [bias_sigma[1]] * 3 + [bias_sigma[0]] * 3)
    problem.add_residuals(Prior(Euclidean(9), np.zeros(9), sigma=known), state[[0]])
    return _Parts(problem, bodies, state, down, point, imu, seen)
