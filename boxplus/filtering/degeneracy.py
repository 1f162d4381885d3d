"""Directions of the pose that a scan does not determine.

The information of points about the pose is S = Σ w h hᵀ, h = [s × C, u] with C = Rᵀu. The normals u come from
noisy points of the map. A row is linear in its normal, h = M u, so noise of the normals alone gives a direction the information

    N = Σ w M Cov(u) Mᵀ,      E[S] = S of the true normals + N

Along a corridor S is N, however many points there are. A direction v is measured when vᵀS v exceeds vᵀN v by a factor, the
threshold: the directions are those of the generalised eigenvalue problem S v = λ N v, and λ depends neither on the units of
rotation and translation nor on the number of points. In a weak direction the update is projected out and the filter keeps
its prediction. (Errors in variables: Fuller, Measurement Error Models, 1987, section 2.2; for degeneracy of a registration by
eigenvalues see Zhang, Kaess, Singh, ICRA 2016.)

In the others noise still has its share (`errors_in_variables`).

A plane counts in both the less, the less its normal is known (`plane_information`): planes across an edge are as good as
noise for the question, and would hide how well the others measure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.filtering.small_linalg import inverse_root_into, symmetric_eigen_into

# No normal is known better than this [rad]: edges of the world are not that straight, and N must not vanish.
_LEAST_TILT = 1e-3
_ENOUGH_POINTS = 2000  # for the threshold as it is set
_TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True, slots=True)
class PoseDirections:
    """Directions of the pose, by how far a scan's information about them exceeds what noise would give.

    Attributes:
        ratios: (6,) ascending, information over that from noise of the normals alone; 1 is noise.
        vectors: (6, 6), column i is the unit direction of `ratios[i]`: rotation (IMU axes, times `lever_arm`), then position.
        lever_arm: root mean square distance of the points from the IMU [m].
        weak: (6,) bool, ratio below the threshold.
        basis: (6, 6), the same directions over [θ, p], such that basisᵀ N basis = I.
    """

    ratios: NDArray[np.float64]
    vectors: NDArray[np.float64]
    lever_arm: float
    weak: NDArray[np.bool_]
    basis: NDArray[np.float64]

    @property
    def measured(self) -> NDArray[np.bool_]:
        """(6,) bool, left when noise is off: neither weak nor, with a threshold below 1, of a ratio of noise alone."""
        return ~self.weak & (self.ratios > 1.0)

    def weakened(self, weight: float = 0.0) -> NDArray[np.float64]:
        """(6, 6) what is left of a small motion [θ, p] with its share along the weak directions times `weight`.

        At 0 this is the projector Π = V_s V_sᵀ N onto the others, which are conjugate to the weak ones in N.
        """
        if not self.weak.any():
            return np.eye(6)
        left: NDArray[np.float64] = (self.basis * np.where(self.weak, weight, 1.0)) @ np.linalg.inv(self.basis)  # V⁻¹ is Vᵀ N
        return left

    def closest_to(self, axis: NDArray[np.float64]) -> int:
        """The direction closest to a shift along a unit `axis` (3,)."""
        return int(np.argmax(np.abs(axis @ self.vectors[3:])))

    def ratio_along(self, axis: NDArray[np.float64]) -> float:
        """The ratio of the direction closest to a shift along a unit `axis` (3,)."""
        return float(self.ratios[self.closest_to(axis)])


def threshold_for(threshold: float, points: int) -> float:
    """The least ratio of a measured direction in a scan of so many points, where 2000 points ask for `threshold`.

    The ratio of a direction that measures nothing scatters about 1 as if every tenth point had a normal of its own: by 0.1 where
    there are 2000 points, by 0.2 where there are 500. A threshold of 1 or less stays as it is.
    """
    return 1.0 + (threshold - 1.0) * max(math.sqrt(_ENOUGH_POINTS / max(points, 1)), 1.0) if threshold > 1.0 else threshold


def pose_directions(S: NDArray[np.float64], N: NDArray[np.float64], lever_arm: float, threshold: float) -> PoseDirections:
    """The directions of the pose that a scan's information distinguishes.

    Args:
        S: (6, 6) information about the pose [θ, p].
        N: (6, 6) what noise of the normals alone would contribute to it.
        lever_arm: root mean square distance of the points from the IMU [m].
        threshold: least ratio of S to N of a measured direction.
    """
    ratios, vectors, basis = np.empty(6), np.empty((6, 6)), np.empty((6, 6))
    if not _directions_into(S, N, lever_arm, ratios, vectors, basis):
        raise np.linalg.LinAlgError("the information of the normals' noise is not positive semidefinite")
    return PoseDirections(ratios, vectors, lever_arm, ratios < threshold, basis)


@kernel
def _directions_into(
    S: NDArray[np.float64],
    N: NDArray[np.float64],
    lever_arm: float,
    ratios: NDArray[np.float64],
    vectors: NDArray[np.float64],
    basis: NDArray[np.float64],
) -> bool:
    """The generalised eigenvalue problem, in units of the lever arm; False where N is no covariance's."""
    scale = np.ones(6)
    scale[:3] = 1.0 / lever_arm
    # The position rows carry unit normals: their trace is the sum of the weights.
    floor = max(_LEAST_TILT * _LEAST_TILT * (S[3, 3] + S[4, 4] + S[5, 5]), _TINY)
    noise, whitening = np.empty((6, 6)), np.empty((6, 6))  # their lower triangles
    for i in range(6):
        for j in range(i + 1):
            noise[i, j] = N[i, j] * scale[i] * scale[j] + (floor if i == j else 0.0)
    if not inverse_root_into(noise, whitening):
        return False
    half, white = np.empty((6, 6)), np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            half[i, j] = 0.0
            for k in range(i + 1):
                half[i, j] += whitening[i, k] * S[k, j] * scale[k] * scale[j]
    for i in range(6):
        for j in range(i + 1):
            white[i, j] = 0.0
            for k in range(j + 1):
                white[i, j] += half[i, k] * whitening[j, k]
            white[j, i] = white[i, j]
    rotated = noise
    symmetric_eigen_into(white, ratios, rotated)
    for j in range(6):
        norm = 0.0
        for i in range(6):
            vectors[i, j] = 0.0
            for k in range(i, 6):
                vectors[i, j] += whitening[k, i] * rotated[k, j]
            norm += vectors[i, j] * vectors[i, j]
            basis[i, j] = scale[i] * vectors[i, j]
        norm = math.sqrt(norm)
        for i in range(6):
            vectors[i, j] /= norm
    return True


def with_weak_axis(directions: PoseDirections, axis: NDArray[np.float64]) -> PoseDirections:
    """The same directions, the one closest to a shift along a unit `axis` (3,) of the position weak, whatever its ratio."""
    weak = directions.weak.copy()
    weak[directions.closest_to(axis)] = True
    return replace(directions, weak=weak)


def strong_step(A: NDArray[np.float64], b: NDArray[np.float64], directions: PoseDirections) -> NDArray[np.float64]:
    """The Gauss-Newton step (6,) of the pose alone, without the weak directions; zero if all are weak."""
    step: NDArray[np.float64] = -strong_covariance(A, directions) @ b[:6]
    return step


def strong_covariance(A: NDArray[np.float64], directions: PoseDirections) -> NDArray[np.float64]:
    """(6, 6) covariance of the pose from A alone, zero along the weak directions."""
    covariance = np.zeros((6, 6))
    if not _strong_covariance_into(np.ascontiguousarray(A[:6, :6]), directions.basis, directions.weak, covariance):
        raise np.linalg.LinAlgError("the information is zero along a direction that is not weak")
    return covariance


@kernel
def _strong_covariance_into(
    A: NDArray[np.float64], basis: NDArray[np.float64], weak: NDArray[np.bool_], covariance: NDArray[np.float64]
) -> bool:
    """V (Vᵀ A V)⁻¹ Vᵀ into zeros, all (6, 6), V the columns of `basis` that are not weak; False where there is no inverse."""
    strong, V = 0, np.empty((6, 6))
    for j in range(6):
        if not weak[j]:
            for i in range(6):
                V[i, strong] = basis[i, j]
            strong += 1
    system, half = np.empty((6, 12)), np.empty(6)  # Vᵀ A V, and beside it Vᵀ, which elimination makes (Vᵀ A V)⁻¹ Vᵀ
    for j in range(strong):
        for i in range(6):
            half[i] = 0.0
            for k in range(6):
                half[i] += A[i, k] * V[k, j]
            system[j, 6 + i] = V[i, j]
        for i in range(strong):
            system[i, j] = 0.0
            for k in range(6):
                system[i, j] += V[k, i] * half[k]
    for column in range(strong):
        pivot = column
        for row in range(column + 1, strong):
            if abs(system[row, column]) > abs(system[pivot, column]):
                pivot = row
        if system[pivot, column] == 0.0:
            return False
        for k in range(12):
            system[column, k], system[pivot, k] = system[pivot, k], system[column, k]
        for row in range(strong):
            if row != column:
                factor = system[row, column] / system[column, column]
                for k in range(column, 12):
                    system[row, k] -= factor * system[column, k]
    for i in range(6):
        for j in range(6):
            for k in range(strong):
                covariance[i, j] += V[i, k] * system[k, 6 + j] / system[k, k]
    return True
