"""The nearest points of a search so far, packed as numbers: an ascending list in one LLVM vector.

A new one goes to its place by a shift, a maximum and a minimum of all lanes at once, without a branch; a loop that moves the
farther ones aside is mispredicted nearly every time. The list stays in registers: it is made in the kernel that searches and
only ever read and written as a whole. Each operation is a plain Python function, which is what runs without the compiler, with
a compiled counterpart (`leaf` has more of the kind).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, overload
from numpy.typing import NDArray

LANES = 16
_POINT_BITS = 32
_NO_POINT = 0xFFFFFFFF

_LONG, _WORD = ir.IntType(64), ir.IntType(32)
_LIST, _LOW = ir.VectorType(_LONG, LANES), ir.VectorType(_WORD, LANES)
_POINTER = types.CPointer(types.uint64)  # type: ignore[no-untyped-call]


def list_of(first: np.uint64) -> NDArray[np.uint64]:
    """A list whose LANES numbers are all `first`."""
    return np.full(LANES, first, dtype=np.uint64)


def take_in(nearest: NDArray[np.uint64], new: np.uint64) -> None:
    """Put a number in its place of the list; the largest falls out."""
    before = np.append(np.uint64(0), nearest[:-1])
    nearest[:] = np.minimum(nearest, np.maximum(before, np.uint64(new)))


def entry(nearest: NDArray[np.uint64], place: np.uint32) -> np.uint64:
    """The number at a place, the smallest at 0."""
    return np.uint64(nearest[place])


def ties(nearest: NDArray[np.uint64]) -> np.uint32:
    """After which places a point follows that is as far: bit i tells of places i and i + 1."""
    high, low = nearest >> np.uint64(_POINT_BITS), nearest & np.uint64(_NO_POINT)
    tied = (high[:-1] == high[1:]) & (low[1:] != _NO_POINT)
    return np.uint32(np.sum(tied.astype(np.uint64) << np.arange(LANES - 1, dtype=np.uint64)))


def _places(first: int) -> ir.Constant:
    """The lanes of a shuffle, from `first` on."""
    return ir.Constant(_LOW, [first + lane for lane in range(LANES)])


def _all(number: int, kind: ir.VectorType = _LIST) -> ir.Constant:
    return ir.Constant(kind, [number] * LANES)


def _spread(builder: Any, scalar: Any) -> ir.Value:
    """A scalar in all lanes."""
    empty = ir.Constant(_LIST, ir.Undefined)
    return builder.shuffle_vector(builder.insert_element(empty, scalar, ir.Constant(_WORD, 0)), empty, _all(0, _LOW))


def _at(builder: Any, pointer: Any) -> Any:
    return builder.bitcast(pointer, _LIST.as_pointer())


@intrinsic  # type: ignore[misc]
def _list_of(_: Any, first: Any) -> tuple[Any, Any]:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> ir.Value:
        place = cgutils.alloca_once(builder, _LIST)  # type: ignore[no-untyped-call]
        builder.store(_spread(builder, arguments[0]), place)
        return builder.bitcast(place, _LONG.as_pointer())

    return _POINTER(types.uint64), generate


@intrinsic  # type: ignore[misc]
def _take_in(_: Any, nearest: Any, new: Any) -> tuple[Any, Any]:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> ir.Value:
        held, added = builder.load(_at(builder, arguments[0])), _spread(builder, arguments[1])
        before = builder.shuffle_vector(_all(0), held, _places(LANES - 1))
        later = builder.select(builder.icmp_unsigned(">", before, added), before, added)
        builder.store(builder.select(builder.icmp_unsigned("<", held, later), held, later), _at(builder, arguments[0]))
        return context.get_dummy_value()

    return types.void(_POINTER, types.uint64), generate


@intrinsic  # type: ignore[misc]
def _entry(_: Any, nearest: Any, place: Any) -> tuple[Any, Any]:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> ir.Value:
        return builder.extract_element(builder.load(_at(builder, arguments[0])), arguments[1])

    return types.uint64(_POINTER, types.uint32), generate


@intrinsic  # type: ignore[misc]
def _ties(_: Any, nearest: Any) -> tuple[Any, Any]:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> ir.Value:
        held = builder.load(_at(builder, arguments[0]))
        following = builder.shuffle_vector(held, _all(2**64 - 1), _places(1))
        high, next_high = (builder.lshr(numbers, _all(_POINT_BITS)) for numbers in (held, following))
        is_point = builder.icmp_unsigned("!=", builder.trunc(following, _LOW), _all(_NO_POINT, _LOW))
        tied = builder.and_(builder.icmp_unsigned("==", high, next_high), is_point)
        return builder.zext(builder.bitcast(tied, ir.IntType(LANES)), _WORD)

    return types.uint32(_POINTER), generate


# Inlined by Numba, before anything is compiled: the list is a place on the stack of the kernel that makes it.
@overload(list_of, strict=False, inline="always")  # type: ignore[misc]
def _compile_list_of(first: Any) -> Callable[..., Any]:
    return lambda first: _list_of(first)  # type: ignore[call-arg]


@overload(take_in, strict=False)  # type: ignore[misc]
def _compile_take_in(nearest: Any, new: Any) -> Callable[..., Any]:
    return lambda nearest, new: _take_in(nearest, new)  # type: ignore[call-arg]


@overload(entry, strict=False)  # type: ignore[misc]
def _compile_entry(nearest: Any, place: Any) -> Callable[..., Any]:
    return lambda nearest, place: _entry(nearest, place)  # type: ignore[call-arg]


@overload(ties, strict=False)  # type: ignore[misc]
def _compile_ties(nearest: Any) -> Callable[..., Any]:
    return lambda nearest: _ties(nearest)  # type: ignore[call-arg]
