"""What the odometry says of the pose of one local map in another, with covariance."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.maps.local_maps.local_map import Floats, LocalMap, relative_covariance

_START = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


class RelativePoses(Protocol):
    """Something that knows the pose of one local map in another."""

    def between(self, a: int, b: int) -> tuple[Floats, Floats]:
        """T_a_b (7,) and its covariance (6, 6) on the right."""


class OdometryChain:
    """Poses of local maps along the odometry, and their covariances P against the first.

    Errors on the right compose as P ← Ad(Z⁻¹) P Ad(Z⁻¹)ᵀ + Q along steps Z with covariance Q; between two maps a before b it is
    P_b − Ad P_a Adᵀ, which needs no walk along the steps between (docs/slam.md).
    """

    def __init__(self) -> None:
        self.poses: list[Floats] = []
        self._covariances: list[Floats] = []

    def __len__(self) -> int:
        return len(self.poses)

    def add(self, local_map: LocalMap) -> None:
        """The next local map."""
        if not self.poses:
            self._covariances.append(np.zeros((6, 6)))
        else:
            Ad = se3.adjoint(se3.compose(se3.inverse(local_map.T_odo_map), self.poses[-1]))
            self._covariances.append(Ad @ self._covariances[-1] @ Ad.T + local_map.covariance)
        self.poses.append(local_map.T_odo_map)

    def between(self, a: int, b: int) -> tuple[Floats, Floats]:
        """T_a_b (7,) and its covariance (6, 6) on the right, for maps in either order."""
        T = se3.compose(se3.inverse(self.poses[a]), self.poses[b])
        if a == b:
            return _START.copy(), np.zeros((6, 6))
        if a < b:
            return T, relative_covariance(self._covariances[a], self._covariances[b], T)
        # T_a_b = T_b_a⁻¹, whose error on the right is −Ad(T_b_a) ξ.
        T_ba, covariance = self.between(b, a)
        Ad = se3.adjoint(T_ba)
        return T, Ad @ covariance @ Ad.T


def mahalanobis(xi: Floats, covariance: Floats) -> float:
    """√(ξᵀ Σ⁻¹ ξ)."""
    return math.sqrt(max(float(xi @ np.linalg.solve(covariance, xi)), 0.0))


def symmetric(matrix: NDArray[np.float64]) -> Floats:
    """The symmetric part."""
    return 0.5 * (matrix + matrix.T)
