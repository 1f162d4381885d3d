"""Manifolds whose four operations are kernels over rows: the shared shell of all of them."""

from __future__ import annotations

import math
from abc import abstractmethod

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus._numbers import as_floats
from boxplus.errors import InputError
from boxplus.manifolds._batch import pair_rows
from boxplus.manifolds.manifold import Manifold

_ROUNDED = 4e-16
_UNIT_TOLERANCE = 1e-3  # quaternions this far from unit length come from rounded files, not from a mistake


class KernelManifold(Manifold):
    """A manifold given by four kernels over rows; broadcasting, shapes and messages are here.

    A subclass gives the `_into` methods, each one call of a kernel; points and tangents come as (N, size), (N, dof),
    contiguous. `out` may be `x` itself.
    """

    @abstractmethod
    def boxplus_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        """out (N, size) = x ⊞ δ for every row."""

    @abstractmethod
    def boxminus_into(self, x: NDArray[np.float64], base: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        """out (N, dof) = x ⊟ base for every row."""

    @abstractmethod
    def boxplus_jacobian_into(self, x: NDArray[np.float64], delta: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        """J (N, dof, dof) of ⊞ for every row, as `boxplus_jacobian`."""

    @abstractmethod
    def boxminus_jacobian_into(self, x: NDArray[np.float64], base: NDArray[np.float64], J: NDArray[np.float64]) -> None:
        """J (N, dof, dof) of ⊟ for every row, as `boxminus_jacobian`."""

    def boxplus(self, x: ArrayLike, delta: ArrayLike) -> NDArray[np.float64]:
        points, tangents, lead = pair_rows("x", x, self.size, "delta", delta, self.dof)
        out = np.empty((len(points), self.size))
        self.boxplus_into(points, tangents, out)
        if not np.isfinite(out).all():
            self._refuse_none(x=points)
        return out.reshape((*lead, self.size))

    def boxminus(self, x: ArrayLike, base: ArrayLike) -> NDArray[np.float64]:
        points, bases, lead = pair_rows("x", x, self.size, "base", base, self.size)
        out = np.empty((len(points), self.dof))
        self.boxminus_into(points, bases, out)
        if not np.isfinite(out).all():
            self._refuse_none(x=points, base=bases)
        return out.reshape((*lead, self.dof))

    def boxplus_jacobian(self, x: ArrayLike, delta: ArrayLike) -> NDArray[np.float64]:
        points, tangents, lead = pair_rows("x", x, self.size, "delta", delta, self.dof)
        J = np.zeros((len(points), self.dof, self.dof))
        self.boxplus_jacobian_into(points, tangents, J)
        return J.reshape((*lead, self.dof, self.dof))

    def boxminus_jacobian(self, x: ArrayLike, base: ArrayLike) -> NDArray[np.float64]:
        points, bases, lead = pair_rows("x", x, self.size, "base", base, self.size)
        J = np.zeros((len(points), self.dof, self.dof))
        self.boxminus_jacobian_into(points, bases, J)
        return J.reshape((*lead, self.dof, self.dof))

    def _refuse_none(self, **points: NDArray[np.float64]) -> None:
        """Refuse finite numbers that are no points, such as quaternions of zeros; NaN gives NaN."""
        for name, rows in points.items():
            self.check(name, rows[np.isfinite(rows).all(axis=1)])

    def check(self, name: str, x: ArrayLike) -> NDArray[np.float64]:
        return checked_rows(name, x, self.size, self.name)


def checked_rows(name: str, x: ArrayLike, size: int, manifold: str) -> NDArray[np.float64]:
    """A new finite (n, size) float64 array; one point may come as (size,).

    Raises:
        InputError: another shape, not numbers, NaN or infinity.
    """
    array = np.array(as_floats(x, f"{name} (n, {size}) on {manifold}"), ndmin=2, order="C")
    if array.ndim != 2 or array.shape[1] != size:
        raise InputError(f"{name} of shape (n, {size}) on {manifold}", f"shape {np.shape(x)}", "give one row for each variable")
    if not np.isfinite(array).all():
        row = int(np.argmin(np.isfinite(array).all(axis=1)))
        numbers = np.array2string(array[row], precision=4, max_line_width=10_000)
        raise InputError(f"{name} finite", f"{numbers} in row {row}", "remove the variable or give it a start value")
    return array


def normalize_quaternions(name: str, rows: NDArray[np.float64]) -> None:
    """Bring rows[:, :4] (wxyz) to unit length in place where they are off by rounding only.

    Raises:
        InputError: a quaternion whose length is not 1.
    """
    row, length = _normalize(rows)
    if row >= 0:
        raise InputError(
            f"{name} with unit quaternions wxyz first",
            f"length {length:.6g} in row {row}",
            "check the order of the columns, or normalise the quaternions",
        )


@kernel
def _normalize(rows: NDArray[np.float64]) -> tuple[int, float]:
    """`normalize_quaternions`, if all are of unit length; the first that is not, and its length, or −1."""
    lengths = np.empty(rows.shape[0])
    for n in range(rows.shape[0]):
        w, x, y, z = rows[n, 0], rows[n, 1], rows[n, 2], rows[n, 3]
        lengths[n] = math.sqrt(((w * w + x * x) + y * y) + z * z)
        if not abs(lengths[n] - 1.0) <= _UNIT_TOLERANCE:
            return n, lengths[n]
    for n in range(rows.shape[0]):
        if abs(lengths[n] - 1.0) > _ROUNDED:  # what is of unit length already keeps its digits
            for k in range(4):
                rows[n, k] /= lengths[n]
    return -1, 1.0
