"""By what factor the lengths of a target are longer than those of a source that lies in it.

Beside the pose of a registration a seventh number is solved for: p goes to T (m + s (p − m)), with m the middle of the points.
Along log s a residual e = uᵀ(T p − q) changes by uᵀR (p − m). Ranges may all be off by the same few centimetres, which data
sheets allow; along such an offset it changes by uᵀR p/|p|. What is left of the information of log s when pose and offset are
eliminated, over the weight of the points, is the square of a lever: by so many metres surfaces close in from all sides, beyond
what an offset does as well. Where they stand on one side only, or all as far away, there is no lever.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion, se3
from boxplus.maps.local_maps.config import LocalMapRegistrationConfig
from boxplus.maps.local_maps.registration import (
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

_BLUNT = (0.25, 0.1, 0.0)  # of the distance, least scale of the residuals at each step: far surfaces are off at first
_FAR = 0.1  # of log s: maps that are followed do not differ by as much, and what says so knows nothing
_LEAST_OFFSET = 1e-6  # of the weight: less information on an offset is rounding, and the pose does all that one does


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
        middle = p.mean(axis=0)
        lever = max(float(np.sqrt(((p - middle) ** 2).sum(axis=1).mean())), 1.0)  # of turns about the middle [m]
        ways = _ways(p, p - middle, lever)
        normals = planes[valid, :3] @ quaternion.to_matrix(T[:4])
        columns = np.einsum("nka,na->nk", ways, normals)
        nuisances = _nuisances(columns, weight, planes[valid], config)
        outwards = columns[:, 7]
        others = nuisances @ (weight * outwards)
        along = outwards - columns[:, :7] @ others
        information = float(along @ (weight * along))
        # As of a direction of the pose: normals that noise tilts seem to see along a wall how far it reaches.
        way = ways[:, 7] - np.einsum("nka,k->na", ways[:, :7], others)
        told = information - NOISE * float((weight * planes[valid, 4]) @ (way**2).sum(axis=1))
        if not told > 0.0:
            return None
        sigma = scale / np.sqrt(told / weight.sum())
        step = float(np.clip(-float(along @ (weight * e)) / information, -0.5 * _FAR, 0.5 * _FAR))
        log_ratio += step
        if not abs(log_ratio) < _FAR:
            return None
        # The offset stays in the residuals: each step finds all of it anew.
        xi = -(nuisances @ (weight * (e + outwards * step)))[:6]
        xi[:3] /= lever
        xi[3:] += np.cross(middle, xi[:3])
        T = se3.compose(T, se3.exp(xi))
        T = se3.compose(T, np.r_[1.0, 0.0, 0.0, 0.0, middle - np.exp(step) * middle])
    return Lengths(log_ratio, float(sigma)) if sigma < _FAR else None


def _ways(p: Floats, arm: Floats, lever: float) -> Floats:
    """(N, 8, 3) of points (N, 3): along a turn about their middle times the lever, a shift, an offset of ranges, and log s.

    Args:
        arm: (N, 3) from the middle to the points.
    """
    ways = np.zeros((len(p), 8, 3))
    for axis, unit in enumerate(np.eye(3)):
        ways[:, axis] = np.cross(unit, arm) / lever
        ways[:, 3 + axis] = unit
    ways[:, 6] = p / np.maximum(np.linalg.norm(p, axis=1), 1e-3)[:, None]
    ways[:, 7] = arm
    return ways


def _nuisances(columns: Floats, weight: Floats, planes: Floats, config: LocalMapRegistrationConfig) -> Floats:
    """(7, N) of columns (N, 8): what gives the step of pose and offset from weighted residuals, where surfaces tell of it."""
    J, offset = columns[:, :6], columns[:, 6]
    values, vectors = np.linalg.eigh(J.T @ (J * weight[:, None]))
    good = has_information(values, weight, planes, config)
    V = vectors[:, good]
    pose = (V / values[good]) @ V.T @ J.T
    by_pose = pose @ (weight * offset)
    own = offset - J @ by_pose
    information = float(own @ (weight * own))
    row = own / information if information > _LEAST_OFFSET * weight.sum() else np.zeros_like(own)
    return np.vstack([pose - np.outer(by_pose, row), row])
