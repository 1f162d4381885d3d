"""The leaf of an ikd-tree, and what is done with all its points at once: LLVM vectors of one lane a point.

A loop that gathers one bit a point is vectorised poorly (the bits are merged lane by lane), and a loop that counts zeros
stays a loop. Here a leaf is one vector: the comparison is its own bit mask. LLVM splits the vectors into whatever the
processor has. Each operation is a plain Python function, which is what runs without the compiler, with a compiled
counterpart to the same bits (no contraction, no reassociation).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic, overload
from numpy.typing import ArrayLike, NDArray

BUCKET = 32  # points in a leaf, one bit of a word each
LEAF = np.dtype(
    [
        ("x", np.float32, BUCKET),
        ("y", np.float32, BUCKET),
        ("z", np.float32, BUCKET),
        ("live", np.uint32),  # bit i: point i is not deleted
        ("count", np.uint32),
        ("stamp", np.uint32),  # number of the rebuild that has already copied this leaf
    ],
    align=True,
)

_BYTE, _LANE, _WORD, _SIZE = ir.IntType(8), ir.FloatType(), ir.IntType(32), ir.IntType(64)
_VECTOR = ir.VectorType(_LANE, BUCKET)
_COORDINATES = [LEAF.fields[name][1] for name in "xyz"]  # type: ignore[index]


def trailing_zeros(bits: np.uint32) -> np.uint32:
    """Index of the lowest bit set; `bits` is not 0."""
    return np.uint32((int(bits) & -int(bits)).bit_length() - 1)


def count_bits(bits: np.uint32) -> np.uint32:
    """Number of bits set."""
    return np.uint32(int(bits).bit_count())


def lanes_within(
    leaf: NDArray[np.void], index: np.uint32, qx: np.float32, qy: np.float32, qz: np.float32, max_sq: np.float32
) -> np.uint32:
    """Which lanes of a leaf lie within `max_sq` of a point (as bits), those that hold no point included."""
    with np.errstate(over="ignore", invalid="ignore"):  # lanes that hold no point hold anything
        x, y, z = leaf[index]["x"] - qx, leaf[index]["y"] - qy, leaf[index]["z"] - qz
        return _as_bits(x * x + y * y + z * z <= max_sq)


def lanes_in_box(leaf: NDArray[np.void], index: np.uint32, box: NDArray[np.float32]) -> np.uint32:
    """Which lanes of a leaf lie in a half-open box (as bits), those that hold no point included."""
    xyz = np.stack([leaf[index]["x"], leaf[index]["y"], leaf[index]["z"]], axis=1)
    return _as_bits(((xyz >= box[:3]) & (xyz < box[3:6])).all(axis=1))


def _as_bits(mask: ArrayLike) -> np.uint32:
    return np.uint32(np.sum(np.asarray(mask, np.uint64) << np.arange(BUCKET, dtype=np.uint64)))


def _lanes(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> list[ir.Value]:
    """The x, y and z of a leaf."""
    data = context.make_array(array_type)(context, builder, array).data
    offset = builder.mul(builder.zext(index, _SIZE), ir.Constant(_SIZE, LEAF.itemsize))
    record = builder.gep(builder.bitcast(data, _BYTE.as_pointer()), [offset])
    places = [builder.gep(record, [ir.Constant(_SIZE, place)]) for place in _COORDINATES]
    return [builder.load(builder.bitcast(place, _VECTOR.as_pointer()), align=4) for place in places]


def _spread(builder: Any, scalar: Any) -> ir.Value:
    """A scalar in all lanes."""
    empty = ir.Constant(_VECTOR, ir.Undefined)
    first = builder.insert_element(empty, scalar, ir.Constant(_WORD, 0))
    return builder.shuffle_vector(first, empty, ir.Constant(ir.VectorType(_WORD, BUCKET), [0] * BUCKET))


@intrinsic  # type: ignore[misc]
def _trailing_zeros(_: Any, bits: Any) -> tuple[Any, Any]:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> ir.Value:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.uint32(types.uint32), generate


@intrinsic  # type: ignore[misc]
def _count_bits(_: Any, bits: Any) -> tuple[Any, Any]:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> ir.Value:
        return builder.ctpop(arguments[0])

    return types.uint32(types.uint32), generate


@intrinsic  # type: ignore[misc]
def _lanes_within(_: Any, leaf: Any, index: Any, qx: Any, qy: Any, qz: Any, max_sq: Any) -> tuple[Any, Any]:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> ir.Value:
        array, row, *query, limit = arguments
        total = None
        for lanes, coordinate in zip(_lanes(context, builder, leaf, array, row), query, strict=True):
            offset = builder.fsub(lanes, _spread(builder, coordinate))
            square = builder.fmul(offset, offset)
            total = square if total is None else builder.fadd(total, square)
        return builder.bitcast(builder.fcmp_ordered("<=", total, _spread(builder, limit)), _WORD)

    single = types.float32
    return types.uint32(leaf, types.uint32, single, single, single, single), generate


@intrinsic  # type: ignore[misc]
def _lanes_between(_: Any, leaf: Any, index: Any, x0: Any, y0: Any, z0: Any, x1: Any, y1: Any, z1: Any) -> tuple[Any, Any]:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> ir.Value:
        array, row = arguments[:2]
        limits = [_spread(builder, limit) for limit in arguments[2:]]
        inside = None
        for axis, lanes in enumerate(_lanes(context, builder, leaf, array, row)):
            hit = builder.fcmp_ordered(">=", lanes, limits[axis])
            hit = builder.and_(hit, builder.fcmp_ordered("<", lanes, limits[axis + 3]))
            inside = hit if inside is None else builder.and_(inside, hit)
        return builder.bitcast(inside, _WORD)

    return types.uint32(leaf, types.uint32, *[types.float32] * 6), generate


@overload(trailing_zeros, strict=False)  # type: ignore[misc]
def _compile_trailing_zeros(bits: Any) -> Callable[..., Any]:
    return lambda bits: _trailing_zeros(bits)  # type: ignore[call-arg]


@overload(count_bits, strict=False)  # type: ignore[misc]
def _compile_count_bits(bits: Any) -> Callable[..., Any]:
    return lambda bits: _count_bits(bits)  # type: ignore[call-arg]


@overload(lanes_within, strict=False)  # type: ignore[misc]
def _compile_lanes_within(leaf: Any, index: Any, qx: Any, qy: Any, qz: Any, max_sq: Any) -> Callable[..., Any]:
    return lambda leaf, index, qx, qy, qz, max_sq: _lanes_within(leaf, index, qx, qy, qz, max_sq)  # type: ignore[call-arg]


@overload(lanes_in_box, strict=False)  # type: ignore[misc]
def _compile_lanes_in_box(leaf: Any, index: Any, box: Any) -> Callable[..., Any]:
    return lambda leaf, index, box: _lanes_between(  # type: ignore[call-arg]
        leaf, index, box[0], box[1], box[2], box[3], box[4], box[5]
    )
