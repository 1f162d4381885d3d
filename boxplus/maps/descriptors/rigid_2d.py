"""The rigid motion of the plane that most matched points agree on (RANSAC with a seeded generator).

Source: Fischler and Bolles, Random Sample Consensus, CACM 1981; the motion between two point sets: Umeyama, PAMI 1991, in the
plane and without scale, where yaw = atan2(Σ p × q, Σ p · q) of the points about their means.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel

Floats = NDArray[np.float64]

_SAMPLES = 1000  # pairs of matches tried; all of them where there are fewer
_SAME_LENGTH = 2.0  # inlier distances by which the two lengths of a sampled pair differ at most


@dataclass(frozen=True, slots=True, eq=False)
class RigidMotion2D:
    """q = R(yaw) p + t for most of the matches.

    Attributes:
        yaw: [rad]; t: (2,) [m].
        inliers: (M,) matches that it explains.
    """

    yaw: float
    t: Floats
    inliers: NDArray[np.bool_]


def find_rigid_motion(p: Floats, q: Floats, inlier_distance: float, seed: int = 0) -> RigidMotion2D | None:
    """The motion that takes most of points p (M, 2) to within `inlier_distance` [m] of q (M, 2); None where fewer than 2 agree.

    The same seed and matches give the same motion.
    """
    count = len(p)
    if count < 2:
        return None
    every = count * (count - 1) // 2
    if every <= _SAMPLES:
        first, second = np.triu_indices(count, 1)
    else:
        random = np.random.Generator(np.random.PCG64(seed))
        first = random.integers(count, size=_SAMPLES)
        second = (first + random.integers(1, count, size=_SAMPLES)) % count
    motion = np.zeros(3)
    best = _best_of(p, q, first.astype(np.int64), second.astype(np.int64), inlier_distance, motion)
    if best < 2:
        return None
    for _ in range(2):  # to the least squares of its inliers, and again
        inliers = _explained(p, q, motion, inlier_distance)
        if np.count_nonzero(inliers) < 2:
            break
        motion = _fit(p[inliers], q[inliers])
    return RigidMotion2D(float(motion[0]), motion[1:], _explained(p, q, motion, inlier_distance))


def _explained(p: Floats, q: Floats, motion: Floats, inlier_distance: float) -> NDArray[np.bool_]:
    c, s = math.cos(motion[0]), math.sin(motion[0])
    moved = p @ np.array([[c, s], [-s, c]]) + motion[1:]
    return np.asarray(((moved - q) ** 2).sum(axis=1) <= inlier_distance**2)


def _fit(p: Floats, q: Floats) -> Floats:
    p_mean, q_mean = p.mean(axis=0), q.mean(axis=0)
    a, b = p - p_mean, q - q_mean
    yaw = math.atan2(float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()), float((a * b).sum()))
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([yaw, *(q_mean - np.array([[c, -s], [s, c]]) @ p_mean)])


@kernel
def _best_of(
    p: Floats, q: Floats, first: NDArray[np.int64], second: NDArray[np.int64], inlier_distance: float, motion: Floats
) -> int:
    """Writes the motion [yaw, x, y] of the pair that most matches agree with; returns how many, 0 where no pair fits itself."""
    best = 0
    limit = inlier_distance * inlier_distance
    for n in range(np.uint64(len(first))):
        i, j = first[n], second[n]
        ax, ay, bx, by = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], q[j, 0] - q[i, 0], q[j, 1] - q[i, 1]
        a, b = math.hypot(ax, ay), math.hypot(bx, by)
        # Two points near each other say nothing of the yaw.
        if abs(a - b) > _SAME_LENGTH * inlier_distance or a < 4.0 * inlier_distance:
            continue
        yaw = math.atan2(ax * by - ay * bx, ax * bx + ay * by)
        c, s = math.cos(yaw), math.sin(yaw)
        mx, my = 0.5 * (p[i, 0] + p[j, 0]), 0.5 * (p[i, 1] + p[j, 1])
        tx = 0.5 * (q[i, 0] + q[j, 0]) - (c * mx - s * my)
        ty = 0.5 * (q[i, 1] + q[j, 1]) - (s * mx + c * my)
        count = 0
        for m in range(np.uint64(len(p))):
            dx = c * p[m, 0] - s * p[m, 1] + tx - q[m, 0]
            dy = s * p[m, 0] + c * p[m, 1] + ty - q[m, 1]
            if dx * dx + dy * dy <= limit:
                count += 1
        if count > best:
            best = count
            motion[0], motion[1], motion[2] = yaw, tx, ty
    return best
