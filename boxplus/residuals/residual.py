"""What every error term of the library is: a group of N residuals of one kind, held as arrays."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_floats
from boxplus.errors import InputError
from boxplus.manifolds.manifold import Manifold
from boxplus.residuals.whitening import Whitening

HALF_TURN_MARGIN = 1e-6  # rotation errors this close to π [rad] have an arbitrary axis sign

Array = NDArray[np.float64]
Arrays = tuple[NDArray[np.float64], ...]
Rows = tuple[NDArray[np.uint32], ...]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Linearization:
    """Residuals and Jacobians of a group, before whitening.

    Attributes:
        residuals: (N, dim).
        jacobians: for every connected variable (N, dim, dof): ∂r(x ⊞ δ)/∂δ at δ = 0.
        valid: (N,) bool; False where the residual is singular (a point behind its camera): its rows are zero.

    Example:
        >>> found = bp.residuals.Prior(bp.SE2, [0.0, 0.0, 0.0]).linearize([0.0, 1.0, 0.0])
        >>> found.residuals, found.jacobians[0].shape, found.valid
        (array([[0., 1., 0.]]), (1, 3, 3), array([ True]))
    """

    residuals: NDArray[np.float64]
    jacobians: tuple[NDArray[np.float64], ...]
    valid: NDArray[np.bool_]


class Residual(ABC):
    """A group of N residuals r(x₀, x₁, …) of one kind with their Jacobians.

    A subclass calls `super().__init__` and gives the two `_into` methods, each one call of a kernel over rows
    [begin, end): it gathers the variables itself, `x[s][index[s][n]]`, so that nothing is copied.

    Attributes:
        dim: rows of one residual.
        count: residuals in the group, N.
        manifolds: of the connected variables, on the side the Jacobians are derived for.
        roles: a name for each connected variable, with frames, such as `T_camera_world`.
        whitening: square root of the information of the residuals.
        fixes_gauge: whether moving all connected variables together, as one rigid body, changes the residual. One that
            connects a single variable does; a relative measurement does not.
        rotation_rows: the first rows are the logarithm of a rotation: 3, 1 in the plane, 0 where they are not.
        jacobian_note: what a user should know of its Jacobians, and a solution says; empty where there is nothing.

    Example:
        >>> prior = bp.residuals.Prior(bp.SE2, np.zeros((3, 3)), sigma=0.1)
        >>> prior.count, prior.dim, prior.roles, prior.manifolds
        (3, 3, ('x',), (SE2,))
    """

    fixes_gauge: bool
    rotation_rows: int = 0
    jacobian_note: str = ""

    def __init__(
        self,
        *,
        dim: int,
        count: int,
        manifolds: tuple[Manifold, ...],
        roles: tuple[str, ...],
        whitening: Whitening,
        fixes_gauge: bool | None = None,
    ) -> None:
        self.dim, self.count, self.manifolds, self.roles, self.whitening = dim, count, manifolds, roles, whitening
        self.fixes_gauge = len(manifolds) == 1 if fixes_gauge is None else fixes_gauge

    @abstractmethod
    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        """Residuals, Jacobians and validity of the rows [begin, end), before whitening.

        Args:
            x: for every connected variable the array (n_s, size_s) it lives in.
            index: for every connected variable (N,) rows of that array.
            r: (N, dim); jacobians: (N, dim, dof_s) each; valid: (N,). Rows [begin, end) are written, all of them: an
                invalid residual writes zeros.
        """

    @abstractmethod
    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        """As `linearize_into`, residuals and validity only; they must be the same bits."""

    def linearize(self, *x: ArrayLike) -> Linearization:
        """Residuals and Jacobians with one value of every connected variable for each residual.

        Args:
            x: for every connected variable (N, size), or (size,) for all residuals alike.

        Raises:
            InputError: wrong number of variables or wrong shapes.
        """
        values, index = self._rows(x)
        r = np.zeros((self.count, self.dim))
        jacobians = tuple(np.zeros((self.count, self.dim, manifold.dof)) for manifold in self.manifolds)
        valid = np.ones(self.count, dtype=np.bool_)
        self.linearize_into(0, self.count, values, index, r, jacobians, valid)
        return Linearization(r, jacobians, valid)

    def evaluate(self, *x: ArrayLike) -> NDArray[np.float64]:
        """Residuals (N, dim), before whitening; arguments as in `linearize`."""
        values, index = self._rows(x)
        r = np.zeros((self.count, self.dim))
        self.evaluate_into(0, self.count, values, index, r, np.ones(self.count, dtype=np.bool_))
        return r

    def at_half_turn(self, *x: ArrayLike) -> NDArray[np.bool_]:
        """Which residuals (N,) have a rotation error within 1e-6 rad of π, where the sign of its axis is arbitrary and the
        Jacobian jumps; arguments as in `linearize`."""
        return self.is_half_turn(self.evaluate(*x))

    def is_half_turn(self, r: NDArray[np.float64]) -> NDArray[np.bool_]:
        """As `at_half_turn`, of residuals r (N, dim) before whitening."""
        angle = np.sqrt((r[:, : self.rotation_rows] ** 2).sum(axis=1))
        return np.asarray(angle >= np.pi - HALF_TURN_MARGIN)

    def _rows(self, x: tuple[ArrayLike, ...]) -> tuple[tuple[NDArray[np.float64], ...], tuple[NDArray[np.uint32], ...]]:
        if len(x) != len(self.manifolds):
            raise InputError(
                f"{len(self.manifolds)} variables ({', '.join(self.roles)})", f"{len(x)}", "give one array for each of them"
            )
        values, index = [], []
        for role, manifold, given in zip(self.roles, self.manifolds, x, strict=True):
            array = np.ascontiguousarray(np.atleast_2d(as_floats(given, role)))
            if array.ndim != 2 or array.shape[1] != manifold.size or len(array) not in (1, self.count):
                raise InputError(
                    f"{role} of shape ({self.count}, {manifold.size}) or ({manifold.size},) on {manifold.name}",
                    f"shape {np.shape(given)}",
                    "give one row for each residual, or one for all",
                )
            values.append(array)
            rows = np.arange(self.count) if len(array) == self.count else np.zeros(self.count)
            index.append(rows.astype(np.uint32))
        return tuple(values), tuple(index)
