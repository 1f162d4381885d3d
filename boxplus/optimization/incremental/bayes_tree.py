"""The Bayes tree of a growing least-squares problem: factors, cliques and δ in arrays that kernels work on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.optimization.incremental.arena import CLASSES
from boxplus.optimization.incremental.growing import grown
from boxplus.optimization.incremental.marginals import solve_unit_columns
from boxplus.optimization.incremental.records import CLIQUE, NONE
from boxplus.optimization.incremental.tree_update import DONE, NEEDS_ROOM, update_tree

Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class TreeUpdate:
    """What one elimination did.

    Attributes:
        changed: variables whose δ has changed.
        solved: variables that were solved for.
        eliminated: variables that were eliminated anew.
        cliques: that these make up.
        undetermined: the variable at which the elimination failed, the tree being what it was; −1 where it did not.
    """

    changed: Indices
    solved: int
    eliminated: int
    cliques: int
    undetermined: int


@kernel
def _append_factors(first: int, connected: Indices, dof: Indices, factor_start: Indices, factor_variables: Indices,
                    factor_of: Indices, adjacency: Indices, next_entry: Indices, contribution_at: Indices) -> None:  # fmt: skip
    """Enter factors that connect variables (N, k), −1 for none, from number `first` on."""
    for n in range(connected.shape[0]):
        f = first + n
        entry, columns = factor_start[f], 1
        for k in range(connected.shape[1]):
            v = connected[n, k]
            if v >= 0:
                factor_variables[entry], factor_of[entry] = v, f
                next_entry[entry] = adjacency[v]
                adjacency[v] = entry
                entry += 1
                columns += dof[v]
        factor_start[f + 1] = entry
        contribution_at[f + 1] = contribution_at[f] + columns * columns


@kernel
def _touched(mark: int, variables: Indices, first: int, end: int, adjacency: Indices, next_entry: Indices, factor_of: Indices,
             factor_start: Indices, factor_mark: Indices, found: Indices) -> tuple[int, int]:  # fmt: skip
    """Factors of variables and those from `first` on: their number and that of their connections."""
    count, connections = 0, 0
    for f in range(first, end):
        factor_mark[f] = mark
        found[count] = f
        count += 1
        connections += factor_start[f + 1] - factor_start[f]
    for v in variables:
        entry = adjacency[v]
        while entry != NONE:
            f = factor_of[entry]
            if factor_mark[f] != mark:
                factor_mark[f] = mark
                found[count] = f
                count += 1
                connections += factor_start[f + 1] - factor_start[f]
            entry = next_entry[entry]
    return count, connections


@kernel
def _near(mark: int, first: int, end: int, steps: int, adjacency: Indices, next_entry: Indices, factor_of: Indices,
          factor_start: Indices, factor_variables: Indices, variable_mark: Indices, found: Indices) -> int:  # fmt: skip
    """Variables of the factors from `first` on, and those that are up to `steps` factors away; returns their number."""
    count = 0
    for k in range(factor_start[first], factor_start[end]):
        v = factor_variables[k]
        if variable_mark[v] != mark:
            variable_mark[v] = mark
            found[count] = v
            count += 1
    begin = 0
    for _ in range(steps):
        reached = count
        for n in range(begin, reached):
            entry = adjacency[found[n]]
            while entry != NONE:
                f = factor_of[entry]
                for k in range(factor_start[f], factor_start[f + 1]):
                    v = factor_variables[k]
                    if variable_mark[v] != mark:
                        variable_mark[v] = mark
                        found[count] = v
                        count += 1
                entry = next_entry[entry]
        begin = reached
    return count


@kernel
def _variables_of(factors: Indices, factor_start: Indices, factor_variables: Indices, seeds: Indices) -> None:
    used = 0
    for f in factors:
        for k in range(factor_start[f], factor_start[f + 1]):
            seeds[used] = factor_variables[k]
            used += 1


@kernel
def _refresh_information(variables: Indices, adjacency: Indices, next_entry: Indices, factor_of: Indices, factor_start: Indices,
                         factor_variables: Indices, dof: Indices, start: Indices, contribution_at: Indices,
                         contributions: NDArray[np.float64], information: NDArray[np.float64]) -> None:  # fmt: skip
    """Diagonals of JᵀJ of variables, over all their factors as they are linearised now."""
    for v in variables:
        for i in range(start[v], start[v] + dof[v]):
            information[i] = 0.0
        entry = adjacency[v]
        while entry != NONE:
            f = factor_of[entry]
            before, columns = 0, 1
            for k in range(factor_start[f], factor_start[f + 1]):
                before += dof[factor_variables[k]] if k < entry else 0
                columns += dof[factor_variables[k]]
            at = contribution_at[f] + before * (columns + 1)
            for i in range(start[v], start[v] + dof[v]):
                information[i] += contributions[at]
                at += columns + 1
            entry = next_entry[entry]


class BayesTree:
    """Factors over variables, and the cliques of their elimination.

    Attributes:
        variables, factors: their numbers.
        start: where each variable begins in `delta`.
        delta: δ of the last update.
        contribution_at, contributions: see `contributions.products`; the caller writes them.
    """

    def __init__(self) -> None:
        self.variables, self.factors = 0, 0
        none = np.zeros(0, np.int64)
        self.dof, self.start, self._clique_of, self._variable_mark, self._local, self._adjacency, self._changed = (none,) * 7
        self.delta, self._information = np.zeros(0), np.zeros(0)
        self._factor_start, self.contribution_at = np.zeros(1, np.int64), np.zeros(1, np.int64)
        self._factor_mark, self._found, self._factor_variables, self._factor_of, self._next_entry = (none,) * 5
        self.contributions = np.zeros(0)
        self._table = np.zeros(1, CLIQUE)
        self._table["first_child"] = NONE
        self._tops = np.array([0, 0, 1, 0])
        self._free_cliques, self._scratch = none, np.zeros(1, np.int64)
        self._numbers, self._integers = np.zeros(0), none
        self._number_heads, self._integer_heads = np.full(CLASSES, NONE), np.full(CLASSES, NONE)
        self._counts = np.zeros(4, np.int64)
        self._mark = 0
        self._tangents = 0

    def add_variables(self, count: int, dof: int) -> int:
        """Number of the first of `count` new variables."""
        first, end = self.variables, self.variables + count
        if end > len(self.dof):
            self.dof, self.start = grown(self.dof, end), grown(self.start, end)
            self._clique_of, self._adjacency = grown(self._clique_of, end, NONE), grown(self._adjacency, end, NONE)
            self._variable_mark, self._local, self._changed = (
                grown(a, end) for a in (self._variable_mark, self._local, self._changed)
            )
            cliques = 2 * len(self.dof) + 1  # old and new ones are there at the same time
            self._table, self._free_cliques = grown(self._table, cliques), grown(self._free_cliques, cliques)
            self._scratch = grown(self._scratch, cliques)
        self.dof[first:end] = dof
        self.start[first:end] = self._tangents + dof * np.arange(count)
        self._tangents += dof * count
        self.delta, self._information = grown(self.delta, self._tangents), grown(self._information, self._tangents)
        self.variables = end
        return first

    def add_factors(self, connected: Indices) -> int:
        """Number of the first of N new factors that connect variables (N, k), −1 for a connection to something fixed."""
        first, end = self.factors, self.factors + len(connected)
        self._factor_start, self.contribution_at = grown(self._factor_start, end + 1), grown(self.contribution_at, end + 1)
        self._factor_mark, self._found = grown(self._factor_mark, end), grown(self._found, end)
        entries = int(self._factor_start[first]) + connected.size
        self._factor_variables, self._factor_of = grown(self._factor_variables, entries), grown(self._factor_of, entries)
        self._next_entry = grown(self._next_entry, entries)
        _append_factors(
            first, connected, self.dof, self._factor_start, self._factor_variables, self._factor_of, self._adjacency,
            self._next_entry, self.contribution_at,
        )  # fmt: skip
        self.contributions = grown(self.contributions, int(self.contribution_at[end]))
        self.factors = end
        return first

    def factors_of(self, variables: Indices, first: int) -> tuple[Indices, int]:
        """The factors of `variables` and those from number `first` on, and how many connections they have."""
        self._mark += 1
        count, connections = _touched(
            self._mark, variables, first, self.factors, self._adjacency, self._next_entry, self._factor_of, self._factor_start,
            self._factor_mark, self._found,
        )  # fmt: skip
        return self._found[:count].copy(), int(connections)

    def touched(self, variables: Indices, first: int) -> tuple[Indices, Indices]:
        """The factors of `variables` and those from number `first` on, and the variables of all of them."""
        factors, connections = self.factors_of(variables, first)
        seeds = np.empty(connections, np.int64)
        _variables_of(factors, self._factor_start, self._factor_variables, seeds)
        return factors, seeds

    def variables_of(self, factors: Indices) -> Indices:
        """The variables of factors, repeated where they share some."""
        found = np.empty(int((self._factor_start[factors + 1] - self._factor_start[factors]).sum()), np.int64)
        _variables_of(factors, self._factor_start, self._factor_variables, found)
        return found

    def near_factors(self, first: int, steps: int) -> Indices:
        """The variables of the factors from number `first` on, and those that are up to `steps` factors away from them."""
        self._mark += 1
        count = _near(
            self._mark, first, self.factors, steps, self._adjacency, self._next_entry, self._factor_of, self._factor_start,
            self._factor_variables, self._variable_mark, self._changed,
        )  # fmt: skip
        return self._changed[:count].copy()

    def is_touched(self, variables: Indices) -> NDArray[np.bool_]:
        """Whether variables have any factor."""
        return np.asarray(self._adjacency[variables] != NONE)

    def update(self, seeds: Indices, last: Indices, wildfire: float) -> TreeUpdate:
        """Eliminate what `seeds` touch and all above; see `update_tree`."""
        _refresh_information(
            seeds, self._adjacency, self._next_entry, self._factor_of, self._factor_start, self._factor_variables, self.dof,
            self.start, self.contribution_at, self.contributions, self._information,
        )  # fmt: skip
        while True:
            self._mark += 1
            status = update_tree(
                self._mark, seeds, last, wildfire, self._table, self._tops, self._free_cliques, self._numbers,
                self._number_heads, self._integers, self._integer_heads, self.dof, self.start, self.delta, self._information,
                self._clique_of, self._variable_mark, self._local, self._adjacency, self._next_entry, self._factor_of,
                self._factor_start, self._factor_variables, self._factor_mark, self.contribution_at, self.contributions,
                self._found, self._scratch, self._changed, self._counts,
            )  # fmt: skip
            counts = self._counts
            if status == DONE:
                changed = self._changed[: counts[0]].copy()
                return TreeUpdate(changed, int(counts[1]), int(counts[2]), int(counts[3]), NONE)
            if status != NEEDS_ROOM:
                return TreeUpdate(np.zeros(0, np.int64), 0, 0, 0, int(counts[0]))
            numbers = np.empty(max(2 * len(self._numbers), int(self._tops[0] + counts[0])))
            numbers[: self._tops[0]] = self._numbers[: self._tops[0]]
            self._numbers = numbers
            self._integers = grown(self._integers, int(self._tops[1] + counts[1]))

    def inverse_columns(self, variable: int, targets: Indices) -> NDArray[np.float64]:
        """Rows of the `targets`, one after the other, of the columns of H⁻¹ that belong to a variable."""
        self._mark += 1
        out = np.empty((int(self.dof[targets].sum()), int(self.dof[variable])))
        solve_unit_columns(
            variable, targets, self._mark, self._table, self._clique_of, self._integers, self._numbers, self.dof, self.start,
            np.zeros(self._tangents), self._scratch, out,
        )  # fmt: skip
        return out
