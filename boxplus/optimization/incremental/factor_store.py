"""Residuals of one kind with one loss, and what they contribute to the normal equations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.incremental.contributions import (
    check_planar_poses,
    check_relative_poses,
    errors,
    linearize_relative_poses,
    products,
    starts,
    turned_factors,
)
from boxplus.optimization.incremental.growing import grown
from boxplus.optimization.incremental.variables import GrowingVariables
from boxplus.optimization.losses import SQUARED, Loss
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.variables import VariableRows, Variables
from boxplus.residuals.relative_pose import RelativePose
from boxplus.residuals.relative_pose_2d import RelativePose2D
from boxplus.residuals.residual import Residual
from boxplus.residuals.whitening import Whitening

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Described = tuple[Residual, list[VariableRows], Loss, str]


class FactorStore(Protocol):
    """Residuals whose contributions are computed together."""

    def linearize(self, rows: Indices, blocks: Sequence[GrowingVariables], at: Indices, contributions: Array) -> int:
        """Write the contributions of some residuals, at the points of linearisation; `at` (k,) their first elements.

        Returns the first of the rows that is not finite, or −1.
        """

    def check(
        self, rows: Indices, blocks: Sequence[GrowingVariables], start: Indices, delta: Array, tolerance: float
    ) -> NDArray[np.bool_]:
        """Which of the residuals (k,) are off their linearisation by more than `tolerance` at the estimates."""

    def described(self, blocks: Sequence[Variables]) -> Described:
        """All residuals over blocks of the same numbers."""


class RelativePoseStore:
    """Relative poses, in the plane or in space, of any number of `add_residuals`: no Python object each.

    Args:
        example: residual whose kind and options all have.
        first, second: numbers of the blocks that they connect.
    """

    def __init__(self, example: RelativePose | RelativePose2D, first: int, second: int, loss: Loss, name: str) -> None:
        self._kind, self._blocks, self._loss, self._name = type(example), (first, second), loss, name
        self._is_spatial = isinstance(example, RelativePose)
        self._is_exact = not isinstance(example, RelativePose) or example.jacobian == "exact"
        self._count = 0
        self._measured, self._factors = np.zeros((0, example.measured.shape[1])), np.zeros((0, example.dim, example.dim))
        self._index, self._free = np.zeros((0, 2), np.uint32), np.zeros((0, 2), np.bool_)
        self._r, self._at = np.zeros((0, example.dim)), np.zeros(0, np.int64)
        self._J_i, self._J_j = np.zeros((0, example.dim, example.dim)), np.zeros((0, example.dim, example.dim))
        self._is_plain = not self._is_spatial and loss.code == SQUARED
        self._turned = np.zeros((0, 3, 3))  # where it is plain

    def append(self, residual: RelativePose | RelativePose2D, rows: NDArray[np.uint32], free: NDArray[np.bool_]) -> int:
        """Row of the first of more residuals that connect `rows` (N, 2)."""
        begin, end = self._count, self._count + residual.count
        self._measured, self._factors = grown(self._measured, end), grown(self._factors, end)
        self._index, self._free, self._at = grown(self._index, end), grown(self._free, end), grown(self._at, end)
        self._r, self._J_i, self._J_j = (grown(a, end) for a in (self._r, self._J_i, self._J_j))
        self._measured[begin:end], self._factors[begin:end] = residual.measured, residual.whitening.factors
        self._index[begin:end], self._free[begin:end] = rows, free
        if self._is_plain:
            self._turned = grown(self._turned, end)
            turned_factors(begin, end, self._measured, self._factors, self._turned)
        self._count = end
        return begin

    def linearize(self, rows: Indices, blocks: Sequence[GrowingVariables], at: Indices, contributions: Array) -> int:
        self._at[rows] = at
        first, second = (blocks[number].points for number in self._blocks)
        return int(
            linearize_relative_poses(
                rows, self._is_spatial, self._is_exact, first, second, self._index, self._measured, self._factors,
                self._loss.code, self._loss.scale, self._free, self._r, self._J_i, self._J_j, self._at, contributions,
            )
        )  # fmt: skip

    def check(
        self, rows: Indices, blocks: Sequence[GrowingVariables], start: Indices, delta: Array, tolerance: float
    ) -> NDArray[np.bool_]:
        first, second = (blocks[number] for number in self._blocks)
        is_off = np.empty(len(rows), np.bool_)
        if self._is_plain:
            check_planar_poses(
                rows, first.estimates, second.estimates, self._index, self._measured, self._turned, first.numbers,
                second.numbers, start, delta, tolerance, self._r, self._J_i, self._J_j, is_off,
            )  # fmt: skip
            return is_off
        check_relative_poses(
            rows, self._is_spatial, self._is_exact, first.estimates, second.estimates, self._index, self._measured, self._factors,
            self._loss.code, self._loss.scale, first.numbers, second.numbers, start, delta, tolerance,
            self._r, self._J_i, self._J_j, is_off,
        )  # fmt: skip
        return is_off

    def described(self, blocks: Sequence[Variables]) -> Described:
        n = self._count
        residual = self._kind(self._measured[:n])
        if not self._is_exact:
            residual = RelativePose(self._measured[:n], jacobian="first_order")
        residual.whitening = Whitening(self._factors[:n].copy(), False)
        rows = [VariableRows(blocks[number], self._index[:n, slot]) for slot, number in enumerate(self._blocks)]
        return residual, rows, self._loss, self._name


class GroupStore:
    """Residuals of any kind, as they were added: all are linearised where one has to be."""

    def __init__(self, group: Group, free: NDArray[np.bool_]) -> None:
        self._group, self._free = group, free
        self._at, self._r = np.zeros(len(free), np.int64), np.zeros_like(group.r)
        self._index = np.stack([connection.rows for connection in group.connections], axis=1)

    def linearize(self, rows: Indices, blocks: Sequence[GrowingVariables], at: Indices, contributions: Array) -> int:
        self._at[rows] = at
        self._group.linearize([block.points for block in blocks], 1)
        self._r[:] = self._group.r
        return int(products(rows, self._free, rows, self._r, self._group.jacobians, self._at, contributions))

    def check(
        self, rows: Indices, blocks: Sequence[GrowingVariables], start: Indices, delta: Array, tolerance: float
    ) -> NDArray[np.bool_]:
        self._group.evaluate([block.estimates for block in blocks], 1)
        is_off = np.empty(len(rows), np.bool_)
        ids = tuple(blocks[c.block.number].numbers for c in self._group.connections)
        places = starts(rows, self._index, ids, start)
        errors(rows, rows, self._group.r, self._r, self._group.jacobians, places, delta, tolerance, is_off)
        return is_off

    def described(self, blocks: Sequence[Variables]) -> Described:
        own = self._group
        return own.residual, [VariableRows(blocks[c.block.number], c.rows) for c in own.connections], own.loss, own.name
