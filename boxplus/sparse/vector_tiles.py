"""Register tiles of dense linear algebra as LLVM vector code: the innermost step of the sparse Cholesky factorisation.

A tile covers up to `TILE_ROWS` rows and 6, 3 or 1 columns of a column-major matrix C, whose rows lie in vector registers:

- `update`: C ← C - A Bᵀ, or C ← -A Bᵀ, over `depth` columns of A and B;
- `transposed`: the same with B stored as its transpose, `depth` rows;
- `dots`: for a single row of C, contiguous, and of A, with B stored as its transpose: C ← C - A Bᵀ;
- `add`: C ← C + A for one column, short as a rule;
- `solve`: C ← (C - A Bᵀ) L⁻ᵀ, where the lower triangle L follows B in its memory, as it does in a panel that is
  factorised from left to right, and the reciprocals of its diagonal are given;
- `factor`: the same where C begins with the rows of L itself, which is formed in registers; the pivots (squares of L's
  diagonal) and the reciprocals are stored. A pivot that is not positive leaves a reciprocal that is not positive and finite.

Numba's loops leave such accumulators in memory; explicit vectors reach the speed of a tuned BLAS, need no foreign library and
no threads of one, and give the same bits on every call. Arrays are flat float64 buffers with an offset (`_at`, elements)
and a column stride. Where Numba does not compile (NUMBA_DISABLE_JIT), plain NumPy does the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from llvmlite import binding, ir
from numba.core import cgutils, types
from numba.core import config as numba_config
from numba.extending import intrinsic
from numpy.typing import NDArray

LANES = 8  # rows per vector; where registers are narrower LLVM splits it
TILE_VECTORS = 2 if binding.get_host_cpu_features().get("avx512f", False) else 1
TILE_ROWS = LANES * TILE_VECTORS
TALL_FROM = LANES + 1 if TILE_VECTORS > 1 else LANES  # rows from which on the tall tile is used

_DOUBLE = ir.DoubleType()
_INDEX = ir.IntType(64)
_VECTOR = ir.VectorType(_DOUBLE, LANES)
_MASK = ir.VectorType(ir.IntType(1), LANES)


def _function(module: Any, kind: Any, name: str) -> Any:
    return cgutils.get_or_insert_function(module, kind, name)  # type: ignore[no-untyped-call]


class _Emitter:
    """Vector loads, stores and arithmetic at `pointer + index` within the function that is being built."""

    def __init__(self, builder: Any, valid_rows: Any, vectors: int, *, masked: bool = True) -> None:
        self.builder = builder
        self.full = vectors - 1 if masked else vectors
        self.vectors = vectors
        module = builder.module
        pointer = ir.PointerType(_VECTOR)
        self._fma = _function(module, ir.FunctionType(_VECTOR, [_VECTOR] * 3), f"llvm.fmuladd.v{LANES}f64")
        self._load = _function(
            module, ir.FunctionType(_VECTOR, [pointer, ir.IntType(32), _MASK, _VECTOR]), f"llvm.masked.load.v{LANES}f64.p0"
        )
        self._store = _function(
            module, ir.FunctionType(ir.VoidType(), [_VECTOR, pointer, ir.IntType(32), _MASK]), f"llvm.masked.store.v{LANES}f64.p0"
        )
        lanes = ir.Constant(ir.VectorType(_INDEX, LANES), list(range(LANES)))
        rest = builder.sub(valid_rows, _INDEX(LANES * (vectors - 1)))
        self._last_rows = builder.icmp_unsigned("<", lanes, self.splat(rest, ir.VectorType(_INDEX, LANES)))
        self.zero = ir.Constant(_VECTOR, [0.0] * LANES)

    def splat(self, scalar: Any, vector_type: Any = _VECTOR) -> Any:
        start = self.builder.insert_element(ir.Constant(vector_type, ir.Undefined), scalar, ir.IntType(32)(0))
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        return self.builder.shuffle_vector(start, ir.Constant(vector_type, ir.Undefined), zeros)

    def address(self, pointer: Any, index: Any) -> Any:
        return self.builder.gep(pointer, [index])

    def broadcast(self, pointer: Any, index: Any) -> Any:
        return self.splat(self.builder.load(self.address(pointer, index)))

    def load(self, pointer: Any) -> list[Any]:
        found = []
        for v in range(self.vectors):
            place = self.builder.bitcast(self.address(pointer, _INDEX(LANES * v)), ir.PointerType(_VECTOR))
            if v < self.full:
                found.append(self.builder.load(place, align=8))
            else:
                found.append(self.builder.call(self._load, [place, ir.IntType(32)(8), self._last_rows, self.zero]))
        return found

    def store(self, values: list[Any], pointer: Any) -> None:
        for v, value in enumerate(values):
            place = self.builder.bitcast(self.address(pointer, _INDEX(LANES * v)), ir.PointerType(_VECTOR))
            if v < self.full:
                self.builder.store(value, place, align=8)
            else:
                self.builder.call(self._store, [value, place, ir.IntType(32)(8), self._last_rows])

    def fma(self, x: Any, y: Any, z: Any) -> Any:
        """x y + z."""
        return self.builder.call(self._fma, [x, y, z])

    def product(
        self, a: Any, lda: Any, b: Any, ldb: Any, depth: Any, columns: int, *, transposed: bool = False
    ) -> list[list[Any]]:
        """`A Bᵀ` of the tile as vectors, `[column][vector]`; `transposed`: B is stored as its transpose."""
        builder = self.builder
        places = [builder.mul(ldb, _INDEX(c)) if transposed else _INDEX(c) for c in range(columns)]
        before = builder.block
        loop, done = builder.append_basic_block("depth"), builder.append_basic_block("depth.done")
        builder.cbranch(builder.icmp_unsigned(">", depth, _INDEX(0)), loop, done)
        builder.position_at_end(loop)
        step, a_now, b_now = builder.phi(_INDEX), builder.phi(a.type), builder.phi(b.type)
        sums = [[builder.phi(_VECTOR) for _ in range(self.vectors)] for _ in range(columns)]
        rows = self.load(a_now)
        new = []
        for c in range(columns):
            factor = self.broadcast(b_now, places[c])
            new.append([self.fma(rows[v], factor, sums[c][v]) for v in range(self.vectors)])
        following, a_next, b_next = (
            builder.add(step, _INDEX(1)),
            self.address(a_now, lda),
            self.address(b_now, _INDEX(1) if transposed else ldb),
        )
        end = builder.block
        builder.cbranch(builder.icmp_unsigned("<", following, depth), loop, done)
        for phi, start, again in [(step, _INDEX(0), following), (a_now, a, a_next), (b_now, b, b_next)]:
            phi.add_incoming(start, before)
            phi.add_incoming(again, end)
        builder.position_at_end(done)
        result = []
        for c in range(columns):
            row = []
            for v in range(self.vectors):
                sums[c][v].add_incoming(self.zero, before)
                sums[c][v].add_incoming(new[c][v], end)
                total = builder.phi(_VECTOR)
                total.add_incoming(self.zero, before)
                total.add_incoming(new[c][v], end)
                row.append(total)
            result.append(row)
        return result


_N = types.uint64
_BUFFER = types.Array(types.float64, 1, "C")
_OPERANDS = (_BUFFER, _N, _N, _BUFFER, _N, _N, _BUFFER, _N, _N, _N, _N)


def _pointer(context: Any, builder: Any, array: Any, offset: Any) -> Any:
    data = context.make_array(_BUFFER)(context, builder, array).data
    return builder.gep(builder.bitcast(data, ir.PointerType(_DOUBLE)), [offset])


class _Tile:
    """What the tiles begin with: C, and the product A Bᵀ."""

    def __init__(self, context: Any, builder: Any, args: Any, shape: tuple[int, int, bool], *, transposed: bool = False) -> None:
        columns, vectors, masked = shape
        c, c_at, ldc, a, a_at, lda, b, b_at, ldb, depth, rows = args[:11]
        self.emit = _Emitter(builder, rows, vectors, masked=masked)
        start, b_pointer = _pointer(context, builder, c, c_at), _pointer(context, builder, b, b_at)
        a_pointer = _pointer(context, builder, a, a_at)
        self.products = self.emit.product(a_pointer, lda, b_pointer, ldb, depth, columns, transposed=transposed)
        self.behind_b = self.emit.address(b_pointer, builder.mul(ldb, depth))
        self.places = [self.emit.address(start, builder.mul(ldc, _INDEX(k))) for k in range(columns)]


def _compiled_update(shape: tuple[int, int, bool], *, transposed: bool) -> Callable[..., None]:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        tile = _Tile(context, builder, args, shape, transposed=transposed)
        emit = tile.emit
        for place, products in zip(tile.places, tile.products, strict=True):
            entry, add, store = builder.block, builder.append_basic_block("accumulate"), builder.append_basic_block("store")
            builder.cbranch(builder.icmp_unsigned("!=", args[11], _INDEX(0)), add, store)
            builder.position_at_end(add)
            old = emit.load(place)
            builder.branch(store)
            builder.position_at_end(store)
            starts = [builder.phi(_VECTOR) for _ in old]
            for start, value in zip(starts, old, strict=True):
                start.add_incoming(emit.zero, entry)
                start.add_incoming(value, add)
            emit.store([builder.fsub(s, x) for s, x in zip(starts, products, strict=True)], place)
        return context.get_dummy_value()

    @intrinsic  # type: ignore[misc]
    def tile(typing: Any, c: Any, c_at: Any, ldc: Any, a: Any, a_at: Any, lda: Any, b: Any, b_at: Any, ldb: Any, depth: Any,
             rows: Any, accumulate: Any) -> Any:  # fmt: skip
        return types.void(*_OPERANDS, _N), generate

    return tile  # type: ignore[no-any-return]


def _solve_columns(builder: Any, tile: _Tile, x: list[list[Any]], inverse: Any, ldb: Any) -> None:
    """X L⁻ᵀ column by column, L and the reciprocals of its diagonal from memory."""
    emit = tile.emit
    for k in range(len(x)):
        scale = emit.broadcast(inverse, _INDEX(k))
        x[k] = [builder.fmul(value, scale) for value in x[k]]
        emit.store(x[k], tile.places[k])
        column = emit.address(tile.behind_b, builder.mul(ldb, _INDEX(k)))
        negative = [builder.fneg(value) for value in x[k]]
        for later in range(k + 1, len(x)):
            weight = emit.broadcast(column, _INDEX(later))
            x[later] = [emit.fma(value, weight, old) for value, old in zip(negative, x[later], strict=True)]


def _factor_columns(builder: Any, tile: _Tile, x: list[list[Any]], inverse: Any, pivots: Any) -> None:
    """L from its first rows in registers. Columns wait for a division by the pivot only; roots are taken beside that."""
    emit = tile.emit
    root = _function(builder.module, ir.FunctionType(_DOUBLE, [_DOUBLE]), "llvm.sqrt.f64")
    for k in range(len(x)):
        pivot = builder.extract_element(x[k][0], ir.IntType(32)(k))
        quotient = builder.fdiv(ir.Constant(_DOUBLE, -1.0), pivot)
        for later in range(k + 1, len(x)):
            weight = emit.splat(builder.fmul(builder.extract_element(x[k][0], ir.IntType(32)(later)), quotient))
            x[later] = [emit.fma(value, weight, old) for value, old in zip(x[k], x[later], strict=True)]
        scale = builder.fdiv(ir.Constant(_DOUBLE, 1.0), builder.call(root, [pivot]))
        builder.store(pivot, emit.address(pivots, _INDEX(k)))
        builder.store(scale, emit.address(inverse, _INDEX(k)))
        emit.store([builder.fmul(value, emit.splat(scale)) for value in x[k]], tile.places[k])


def _compiled_solve(shape: tuple[int, int, bool], *, factor: bool) -> Callable[..., None]:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        tile = _Tile(context, builder, args, shape)
        emit = tile.emit
        inverse, pivots = (_pointer(context, builder, args[k], args[12]) for k in (11, 13 if factor else 11))
        x = [
            [builder.fsub(o, s) for o, s in zip(emit.load(p), sums, strict=True)]
            for p, sums in zip(tile.places, tile.products, strict=True)
        ]
        if factor:
            _factor_columns(builder, tile, x, inverse, pivots)
        else:
            _solve_columns(builder, tile, x, inverse, args[8])
        return context.get_dummy_value()

    if factor:

        @intrinsic  # type: ignore[misc]
        def tile_factor(typing: Any, c: Any, c_at: Any, ldc: Any, a: Any, a_at: Any, lda: Any, b: Any, b_at: Any, ldb: Any,
                        depth: Any, rows: Any, inverse: Any, inverse_at: Any, pivots: Any) -> Any:  # fmt: skip
            return types.void(*_OPERANDS, _BUFFER, _N, _BUFFER), generate

        return tile_factor  # type: ignore[no-any-return]

    @intrinsic  # type: ignore[misc]
    def tile_solve(typing: Any, c: Any, c_at: Any, ldc: Any, a: Any, a_at: Any, lda: Any, b: Any, b_at: Any, ldb: Any, depth: Any,
                   rows: Any, inverse: Any, inverse_at: Any) -> Any:  # fmt: skip
        return types.void(*_OPERANDS, _BUFFER, _N), generate

    return tile_solve  # type: ignore[no-any-return]


def _compiled_dots(columns: int) -> Callable[..., None]:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        c, c_at, a, a_at, b, b_at, ldb, depth = args
        c_pointer, a_pointer, b_pointer = (_pointer(context, builder, x, at) for x, at in ((c, c_at), (a, a_at), (b, b_at)))
        starts = [builder.gep(b_pointer, [builder.mul(ldb, _INDEX(k))]) for k in range(columns)]
        zero = ir.Constant(_VECTOR, [0.0] * LANES)
        before = builder.block
        loop, done = builder.append_basic_block("rows"), builder.append_basic_block("rows.done")
        builder.cbranch(builder.icmp_unsigned(">", depth, _INDEX(0)), loop, done)
        builder.position_at_end(loop)
        row, sums = builder.phi(_INDEX), [builder.phi(_VECTOR) for _ in range(columns)]
        emit = _Emitter(builder, builder.sub(depth, row), 1)
        (weights,) = emit.load(builder.gep(a_pointer, [row]))
        new = [emit.fma(emit.load(builder.gep(start, [row]))[0], weights, old) for start, old in zip(starts, sums, strict=True)]
        following = builder.add(row, _INDEX(LANES))
        builder.cbranch(builder.icmp_unsigned("<", following, depth), loop, done)
        row.add_incoming(_INDEX(0), before)
        row.add_incoming(following, loop)
        builder.position_at_end(done)
        flags = ("reassoc",)
        reduce = _function(builder.module, ir.FunctionType(_DOUBLE, [_DOUBLE, _VECTOR]), f"llvm.vector.reduce.fadd.v{LANES}f64")
        for k in range(columns):
            sums[k].add_incoming(zero, before)
            sums[k].add_incoming(new[k], loop)
            total = builder.phi(_VECTOR)
            total.add_incoming(zero, before)
            total.add_incoming(new[k], loop)
            new[k] = total
        for k in range(columns):
            place = builder.gep(c_pointer, [_INDEX(k)])
            dot = builder.call(reduce, [ir.Constant(_DOUBLE, -0.0), new[k]], fastmath=flags)
            builder.store(builder.fsub(builder.load(place), dot), place)
        return context.get_dummy_value()

    @intrinsic  # type: ignore[misc]
    def tile(typing: Any, c: Any, c_at: Any, a: Any, a_at: Any, b: Any, b_at: Any, ldb: Any, depth: Any) -> Any:
        return types.void(_BUFFER, _N, _BUFFER, _N, _BUFFER, _N, _N, _N), generate

    return tile  # type: ignore[no-any-return]


def _compiled_add() -> Callable[..., None]:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        c, c_at, a, a_at, count = args
        target, source = _pointer(context, builder, c, c_at), _pointer(context, builder, a, a_at)
        before = builder.block
        loop, done = builder.append_basic_block("add"), builder.append_basic_block("add.done")
        builder.branch(loop)
        builder.position_at_end(loop)
        row = builder.phi(_INDEX)
        emit = _Emitter(builder, builder.sub(count, row), 1)
        place = emit.address(target, row)
        (old,), (more,) = emit.load(place), emit.load(emit.address(source, row))
        emit.store([builder.fadd(old, more)], place)
        following = builder.add(row, _INDEX(LANES))
        row.add_incoming(_INDEX(0), before)
        row.add_incoming(following, loop)
        builder.cbranch(builder.icmp_unsigned("<", following, count), loop, done)
        builder.position_at_end(done)
        return context.get_dummy_value()

    @intrinsic  # type: ignore[misc]
    def tile(typing: Any, c: Any, c_at: Any, a: Any, a_at: Any, count: Any) -> Any:
        return types.void(_BUFFER, _N, _BUFFER, _N, _N), generate

    return tile  # type: ignore[no-any-return]


def _view(buffer: NDArray[np.float64], at: int, ld: int, rows: int, columns: int) -> NDArray[np.float64]:
    return np.lib.stride_tricks.as_strided(buffer[int(at) :], (int(rows), int(columns)), (8, 8 * int(ld)))


def _plain_update(columns: int, *, transposed: bool) -> Callable[..., None]:
    def tile(c, c_at, ldc, a, a_at, lda, b, b_at, ldb, depth, rows, accumulate):  # type: ignore[no-untyped-def]
        target = _view(c, c_at, ldc, rows, columns)
        other = _view(b, b_at, ldb, depth, columns) if transposed else _view(b, b_at, ldb, columns, depth).T
        target[:] = (target if accumulate else 0.0) - _view(a, a_at, lda, rows, depth) @ other

    return tile


def _plain_solve(columns: int, *, factor: bool) -> Callable[..., None]:
    def tile(c, c_at, ldc, a, a_at, lda, b, b_at, ldb, depth, rows, inverse, inverse_at, pivots=None):  # type: ignore[no-untyped-def]
        x, triangle = _view(c, c_at, ldc, rows, columns), _view(b, b_at + depth * ldb, ldb, columns, columns)
        x -= _view(a, a_at, lda, rows, depth) @ _view(b, b_at, ldb, columns, depth).T
        with np.errstate(invalid="ignore", divide="ignore"):
            for k in range(columns):
                if factor:
                    pivots[inverse_at + k] = x[k, k]
                    inverse[inverse_at + k] = 1.0 / np.sqrt(x[k, k])
                x[:, k] *= inverse[inverse_at + k]
                x[:, k + 1 :] -= np.outer(x[:, k], x[k + 1 : columns, k] if factor else triangle[k + 1 :, k])

    return tile


def _plain_dots(columns: int) -> Callable[..., None]:
    def tile(c, c_at, a, a_at, b, b_at, ldb, depth):  # type: ignore[no-untyped-def]
        _view(c, c_at, 1, columns, 1)[:, 0] -= _view(b, b_at, ldb, depth, columns).T @ _view(a, a_at, 1, depth, 1)[:, 0]

    return tile


def _tiles(kind: Literal["update", "update_transposed", "solve", "factor"]) -> list[Callable[..., None]]:
    """The six shapes of one kind: 6, 3 and 1 columns, each for `TALL_FROM … TILE_ROWS` rows and for 1 to `LANES`.

    Masks cost nothing where there are registers for them, as there are with AVX-512; elsewhere the tall tile is a full one.
    """
    shapes = [(columns, *rows) for columns in (6, 3, 1) for rows in ((TILE_VECTORS, TILE_VECTORS > 1), (1, True))]
    transposed, factor = kind == "update_transposed", kind == "factor"
    if numba_config.DISABLE_JIT:  # type: ignore[attr-defined]
        return [
            _plain_update(shape[0], transposed=transposed) if "update" in kind else _plain_solve(shape[0], factor=factor)
            for shape in shapes
        ]
    if "update" in kind:
        return [_compiled_update(shape, transposed=transposed) for shape in shapes]
    return [_compiled_solve(shape, factor=factor) for shape in shapes]


update_6, update_6_short, update_3, update_3_short, update_1, update_1_short = _tiles("update")
transposed_6, transposed_6_short, transposed_3, transposed_3_short, transposed_1, transposed_1_short = _tiles("update_transposed")
solve_6, solve_6_short, solve_3, solve_3_short, solve_1, solve_1_short = _tiles("solve")
factor_6, factor_6_short, factor_3, factor_3_short, factor_1, factor_1_short = _tiles("factor")
dots_6, dots_3, dots_1 = ((_plain_dots if numba_config.DISABLE_JIT else _compiled_dots)(c) for c in (6, 3, 1))  # type: ignore[attr-defined]


def _plain_add(c, c_at, a, a_at, count):  # type: ignore[no-untyped-def]
    c[int(c_at) : int(c_at) + int(count)] += a[int(a_at) : int(a_at) + int(count)]


add = _plain_add if numba_config.DISABLE_JIT else _compiled_add()  # type: ignore[attr-defined]
