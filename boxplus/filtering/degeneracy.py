"""Directions of the pose that a scan does not determine, and the update without them.

The information of points about the pose is S = Σ w h hᵀ, h = [s × C, u] with C = Rᵀu. The normals u come from
noisy points of the map. A row is linear in its normal, h = M u, so noise of the normals alone gives a direction the information

    N = Σ w M Cov(u) Mᵀ,      E[S] = S of the true normals + N

Along a corridor S is N, however many points there are. A direction v is measured when vᵀS v exceeds vᵀN v by a factor, the
threshold: the directions are those of the generalised eigenvalue problem S v = λ N v, and λ depends neither on the units of
rotation and translation nor on the number of points. In a weak direction the update is projected out and the filter keeps
its prediction. (Errors in variables: Fuller, Measurement Error Models, 1987, section 2.2; for degeneracy of a registration by
eigenvalues see Zhang, Kaess, Singh, ICRA 2016.)

A plane counts in both the less, the less its normal is known (`plane_information`): planes across an edge are as good as
noise for the question, and would hide how well the others measure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

# No normal is known better than this [rad]: edges of the world are not that straight, and N must not vanish.
_LEAST_TILT = 1e-3


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

    def weakened(self, weight: float = 0.0) -> NDArray[np.float64]:
        """(6, 6) what is left of a small motion [θ, p] with its share along the weak directions times `weight`.

        At 0 this is the projector Π = V_s V_sᵀ N onto the others, which are conjugate to the weak ones in N.
        """
        if not self.weak.any():
            return np.eye(6)
        # The inverse of V is Vᵀ N.
        left: NDArray[np.float64] = (self.basis * np.where(self.weak, weight, 1.0)) @ np.linalg.inv(self.basis)
        return left

    def closest_to(self, axis: NDArray[np.float64]) -> int:
        """The direction closest to a shift along a unit `axis` (3,)."""
        return int(np.argmax(np.abs(axis @ self.vectors[3:])))

    def ratio_along(self, axis: NDArray[np.float64]) -> float:
        """The ratio of the direction closest to a shift along a unit `axis` (3,)."""
        return float(self.ratios[self.closest_to(axis)])


def pose_directions(S: NDArray[np.float64], N: NDArray[np.float64], lever_arm: float, threshold: float) -> PoseDirections:
    """The directions of the pose that a scan's information distinguishes.

    Args:
        S: (6, 6) information about the pose [θ, p].
        N: (6, 6) what noise of the normals alone would contribute to it.
        lever_arm: root mean square distance of the points from the IMU [m].
        threshold: least ratio of S to N of a measured direction.
    """
    scale = np.array([1.0 / lever_arm] * 3 + [1.0] * 3)
    scales = np.outer(scale, scale)
    # The position rows carry unit normals: their trace is the sum of the weights.
    floor = max(_LEAST_TILT**2 * float(np.trace(S[3:6, 3:6])), np.finfo(float).tiny)
    root = np.linalg.cholesky(N * scales + floor * np.eye(6))
    whitening = np.linalg.inv(root)
    ratios, rotated = np.linalg.eigh(whitening @ (S * scales) @ whitening.T)
    scaled = whitening.T @ rotated
    vectors = scaled / np.linalg.norm(scaled, axis=0)
    return PoseDirections(ratios, vectors, lever_arm, ratios < threshold, scale[:, None] * scaled)


def with_weak_axis(directions: PoseDirections, axis: NDArray[np.float64]) -> PoseDirections:
    """The same directions, the one closest to a shift along a unit `axis` (3,) of the position weak, whatever its ratio."""
    weak = directions.weak.copy()
    weak[directions.closest_to(axis)] = True
    return replace(directions, weak=weak)


def project_out_weak(
    A: NDArray[np.float64], b: NDArray[np.float64], directions: PoseDirections
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A and b without what they claim about the weak directions of the pose; what they say of the others stays whole.

    With the projector Π of `PoseDirections.weakened`: ΠᵀAΠ, Πᵀb.
    """
    if not directions.weak.any():
        return A, b
    projector = np.eye(12)
    projector[:6, :6] = directions.weakened()
    return projector.T @ A @ projector, projector.T @ b


def strong_step(A: NDArray[np.float64], b: NDArray[np.float64], directions: PoseDirections) -> NDArray[np.float64]:
    """The Gauss-Newton step (6,) of the pose alone, without the weak directions; zero if all are weak."""
    step: NDArray[np.float64] = -strong_covariance(A, directions) @ b[:6]
    return step


def strong_covariance(A: NDArray[np.float64], directions: PoseDirections) -> NDArray[np.float64]:
    """(6, 6) covariance of the pose from A alone, zero along the weak directions."""
    strong = directions.basis[:, ~directions.weak]
    reduced = strong.T @ A[:6, :6] @ strong
    covariance: NDArray[np.float64] = strong @ np.linalg.solve(reduced, strong.T)
    return covariance
