"""The covariance of a pose against the start of a run, when the map is made from the estimates themselves.

The filter measures the pose against the map and takes the map for exact: its covariance P is that of the pose relative to
the *local map*. The map has been placed by earlier estimates and shares their errors, which no later scan can see. Both are
followed here to first order, with the gain the filter has used (a consider or Schmidt filter, Jazwinski 1970, section 8.4):

    e ← (I − G)(e + w) + G (d + v)        pose error after a scan; G = P Aₓ, Aₓ the scan's information about the pose
    d ← (1 − f) d + f (e + n)             datum error of the map; f, the share of the local map that the scan has brought

w is the IMU's noise over the scan (prior minus last posterior covariance of the filter), v that of the points (K R Kᵀ =
P A P), and n that of the map points: f N points, if N are compared in a scan, place what they bring as badly as a scan
of theirs would be placed, with f n of covariance f A⁻¹. With d = 0, e has the covariance of the filter.

Points that lie on one surface share what is wrong with it, and say less than as many independent ones would: v and n can be
counted several times for that.

What two poses share is in neither of them against the other. Both equations stay as they are when the same motion is taken off e
and d: with the error e₀ of an earlier pose off both, they give the covariance of e − e₀, beginning with 0 and d − e₀.

The local map is what has been taken in within about one lever arm of the points: what lies farther back is not compared any more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.degeneracy import PoseDirections, strong_covariance
from boxplus.filtering.nav_state import MEASURED, P, R

_FIRST, _MARKED = 0, 1  # the pose that errors are counted against
_POSE = slice(0, 6)
_MAP = slice(6, 12)


@dataclass(frozen=True, slots=True)
class Correction:
    """What a scan has done to the pose.

    Attributes:
        gain: (6, 6) G, how the pose follows a shift of the scan against the map.
        noise: (6, 6) covariance of the pose from the noise of the points.
        alone: (6, 6) covariance of the pose from the points alone, zero along directions they do not determine.
        lever_arm: root mean square distance of the points [m].
    """

    gain: NDArray[np.float64]
    noise: NDArray[np.float64]
    alone: NDArray[np.float64]
    lever_arm: float

    @classmethod
    def of(cls, cov: NDArray[np.float64], A: NDArray[np.float64], directions: PoseDirections) -> Correction:
        """Of a filter.

        Args:
            cov: (24, 24) after the scan.
            A: (12, 12) information of the scan as the filter took it, with the directions of the pose it determines.
        """
        gain = cov[_POSE][:, MEASURED] @ A
        return cls(gain[:, _POSE], gain @ cov[MEASURED][:, _POSE], strong_covariance(A, directions), directions.lever_arm)


class MapDatum:
    """Joint covariance (12, 12) of the errors of pose and map, as small motions about the IMU: [θ, p] along the world's axes.

    Twice: against the first pose, and against the one that was marked last.

    Args:
        x: (36,) first state; cov: (24, 24) its covariance. The first scan makes the map at this pose.
        shared_errors: how many times the covariance of a scan counts, since its points are not independent.
    """

    def __init__(self, x: NDArray[np.float64], cov: NDArray[np.float64], shared_errors: float = 1.0) -> None:
        self._shared = shared_errors
        self._filter = _along_world(cov[_POSE, _POSE], x)
        self._joint = np.zeros((2, 12, 12))
        self._joint[_FIRST, _POSE, _POSE] = self._filter
        self._p_world_imu = x[P : P + 3].copy()
        self._local_points = 0.0
        self._new_share = 0.0

    def follow(
        self,
        x: NDArray[np.float64],
        cov_prior: NDArray[np.float64],
        cov: NDArray[np.float64],
        correction: Correction | None = None,
    ) -> None:
        """The filter has gone on by a scan.

        Args:
            x: (36,) posterior; cov_prior, cov: (n, n), covariance of the filter before and after the scan, the pose first.
            correction: by the scan; None if the filter took none.
        """
        shift = x[P : P + 3] - self._p_world_imu
        move = np.eye(6)  # a small motion about the last position, as one about this position
        move[3:, :3] = [[0.0, shift[2], -shift[1]], [-shift[2], 0.0, shift[0]], [shift[1], -shift[0], 0.0]]
        both = np.kron(np.eye(2), move)
        joint = both @ self._joint @ both.T
        prior = _along_world(cov_prior[_POSE, _POSE], x)
        joint[:, _POSE, _POSE] += positive_part(prior - move @ self._filter @ move.T)
        if correction is not None:
            joint[:, _MAP, _MAP] += self._shared * self._new_share * _along_world(correction.alone, x)
            self._new_share = 0.0
            self._local_points *= math.exp(-float(np.linalg.norm(shift)) / correction.lever_arm)
            step = np.eye(12)
            step[_POSE, _MAP] = _along_world(correction.gain, x)
            step[_POSE, _POSE] -= step[_POSE, _MAP]
            joint = step @ joint @ step.T
            joint[:, _POSE, _POSE] += self._shared * _along_world(correction.noise, x)
        self._joint, self._filter, self._p_world_imu = joint, _along_world(cov[_POSE, _POSE], x), x[P : P + 3].copy()

    def insert(self, points: int) -> None:
        """The map has taken in so many points of the scan."""
        self._local_points += points
        self._new_share = points / self._local_points if points else 0.0
        step = np.eye(12)
        step[_MAP, _MAP] *= 1.0 - self._new_share
        step[_MAP, _POSE] = self._new_share * np.eye(6)
        self._joint = step @ self._joint @ step.T

    def widen(self, excess: NDArray[np.float64], x: NDArray[np.float64]) -> None:
        """An error of covariance (6, 6), [θ about the IMU's axes, p along the world's], that pose and map share at x (36,)."""
        self._joint += np.kron(np.ones((2, 2)), _along_world(excess, x))

    def mark(self) -> None:
        """Count `covariance_since_mark` against the present pose from now on."""
        step = np.eye(12)
        step[_POSE, _POSE] = 0.0
        step[_MAP, _POSE] = -np.eye(6)
        self._joint[_MARKED] = step @ self._joint[_MARKED] @ step.T

    def pose_covariance(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(6, 6) covariance of the pose at x (36,) against the first pose: [θ about the IMU's axes, p along the world's]."""
        return _turned(self._joint[_FIRST, _POSE, _POSE], x[R : R + 9].reshape(3, 3).T)

    def covariance_since_mark(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(6, 6) covariance of the pose at x (36,) against the one marked last (the first one before any), likewise.

        Of the motion e − e₀ about the present position, e₀ what the error of the marked pose moves there: a heading that is off
        since long before is in neither the turn nor the way between the two.
        """
        return _turned(self._joint[_MARKED, _POSE, _POSE], x[R : R + 9].reshape(3, 3).T)


def _along_world(M: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """A (6, 6) over [θ about the IMU's axes, p], with θ about the world's."""
    return _turned(M, x[R : R + 9].reshape(3, 3))


def _turned(M: NDArray[np.float64], rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    turned = M.copy()
    turned[:3] = rotation @ turned[:3]
    turned[:, :3] = turned[:, :3] @ rotation.T
    return turned


def positive_part(M: NDArray[np.float64]) -> NDArray[np.float64]:
    """The positive semidefinite part of a symmetric matrix."""
    values, vectors = np.linalg.eigh(M)
    positive: NDArray[np.float64] = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return positive
