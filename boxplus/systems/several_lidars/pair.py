"""Where and when one LiDAR must be, so that it sees the surfaces another one has seen: point to plane, in seven unknowns.

A point p that the other LiDAR measured at time t by its clock lies in the world at w = T_world_first(t + δ) T_first_other p, on a
plane (n, c) the first LiDAR has seen: r = nᵀ(w − c). With T_first_other ⊞ (θ, ρ) = (R Exp(θ), p + ρ), m = R p + p_first_other
and the first LiDAR's turn rate ω (its own axes) and velocity v (the world's),

    ∂r/∂θ = −nᵀ R_world_first R [p]×,   ∂r/∂ρ = nᵀ R_world_first,   ∂r/∂δ = nᵀ (v + R_world_first (ω × m)).

Gauss-Newton with neighbours anew in every step (point-to-plane ICP: Chen and Medioni, 1992), from far to near.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.systems.several_lidars.motion import LidarMotion
from boxplus.systems.several_lidars.surfaces import Surfaces

_REACH_M = (3.0, 3.0, 2.0, 2.0, 1.2, 1.2, 0.8, 0.5, 0.5, 0.4, 0.4, 0.4)
"""How far a plane may be in each step; the last is repeated until nothing moves."""
_MOST_STEPS = 25
_SETTLED = 1e-4, 1e-3, 1e-4  # rad, m, s
_NEAR_M = 0.12  # off its plane, a point lies on it
_LEAST_SIGMA_M = 0.02
_PRIOR = np.array([0.5] * 3 + [1.0] * 3 + [0.5])  # rad, m, s: what is not measured stays where it was declared
_SHARED = 25.0  # how many points share an error of a plane: neighbours are not independent
_LATEST_S = 0.7
FEWEST_POINTS = 150


@dataclass(frozen=True, slots=True)
class PairFit:
    """Where the other LiDAR's points fit what the first one has seen.

    Attributes:
        T_first_other: (4, 4) float64, coordinates of the other LiDAR to those of the first.
        time_offset_s: to be added to the other's times [s].
        difference: (7,) from what was declared: rotation about the other's axes [rad], translation along the first's [m], and
            time [s].
        covariance: (7, 7) of it; wide along what the points do not determine.
        near: share of the points with a surface of the first LiDAR within 0.4 m.
        fitting: share of these that lie on it.
        points: that lie on a surface.
    """

    T_first_other: NDArray[np.float64]
    time_offset_s: float
    difference: NDArray[np.float64]
    covariance: NDArray[np.float64]
    near: float
    fitting: float
    points: int


def fit_pair(
    motion: LidarMotion,
    surfaces: Surfaces,
    p_other: NDArray[np.float64],
    time_ns: NDArray[np.int64],
    T_declared: NDArray[np.float64],
    T_begin: NDArray[np.float64] | None = None,
    offset_begin_s: float = 0.0,
) -> PairFit | None:
    """Fit the other LiDAR's pose on the first and its clock; None where too few points lie near a surface of the first.

    Args:
        motion: of the first LiDAR.
        surfaces: that it has seen, in the frame of its motion.
        p_other, time_ns: (N, 3) points in the other's frame [m], (N,) int64 by its clock.
        T_declared: (4, 4) T_first_other as declared.
        T_begin, offset_begin_s: where to begin; what is declared when not given.
    """
    T: NDArray[np.float64] = T_declared if T_begin is None else T_begin
    offset_s, seconds = offset_begin_s, (time_ns - motion.begin_ns).astype(np.float64) * 1e-9
    keep = (seconds > 0.0) & (seconds < motion.seconds)
    p, seconds = p_other[keep], seconds[keep]
    if len(p) < FEWEST_POINTS or not surfaces.count:
        return None
    sigma, settled = 0.5, False
    for step in range(_MOST_STEPS):
        reach = _REACH_M[min(step, len(_REACH_M) - 1)]
        found = _linearized(motion, surfaces, p, seconds, T, offset_s, reach)
        if found is None:
            return None
        J, r, has = found
        sigma = float(np.clip(1.4826 * np.median(np.abs(r)), _LEAST_SIGMA_M, 0.5))
        weight = 1.0 / (1.0 + (r / (2.0 * sigma)) ** 2) ** 2  # Geman-McClure
        from_declared = _difference(T, offset_s, T_declared)
        A = (J.T * weight) @ J / sigma**2 / _SHARED + np.diag(_PRIOR**-2)
        b = -(J.T @ (weight * r)) / sigma**2 / _SHARED - from_declared / _PRIOR**2
        delta = np.linalg.solve(A, b)
        T, offset_s = _moved(T, delta), float(np.clip(offset_s + delta[6], -_LATEST_S, _LATEST_S))
        sizes = np.linalg.norm(delta[:3]), np.linalg.norm(delta[3:6]), abs(delta[6])
        settled = step >= len(_REACH_M) and all(size < least for size, least in zip(sizes, _SETTLED, strict=True))
        if settled:
            break
    on = np.abs(r) < _NEAR_M
    return PairFit(
        T,
        offset_s,
        _difference(T, offset_s, T_declared),
        np.asarray(np.linalg.inv(A), np.float64),
        float(has.mean()),
        float(on.mean()) if len(on) else 0.0,
        int(on.sum()),
    )


def _linearized(
    motion: LidarMotion,
    surfaces: Surfaces,
    p: NDArray[np.float64],
    seconds: NDArray[np.float64],
    T: NDArray[np.float64],
    offset_s: float,
    reach_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]] | None:
    """Jacobian (M, 7) and residual (M,) [m] of the points with a plane within reach, and which these are (N,)."""
    at = np.clip(seconds + offset_s, 0.0, motion.seconds)
    R_world, p_world, rate, velocity = motion.at(at)
    m = p @ T[:3, :3].T + T[:3, 3]
    w = np.einsum("nij,nj->ni", R_world, m) + p_world
    has, normals, r = surfaces.beside(w, reach_m)
    if has.sum() < FEWEST_POINTS:
        return None
    n_first = np.einsum("nij,ni->nj", R_world[has], normals)
    n_other = n_first @ T[:3, :3]
    J = np.empty((len(r), 7))
    J[:, :3] = np.cross(p[has], n_other)
    J[:, 3:6] = n_first
    J[:, 6] = np.einsum("ij,ij->i", normals, velocity[has]) + np.einsum("ij,ij->i", n_first, np.cross(rate[has], m[has]))
    return J, r, has


def _moved(T: NDArray[np.float64], delta: NDArray[np.float64]) -> NDArray[np.float64]:
    moved = T.copy()
    moved[:3, :3] = T[:3, :3] @ so3.exp(delta[:3])
    moved[:3, 3] += delta[3:6]
    return moved


def _difference(T: NDArray[np.float64], offset_s: float, T_declared: NDArray[np.float64]) -> NDArray[np.float64]:
    """(7,) T ⊟ T_declared, and the time."""
    return np.concatenate([so3.log(T_declared[:3, :3].T @ T[:3, :3]), T[:3, 3] - T_declared[:3, 3], [offset_s]])
