"""Sums Σ Aᵀ B of small matrices picked from two long arrays, kept in vector registers: the innermost step of normal equations.

Loops of Numba leave such sums in memory, which takes three to seven times as long. A tile is generated for fixed sizes: A is
(n, depth, rows), B is (m, depth, columns), and the sum over pairs of entries is (rows, columns). Sizes that have no tile, and
Numba without its compiler (NUMBA_DISABLE_JIT), take plain loops; `tile_of` says which.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core import config as numba_config
from numba.extending import intrinsic
from numpy.typing import NDArray

from boxplus._jit import kernel

LANES = 4
LOOPS = -1  # no tile
# (depth, rows, columns): pose graphs; bundle adjustment with cameras of 6 and 9 degrees of freedom, and what is eliminated.
SIZES = ((6, 6, 6), (3, 3, 3), (2, 6, 6), (2, 9, 9), (2, 3, 3), (2, 3, 6), (2, 3, 9), (3, 6, 6), (3, 9, 9))

_DOUBLE, _INDEX = ir.DoubleType(), ir.IntType(64)
_VECTOR = ir.VectorType(_DOUBLE, LANES)
_MATRICES = types.Array(types.float64, 3, "C")
_ENTRIES = types.Array(types.uint32, 1, "C")
_SUM = types.Array(types.float64, 2, "C")


def tile_of(depth: int, rows: int, columns: int) -> int:
    """Number of the tile for these sizes, or LOOPS."""
    sizes = (depth, rows, columns)
    return SIZES.index(sizes) if sizes in SIZES and not numba_config.DISABLE_JIT else LOOPS  # type: ignore[attr-defined]


def padded(columns: int) -> int:
    """Columns of a sum as the tiles store it."""
    return -(-columns // LANES) * LANES


def _tile(depth: int, rows: int, columns: int) -> Callable[..., None]:
    """tile(A, B, entry_a, entry_b, begin, end, total): total (rows, padded columns) = Σ A[entry_a[m]]ᵀ B[entry_b[m]]."""
    width = padded(columns)
    vectors = width // LANES
    mask = ir.Constant(ir.VectorType(ir.IntType(1), LANES), [lane < columns - LANES * (vectors - 1) for lane in range(LANES)])

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def data(kind: Any, value: Any) -> Any:
            return context.make_array(kind)(context, builder, value).data

        a_all, b_all = (builder.bitcast(data(_MATRICES, args[k]), ir.PointerType(_DOUBLE)) for k in (0, 1))
        entries_a, entries_b = data(_ENTRIES, args[2]), data(_ENTRIES, args[3])
        begin, end, total = args[4], args[5], builder.bitcast(data(_SUM, args[6]), ir.PointerType(_DOUBLE))

        def function(kind: Any, name: str) -> Any:
            return cgutils.get_or_insert_function(builder.module, kind, name)  # type: ignore[no-untyped-call]

        fma = function(ir.FunctionType(_VECTOR, [_VECTOR] * 3), f"llvm.fmuladd.v{LANES}f64")
        masked_type = ir.FunctionType(_VECTOR, [ir.PointerType(_VECTOR), ir.IntType(32), mask.type, _VECTOR])
        masked = function(masked_type, f"llvm.masked.load.v{LANES}f64.p0")
        undefined, zero = ir.Constant(_VECTOR, ir.Undefined), ir.Constant(_VECTOR, [0.0] * LANES)
        first_lane = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)

        def splat(scalar: Any) -> Any:
            return builder.shuffle_vector(builder.insert_element(undefined, scalar, ir.IntType(32)(0)), undefined, first_lane)

        def place(pointer: Any, index: int) -> Any:
            return builder.bitcast(builder.gep(pointer, [_INDEX(index)]), ir.PointerType(_VECTOR))

        def row_of(b: Any, i: int) -> list[Any]:
            """Row i of B; its last vector does not read beyond the row, which may be the end of the array."""
            whole = [builder.load(place(b, i * columns + v * LANES), align=8) for v in range(vectors - 1)]
            last = place(b, i * columns + (vectors - 1) * LANES)
            if columns % LANES == 0:
                return [*whole, builder.load(last, align=8)]
            return [*whole, builder.call(masked, [last, ir.IntType(32)(8), mask, zero])]

        def entry(pointer: Any, entries: Any, at: Any, size: int) -> Any:
            number = builder.zext(builder.load(builder.gep(entries, [at])), _INDEX)
            return builder.gep(pointer, [builder.mul(number, _INDEX(size))])

        before = builder.block
        loop, done = builder.append_basic_block("pairs"), builder.append_basic_block("pairs.done")
        builder.cbranch(builder.icmp_unsigned("<", begin, end), loop, done)
        builder.position_at_end(loop)
        at = builder.phi(_INDEX)
        sums = [[builder.phi(_VECTOR) for _ in range(vectors)] for _ in range(rows)]
        new: list[list[Any]] = [list(row) for row in sums]
        a, b = entry(a_all, entries_a, at, depth * rows), entry(b_all, entries_b, at, depth * columns)
        for i in range(depth):
            right = row_of(b, i)
            for p in range(rows):
                factor = splat(builder.load(builder.gep(a, [_INDEX(i * rows + p)])))
                new[p] = [builder.call(fma, [factor, right[v], new[p][v]]) for v in range(vectors)]
        following = builder.add(at, _INDEX(1))
        builder.cbranch(builder.icmp_unsigned("<", following, end), loop, done)
        at.add_incoming(begin, before)
        at.add_incoming(following, loop)
        builder.position_at_end(done)
        for p in range(rows):
            for v in range(vectors):
                sums[p][v].add_incoming(zero, before)
                sums[p][v].add_incoming(new[p][v], loop)
                result = builder.phi(_VECTOR)
                result.add_incoming(zero, before)
                result.add_incoming(new[p][v], loop)
                new[p][v] = result
        for p in range(rows):
            for v in range(vectors):
                builder.store(new[p][v], place(total, p * width + v * LANES), align=8)
        return context.get_dummy_value()

    @intrinsic  # type: ignore[misc]
    def tile(typing: Any, a: Any, b: Any, entry_a: Any, entry_b: Any, begin: Any, end: Any, total: Any) -> Any:
        return types.void(_MATRICES, _MATRICES, _ENTRIES, _ENTRIES, types.uint64, types.uint64, _SUM), generate

    return tile  # type: ignore[no-any-return]


def _plain(depth: int, rows: int, columns: int) -> Callable[..., None]:
    def tile(a, b, entry_a, entry_b, begin, end, total):  # type: ignore[no-untyped-def]
        chosen = slice(int(begin), int(end))
        total[:, :columns] = np.einsum("nip,niq->pq", a[entry_a[chosen]], b[entry_b[chosen]])

    return tile


_make = _plain if numba_config.DISABLE_JIT else _tile  # type: ignore[attr-defined]
_sum_666, _sum_333, _sum_266, _sum_299, _sum_233, _sum_236, _sum_239, _sum_366, _sum_399 = (_make(*sizes) for sizes in SIZES)


@kernel
def sum_products(
    tile: int,
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    entry_a: NDArray[np.uint32],
    entry_b: NDArray[np.uint32],
    begin: int,
    end: int,
    total: NDArray[np.float64],
) -> None:
    """total = Σ A[entry_a[m]]ᵀ B[entry_b[m]] over m in [begin, end); total is (rows, padded columns)."""
    first, last = np.uint64(begin), np.uint64(end)
    if tile == 0:
        _sum_666(a, b, entry_a, entry_b, first, last, total)
    elif tile == 1:
        _sum_333(a, b, entry_a, entry_b, first, last, total)
    elif tile == 2:
        _sum_266(a, b, entry_a, entry_b, first, last, total)
    elif tile == 3:
        _sum_299(a, b, entry_a, entry_b, first, last, total)
    elif tile == 4:
        _sum_233(a, b, entry_a, entry_b, first, last, total)
    elif tile == 5:
        _sum_236(a, b, entry_a, entry_b, first, last, total)
    elif tile == 6:
        _sum_239(a, b, entry_a, entry_b, first, last, total)
    elif tile == 7:
        _sum_366(a, b, entry_a, entry_b, first, last, total)
    elif tile == 8:
        _sum_399(a, b, entry_a, entry_b, first, last, total)
    else:
        total[:] = 0.0
        for m in range(first, last):
            left, right = a[np.uint64(entry_a[m])], b[np.uint64(entry_b[m])]
            for i in range(left.shape[0]):
                for p in range(left.shape[1]):
                    factor = left[i, p]
                    if factor != 0.0:
                        for q in range(right.shape[1]):
                            total[p, q] += factor * right[i, q]


@kernel
def add_sums(
    tile: int,
    sign: float,
    first: int,
    last: int,
    target: NDArray[np.int64],
    begin: NDArray[np.int64],
    entry_a: NDArray[np.uint32],
    entry_b: NDArray[np.uint32],
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    values: NDArray[np.float64],
) -> None:
    """values[target[k]:] += sign Σ Aᵀ B, row-major, over the pairs [begin[k], begin[k + 1]) of each k in [first, last)."""
    rows, columns = a.shape[2], b.shape[2]
    total = np.empty((rows, (columns + LANES - 1) // LANES * LANES))
    for k in range(first, last):
        sum_products(tile, a, b, entry_a, entry_b, begin[k], begin[k + 1], total)
        at = np.uint64(target[k])
        for p in range(np.uint64(rows)):
            for q in range(np.uint64(columns)):
                values[at + p * np.uint64(columns) + q] += sign * total[p, q]
