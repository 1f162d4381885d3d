"""The pattern of a symmetric block-sparse matrix: the normal matrix of a least-squares problem over variables."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix


@dataclass(frozen=True, slots=True)
class PairIndex:
    """Where pairs of variables lie in a pattern.

    Attributes:
        block: (m,) int64, block of each pair.
        transposed: (m,) bool, true where the pair (i, j) has i < j, so that the block holds its transpose.
    """

    block: NDArray[np.int64]
    transposed: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class BlockPattern:
    """Lower triangle of a symmetric block-sparse matrix, column by column.

    The values of block k are `values[value_start[k]:value_start[k + 1]]`, row-major, `(sizes[row], sizes[column])`. Diagonal
    blocks are full, but only their lower triangle is read.

    Attributes:
        sizes: (n,) int64, rows and columns of each diagonal block: the degrees of freedom of a variable.
        col_start: (n + 1,) int64, first block of each column.
        row: (m,) int64, block rows, at or below the diagonal, ascending in each column, the diagonal first.
        start: (n + 1,) int64, first scalar row of each block row.
        value_start: (m + 1,) int64, first value of each block.

    Raises:
        InputError: the arrays do not describe such a pattern.
    """

    sizes: NDArray[np.int64]
    col_start: NDArray[np.int64]
    row: NDArray[np.int64]
    start: NDArray[np.int64] = field(init=False)
    value_start: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        sizes, col_start, row = (np.ascontiguousarray(a, np.int64) for a in (self.sizes, self.col_start, self.row))
        n = len(sizes)
        start, value_start = np.zeros(n + 1, np.int64), np.zeros(len(row) + 1, np.int64)
        if sizes.ndim != 1 or not _lay_out_rows(sizes, start):
            raise InputError(
                "a size of at least 1 for every variable", f"sizes {self.sizes}", "leave out variables without freedom"
            )
        if col_start.shape != (n + 1,) or row.ndim != 1 or not _is_partition(col_start, len(row)):
            raise InputError(
                f"{n + 1} ascending column starts from 0 to {len(row)}, every column with its diagonal",
                f"{col_start}",
                "build the pattern with BlockPattern.from_pairs",
            )
        if not _lay_out_values(sizes, col_start, row, value_start):
            raise InputError(
                "in each column the diagonal and then ascending block rows below it",
                "another order",
                "build the pattern with BlockPattern.from_pairs",
            )
        for name, array in zip(self.__slots__, (sizes, col_start, row, start, value_start), strict=True):
            object.__setattr__(self, name, array)

    @classmethod
    def from_pairs(cls, sizes: ArrayLike, i: ArrayLike, j: ArrayLike) -> tuple[BlockPattern, PairIndex]:
        """The pattern with a block for each pair of variables, and where each pair lies in it.

        Args:
            sizes: (n,) degrees of freedom of the variables.
            i: (m,) first variable of each pair, in any order, repeated pairs allowed.
            j: (m,) second variable. Diagonal blocks are always there and need no pair.

        Raises:
            InputError: a variable out of range, or arrays of different lengths.
        """
        sizes, i, j = (np.atleast_1d(np.asarray(a, np.int64)) for a in (sizes, i, j))
        n = len(sizes)
        if i.shape != j.shape or i.ndim != 1:
            raise InputError("as many first as second variables", f"{i.shape} and {j.shape}", "give the pairs as two flat arrays")
        keys = np.empty(n + len(i), np.int64)
        if not _keys_of_pairs(n, np.ascontiguousarray(i), np.ascontiguousarray(j), keys):
            raise InputError(
                f"variables from 0 to {n - 1}", f"{min(i.min(), j.min())} to {max(i.max(), j.max())}", "check the indices"
            )
        different, block = unique_keys(keys, n * n)
        col_start, row = np.zeros(n + 1, np.int64), np.empty(len(different), np.int64)
        _columns_of_keys(n, different, col_start, row)
        return cls(sizes, col_start, row), PairIndex(block[n:], i < j)

    @classmethod
    def from_scipy(cls, matrix: csc_matrix, sizes: ArrayLike | None = None) -> tuple[BlockPattern, NDArray[np.float64]]:
        """Pattern and values of a symmetric scipy matrix, of which only the lower triangle is read.

        Args:
            matrix: (N, N), any sparse format.
            sizes: degrees of freedom of the variables, N in sum; 1 each when None.

        Raises:
            InputError: the matrix is not square, or the sizes do not add up to its rows.
        """
        from scipy.sparse import tril

        lower = tril(matrix).tocoo()
        size = np.ones(lower.shape[0], np.int64) if sizes is None else np.asarray(sizes, np.int64)
        if lower.shape[0] != lower.shape[1] or size.sum() != lower.shape[0]:
            raise InputError(f"a square matrix of {size.sum()} rows", f"{lower.shape}", "check matrix and sizes")
        variable, start = np.repeat(np.arange(len(size)), size), np.concatenate([[0], np.cumsum(size)])
        i, j = variable[lower.row], variable[lower.col]
        pattern, index = cls.from_pairs(size, i, j)
        values = np.zeros(pattern.value_start[-1])
        at = pattern.value_start[index.block] + (lower.row - start[i]) * size[j] + lower.col - start[j]
        np.add.at(values, at, lower.data)
        return pattern, values

    @property
    def column(self) -> NDArray[np.int64]:
        """(m,) block column of each block."""
        return np.repeat(np.arange(len(self.sizes)), np.diff(self.col_start))

    def dense_places(self) -> NDArray[np.int64]:
        """Where each value lies in the matrix (N, N) laid out row by row; the lower triangle and the diagonal blocks."""
        column = self.column
        block = np.repeat(np.arange(len(self.row)), np.diff(self.value_start))
        within = np.arange(int(self.value_start[-1])) - self.value_start[block]
        width = self.sizes[column[block]]
        rows = self.start[self.row[block]] + within // width
        return np.asarray(rows * self.start[-1] + self.start[column[block]] + within % width)

    def to_scipy(self, values: ArrayLike) -> csc_matrix:
        """The whole symmetric matrix, both triangles, (N, N)."""
        from scipy.sparse import coo_matrix

        values = np.asarray(values, np.float64)
        if values.shape != (self.value_start[-1],):
            raise InputError(
                f"{self.value_start[-1]} values", f"shape {values.shape}", "give the values of all blocks, one after another"
            )
        column = self.column
        block = np.repeat(np.arange(len(self.row)), np.diff(self.value_start))
        place = np.arange(len(values)) - self.value_start[block]
        width = self.sizes[column[block]]
        i, j = self.start[self.row[block]] + place // width, self.start[column[block]] + place % width
        lower = i >= j
        below = i > j
        entries = np.concatenate([values[lower], values[below]])
        rows, columns = np.concatenate([i[lower], j[below]]), np.concatenate([j[lower], i[below]])
        return coo_matrix((entries, (rows, columns)), shape=(self.start[-1], self.start[-1])).tocsc()


def unique_keys(keys: NDArray[np.int64], size: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The different keys in ascending order, and the position of each key among them; keys are below `size`."""
    if size > 4 * len(keys) + 65536:
        different, position = np.empty_like(keys), np.empty_like(keys)
        bits = (int(size - 1).bit_length() + 1) // 2
        return different[: _number(keys, bits, different, position)], position
    # Few variables and many pairs: a table is quicker than a sort.
    different, position = np.empty(min(size, len(keys)), np.int64), np.empty(len(keys), np.int64)
    return different[: _number_by_table(keys, np.zeros(size, np.int64), different, position)], position


@kernel
def _number_by_table(
    keys: NDArray[np.int64], table: NDArray[np.int64], different: NDArray[np.int64], position: NDArray[np.int64]
) -> int:
    """Count the different keys, which are below the length of the table of zeros, and say which one each is."""
    for k in range(np.uint64(len(keys))):
        table[np.uint64(keys[k])] = 1
    found = 0
    for key in range(np.uint64(len(table))):
        if table[key]:
            different[found] = np.int64(key)
            table[key] = found
            found += 1
    for k in range(np.uint64(len(keys))):
        position[k] = table[np.uint64(keys[k])]
    return found


@kernel
def _keys_of_pairs(n: int, i: NDArray[np.int64], j: NDArray[np.int64], keys: NDArray[np.int64]) -> bool:
    """Column · n + row of the n diagonal blocks and of every pair; False where a variable is none of the n."""
    for k in range(n):
        keys[k] = k * (n + 1)
    for k in range(len(i)):
        low, high = min(i[k], j[k]), max(i[k], j[k])
        if low < 0 or high >= n:
            return False
        keys[n + k] = low * n + high
    return True


@kernel
def _columns_of_keys(n: int, keys: NDArray[np.int64], col_start: NDArray[np.int64], row: NDArray[np.int64]) -> None:
    """Where the columns of ascending keys begin, and their rows; `col_start` is zero before."""
    for k in range(len(keys)):
        column = keys[k] // n
        row[k] = keys[k] - column * n
        col_start[column + 1] += 1
    for column in range(n):
        col_start[column + 1] += col_start[column]


@kernel
def _lay_out_rows(sizes: NDArray[np.int64], start: NDArray[np.int64]) -> bool:
    """First scalar row of each block row; False where one has none."""
    for k in range(len(sizes)):
        if sizes[k] < 1:
            return False
        start[k + 1] = start[k] + sizes[k]
    return True


@kernel
def _is_partition(col_start: NDArray[np.int64], blocks: int) -> bool:
    """Whether columns share the blocks out, one at least for each."""
    ascends = col_start[0] == 0 and col_start[len(col_start) - 1] == blocks
    for column in range(len(col_start) - 1):
        ascends &= col_start[column + 1] > col_start[column]
    return bool(ascends)


@kernel
def _lay_out_values(
    sizes: NDArray[np.int64], col_start: NDArray[np.int64], row: NDArray[np.int64], value_start: NDArray[np.int64]
) -> bool:
    """First value of each block; False where a column does not begin with its diagonal, or does not ascend."""
    n = len(sizes)
    for column in range(n):
        before = column - 1
        for k in range(col_start[column], col_start[column + 1]):
            if row[k] <= before or row[k] >= n or (before < column and row[k] != column):
                return False
            before = row[k]
            value_start[k + 1] = value_start[k] + sizes[row[k]] * sizes[column]
    return True


@kernel
def _number(keys: NDArray[np.int64], bits: int, different: NDArray[np.int64], position: NDArray[np.int64]) -> int:
    """Sort keys below 2²ᵇ by two digits of b bits each, count the different ones, and say which one each is."""
    count, base = np.uint64(len(keys)), 1 << bits
    order, second = np.empty(count, np.int64), np.empty(count, np.int64)
    low, high = np.zeros(base + 1, np.int64), np.zeros(base + 1, np.int64)
    for k in range(count):
        low[(keys[k] & (base - 1)) + 1] += 1
        high[(keys[k] >> bits) + 1] += 1
    for digit in range(base):
        low[digit + 1] += low[digit]
        high[digit + 1] += high[digit]
    for k in range(count):
        digit = keys[k] & (base - 1)
        order[low[digit]] = np.int64(k)
        low[digit] += 1
    for k in range(count):
        digit = keys[order[k]] >> bits
        second[high[digit]] = order[k]
        high[digit] += 1
    found = 0
    for k in range(count):
        key = keys[second[k]]
        if found == 0 or different[found - 1] != key:
            different[found] = key
            found += 1
        position[second[k]] = found - 1
    return found
