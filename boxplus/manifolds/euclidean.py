"""Vectors of n numbers, moved by addition."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.manifolds._kernel_manifold import KernelManifold

_AXES = ("x", "y", "z")


@dataclass(frozen=True, repr=False)
class Euclidean(KernelManifold):
    """ℝⁿ: x ⊞ δ = x + δ. `Euclidean(3)` equals every other `Euclidean(3)`.

    Raises:
        InputError: n is not a positive whole number.

    Example:
        >>> plane = bp.Euclidean(2)
        >>> plane.boxplus([1.0, 2.0], [0.5, 0.0])
        array([1.5, 2. ])
        >>> bp.Euclidean(2) == plane, plane.tangent_names
        (True, ('x', 'y'))
    """

    n: int

    def __post_init__(self) -> None:
        if isinstance(self.n, bool) or not isinstance(self.n, int) or self.n < 1:
            raise InputError("a dimension n ≥ 1", repr(self.n), "write Euclidean(3) for points in space")

    @property
    def name(self) -> str:  # type: ignore[override]
        return f"Euclidean({self.n})"

    @property
    def size(self) -> int:  # type: ignore[override]
        return self.n

    @property
    def dof(self) -> int:  # type: ignore[override]
        return self.n

    @property
    def tangent_names(self) -> tuple[str, ...]:  # type: ignore[override]
        return _AXES[: self.n] if self.n <= len(_AXES) else tuple(f"component {i}" for i in range(self.n))

    def boxplus_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        np.add(x, delta, out=out)

    def boxminus_into(self, x: NDArray[np.float64], base: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        np.subtract(x, base, out=out)

    def boxplus_jacobian_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        J[:] = np.eye(self.n)

    def boxminus_jacobian_into(self, x: NDArray[np.float64], base: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        J[:] = np.eye(self.n)

    def identity(self) -> NDArray[np.float64]:
        return np.zeros(self.n)

    def random(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        return rng.normal(size=(count, self.n))
