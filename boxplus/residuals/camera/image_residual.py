"""What residuals of measured image coordinates share: the coordinates may move, as those of an image taken a little later do."""

from __future__ import annotations

import copy
from abc import abstractmethod
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows


class ImageResidual(Residual):
    """A residual of image coordinates z (N, k) [px], in which it is affine: e(z + δ) = e(z) + ∂e/∂z δ, whatever δ.

    Attributes:
        measured_name: the attribute that holds z.
    """

    measured_name: ClassVar[str] = "pixels"

    @property
    def measured(self) -> NDArray[np.float64]:
        """z (N, k) [px]."""
        coordinates: NDArray[np.float64] = getattr(self, self.measured_name)
        return coordinates

    def measuring(self, z: NDArray[np.float64]) -> Self:
        """The same residual of the coordinates z (N, k), which it reads anew in every evaluation."""
        twin = copy.copy(self)
        setattr(twin, self.measured_name, z)
        return twin

    def change_into(self, begin: int, end: int, x: Arrays, index: Rows, delta: Array, out: Array) -> None:
        """out[begin:end] = ∂e/∂z δ (N, dim) for δ (N, k); here e = z − …"""
        out[begin:end] = delta[begin:end]


class PixelResidual(ImageResidual):
    """An image residual whose kernel does both: with Jacobians, or with none.

    Attributes:
        no_jacobians: empty arrays of the Jacobians' shapes, for the kernel to leave alone.
    """

    no_jacobians: ClassVar[Arrays]

    @abstractmethod
    def _run(
        self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask, with_jacobians: bool
    ) -> None:
        """Fill r, valid and, if wanted, the Jacobians [begin:end]."""

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        """See `Residual.linearize_into`."""
        self._run(begin, end, x, index, r, jacobians, valid, True)

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        """See `Residual.evaluate_into`."""
        self._run(begin, end, x, index, r, self.no_jacobians, valid, False)
