"""By what factor the lengths of a target are longer than those of a source that lies in it.

Beside the pose of a registration a seventh number is solved for: p goes to T (m + s (p − m)), with m the middle of the points.
Along log s a residual e = uᵀ(T p − q) changes by uᵀR (p − m). What is left of its information when the pose is eliminated, over
the weight of the points, is the square of a lever: by so many metres surfaces close in from all sides. Where they stand on one
side only, a scale is a shift, and there is no lever.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion, se3
from boxplus.systems.slam.config import LocalMapRegistrationConfig
from boxplus.systems.slam.registration import (
    FEWEST_ON_PLANES,
    LEAST_RESIDUAL_SCALE,
    NOISE,
    Surface,
    has_information,
    planes_beside,
    residual_scale,
    residual_weights,
)

Floats = NDArray[np.float64]

_BLUNT = (0.25, 0.25, 0.1, 0.0, 0.0)  # of the distance, least scale of the residuals at each step: far surfaces are off at first


@dataclass(frozen=True, slots=True)
class Lengths:
    """What a scan says of the lengths of a map.

    Attributes:
        log_ratio: logarithm of the map's lengths over those of the scan.
        sigma: its standard deviation, as if all surfaces of the map shared one error of the size of the residuals' spread.
    """

    log_ratio: float
    sigma: float


def compare_lengths(
    points: NDArray[np.float32],
    target: Surface,
    T_target_source: Floats,
    config: LocalMapRegistrationConfig,
    *,
    distance: float,
) -> Lengths | None:
    """The lengths of a target against those of points that lie in it; None where too few find a plane, or none tell.

    Args:
        points: (N, 3) float32 of the source [m].
        T_target_source: (7,) where they were registered.
        distance: of a plane's points, at most [m].
    """
    T, log_ratio, sigma = np.array(T_target_source, dtype=np.float64), 0.0, np.inf
    for blunt in _BLUNT:
        scaled = (np.exp(log_ratio) * points).astype(np.float32)
        planes, valid = planes_beside(scaled, target, T, distance, config)
        if np.count_nonzero(valid) < FEWEST_ON_PLANES:
            return None
        p, e = scaled[valid].astype(np.float64), planes[valid, 3]
        scale = residual_scale(e, max(blunt * distance, LEAST_RESIDUAL_SCALE))
        weight = residual_weights(e, scale)
        along, information, pose = _along_scale(p, planes[valid], T, weight, config)
        middle = p.mean(axis=0)
        # As of a direction of the pose: normals that noise tilts seem to see along a wall how far it reaches.
        told = information - NOISE * float((weight * planes[valid, 4]) @ ((p - middle) ** 2).sum(axis=1))
        if not told > 0.0:
            return None
        step = -float(along @ (weight * e)) / information
        log_ratio += step
        sigma = scale / np.sqrt(told / weight.sum())
        xi = -pose @ (weight * (e + _outwards(p, planes[valid], T) * step))
        T = se3.compose(T, se3.exp(xi))
        T = se3.compose(T, np.r_[1.0, 0.0, 0.0, 0.0, middle - np.exp(step) * middle])
    return Lengths(log_ratio, float(sigma))


def _outwards(p: Floats, planes: Floats, T: Floats) -> Floats:
    """(N,) derivative of the residuals along log s."""
    normals = planes[:, :3] @ quaternion.to_matrix(T[:4])
    return np.asarray(np.einsum("na,na->n", normals, p - p.mean(axis=0)))


def _along_scale(
    p: Floats, planes: Floats, T: Floats, weight: Floats, config: LocalMapRegistrationConfig
) -> tuple[Floats, float, Floats]:
    """(N,) derivative along log s without what the pose does as well; its information; (6, N) what gives the pose's step."""
    middle = p.mean(axis=0)
    normals = planes[:, :3] @ quaternion.to_matrix(T[:4])
    J = np.hstack([np.cross(p - middle, normals), normals])
    lever = max(float(np.sqrt(((p - middle) ** 2).sum(axis=1).mean())), 1.0)
    J[:, :3] /= lever
    values, vectors = np.linalg.eigh(J.T @ (J * weight[:, None]))
    good = has_information(values, weight, planes, config)
    V = vectors[:, good]
    pose = (V / values[good]) @ V.T @ J.T
    outwards = _outwards(p, planes, T)
    along = outwards - (pose @ (weight * outwards)) @ J.T
    # [lever w, v'] about the middle to [w, v] about the origin.
    x, y, z = middle
    A = np.eye(6)
    A[:3, :3] /= lever
    A[3:, :3] = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) / lever
    return along, float(along @ (weight * along)), A @ pose
