"""Heading and place of a map on the Earth from paths: by the pairs of fixes most others agree with, whatever the rest says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_PAIRS = 400
_SEED = 901
_FAR = 0.3  # of the extent, the least distance between the two fixes of a pair
_REFITS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """A turn about the vertical and a shift, from a level map to east, north and up.

    Attributes:
        yaw: [rad]. shift: (3,) [m].
        inliers: (N,) fixes within their tolerance on the ground.
        scale: of the path of the fixes against the odometry's, by those that fit.
        cost: mean over the fixes of (distance/tolerance)², 1 at most: 0 where all fit, 1 where none does.
    """

    yaw: float
    shift: Floats
    inliers: NDArray[np.bool_]
    scale: float
    cost: float

    @property
    def share(self) -> float:
        """Of the fixes that fit."""
        return float(self.inliers.mean())


def extent_of(p: Floats) -> float:
    """Diameter of positions (N, 2 or 3) on the ground [m]; within a factor √2 of it."""
    return float(np.linalg.norm(np.ptp(p[:, :2], axis=0)))


def find_start(p_level: Floats, p_enu: Floats, tolerance: Floats) -> Start | None:
    """The heading and shift most fixes agree with (RANSAC over pairs of fixes far from each other), refitted to those.

    Args:
        p_level: (N, 3) antenna by the odometry, z up. p_enu: (N, 3) by the receiver. tolerance: (N,) [m].

    Returns:
        None where no pair is far apart, or as far apart in one as in the other.
    """
    count = len(p_level)
    if count < 2:
        return None
    random = np.random.Generator(np.random.PCG64(_SEED))
    i, j = random.integers(0, count, (2, 4 * _PAIRS))
    a, b = p_level[j, :2] - p_level[i, :2], p_enu[j, :2] - p_enu[i, :2]
    length, measured = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    fits = (length > _FAR * extent_of(p_level)) & (length > 0.0) & (np.abs(length - measured) < tolerance[i] + tolerance[j])
    chosen = np.flatnonzero(fits)[:_PAIRS]
    if not len(chosen):
        return None
    yaw = np.arctan2(b[chosen, 1], b[chosen, 0]) - np.arctan2(a[chosen, 1], a[chosen, 0])
    ends = 0.5 * (p_level[i[chosen], :2] + p_level[j[chosen], :2]), 0.5 * (p_enu[i[chosen], :2] + p_enu[j[chosen], :2])
    best, best_cost = 0, np.inf
    for k, angle in enumerate(yaw):
        cost = _cost(_turned(p_level[:, :2] - ends[0][k], angle) + ends[1][k] - p_enu[:, :2], tolerance)
        if cost < best_cost:
            best, best_cost = k, cost
    angle, shift = float(yaw[best]), ends[1][best] - _turned(ends[0][best][None], float(yaw[best]))[0]
    for _ in range(_REFITS):
        near = _near(p_level, p_enu, angle, shift, tolerance)
        if near.sum() >= 2:
            angle, shift = _fitted(p_level[near, :2], p_enu[near, :2], 1.0 / tolerance[near] ** 2)
    inliers = _near(p_level, p_enu, angle, shift, tolerance)
    errors = _turned(p_level[:, :2], angle) + shift - p_enu[:, :2]
    up = np.median((p_enu - p_level)[inliers if inliers.any() else slice(None), 2])
    scale = _scale(_turned(p_level[inliers, :2], angle), p_enu[inliers, :2]) if inliers.sum() > 1 else 0.0
    return Start(angle, np.array([*shift, up]), inliers, scale, _cost(errors, tolerance))


def _scale(p: Floats, q: Floats) -> float:
    a, b = p - p.mean(axis=0), q - q.mean(axis=0)
    return float((a * b).sum() / max(float((a * a).sum()), 1e-12))


def _cost(errors: Floats, tolerance: Floats) -> float:
    return float(np.minimum((errors**2).sum(axis=1) / tolerance**2, 1.0).mean())


def _near(p_level: Floats, p_enu: Floats, angle: float, shift: Floats, tolerance: Floats) -> NDArray[np.bool_]:
    errors = _turned(p_level[:, :2], angle) + shift - p_enu[:, :2]
    return np.asarray(np.linalg.norm(errors, axis=1) <= tolerance)


def _turned(p: Floats, angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(p @ np.array([[c, s], [-s, c]]))


def _fitted(p: Floats, q: Floats, weights: Floats) -> tuple[float, Floats]:
    """Least squares: yaw = atan2(Σ w p × q, Σ w p · q) about the means."""
    w = weights / weights.sum()
    mean_p, mean_q = w @ p, w @ q
    a, b = p - mean_p, q - mean_q
    angle = float(np.arctan2(w @ (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), w @ (a * b).sum(axis=1)))
    return angle, mean_q - _turned(mean_p[None], angle)[0]
