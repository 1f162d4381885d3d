"""Reprojection error of a camera whose intrinsics are tied: one focal length for both axes, a principal point that is held.

The intrinsics c of `reprojection_intrinsics` are an affine function of fewer numbers q,

    c = c₀ + B q,    ∂e/∂q = ∂e/∂c B,

so that nothing but the numbers that are really free is estimated. B has full rank. Pose and point as in
`reprojection_intrinsics`; singular cases too.

Source: docs/cameras.md and docs/residuals/reprojection.md.
"""

from __future__ import annotations

from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_floats
from boxplus.cameras.model import CameraModel
from boxplus.errors import InputError
from boxplus.manifolds.euclidean import Euclidean
from boxplus.residuals.camera.image_residual import ImageResidual
from boxplus.residuals.camera.reprojection_intrinsics import ReprojectionIntrinsics
from boxplus.residuals.residual import Array, Arrays, Mask, Rows


class ReprojectionTiedIntrinsics(ImageResidual):
    """Points seen in a camera that is calibrated along some directions only: pixel − π(T_camera_world p_world; c₀ + B q).

    Variables: `T_camera_world` on `SE3Left` (7,), `p_world` on `Euclidean(3)` [m], `q` on `Euclidean(m)`.

    Args:
        camera: its model and `nearest` (`z_min` of a pinhole) are used.
        pixels: (N, 2) measured, distorted as the camera distorts [px].
        offset: c₀ (n,), laid out as `camera.parameters`.
        basis: B (n, m) with m ≤ n, of full rank.
        sigma, covariance, information: of a pixel measurement, as in `Whitening.of`; none of them stands for 1 px.

    Raises:
        InputError: shapes that do not match, a basis that is not of full rank, or as `ReprojectionIntrinsics`.

    Example:
        >>> camera = bp.Pinhole(500.0, 500.0, 320.0, 240.0)
        >>> basis = [[1.0], [1.0], [0.0], [0.0]]  # one focal length for both axes
        >>> seen = bp.residuals.ReprojectionTiedIntrinsics(camera, [[320.0, 240.0]], [0.0, 0.0, 320.0, 240.0], basis)
        >>> np.abs(seen.evaluate(bp.SE3Left.identity(), [0.4, 0.0, 4.0], [500.0])).round(6)
        array([[50.,  0.]])
    """

    def __init__(
        self,
        camera: CameraModel,
        pixels: ArrayLike,
        offset: ArrayLike,
        basis: ArrayLike,
        *,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        information: ArrayLike | None = None,
    ) -> None:
        self._full = ReprojectionIntrinsics(camera, pixels, sigma=sigma, covariance=covariance, information=information)
        self.offset = as_floats(offset, "offset")
        self.basis = as_floats(basis, "basis")
        count = len(camera.parameters)
        if self.offset.shape != (count,) or self.basis.ndim != 2 or len(self.basis) != count:
            raise InputError(
                f"an offset ({count},) and a basis ({count}, m), as the camera has {count} parameters",
                f"{self.offset.shape} and {self.basis.shape}",
                "give a row for each of " + ", ".join(camera.parameter_names),
            )
        rank = int(np.linalg.matrix_rank(self.basis)) if np.isfinite(self.basis).all() and self.basis.size else 0
        if not rank or rank < self.basis.shape[1] or not np.isfinite(self.offset).all():
            raise InputError(
                f"a finite offset, and a finite basis of rank {self.basis.shape[1]}", f"rank {rank}", "give independent columns"
            )
        super().__init__(
            dim=2,
            count=self._full.count,
            manifolds=(*self._full.manifolds[:2], Euclidean(self.basis.shape[1])),
            roles=("T_camera_world", "p_world", "q"),
            whitening=self._full.whitening,
        )
        self.pixels = self._full.pixels
        self._J = np.zeros((self.count, 2, count))

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        """See `Residual.linearize_into`."""
        self._full.linearize_into(begin, end, self._expanded(x), index, r, (jacobians[0], jacobians[1], self._J), valid)
        np.matmul(self._J[begin:end], self.basis, out=jacobians[2][begin:end])

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        """See `Residual.evaluate_into`."""
        self._full.evaluate_into(begin, end, self._expanded(x), index, r, valid)

    def measuring(self, z: NDArray[np.float64]) -> Self:
        """See `ImageResidual.measuring`."""
        twin = super().measuring(z)
        twin._full, twin._J = self._full.measuring(z), self._J.copy()
        return twin

    def intrinsics(self, q: ArrayLike) -> NDArray[np.float64]:
        """c = c₀ + B q (..., n) of (..., m)."""
        return np.ascontiguousarray(self.offset + as_floats(q, "q") @ self.basis.T)

    def _expanded(self, x: tuple[NDArray[np.float64], ...]) -> tuple[NDArray[np.float64], ...]:
        return x[0], x[1], self.intrinsics(x[2])
