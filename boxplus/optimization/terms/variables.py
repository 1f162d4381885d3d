"""Variables of a problem: blocks of points of one manifold, and rows of them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._arguments import require
from boxplus._jit import kernel
from boxplus._numbers import as_array
from boxplus.errors import InputError
from boxplus.manifolds.manifold import Manifold

_WIDEST = 8  # times as many places as ids to look up, of a table that is worth filling


@kernel
def find_rows(ids: NDArray[np.int64], wanted: NDArray[np.int64], rows: NDArray[np.uint32]) -> bool:
    """Where each of the ids `wanted` stands among those that ascend, in `rows`; False where one is not among them."""
    count, first = len(ids), ids[0] if len(ids) else 0
    span = ids[count - 1] - first + 1 if count else 0
    if span <= _WIDEST * len(wanted):
        # Many are found sooner in a table than by a search for each.
        table = np.full(span, -1)
        for k in range(count):
            table[ids[k] - first] = k
        for k in range(len(wanted)):
            place = wanted[k] - first
            if place < 0 or place >= span or table[place] < 0:
                return False
            rows[k] = table[place]
        return True
    for k in range(len(wanted)):
        row = np.searchsorted(ids, wanted[k])
        if row >= count or ids[row] != wanted[k]:
            return False
        rows[k] = row
    return True


class Variables:
    """A block of n variables on one manifold, made by `Problem.add_variables`.

    `block[3]` and `block[[3, 5]]` select variables by their ids for `add_residuals`, `fix` and `covariance`; ids may repeat. An
    id is the place at which a variable was added, counted from 0, and stays its name for good: removing others does not change
    it, and it is never given again. Slices and masks select among the variables that are there, in their order.

    Attributes:
        manifold: of every variable of the block.
        name: for messages.
        ids: (n,) of the variables that are there, ascending.
        values: (n, size), where the next search starts; a solution has its own.
        is_fixed: (n,) bool, held where they start by the solver; set by `Problem.fix` and `free` only.
        is_held: (n, dof) bool, single components that are held; None for none. Set likewise.
        is_all_fixed: whether all of them are.
        number: of the block in its problem.
        revision: grows when something happens that invalidates what was worked out about the block; not when it is extended.
    """

    def __init__(self, number: int, name: str, manifold: Manifold, values: NDArray[np.float64]) -> None:
        require(name, str, "a name as text", "leave it out for one that is made up")
        self.number, self.name, self.manifold, self.values = number, name, manifold, values
        self.ids = np.arange(len(values))
        self.set_fixed(np.zeros(len(values), dtype=np.bool_))
        self.is_held: NDArray[np.bool_] | None = None
        self.revision = 0
        self.next_id = len(values)
        self._is_first, self._has_first = np.zeros(len(values), dtype=np.bool_), False
        self._first = values

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, selected: Any) -> VariableRows:
        return VariableRows(self, selected)

    def __iter__(self) -> Iterator[VariableRows]:
        return (self[int(k)] for k in self.ids)

    def __repr__(self) -> str:
        return f"{len(self)} variables {self.name!r} on {self.manifold}"

    def rows_of(self, ids: NDArray[np.int64]) -> NDArray[np.uint32]:
        """At which row each variable stands now.

        Raises:
            InputError: one of them was removed.
        """
        if self.next_id == len(self.ids):  # nothing was ever removed
            return ids.astype(np.uint32)
        if len(ids) == 1 and (row := int(self.ids.searchsorted(ids[0]))) < len(self.ids) and self.ids[row] == ids[0]:
            return np.array([row], dtype=np.uint32)  # as marginal priors ask for theirs, one by one
        if not len(ids):
            return np.zeros(0, dtype=np.uint32)
        rows = np.empty(len(ids), dtype=np.uint32)
        if not find_rows(self.ids, np.array(ids, dtype=np.int64), rows):
            gone = ~np.isin(ids, self.ids)
            raise InputError(
                f"variables of {self.name!r} that are there",
                f"{self.name}[{ids[np.argmax(gone)]}], which was removed",
                "drop what was connected to it",
            )
        return rows

    def extend(self, values: NDArray[np.float64]) -> VariableRows:
        """Append variables, for `Problem.extend`."""
        count = len(values)
        self.ids = np.append(self.ids, self.next_id + np.arange(count))
        self.next_id += count
        self.values, self._first = np.concatenate([self.values, values]), np.concatenate([self._first, values])
        self._is_first = np.append(self._is_first, np.zeros(count, dtype=np.bool_))
        self.set_fixed(np.append(self.is_fixed, np.zeros(count, dtype=np.bool_)))
        if self.is_held is not None:
            self.is_held = np.concatenate([self.is_held, np.zeros((count, self.manifold.dof), dtype=np.bool_)])
        return VariableRows(self, self.ids[len(self.ids) - count :])

    def drop(self, gone: NDArray[np.bool_]) -> None:
        """Remove variables (n,), for `Problem.remove`."""
        if not gone.any():
            return
        self.ids, self.values, self._first = self.ids[~gone], self.values[~gone], self._first[~gone]
        self._is_first = self._is_first[~gone]
        self.set_fixed(self.is_fixed[~gone])
        if self.is_held is not None:
            self.is_held = self.is_held[~gone]
        self.revision += 1

    def set_fixed(self, is_fixed: NDArray[np.bool_]) -> None:
        """Take over (n,) which are fixed, for `Problem.fix` and `free`."""
        self.is_fixed = is_fixed
        self.is_fixed.flags.writeable = False
        self.is_all_fixed = bool(is_fixed.all())

    def set_held(self, is_held: NDArray[np.bool_]) -> None:
        """Take over (n, dof) which components are held, for `Problem.fix` and `free`."""
        self.is_held = is_held if is_held.any() else None
        self.revision += 1

    def has_first_estimate(self, rows: NDArray[np.uint32]) -> bool:
        """Whether the Jacobians of one of these variables are taken at its first estimate, as a marginal prior knows it."""
        return self._has_first and bool(self._is_first[rows].any())

    def keep_first_estimates(self, known: NDArray[np.bool_], x0: NDArray[np.float64]) -> None:
        """Take Jacobians of the variables `known` (n,) at their points x0 (n, size) from now on, others where they are."""
        if not np.array_equal(known, self._is_first):
            self.revision += 1
        self._is_first, self._has_first, self._first = known, bool(known.any()), x0

    def linearized_at(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where Jacobians are taken when the block is at `values`: there, or at the first estimates."""
        if not self._has_first:
            return values
        known = self._is_first[: len(values)]  # a solution may be older than the last variables
        return np.where(known[:, None], self._first[: len(values)], values)


class VariableRows:
    """Some variables of one block, such as those that each residual of a group is connected to; see `Variables`.

    Attributes:
        block, ids: the block, and the ids of the variables in it.

    Raises:
        InputError: an id out of range, negative, of a removed variable, or not an integer.
    """

    def __init__(self, block: Variables, selected: ArrayLike | slice) -> None:
        self.block = block
        if isinstance(selected, slice):
            selected = block.ids[selected]
        elif isinstance(selected, (int, np.integer)) and 0 <= selected < block.next_id:
            self.ids = np.array([selected], dtype=np.int64)
            self._rows, self._revision = block.rows_of(self.ids), block.revision
            return
        given = as_array(selected, f"rows of {block.name!r}")
        if given.dtype == np.int64 and given.ndim == 1 and self._is_there(given):
            return
        if given.dtype == np.bool_ and given.shape == (len(block),):
            given = block.ids[given]
        if given.size == 0:
            given = given.astype(np.int64)
        if given.ndim > 1 or not np.issubdtype(given.dtype, np.integer):
            raise InputError(
                f"integer rows of {block.name!r}, one-dimensional",
                f"{given.dtype} of shape {given.shape}",
                "select with integers",
            )
        given = np.atleast_1d(given)
        if len(given) and (given.min() < 0 or given.max() >= block.next_id):
            outside = (given < 0) | (given >= block.next_id)
            at = int(np.argmax(outside))
            raise InputError(
                f"rows of {block.name!r} from 0 to {block.next_id - 1}",
                f"{given[at]} at position {at}",
                "the index dangles: repair the association",
            )
        self.ids = given.astype(np.int64)
        self._rows, self._revision = block.rows_of(self.ids), block.revision

    def _is_there(self, given: NDArray[np.int64]) -> bool:
        """Takes these ids where all of them are in the block, as they mostly are."""
        block = self.block
        if not (len(given) and len(block)):
            return False
        if block.next_id == len(block):  # nothing was ever removed
            if given.min() < 0 or given.max() >= block.next_id:
                return False
            ids, rows = given.copy(), given.astype(np.uint32)
        else:
            ids, rows = given.copy(), np.empty(len(given), dtype=np.uint32)
            if not find_rows(block.ids, ids, rows):
                return False
        self.ids, self._rows, self._revision = ids, rows, self.block.revision
        return True

    @classmethod
    def known(cls, block: Variables, ids: NDArray[np.int64], rows: NDArray[np.uint32] | None = None) -> VariableRows:
        """Of ids (k,) that are known to be there, at rows (k,); where none are given they are looked up when asked for."""
        selected = cls.__new__(cls)
        selected.block, selected.ids = block, ids
        if rows is None:
            selected._revision = -1
        else:
            selected._rows, selected._revision = rows, block.revision
        return selected

    def __len__(self) -> int:
        return len(self.ids)

    def singles(self) -> list[VariableRows]:
        """A selection of one variable for every one of these."""
        rows = self.rows
        return [VariableRows.known(self.block, self.ids[k : k + 1], rows[k : k + 1]) for k in range(len(rows))]

    @property
    def rows(self) -> NDArray[np.uint32]:
        """(k,) where the variables stand in the values of their block now.

        Raises:
            InputError: one of them was removed.
        """
        if self._revision != self.block.revision:
            self._rows, self._revision = self.block.rows_of(self.ids), self.block.revision
        return self._rows
