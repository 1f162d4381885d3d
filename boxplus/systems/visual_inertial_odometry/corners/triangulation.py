"""Parallax and depth: what several frames and cameras tell together about the place of corners."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.manifolds import quaternion
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks, shared_rows
from boxplus.systems.visual_inertial_odometry.rig import RigCamera

_MOST_SIGMAS = 5.0  # by which a view may differ from the point found
_RELATIVE, _ABSOLUTE = 0.3, 0.02  # of the standard deviation of ρ: of ρ, and in 1/m for points that are nearly at infinity
_RANGE = (-0.02, 5.0)  # 1/m
_LEAST_INFORMATION = 1e-18  # of a ray through the epipole

Floats = NDArray[np.float64]


def triangulate(
    rays: Floats, bodies: Floats, mountings: Floats, sigma: float
) -> tuple[NDArray[np.intp], Floats, NDArray[np.bool_]]:
    """The anchor of each corner, its inverse depth there, and whether to believe it.

    The anchor is the first frame whose first camera saw the corner. With m the ray there and (R, t) the pose of another camera
    against it, y ∝ R m + ρ t is linear in ρ; least squares over all views, weighted by what a pixel moves with ρ.

    Args:
        rays: (f, n, c, 3) of n corners in c cameras of f frames, [X/Z, Y/Z, 1]; NaN where not seen.
        bodies: (f, 7) T_world_imu, wxyz and xyz.
        mountings: (c, 7) T_imu_camera.
        sigma: standard deviation of a ray's x and y.

    Returns:
        (n,) frame, (n,) ρ [1/m], (n,) bool.
    """
    frames, count, cameras = rays.shape[:3]
    seen = np.isfinite(rays[..., 0])
    anchor = np.argmax(seen[:, :, 0], axis=0)
    anchored = np.asarray(seen[:, :, 0].any(axis=0))
    n = np.arange(count)
    R_c, p_c = quaternion.to_matrix(mountings[:, :4]), mountings[:, 4:]
    R_b, p_b = quaternion.to_matrix(bodies[:, :4]), bodies[:, 4:]
    R_w = np.einsum("fij,cjk->fcik", R_b, R_c)  # R_world_camera
    p_w = p_b[:, None] + np.einsum("fij,cj->fci", R_b, p_c)
    m_world = np.einsum("nij,nj->ni", R_w[anchor, 0], rays[anchor, n, 0])
    turned = np.einsum("fcji,nj->fnci", R_w, m_world)
    t = np.einsum("fcji,fncj->fnci", R_w, p_w[anchor, 0][None, :, None] - p_w[:, None])
    is_own = (np.arange(frames)[:, None] == anchor)[:, :, None] & (np.arange(cameras) == 0)
    used = seen & ~is_own & (np.arange(frames)[:, None] >= anchor)[:, :, None] & anchored[:, None]
    y = np.where(used[..., None], rays, 0.0)
    a = np.where(used[..., None], t[..., :2] - y[..., :2] * t[..., 2:], 0.0)
    b = np.where(used[..., None], y[..., :2] * turned[..., 2:] - turned[..., :2], 0.0)
    rho = np.zeros(count)
    square = np.ones(count)
    depth = np.where(used, turned[..., 2], 1.0)
    for _ in range(2):
        w = np.where(used, 1.0 / np.maximum(depth, 0.05) ** 2, 0.0)
        square = (w * (a * a).sum(axis=-1)).sum(axis=(0, 2))
        rho = (w * (a * b).sum(axis=-1)).sum(axis=(0, 2)) / np.maximum(square, 1e-12)
        depth = np.where(used, turned[..., 2] + rho[:, None] * t[..., 2], 1.0)
    rho_sigma = np.sqrt(2.0) * sigma / np.sqrt(np.maximum(square, 1e-12))
    off = np.linalg.norm(a * rho[:, None, None] - b, axis=-1) / np.maximum(depth, 0.05)
    fits = (np.where(used, off, 0.0) < _MOST_SIGMAS * sigma).all(axis=(0, 2)) & (depth > 0.05).all(axis=(0, 2))
    sharp = rho_sigma < np.maximum(_RELATIVE * rho, _ABSOLUTE)
    good: NDArray[np.bool_] = used.any(axis=(0, 2)) & fits & sharp & (rho > _RANGE[0]) & (rho < _RANGE[1])
    return anchor, rho, good


def mean_parallax(before: Tracks, now: Tracks, body_before: Floats, body_now: Floats, camera: RigCamera) -> float:
    """By how much corners moved in the first camera beside what its turning explains, in the mean [px]; infinite without any.

    Args:
        body_before, body_now: (7,) T_world_imu, of which only the attitude counts.
        camera: the first one of the rig.
    """
    then, there = shared_rows(before.ids, now.ids)
    if not len(there):
        return float("inf")
    R_before, R_now = (quaternion.to_matrix(body[:4]) @ camera.T_imu_camera[:3, :3] for body in (body_before, body_now))
    turned = before.rays[then, 0] @ (R_now.T @ R_before).T
    shift = (now.rays[there, 0, :2] - turned[:, :2] / turned[:, 2:]) * [camera.model.fx, camera.model.fy]
    return float(np.linalg.norm(shift, axis=1).mean())


def inverse_depths(turned: Floats, t: Floats, rays: Floats) -> tuple[Floats, Floats]:
    """Inverse depths in one camera from what a second one sees, and what they are known by.

    turned + ρ t points along y: turned_x + ρ t_x = y_x (turned_z + ρ t_z), and likewise for y; least squares of both.

    Args:
        turned: (n, 3) rays of the first camera in the axes of the second; t: (3,) the first one's place there.
        rays: (n, 3) y of the second camera, [X/Z, Y/Z, 1].

    Returns:
        (n,) ρ, in units of 1/|t|'s; (n,) its information for equations of unit variance, where turned_z is 1.
    """
    rho, information = np.empty((2, len(rays)))
    _intersect(*(np.ascontiguousarray(values) for values in (turned, t, rays)), rho, information)
    return rho, information


@kernel
def _intersect(turned: Floats, t: Floats, rays: Floats, rho: Floats, information: Floats) -> None:
    for k in range(len(rays)):
        a0, a1 = t[0] - rays[k, 0] * t[2], t[1] - rays[k, 1] * t[2]
        b0, b1 = rays[k, 0] * turned[k, 2] - turned[k, 0], rays[k, 1] * turned[k, 2] - turned[k, 1]
        square = a0 * a0 + a1 * a1
        information[k] = _LEAST_INFORMATION if square < _LEAST_INFORMATION else square
        rho[k] = (a0 * b0 + a1 * b1) / information[k]


def epipolar_distances(turned: Floats, t: Floats, rays: Floats) -> Floats:
    """How far (n,) rays of a second camera lie from the epipolar lines of those of the first, in units of the rays.

    (turned + ρ t) / z lies on the line through turned and t, to which n = t × turned is at right angles.

    Args:
        turned, t, rays: as for `inverse_depths`.
    """
    off = np.empty(len(rays))
    _measure(*(np.ascontiguousarray(values) for values in (turned, t, rays)), off)
    return off


@kernel
def _measure(turned: Floats, t: Floats, rays: Floats, off: Floats) -> None:
    for k in range(len(rays)):
        x, y, z = turned[k, 0], turned[k, 1], turned[k, 2]
        n0, n1, n2 = t[1] * z - t[2] * y, t[2] * x - t[0] * z, t[0] * y - t[1] * x
        off[k] = abs((n0 * rays[k, 0] + n1 * rays[k, 1]) + n2 * rays[k, 2]) / math.sqrt(n0 * n0 + n1 * n1)
