"""What a variable is: a manifold with ⊞ and ⊟ (Hertzberg et al., Integrating generic sensor fusion algorithms, 2013)."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Manifold(ABC):
    """A space whose points are stored as `size` numbers and moved by tangents of `dof` numbers.

    Every method is batch-first: points are (..., size), tangents (..., dof). Two manifolds are equal when their type and
    parameters are; instances are immutable and serve as their own description, such as `SE3` or `Euclidean(3)`.

    Attributes:
        name: as a user writes it, for messages.
        size: numbers stored for a point.
        dof: numbers of a tangent, and degrees of freedom.
        tangent_names: (dof,) what each tangent direction moves, with its unit, for messages, such as `rotation x [rad]`.

    Example:
        >>> bp.SE2.boxminus(bp.SE2.boxplus([0.0, 1.0, 2.0], [0.1, 0.0, 0.0]), [0.0, 1.0, 2.0])
        array([0.1, 0. , 0. ])
    """

    name: str
    size: int
    dof: int
    tangent_names: tuple[str, ...]

    @abstractmethod
    def boxplus(self, x: ArrayLike, delta: ArrayLike) -> NDArray[np.float64]:
        """x ⊞ δ: the point (..., size) that lies δ (..., dof) away from x (..., size).

        NaN gives NaN in its row and nowhere else, as of the functions of NumPy. What keeps points looks at them, by `check`.
        """

    @abstractmethod
    def boxminus(self, x: ArrayLike, base: ArrayLike) -> NDArray[np.float64]:
        """x ⊟ base: the δ (..., dof) with base ⊞ δ = x; NaN as in `boxplus`."""

    @abstractmethod
    def boxplus_jacobian(self, x: ArrayLike, delta: ArrayLike) -> NDArray[np.float64]:
        """∂((x ⊞ (δ + ε)) ⊟ (x ⊞ δ))/∂ε at ε = 0, (..., dof, dof)."""

    @abstractmethod
    def boxminus_jacobian(self, x: ArrayLike, base: ArrayLike) -> NDArray[np.float64]:
        """∂((x ⊞ ε) ⊟ base)/∂ε at ε = 0, (..., dof, dof): the inverse of `boxplus_jacobian(base, x ⊟ base)`."""

    @abstractmethod
    def check(self, name: str, x: ArrayLike) -> NDArray[np.float64]:
        """Points as a new (n, size) float64 array, brought onto the manifold where they are off by rounding only.

        Raises:
            InputError: wrong shape, not finite, or too far from the manifold (a quaternion of length 0.9).
        """

    @abstractmethod
    def identity(self) -> NDArray[np.float64]:
        """The point (size,) that stands for no motion, or the origin."""

    @abstractmethod
    def random(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """(count, size) points spread over the manifold (translations and the like: unit normal)."""

    def __repr__(self) -> str:
        return self.name
