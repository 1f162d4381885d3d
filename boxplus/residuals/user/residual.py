"""Residuals that a user writes: a function of one residual, compiled on the fly, or a batch function in NumPy."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_array, as_floats
from boxplus.errors import InputError
from boxplus.manifolds.manifold import Manifold
from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows
from boxplus.residuals.user.kernels import Derivative, Loops, compiled_loops
from boxplus.residuals.whitening import Whitening

_STEP = 1e-5  # of central differences: truncation and rounding both stay below about 1e-10
_STRAIGHT = 1e-3  # what a straight line may bend by over two steps, as a share of its rise


class UserResidual(Residual):
    """A residual given by a Python function.

    The function takes the stored numbers of every connected variable, then the entries of every data array, of one residual:

        def relative_pose(T_i, T_j, z):               # rows (7,), (7,) and (7,)
            return w0, w1, w2, v0, v1, v2             # dim numbers: a tuple, or an array (slower)

        UserResidual(relative_pose, dim=6, manifolds=(SE3, SE3), data=(measured,), sigma=0.1)

    It is compiled by Numba and called from a compiled loop; it may call kernels of `boxplus.manifolds` and functions of its own
    that are compiled by `numba.njit`. Where it returns None the residual is singular and left out. With `is_batch` it is called
    as it is, with (n, size) and (n, …) arrays of n residuals, and returns (n, dim), or that and a mask (n,) of valid ones.

    Args:
        function: as above; it must not change its arguments.
        dim: rows of one residual.
        manifolds: of the connected variables.
        data: arrays (N,) or (N, …) with the measurements; an entry of (N,) comes as a scalar. What is the same for all residuals
            comes as a number, or as the single row of (1, …).
        count: N, where no data tell.
        jacobian: takes the arguments of the function and then, for every variable, an array (dim, dof) of zeros to fill with
            ∂r(x ⊞ δ)/∂δ. In a batch, it returns one array (n, dim, dof) for each variable. "automatic" differentiates the
            compiled function itself, exactly (but for rows of zeros behind a branch that leaves early: docs/differentiation.md),
            and refuses one of which it cannot; "differences" takes central differences on the manifold. Without it, the first
            where that can be, else the second: `jacobian_kind` says which, `jacobian_note` why.
        roles: names for the variables, for messages; the function's own argument names otherwise.
        step: of the differences, in tangent units; one number, or for every variable a number or (dof,). A variable of 1e5
            needs a larger one than the default 1e-5.
        sigma, covariance, information: as for `Whitening.of`.
        fixes_gauge: whether moving all connected variables as one rigid body changes the residual; by default, that of a
            single variable.

    Attributes:
        jacobian_kind: "analytic", "automatic" (docs/differentiation.md) or "numeric".

    Raises:
        InputError: shapes that do not fit; a function that does not compile or cannot be differentiated as it was asked for
            (with the reason Numba gives), or returns another number of values, the latter when it is first called if its
            type does not tell.

    Example:
        >>> def distance(beacon, robot, measured):
        ...     return np.hypot(beacon[0] - robot[0], beacon[1] - robot[1]) - measured
        >>> plane = bp.Euclidean(2)
        >>> beacons = bp.residuals.UserResidual(distance, dim=1, manifolds=(plane, plane), data=([5.0],), sigma=0.1)
        >>> beacons.evaluate([3.0, 4.0], [0.0, 0.5]).round(3)
        array([[-0.39]])
    """

    jacobian_kind: Derivative

    def __init__(
        self,
        function: Callable[..., Any],
        *,
        dim: int,
        manifolds: Sequence[Manifold],
        data: Sequence[ArrayLike] = (),
        count: int | None = None,
        jacobian: Callable[..., Any] | Literal["automatic", "differences"] | None = None,
        is_batch: bool = False,
        roles: Sequence[str] | None = None,
        step: float | Sequence[ArrayLike] = _STEP,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        information: ArrayLike | None = None,
        fixes_gauge: bool | None = None,
    ) -> None:
        connected = tuple(manifolds)
        if not connected or not all(isinstance(manifold, Manifold) for manifold in connected):
            raise InputError("manifolds as a tuple of manifolds", repr(manifolds), "write manifolds=(SE3, SE3)")
        if dim < 1:
            raise InputError("dim ≥ 1", str(dim), "give the number of rows of one residual")
        self.data = tuple(_data(k, array) for k, array in enumerate(data))
        rows = _count(self.data, count)
        self._is_shared = tuple(len(array) == 1 != rows for array in self.data)
        if roles is None:
            code = getattr(function, "__code__", getattr(getattr(function, "py_func", None), "__code__", None))
            roles = code.co_varnames[: len(connected)] if code is not None else ()
        if len(roles) != len(connected):
            roles = tuple(f"variable {k}" for k in range(len(connected)))
        super().__init__(
            dim=dim,
            count=rows,
            manifolds=connected,
            roles=tuple(roles),
            whitening=Whitening.of(dim, rows, sigma=sigma, covariance=covariance, information=information),
            fixes_gauge=fixes_gauge,
        )
        wanted = _derivative(jacobian, is_batch)
        self.function, self.is_batch = function, is_batch
        self.jacobian = jacobian if callable(jacobian) else None
        self.jacobian_kind = wanted or "numeric"
        self._steps = _difference_steps(step, connected)
        self._loops: Loops | None = None
        if not is_batch:
            types = tuple((d.dtype.name, d.ndim, shared) for d, shared in zip(self.data, self._is_shared, strict=True))
            self._loops = compiled_loops(function, self.jacobian, wanted, dim, connected, types)
            self.jacobian_kind, self.jacobian_note = self._loops.derivative, self._loops.note

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        if self._loops is not None and self._loops.linearize is not None:
            rows = (*x, *index, *self.data, *self._loops.tables)
            if self.jacobian_kind == "analytic":
                self._run(self._loops.linearize, begin, end, rows, (r, *jacobians, valid))
                return
            self.evaluate_into(begin, end, x, index, r, valid)  # with bounds checked, which the derivatives are not
            if self.jacobian_kind == "automatic":
                if self._run(self._loops.linearize, begin, end, rows, (*jacobians, valid)):
                    self._differentiate_flat(self._loops, begin, end, x, index, r, jacobians, valid)
            else:
                self._run(self._loops.linearize, begin, end, (*rows, *self._steps), (r, *jacobians, valid))
            return
        self.evaluate_into(begin, end, x, index, r, valid)
        if self.jacobian is None:
            self._differentiate(begin, end, x, index, r, jacobians)
        else:
            self._call_batch_jacobian(self.jacobian, begin, end, self._gather(begin, end, x, index), jacobians)
        for J in jacobians:
            J[begin:end][~valid[begin:end]] = 0.0
        r[begin:end][~valid[begin:end]] = 0.0

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        if self._loops is not None:
            self._run(self._loops.evaluate, begin, end, (*x, *index, *self.data), (r, valid))
        else:
            r[begin:end], valid[begin:end] = self._call_batch(begin, end, self._gather(begin, end, x, index))
            r[begin:end][~valid[begin:end]] = 0.0

    def _gather(
        self, begin: int, end: int, x: tuple[NDArray[np.float64], ...], index: tuple[NDArray[np.uint32], ...]
    ) -> list[NDArray[np.float64]]:
        return [values[rows[begin:end]] for values, rows in zip(x, index, strict=True)]

    def _rows_of_data(self, begin: int, end: int) -> list[NDArray[Any]]:
        """Entries [begin, end) of every data array; a row for all residuals is repeated, without a copy."""
        parts = zip(self.data, self._is_shared, strict=True)
        return [np.broadcast_to(d, (end - begin, *d.shape[1:])) if shared else d[begin:end] for d, shared in parts]

    def _at(self, begin: int, end: int, values: Sequence[NDArray[np.float64]]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Residuals and validity of rows [begin, end) with one value (end − begin, size) of every variable each."""
        if self._loops is None:
            return self._call_batch(begin, end, values)
        return self._evaluated(self._loops, slice(begin, end), begin, values)

    def _evaluated(
        self, loops: Loops, rows: slice | NDArray[np.intp], first: int, values: Sequence[NDArray[np.float64]]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """As `_at`, of chosen rows of a compiled function; `first` is the first of them, for messages."""
        count = len(values[0])
        r, valid = np.zeros((count, self.dim)), np.ones(count, dtype=np.bool_)
        index = (np.arange(count, dtype=np.uint32),) * len(values)
        data = (array if shared else array[rows] for array, shared in zip(self.data, self._is_shared, strict=True))
        self._run(loops.evaluate, 0, count, (*values, *index, *data), (r, valid), first=first)
        return r, valid

    def _call_batch(
        self, begin: int, end: int, values: Sequence[NDArray[np.float64]]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        returned = self.function(*values, *self._rows_of_data(begin, end))
        if not (isinstance(returned, tuple) and len(returned) == 2):
            returned = returned, np.ones(end - begin, dtype=np.bool_)
        r, valid = np.asarray(returned[0], dtype=np.float64), np.asarray(returned[1])
        if r.shape != (end - begin, self.dim) or valid.shape != (end - begin,) or valid.dtype != np.bool_:
            raise InputError(
                f"residuals ({end - begin}, {self.dim}) from {self._name}, or those and a mask ({end - begin},) of bool",
                f"shape {r.shape} with a mask {valid.shape} of {valid.dtype}",
                "return one row for each residual",
            )
        return r, valid

    def _call_batch_jacobian(
        self, jacobian: Callable[..., Any], begin: int, end: int, values: Sequence[NDArray[np.float64]], jacobians: Arrays
    ) -> None:
        returned = jacobian(*values, *self._rows_of_data(begin, end))
        matrices = [np.asarray(J, dtype=np.float64) for J in (returned if isinstance(returned, tuple | list) else (returned,))]
        shapes = [(end - begin, self.dim, manifold.dof) for manifold in self.manifolds]
        if [J.shape for J in matrices] != shapes:
            raise InputError(
                f"Jacobians of shapes {shapes}",
                f"{[J.shape for J in matrices]}",
                "return one (n, dim, dof) array for each variable",
            )
        for J, matrix in zip(jacobians, matrices, strict=True):
            J[begin:end] = matrix

    def _differentiate(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays) -> None:
        """Central differences, a whole chunk at a time; one-sided beside a singular neighbour."""
        values = self._gather(begin, end, x, index)
        for slot, manifold in enumerate(self.manifolds):
            moved = list(values)
            for k in range(manifold.dof):
                difference, reach = np.zeros((end - begin, self.dim)), np.zeros((end - begin, 1))
                for side in (1.0, -1.0):
                    delta = np.zeros(manifold.dof)
                    delta[k] = side * self._steps[slot][k, 0]
                    moved[slot] = manifold.boxplus(values[slot], delta)
                    neighbour, is_known = self._at(begin, end, moved)
                    difference += np.where(is_known[:, None], side * (neighbour - r[begin:end]), 0.0)
                    reach += np.where(is_known, abs(delta[k]), 0.0)[:, None]
                jacobians[slot][begin:end, :, k] = difference / np.where(reach > 0.0, reach, 1.0)

    def _differentiate_flat(
        self, loops: Loops, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask
    ) -> None:
        """Derivatives of rows that a branch leaves early at this very point (if n < eps: return 0), by differences.

        Such a row is zero in the Jacobian and a straight line beside the point. What does not move, a corner and what is curved
        have the derivative zero that they were given.
        """
        flat = valid[begin:end, None] & ~np.logical_or.reduce([J[begin:end].any(axis=2) for J in jacobians])
        rows = begin + np.flatnonzero(flat.any(axis=1))
        steps = [table[:, 0] for table in self._steps]

        def at(deltas: dict[int, NDArray[np.float64]]) -> NDArray[np.float64]:
            moved = [values[chosen[rows]] for values, chosen in zip(x, index, strict=True)]
            for slot, delta in deltas.items():
                moved[slot] = self.manifolds[slot].boxplus(moved[slot], delta)
            found, known = self._evaluated(loops, rows, int(rows[0]), moved)
            found[~known] = np.nan  # nothing is straight beside a singular residual
            return found

        # Most do not move at all: one look along a direction that is nobody's own.
        aside = at({slot: h * np.cos(np.arange(1.0 + slot, 1.0 + slot + len(h))) for slot, h in enumerate(steps)})
        moves = flat[rows - begin] & np.isfinite(aside) & (aside != r[rows])
        rows = rows[moves.any(axis=1)]
        if not len(rows):
            return
        here, flat = r[rows], flat[rows - begin]
        for slot, h in enumerate(steps):
            for k, e in enumerate(np.diag(h)):
                ahead, behind, further, before = (at({slot: scale * e}) for scale in (1.0, -1.0, 2.0, -2.0))
                rise = ahead - behind
                bend = np.maximum(np.abs(ahead + behind - 2.0 * here), np.abs(further - before - 2.0 * rise))
                straight = flat & (rise != 0.0) & (bend <= _STRAIGHT * np.abs(rise))
                jacobians[slot][rows, :, k] = np.where(straight, rise / (2.0 * h[k]), jacobians[slot][rows, :, k])

    @property
    def _name(self) -> str:
        return str(getattr(self.function, "__name__", "the function"))

    def _run(
        self,
        loop: Callable[..., int],
        begin: int,
        end: int,
        rows: tuple[NDArray[Any], ...],
        out: tuple[NDArray[Any], ...],
        *,
        first: int = 0,
    ) -> int:
        """What a compiled loop over rows [begin, end) returns; the first of them is residual `first + begin` of the group."""
        try:
            wrong = loop(begin, end, *rows, *out)
        except IndexError:
            raise self._beyond(first + self._first_beyond(loop, begin, end, rows, out)) from None
        if wrong > 0:
            raise InputError(f"{self.dim} numbers from {self._name}", f"{wrong - 1}", "return as many as dim says")
        return wrong

    @staticmethod
    def _first_beyond(
        loop: Callable[..., int], begin: int, end: int, rows: tuple[NDArray[Any], ...], out: tuple[NDArray[Any], ...]
    ) -> int:
        for n in range(begin, end):
            try:
                loop(n, n + 1, *rows, *out)
            except IndexError:
                return n
        return begin

    def _beyond(self, residual: int) -> InputError:
        named = [f"{role} ({manifold.size},)" for role, manifold in zip(self.roles, self.manifolds, strict=True)]
        named += [f"data[{k}] {'scalar' if array.ndim == 1 else array.shape[1:]}" for k, array in enumerate(self.data)]
        return InputError(
            f"indices within the arrays that {self._name} uses",
            f"one beyond the end, in residual {residual} of {self.count}, whose arguments are {', '.join(named)}",
            "correct the index, or return None where there is no residual",
        )


def _derivative(jacobian: Any, is_batch: bool) -> Derivative | None:
    """What the argument `jacobian` asks for; None where it leaves the choice."""
    if callable(jacobian):
        return "analytic"
    if jacobian is None or jacobian == "differences":
        return "numeric" if is_batch or jacobian else None
    if jacobian != "automatic" or is_batch:
        raise InputError(
            'a function as jacobian, "automatic" (but for a batch function, which is not compiled), "differences" or None',
            repr(jacobian),
            "leave it out: differences are taken where automatic differentiation cannot be",
        )
    return "automatic"


def _data(number: int, array: ArrayLike) -> NDArray[Any]:
    values = as_array(array, f"data[{number}]")
    if values.dtype.kind not in "fiub":
        raise InputError(
            f"data[{number}] as numbers (N, …), (1, …) or one number",
            f"{values.dtype} of shape {values.shape}",
            "give one row for each residual, or one for all",
        )
    return np.array(np.atleast_1d(values), dtype=np.float64 if values.dtype.kind == "f" else np.int64, order="C")


def _count(data: tuple[NDArray[Any], ...], count: int | None) -> int:
    lengths = {len(array) for array in data} | ({count} if count is not None else set())
    if len(lengths) > 1:
        lengths -= {1}  # rows for all residuals
    if len(lengths) != 1 or (count is not None and lengths != {count}):
        raise InputError(
            "data arrays of one length N (or 1, for all residuals), or count",
            f"lengths {[len(array) for array in data]}" + ("" if count is None else f" and count {count}"),
            "give one row for each residual, or one for all: [row], not row",
        )
    return lengths.pop()


def _difference_steps(step: float | Sequence[ArrayLike], manifolds: tuple[Manifold, ...]) -> tuple[NDArray[np.float64], ...]:
    """For every variable (dof, 3): step h, cos h/2, sin h/2."""
    given = [step] * len(manifolds) if isinstance(step, int | float) else list(step)
    if len(given) != len(manifolds):
        raise InputError(f"one step, or {len(manifolds)}", f"{len(given)}", "give one for each connected variable")
    tables = []
    for manifold, one in zip(manifolds, given, strict=True):
        h = as_floats(one, "step")
        if h.shape not in ((), (manifold.dof,)) or not (np.isfinite(h) & (h > 0.0) & (h < math.pi)).all():
            raise InputError(
                f"a positive step, or ({manifold.dof},) for {manifold.name}",
                f"{one!r}",
                "take about 1e-5 of the variable's scale",
            )
        h = np.broadcast_to(h, (manifold.dof,))
        tables.append(np.column_stack([h, np.cos(0.5 * h), np.sin(0.5 * h)]))
    return tuple(tables)
