"""Velocity, gravity and depths at once, linear, once the rotations are known.

In the axes of the first frame, with the rotations R_k from the gyroscope, its bias taken off, and α_k, β_k the sums of the
accelerometer from the first frame on, the position of the body is linear in x = [v_0, g, b_a]:

    p_k = v_0 t_k + ½ g t_k² + α_k + J_k b_a,        c_o = p_k + R_k p_C        the camera of sighting o

A point at distance d along the ray w_a of its first sighting a, seen again along w_o, gives two equations, Bᵀ w_o = 0:

    Bᵀ (c_a − c_o + d w_a) / d' = 0                                              [rad], with d' the depth of the round before

The distances are eliminated point by point. Several cameras make that a linear system for x: the rays between them are metric.

With one camera the same equations are homogeneous in x, without b_a, and a factor of α_k + R_k p_C: the smallest generalised
eigenvector under Σ ‖c_k‖² = 1 gives the centres c_k up to a common factor. They are then brought together with the
accelerometer, linear in s and x: s c_k = p_k + R_k p_C − p_C. Solving for x from the rays at once would be shorter and
wrong: noise makes every distance, and with them the scale, too small.

Gravity is held at its magnitude, and refined in the tangent plane of the sphere. What the equations do not determine (no
acceleration: the scale) shows in the covariance of what follows, not here.

Source: Martinelli, Closed-form solution of visual-inertial structure from motion, IJCV 2014; Qin, Li and Shen, VINS-Mono, TRO
2018 (alignment, gravity in its tangent plane).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from boxplus.manifolds import quaternion, sphere
from boxplus.residuals.inertial.imu_preintegration import Preintegration
from boxplus.systems.visual_inertial_odometry.start.ray_tracks import Floats, Integers, RayTracks

_ACCEL_BIAS = 0.1  # m/s², standard deviation beforehand
_FIRST_DEPTH = 3.0  # m, where nothing is known; only the weights of the first round depend on it
_NEAREST, _FARTHEST = 0.2, 100.0  # m, of depths in weights
_ROUNDS = (30.0, 15.0, 8.0, 5.0, 4.0, 3.0)  # px, scale of the weights after Geman and McClure
_NEAR_SHARE = 0.05  # of the median depth
_WAY_STD = 0.005  # m, of the camera's way from the images
_ON_SPHERE = 4


@dataclass(frozen=True)
class LinearMotion:
    """In the axes of the first frame, which stands at the origin.

    Attributes:
        R: (K, 3, 3); p: (K, 3) [m]; v: (K, 3) [m/s].
        gravity: (3,) [m/s²].
        accel_bias: (3,) [m/s²].
        tracks: (T,) names of the tracks; anchors: (T,) their first sightings; depth: (T,) along the unit ray [m].
        weight: (N,) of the sightings at the end, 0 to 1; that of anchors is 1.
    """

    R: Floats
    p: Floats
    v: Floats
    gravity: Floats
    accel_bias: Floats
    tracks: Integers
    anchors: Integers
    depth: Floats
    weight: Floats


def solve_motion(
    tracks: RayTracks, since_first: Preintegration, magnitude: float, pixel: float, points: Floats | None
) -> LinearMotion | None:
    """Velocity, gravity and depths; None where the rays do not determine them.

    Args:
        tracks: in K frames; of every track two sightings at least.
        since_first: K − 1 intervals, all from the first frame on, at the bias of the gyroscope.
        magnitude: of gravity [m/s²].
        pixel: a pixel, in the unit of the rays.
        points: (N, 3) the point of every sighting in the body at that time, NaN where it is not known; None for one camera.
    """
    R = np.concatenate([np.eye(3)[None], quaternion.to_matrix(since_first.gamma_wxyz)])
    rays = _Rays.of(tracks, R)
    motion = _Motion.of(since_first)
    prior = np.diag([0.0] * 6 + [1.0 / _ACCEL_BIAS**2] * 3)
    if points is None:
        arms = R @ tracks.T_imu_camera[0, 4:]
        seen = _up_to_scale(rays, motion, arms, pixel)
        if seen is None:
            return None
        scale, x = _aligned(seen[0], motion, arms, prior, magnitude)
        if not scale > 0.0:
            return None
        depth, weight = scale * seen[1], seen[2]
    else:
        x, depth, weight = _metric(rays, motion, R, tracks, points, prior, magnitude, pixel)
    beta = motion.beta + motion.beta_by_bias @ x[6:]
    return LinearMotion(
        R=R,
        p=motion.M @ x + motion.alpha,
        v=x[:3] + x[3:6] * motion.t[:, None] + beta,
        gravity=x[3:6],
        accel_bias=x[6:],
        tracks=rays.names,
        anchors=rays.anchors,
        depth=depth,
        weight=weight,
    )


@dataclass(frozen=True)
class _Motion:
    """p_k = M_k x + α_k, v_k = v_0 + g t_k + β_k + ∂β_k b_a, x = [v_0, g, b_a], for K frames."""

    t: Floats
    M: Floats
    alpha: Floats
    beta: Floats
    beta_by_bias: Floats

    @classmethod
    def of(cls, since_first: Preintegration) -> _Motion:
        t = np.concatenate([[0.0], since_first.duration_s])
        zero, none = np.zeros((1, 3)), np.zeros((1, 3, 3))
        M = np.zeros((len(t), 3, 9))
        M[:, :, :3] = t[:, None, None] * np.eye(3)
        M[:, :, 3:6] = 0.5 * (t * t)[:, None, None] * np.eye(3)
        M[1:, :, 6:] = since_first.bias_jacobian[:, :3, :3]
        alpha, beta = np.concatenate([zero, since_first.alpha]), np.concatenate([zero, since_first.beta])
        return cls(t, M, alpha, beta, np.concatenate([none, since_first.bias_jacobian[:, 6:, :3]]))


@dataclass(frozen=True)
class _Rays:
    """Every sighting in the axes of the first frame, Bᵀ w = 0, and h = Bᵀ w_a of the first sighting of its track."""

    names: Integers
    track_of: Integers
    anchors: Integers
    frame_of: Integers
    B: Floats
    h: Floats

    @classmethod
    def of(cls, tracks: RayTracks, R: Floats) -> _Rays:
        w = np.einsum("nij,nj->ni", R[tracks.frame_of], tracks.directions())
        names, track_of = np.unique(tracks.track_of, return_inverse=True)
        order = np.lexsort((tracks.camera_of, tracks.frame_of))
        rank = np.empty(len(order), dtype=np.int64)
        rank[order] = np.arange(len(order))
        first = np.full(len(names), len(order))
        np.minimum.at(first, track_of, rank)
        anchors = order[first]
        B = np.linalg.svd(w[:, None, :])[2][:, 1:, :]  # (N, 2, 3)
        h = (B @ w[anchors[track_of]][:, :, None])[:, :, 0]
        return cls(names, track_of, anchors, tracks.frame_of, B, h)

    @property
    def anchor(self) -> Integers:
        """(N,) first sighting of the track of each."""
        return self.anchors[self.track_of]


def _metric(
    rays: _Rays,
    motion: _Motion,
    R: Floats,
    tracks: RayTracks,
    points: Floats,
    prior: Floats,
    magnitude: float,
    pixel: float,
) -> tuple[Floats, Floats, Floats]:
    """x, depths and weights where several cameras see depth."""
    of, anchor, track_of, count = rays.frame_of, rays.anchor, rays.track_of, len(rays.names)
    centre = motion.alpha[of] + np.einsum("nij,nj->ni", R[of], tracks.T_imu_camera[tracks.camera_of, 4:])
    A = rays.B @ (motion.M[of[anchor]] - motion.M[of])
    b = -(rays.B @ (centre[anchor] - centre)[:, :, None])[:, :, 0]
    depth = np.full(count, _FIRST_DEPTH)
    known = np.isfinite(points[rays.anchors]).all(axis=1)
    arms = points[rays.anchors] - tracks.T_imu_camera[tracks.camera_of[rays.anchors], 4:]
    depth[known] = np.linalg.norm(arms[known], axis=1)
    weight, x = np.ones(len(of)), np.zeros(9)
    for scale in _ROUNDS:
        size = np.clip(np.abs(depth), _NEAREST, _FARTHEST)[track_of]
        factor = weight / (pixel * size) ** 2
        H, g = _reduced(A, rays.h, b, factor, track_of, count)
        x = _with_gravity(H + prior, g, magnitude)
        depth = _depths(A, rays.h, b, factor, x, track_of, count)
        weight = _weights((A @ x + rays.h * depth[track_of][:, None] - b) / size[:, None], scale * pixel)
    return x, depth, weight


def _up_to_scale(rays: _Rays, motion: _Motion, arms: Floats, pixel: float) -> tuple[Floats, Floats, Floats] | None:
    """Centres (K, 3) of one camera, the first at the origin, depths and weights, in a unit that makes the median depth 1."""
    of, anchor, track_of, count = rays.frame_of, rays.anchor, rays.track_of, len(rays.names)
    M = np.concatenate([motion.M[:, :, :6], (motion.alpha + arms - arms[0])[:, :, None]], axis=2)
    A = rays.B @ (M[of[anchor]] - M[of])
    b = np.zeros((len(of), 2))
    rows = M.reshape(-1, 7)
    N = rows.T @ rows
    N += 1e-9 * np.trace(N) * np.eye(7)
    depth, weight, y = np.ones(count), np.ones(len(of)), np.zeros(7)
    for scale in _ROUNDS:
        size = np.clip(np.abs(depth), _NEAR_SHARE, 1.0 / _NEAR_SHARE)[track_of]
        factor = weight / (pixel * size) ** 2
        H, _ = _reduced(A, rays.h, b, factor, track_of, count)
        y = scipy.linalg.eigh(H, N)[1][:, 0]
        depth = _depths(A, rays.h, b, factor, y, track_of, count)
        middle = float(np.median(depth))
        if not abs(middle) > 1e-9:
            return None
        y, depth = y / middle, depth / middle
        size = np.clip(np.abs(depth), _NEAR_SHARE, 1.0 / _NEAR_SHARE)[track_of]
        weight = _weights((A @ y + rays.h * depth[track_of][:, None]) / size[:, None], scale * pixel)
    return M @ y, depth, weight


def _aligned(centres: Floats, motion: _Motion, arms: Floats, prior: Floats, magnitude: float) -> tuple[float, Floats]:
    """The scale s and x that bring the camera's way and the IMU's together: s c_k = M_k x + α_k + R_k p_C − p_C."""
    size = len(motion.t)
    A = np.zeros((size, 3, 10))
    A[:, :, :9], A[:, :, 9] = motion.M, -centres
    b = -(motion.alpha + arms - arms[0])
    A, b = A[1:].reshape(-1, 10) / _WAY_STD, b[1:].ravel() / _WAY_STD
    H = A.T @ A
    H[:9, :9] += prior
    y = _with_gravity(H, A.T @ b, magnitude)
    return float(y[9]), y[:9]


def _weights(angle: Floats, scale: float) -> Floats:
    weight: Floats = (scale**2 / (scale**2 + (angle * angle).sum(axis=1))) ** 2
    return weight


def _reduced(A: Floats, h: Floats, b: Floats, factor: Floats, track_of: Integers, count: int) -> tuple[Floats, Floats]:
    """Normal equations of x, the depths eliminated."""
    size = A.shape[2]
    hh = np.bincount(track_of, factor * (h * h).sum(axis=1), count)
    hA, hb = np.zeros((count, size)), np.bincount(track_of, factor * (h * b).sum(axis=1), count)
    np.add.at(hA, track_of, factor[:, None] * (h[:, None, :] @ A)[:, 0])
    inverse = np.where(hh > 0.0, 1.0 / np.maximum(hh, 1e-300), 0.0)
    rows = (np.sqrt(factor)[:, None, None] * A).reshape(-1, size)
    H = rows.T @ rows - (hA * inverse[:, None]).T @ hA
    g = rows.T @ (np.sqrt(factor)[:, None] * b).ravel() - hA.T @ (inverse * hb)
    return H, g


def _depths(A: Floats, h: Floats, b: Floats, factor: Floats, x: Floats, track_of: Integers, count: int) -> Floats:
    hh = np.bincount(track_of, factor * (h * h).sum(axis=1), count)
    hr = np.bincount(track_of, factor * (h * (b - A @ x)).sum(axis=1), count)
    depths: Floats = np.where(hh > 0.0, hr / np.maximum(hh, 1e-300), _FARTHEST)
    return depths


def _with_gravity(H: Floats, g: Floats, magnitude: float) -> Floats:
    """The minimum over x, whose entries 3 to 5 are gravity of the magnitude given."""
    x: Floats = np.asarray(np.linalg.lstsq(H, g, rcond=None)[0], dtype=np.float64)
    free = np.zeros((len(x), len(x) - 1))
    free[:3, :3], free[6:, 5:] = np.eye(3), np.eye(len(x) - 6)
    for _ in range(_ON_SPHERE):
        # In the plane that touches the sphere at its direction now, and back on the sphere.
        direction = x[3:6] / np.linalg.norm(x[3:6])
        free[3:6, 3:5] = magnitude * sphere.tangent_basis(direction)
        fixed = np.zeros(len(x))
        fixed[3:6] = magnitude * direction
        x = np.asarray(
            fixed + free @ np.linalg.lstsq(free.T @ H @ free, free.T @ (g - H @ fixed), rcond=None)[0], dtype=np.float64
        )
        x[3:6] *= magnitude / np.linalg.norm(x[3:6])
    return x
