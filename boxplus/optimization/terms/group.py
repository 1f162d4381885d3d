"""A residual group in a problem: its variables, its loss, and its current whitened linearisation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import run_chunks
from boxplus.errors import InputError
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.tangents.change import TangentChange, tangent_change
from boxplus.optimization.losses import SQUARED, Loss, Squared
from boxplus.optimization.terms.variables import VariableRows
from boxplus.optimization.terms.weighting import (
    first_not_finite,
    weigh_jacobian,
    weigh_residuals,
    whiten_jacobian,
    whiten_residuals,
)
from boxplus.optimization.user_loss import compiled_loss
from boxplus.residuals.residual import Residual

# Residuals linearised, whitened and weighted in one go: few enough to stay in the second-level cache.
_CHUNK = 1024
_WORTH_THREADS = 200_000  # numbers in the Jacobians of a group; to wake a thread for fewer takes as long as it saves


@dataclass(frozen=True, slots=True)
class GroupCost:
    """What a group costs at a point.

    Attributes:
        cost: ½ Σ ρ over the valid residuals.
        common: the same over those that were valid where the step started.
        lost: residuals that the step made invalid.
        valid: valid residuals.
    """

    cost: float
    common: float
    lost: int
    valid: int

    def __add__(self, other: GroupCost) -> GroupCost:
        return GroupCost(self.cost + other.cost, self.common + other.common, self.lost + other.lost, self.valid + other.valid)


@dataclass(frozen=True, slots=True)
class ResidualRows:
    """Some residuals of one group, for `Problem.remove`: `group[rows]`.

    Attributes:
        group: theirs.
        chosen: (N,) bool.
    """

    group: Group
    chosen: NDArray[np.bool_]


class Group:
    """N residuals of one kind, connected to variables.

    A residual keeps its row, from 0 to N − 1, whatever is removed.

    Attributes:
        residual, name: as given to `Problem.add_residuals`.
        loss: as given there, or to `set_loss` since.
        connections: one `VariableRows` of length N for each connected variable.
        left_out: (N,) residuals of weight zero that the structure of the problem leaves out; None for none.
        removed: (N,) residuals that are gone for good and count nothing; None for none.
        revision: grows when residuals are removed.
        r, jacobians, valid: whitened and weighted linearisation, (N, dim), (N, dim, dof) each, (N,); Jacobians for a block all of
            which is fixed, which nobody reads, are as the residual gave them.
    """

    def __init__(
        self, residual: Residual, connections: Sequence[VariableRows], loss: Loss, name: str, *, holds: bool = False
    ) -> None:
        """`holds`: the group stands for components that are held, and is the only one that has Jacobians for them."""
        if not isinstance(loss, Loss):
            raise InputError("a loss of boxplus.losses", f"{loss!r}", "write it as loss=bp.losses.Huber(1.5)")
        self.residual, self.name = residual, name
        self.connections = tuple(broadcast(rows, residual.count) for rows in connections)
        self.r = np.zeros((residual.count, residual.dim))
        self.jacobians = tuple(np.zeros((residual.count, residual.dim, c.block.manifold.dof)) for c in self.connections)
        self.valid = np.ones(residual.count, dtype=np.bool_)
        self.counted = np.zeros(residual.count, dtype=np.bool_)
        self._holds = holds
        self.removed: NDArray[np.bool_] | None = None
        self.revision = 0
        self.synchronize()
        self._change = [
            tangent_change(native, c.block.manifold) for native, c in zip(residual.manifolds, self.connections, strict=True)
        ]
        whitening = residual.whitening
        self._is_white = bool(len(whitening.factors) == 1 and np.array_equal(whitening.factors[0], np.eye(residual.dim)))
        self.set_loss(loss)
        self.left_out: NDArray[np.bool_] | None = None
        self._root: NDArray[np.float64] | None = None
        self._chunk = max(residual.count, 1) if residual.count <= 2 * _CHUNK else _CHUNK
        self._is_large = residual.count * residual.dim * self.tangents >= _WORTH_THREADS
        self._sums = np.zeros((-(-residual.count // self._chunk), 4))

    def __getitem__(self, rows: ArrayLike | slice) -> ResidualRows:
        """Residuals by their rows, or by a mask (N,).

        Raises:
            InputError: rows that the group does not have.
        """
        chosen = np.zeros(self.residual.count, dtype=np.bool_)
        try:
            chosen[rows if isinstance(rows, slice) else np.asarray(rows)] = True
        except IndexError:
            raise InputError(
                f"rows of {self.name!r} from 0 to {self.residual.count - 1}, or a mask", f"{rows!r}", "select with integers"
            ) from None
        return ResidualRows(self, chosen)

    @property
    def absent(self) -> NDArray[np.bool_] | None:
        """(N,) residuals that are not in the structure of the problem, removed or left out; None for none."""
        if self.removed is None or self.left_out is None:
            return self.removed if self.left_out is None else self.left_out
        return self.removed | self.left_out

    @property
    def is_white(self) -> bool:
        """Whether residuals count as they are, because their standard deviations are 1 or were not given."""
        return self._is_white

    @property
    def is_weighted(self) -> bool:
        """Whether residuals count by weights that were set."""
        return self._root is not None

    @property
    def tangents(self) -> int:
        """Columns of all Jacobians together."""
        return sum(J.shape[2] for J in self.jacobians)

    @property
    def remaining(self) -> int:
        """How many residuals were not removed."""
        return self.residual.count if self.removed is None else int((~self.removed).sum())

    def remove(self, gone: NDArray[np.bool_]) -> None:
        """Let residuals (N,) count nothing from now on, for `Problem.remove`; one at least is left."""
        if not gone.any():
            return
        self.removed = gone if self.removed is None else self.removed | gone
        # What they were connected to may go as well: they are connected to what another one has, and never looked at.
        present = int(np.argmin(self.removed))
        self.connections = tuple(
            VariableRows.known(c.block, np.where(self.removed, c.ids[present], c.ids)) for c in self.connections
        )
        self.revision += 1

    def synchronize(self) -> None:
        """Look up where the variables stand, after some were removed, held, or had their first estimates kept."""
        self._index = tuple(c.rows for c in self.connections)
        self._at_first = any(c.block.has_first_estimate(rows) for c, rows in zip(self.connections, self._index, strict=True))
        self._free = [
            None if c.block.is_held is None or self._holds else (~c.block.is_held).astype(np.float64) for c in self.connections
        ]

    def __repr__(self) -> str:
        return f"{self.name!r} ({self.residual.count} × {type(self.residual).__name__})"

    def set_loss(self, loss: Loss) -> None:
        """Weigh the residuals by another loss from the next linearisation on."""
        self.loss = loss
        scaled = self.residual.count if loss.code != SQUARED else 0
        self._factor, self._projection = np.zeros(scaled), np.zeros(scaled)
        self._fill = compiled_loss(loss.taken_down)[0] if loss.taken_down is not None else None
        self._derivatives = np.zeros((scaled if self._fill is not None else 0, 3))

    def set_weights(self, weights: NDArray[np.float64] | None) -> None:
        """Count ‖W r‖² (N,) times from the next linearisation on, whatever the loss; None for once. See `Problem.set_weights`."""
        self._root = None if weights is None else np.sqrt(weights)

    def is_weighed_as(self, loss: Loss, root: NDArray[np.float64] | None) -> bool:
        """Whether residuals count as they did when `weighting` was this."""
        if self.loss != loss or (self._root is None) != (root is None):
            return False
        return self._root is root or bool(np.array_equal(np.asarray(self._root), np.asarray(root)))

    @property
    def weighting(self) -> tuple[Loss, NDArray[np.float64] | None]:
        """What residuals count by: the loss, and the roots (N,) of weights, where they have some."""
        return self.loss, self._root

    def loss_weights(self, values: Sequence[NDArray[np.float64]] | None, threads: int = 1) -> NDArray[np.float64]:
        """(N,) weights ρ′ of the loss at the point `values`, 1 for least squares; 0 where a residual cannot be evaluated.

        Overwrites `r` and `valid`, as `evaluate` does. Without `values` at the point that was linearised or evaluated last.
        """
        if values is not None:
            self.evaluate(values, threads)
        return self._factor**2 if self.loss.code != SQUARED else self.valid.astype(np.float64)

    def squares(self, values: Sequence[NDArray[np.float64]], threads: int = 1) -> NDArray[np.float64]:
        """(N,) ‖W r‖² at the point `values`, whatever loss and weights; infinite where a residual cannot be evaluated.

        Overwrites `r` and `valid`, as `evaluate` does.
        """
        loss, root = self.loss, self._root
        self.set_loss(Squared())
        self._root = None
        try:
            self.evaluate(values, threads)
            return np.where(self.valid, (self.r * self.r).sum(axis=1), np.inf)
        finally:
            self._root = root
            self.set_loss(loss)

    def linearize(
        self, values: Sequence[NDArray[np.float64]], threads: int, tangents: Sequence[Manifold] | None = None
    ) -> GroupCost:
        """Fill `r`, `jacobians` and `valid` at the point `values` (one array a block of the problem).

        Args:
            tangents: for every block the manifold whose tangents the Jacobians are for; its own where left out.
        """
        changes = self._change
        if tangents is not None:
            parts = zip(self.residual.manifolds, self.connections, strict=True)
            changes = [tangent_change(native, tangents[c.block.number]) for native, c in parts]
        return self._visit(values, threads, changes)

    def linearize_some(self, values: Sequence[NDArray[np.float64]], chosen: NDArray[np.bool_]) -> None:
        """As `linearize`, but of the residuals from the first to the last of those chosen (N,) alone; one at least is."""
        first, after = int(np.argmax(chosen)), len(chosen) - int(np.argmax(chosen[::-1]))
        self._visit(values, 1, self._change, (first, after))

    def evaluate(self, values: Sequence[NDArray[np.float64]], threads: int) -> GroupCost:
        """Cost at the point `values`; overwrites `r` and `valid`, not the Jacobians."""
        return self._visit(values, threads, None)

    def half_turned(self, values: Sequence[NDArray[np.float64]]) -> NDArray[np.bool_]:
        """(N,) residuals whose rotation error is half a turn at the point `values`, those that were removed left out."""
        if not self.residual.rotation_rows:
            return np.zeros(self.residual.count, dtype=np.bool_)
        x = tuple(values[connection.block.number] for connection in self.connections)
        r, valid = np.zeros((self.residual.count, self.residual.dim)), np.ones(self.residual.count, dtype=np.bool_)
        self.residual.evaluate_into(0, self.residual.count, x, self._index, r, valid)
        found = self.residual.is_half_turn(r) & valid
        return found if self.removed is None else found & ~self.removed

    def unweighed(self) -> Group:
        """The same residuals under least squares, with arrays of its own: what it linearises disturbs nobody."""
        other = Group(self.residual, self.connections, Squared(), self.name)
        other.removed, other._root = self.removed, self._root
        return other

    def accept(self) -> None:
        """The next costs are compared over the residuals that are valid now."""
        self.counted[:] = self.valid

    def _visit(
        self,
        values: Sequence[NDArray[np.float64]],
        threads: int,
        changes: list[TangentChange | None] | None,
        within: tuple[int, int] | None = None,
    ) -> GroupCost:
        """Residuals, and unless `changes` is None Jacobians with the change of tangent of every connected variable.

        Args:
            within: begin and end of the residuals that are looked at; all where left out.
        """
        x = tuple(values[c.block.number] for c in self.connections)
        # Jacobians where the variables were first known, residuals where they are.
        x0 = x
        if self._at_first:
            at = {c.block.number: c.block for c in self.connections}
            points = {number: block.linearized_at(values[number]) for number, block in at.items()}
            x0 = tuple(points[c.block.number] for c in self.connections)
        residual, factors, diagonal = self.residual, self.residual.whitening.factors, self.residual.whitening.is_diagonal

        def work(chunk: int, begin: int, end: int) -> None:
            if changes is not None:
                residual.linearize_into(begin, end, x0, self._index, self.r, self.jacobians, self.valid)
                if self._at_first:
                    self._evaluate_beside(begin, end, x)
            else:
                residual.evaluate_into(begin, end, x, self._index, self.r, self.valid)
            if self.removed is not None:
                self._leave_out(begin, end, self.removed[begin:end], changes is not None)
            if not self._is_white:
                whiten_residuals(begin, end, factors, diagonal, self.r)
            if self._root is not None:
                self.r[begin:end] *= self._root[begin:end, None]
            if self._fill is not None:
                self._fill(begin, end, self.loss.scale, self.r, self.valid, self._derivatives)
            weigh_residuals(
                begin, end, self.loss.code, self.loss.scale, self.r, self.valid, self.counted,
                self._factor, self._projection, self._derivatives, self._sums[chunk],
            )  # fmt: skip
            if changes is None:
                return
            for slot, J in enumerate(self.jacobians):
                if self.connections[slot].block.is_all_fixed:
                    continue
                change = changes[slot]
                if change is not None:
                    change(begin, end, x0[slot], self._index[slot], J)
                free = self._free[slot]
                if free is not None:
                    J[begin:end] *= free[self._index[slot][begin:end], None, :]
                if not self._is_white:
                    whiten_jacobian(begin, end, factors, diagonal, J)
                if self._root is not None:
                    J[begin:end] *= self._root[begin:end, None, None]
                if self.loss.code != SQUARED:
                    weigh_jacobian(begin, end, self.r, self._factor, self._projection, J)

        if within is None:
            run_chunks(work, residual.count, self._chunk, threads if self._is_large else 1)
        else:
            work(0, *within)
        cost, common, lost, valid = (self._sums[0] if len(self._sums) == 1 else self._sums.sum(axis=0)).tolist()
        return GroupCost(cost, common, int(lost), int(valid))

    def _evaluate_beside(self, begin: int, end: int, x: tuple[NDArray[np.float64], ...]) -> None:
        """Residuals at x, beside Jacobians that were taken elsewhere; what is singular at one of the points counts nothing."""
        valid = self.valid[begin:end].copy()
        self.residual.evaluate_into(begin, end, x, self._index, self.r, self.valid)
        self.valid[begin:end] &= valid
        self._leave_out(begin, end, ~self.valid[begin:end], True)

    def _leave_out(self, begin: int, end: int, rows: NDArray[np.bool_], with_jacobians: bool) -> None:
        """Let the marked ones of the residuals [begin, end) be invalid."""
        if not rows.any():
            return
        self.valid[begin:end][rows] = False
        self.r[begin:end][rows] = 0.0
        if with_jacobians:
            for J in self.jacobians:
                J[begin:end][rows] = 0.0

    def find_not_finite(self) -> tuple[int, str] | None:
        """(residual, what) of the first NaN or infinity in the current linearisation."""
        row = first_not_finite(self.r)
        if row >= 0:
            return int(row), "residual"
        for connection, role, J in zip(self.connections, self.residual.roles, self.jacobians, strict=True):
            row = first_not_finite(J.reshape(len(J), -1))
            if row >= 0:
                return int(row), f"Jacobian with respect to {role} ({connection.block.name!r})"
        return None


def broadcast(rows: VariableRows, count: int) -> VariableRows:
    """One row for each of `count` residuals, a single one for all.

    Raises:
        InputError: another number of rows.
    """
    if len(rows) == count:
        return rows
    if len(rows) == 1:
        return VariableRows(rows.block, np.repeat(rows.ids, count))
    raise InputError(
        f"{count} rows of {rows.block.name!r}, one for each residual (or one for all)",
        f"{len(rows)}",
        "select a variable for every residual, as in cameras[camera_of]",
    )
