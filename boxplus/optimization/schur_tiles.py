"""Sums of products Zₐ Z_bᵀ over pairs of entries, kept in vector registers: the innermost step of a Schur elimination.

As in `vector_tiles`, loops of Numba would leave the sums in memory, which costs three times the time. The two tiles are those of
bundle adjustment: points of three coordinates seen by cameras of six or nine degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core import config as numba_config
from numba.extending import intrinsic

from boxplus.optimization.schur_padding import VECTOR, padded

_DOUBLE = ir.DoubleType()
_INDEX = ir.IntType(64)
_VECTOR = ir.VectorType(_DOUBLE, VECTOR)
_Z = types.Array(types.float64, 3, "C")
_ENTRIES = types.Array(types.uint32, 1, "C")
_SUM = types.Array(types.float64, 2, "C")


def _compiled(e: int, dof: int) -> Callable[..., None]:
    """tile(Za, Zb, entry_a, entry_b, begin, end, total): total (dof, padded) = Σ Za[entry_a[m]]ᵀ Zb[entry_b[m]]."""
    width = padded(dof)
    vectors = width // VECTOR

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        def data(kind: Any, value: Any) -> Any:
            return context.make_array(kind)(context, builder, value).data

        za, zb = (builder.bitcast(data(_Z, args[k]), ir.PointerType(_DOUBLE)) for k in (0, 1))
        entry_a, entry_b = data(_ENTRIES, args[2]), data(_ENTRIES, args[3])
        begin, end, total = args[4], args[5], builder.bitcast(data(_SUM, args[6]), ir.PointerType(_DOUBLE))
        fma = cgutils.get_or_insert_function(  # type: ignore[no-untyped-call]
            builder.module, ir.FunctionType(_VECTOR, [_VECTOR] * 3), f"llvm.fmuladd.v{VECTOR}f64"
        )
        undefined = ir.Constant(_VECTOR, ir.Undefined)
        lanes = ir.Constant(ir.VectorType(ir.IntType(32), VECTOR), [0] * VECTOR)

        def splat(scalar: Any) -> Any:
            return builder.shuffle_vector(builder.insert_element(undefined, scalar, ir.IntType(32)(0)), undefined, lanes)

        def vector_at(pointer: Any, index: int) -> Any:
            return builder.bitcast(builder.gep(pointer, [_INDEX(index)]), ir.PointerType(_VECTOR))

        def entry(pointer: Any, entries: Any, at: Any) -> Any:
            number = builder.zext(builder.load(builder.gep(entries, [at])), _INDEX)
            return builder.gep(pointer, [builder.mul(number, _INDEX(e * width))])

        before = builder.block
        loop, done = builder.append_basic_block("pairs"), builder.append_basic_block("pairs.done")
        zero = ir.Constant(_VECTOR, [0.0] * VECTOR)
        builder.cbranch(builder.icmp_unsigned("<", begin, end), loop, done)
        builder.position_at_end(loop)
        at = builder.phi(_INDEX)
        sums = [[builder.phi(_VECTOR) for _ in range(vectors)] for _ in range(dof)]
        new: list[list[Any]] = [list(row) for row in sums]
        a, b = entry(za, entry_a, at), entry(zb, entry_b, at)
        for i in range(e):
            columns = [builder.load(vector_at(b, i * width + v * VECTOR), align=8) for v in range(vectors)]
            for p in range(dof):
                factor = splat(builder.load(builder.gep(a, [_INDEX(i * width + p)])))
                new[p] = [builder.call(fma, [factor, columns[v], new[p][v]]) for v in range(vectors)]
        following = builder.add(at, _INDEX(1))
        builder.cbranch(builder.icmp_unsigned("<", following, end), loop, done)
        at.add_incoming(begin, before)
        at.add_incoming(following, loop)
        builder.position_at_end(done)
        for p in range(dof):
            for v in range(vectors):
                sums[p][v].add_incoming(zero, before)
                sums[p][v].add_incoming(new[p][v], loop)
                result = builder.phi(_VECTOR)
                result.add_incoming(zero, before)
                result.add_incoming(new[p][v], loop)
                new[p][v] = result
        for p in range(dof):
            for v in range(vectors):
                builder.store(new[p][v], vector_at(total, p * width + v * VECTOR), align=8)
        return context.get_dummy_value()

    @intrinsic  # type: ignore[misc]
    def tile(typing: Any, za: Any, zb: Any, entry_a: Any, entry_b: Any, begin: Any, end: Any, total: Any) -> Any:
        return types.void(_Z, _Z, _ENTRIES, _ENTRIES, types.uint64, types.uint64, _SUM), generate

    return tile  # type: ignore[no-any-return]


def _plain(e: int, dof: int) -> Callable[..., None]:
    def tile(za, zb, entry_a, entry_b, begin, end, total):  # type: ignore[no-untyped-def]
        chosen = slice(int(begin), int(end))
        total[:] = np.einsum("nip,niq->pq", za[entry_a[chosen]][:, :, :dof], zb[entry_b[chosen]])

    return tile


_make = _plain if numba_config.DISABLE_JIT else _compiled  # type: ignore[attr-defined]
sum_pairs_6 = _make(3, 6)
sum_pairs_9 = _make(3, 9)
