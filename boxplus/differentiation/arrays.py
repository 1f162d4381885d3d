"""Arrays of dual numbers: what NumPy does with arrays of floats, as far as functions of one residual need it.

Indexing, slices, `len`, `.shape`, `.T`, `.copy()` and `reshape` are Numba's own, which ask nothing of what an array holds. Here
are elementwise operations and functions, products, sums and norms; and `constructors`, in whose arrays derivatives have room.
"""

# mypy: disable-error-code="call-arg, var-annotated, dict-item, no-untyped-call"
# Numba's machinery has no types, and what it compiles has others than Python sees.

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba.core import types
from numba.extending import overload

from boxplus.differentiation.dual import Dual, zeros
from boxplus.differentiation.slopes import UNARY

_PLAIN = (types.Number, types.Boolean)


def _width(*kinds: Any) -> int | None:
    """Of the dual numbers among scalars and arrays of one or two axes; None where there is no array, or nothing is dual."""
    held = [kind.dtype if isinstance(kind, types.Array) and kind.ndim in (1, 2) else kind for kind in kinds]
    widths = {kind.width for kind in held if isinstance(kind, Dual)}
    numbers = all(isinstance(kind, (Dual, *_PLAIN)) for kind in held)
    arrays = any(isinstance(kind, types.Array) for kind in kinds)
    return widths.pop() if widths and numbers and arrays else None


def _overload_elementwise(operation: Callable[..., Any], *keys: Any) -> None:
    def implement(a, b):  # type: ignore[no-untyped-def]
        width = _width(a, b)
        if width is None:
            return None
        axes = [kind.ndim if isinstance(kind, types.Array) else 0 for kind in (a, b)]
        if axes == [1, 1]:

            def lines(a, b):  # type: ignore[no-untyped-def]
                if len(a) != len(b):
                    raise ValueError("arrays of different lengths")
                out = zeros((len(a),), width)
                for i in range(len(a)):
                    out[i] = operation(a[i], b[i])
                return out

            return lines
        if axes == [2, 2]:

            def tables(a, b):  # type: ignore[no-untyped-def]
                if a.shape != b.shape:
                    raise ValueError("arrays of different shapes")
                out = zeros(a.shape, width)
                for i in range(a.shape[0]):
                    for j in range(a.shape[1]):
                        out[i, j] = operation(a[i, j], b[i, j])
                return out

            return tables
        if axes == [0, 1]:

            def number_and_line(a, b):  # type: ignore[no-untyped-def]
                out = zeros((len(b),), width)
                for i in range(len(b)):
                    out[i] = operation(a, b[i])
                return out

            return number_and_line
        if axes == [1, 0]:

            def line_and_number(a, b):  # type: ignore[no-untyped-def]
                out = zeros((len(a),), width)
                for i in range(len(a)):
                    out[i] = operation(a[i], b)
                return out

            return line_and_number
        if axes == [0, 2]:

            def number_and_table(a, b):  # type: ignore[no-untyped-def]
                out = zeros(b.shape, width)
                for i in range(b.shape[0]):
                    for j in range(b.shape[1]):
                        out[i, j] = operation(a, b[i, j])
                return out

            return number_and_table
        if axes == [2, 0]:

            def table_and_number(a, b):  # type: ignore[no-untyped-def]
                out = zeros(a.shape, width)
                for i in range(a.shape[0]):
                    for j in range(a.shape[1]):
                        out[i, j] = operation(a[i, j], b)
                return out

            return table_and_number
        return None

    for key in keys:
        overload(key)(implement)


_overload_elementwise(operator.add, operator.add, np.add)
_overload_elementwise(operator.sub, operator.sub, np.subtract)
_overload_elementwise(operator.mul, operator.mul, np.multiply)
_overload_elementwise(operator.truediv, operator.truediv, np.divide, np.true_divide)
_overload_elementwise(operator.pow, operator.pow, np.power)


def _overload_function(function: Callable[..., Any], *keys: Any) -> None:
    def implement(a):  # type: ignore[no-untyped-def]
        width = _width(a)
        if width is None:
            return None

        if a.ndim == 1:

            def line(a):  # type: ignore[no-untyped-def]
                out = zeros((len(a),), width)
                for i in range(len(a)):
                    out[i] = function(a[i])
                return out

            return line

        def table(a):  # type: ignore[no-untyped-def]
            out = zeros(a.shape, width)
            for i in range(a.shape[0]):
                for j in range(a.shape[1]):
                    out[i, j] = function(a[i, j])
            return out

        return table

    for key in keys:
        overload(key)(implement)


_overload_function(operator.neg, operator.neg, np.negative)
for _keys, _ in UNARY:
    if any(isinstance(_key, np.ufunc) for _key in _keys):
        _ufunc = next(_key for _key in _keys if isinstance(_key, np.ufunc))
        _overload_function(_ufunc, *[_key for _key in _keys if isinstance(_key, np.ufunc)])


def _product(a, b):  # type: ignore[no-untyped-def]
    width = _width(a, b)
    if width is None or not (isinstance(a, types.Array) and isinstance(b, types.Array)):
        return None
    if (a.ndim, b.ndim) == (1, 1):

        def inner(a, b):  # type: ignore[no-untyped-def]
            if len(a) != len(b):
                raise ValueError("arrays of different lengths")
            total = a[0] * b[0]
            for i in range(1, len(a)):
                total += a[i] * b[i]
            return total

        return inner
    if (a.ndim, b.ndim) == (2, 1):

        def matrix_vector(a, b):  # type: ignore[no-untyped-def]
            if a.shape[1] != len(b):
                raise ValueError("a matrix and a vector that do not fit")
            out = zeros((a.shape[0],), width)
            for i in range(a.shape[0]):
                for k in range(a.shape[1]):
                    out[i] += a[i, k] * b[k]
            return out

        return matrix_vector
    if (a.ndim, b.ndim) == (1, 2):

        def vector_matrix(a, b):  # type: ignore[no-untyped-def]
            if len(a) != b.shape[0]:
                raise ValueError("a vector and a matrix that do not fit")
            out = zeros((b.shape[1],), width)
            for j in range(b.shape[1]):
                for k in range(b.shape[0]):
                    out[j] += a[k] * b[k, j]
            return out

        return vector_matrix

    def matrices(a, b):  # type: ignore[no-untyped-def]
        if a.shape[1] != b.shape[0]:
            raise ValueError("matrices that do not fit")
        out = zeros((a.shape[0], b.shape[1]), width)
        for i in range(a.shape[0]):
            for j in range(b.shape[1]):
                for k in range(a.shape[1]):
                    out[i, j] += a[i, k] * b[k, j]
        return out

    return matrices


for _key in (np.dot, operator.matmul):
    overload(_key)(_product)


@overload(np.vdot)
def _vdot(a, b):  # type: ignore[no-untyped-def]
    if isinstance(a, types.Array) and isinstance(b, types.Array) and (a.ndim, b.ndim) == (1, 1):
        return _product(a, b)
    return None


@overload(np.cross)
def _cross(a, b):  # type: ignore[no-untyped-def]
    width = _width(a, b)
    if width is None or not (isinstance(a, types.Array) and isinstance(b, types.Array) and a.ndim == b.ndim == 1):
        return None

    def cross(a, b):  # type: ignore[no-untyped-def]
        if len(a) != 3 or len(b) != 3:
            raise ValueError("vectors of three numbers")
        out = zeros((3,), width)
        out[0] = a[1] * b[2] - a[2] * b[1]
        out[1] = a[2] * b[0] - a[0] * b[2]
        out[2] = a[0] * b[1] - a[1] * b[0]
        return out

    return cross


@overload(np.sum)
def _sum(a):  # type: ignore[no-untyped-def]
    if _width(a) is None:
        return None
    if a.ndim == 1:

        def line(a):  # type: ignore[no-untyped-def]
            total = 0.0 * a[0]
            for i in range(len(a)):
                total += a[i]
            return total

        return line

    def table(a):  # type: ignore[no-untyped-def]
        total = 0.0 * a[0, 0]
        for i in range(a.shape[0]):
            for j in range(a.shape[1]):
                total += a[i, j]
        return total

    return table


@overload(np.linalg.norm)
def _norm(x):  # type: ignore[no-untyped-def]
    if _width(x) is None:
        return None
    return lambda x: math.sqrt(np.sum(x * x))


def _is_float(dtype: Any) -> bool:
    """Whether an argument `dtype` asks for floats, as none does."""
    if isinstance(dtype, types.Omitted):
        return dtype.value is None
    return (
        dtype is None
        or isinstance(dtype, types.NoneType)
        or getattr(dtype, "dtype", None) == types.float64
        or "float" in str(dtype)
    )


@cache
def constructors(width: int) -> dict[Any, Callable[..., Any]]:
    """NumPy's makers of arrays of floats, and what takes their place where derivatives along `width` directions are wanted."""

    def substitute(original: Any, make: Callable[..., Any]) -> Callable[..., Any]:
        def stub(*arguments):  # type: ignore[no-untyped-def]
            raise NotImplementedError

        stub.__name__ = original.__name__
        overload(stub)(make)
        return stub

    def of_shape(original: Any, value: float) -> Callable[..., Any]:
        def make(shape, dtype=None):  # type: ignore[no-untyped-def]
            if not _is_float(dtype):
                return lambda shape, dtype=None: original(shape, dtype)
            if isinstance(shape, types.Integer):

                def line(shape, dtype=None):  # type: ignore[no-untyped-def]
                    out = zeros((shape,), width)
                    for i in range(shape):
                        out[i] += value
                    return out

                return line

            def table(shape, dtype=None):  # type: ignore[no-untyped-def]
                out = zeros(shape, width)
                if value != 0.0:
                    for i in np.ndindex(shape):
                        out[i] += value
                return out

            return table

        return make

    def like(a):  # type: ignore[no-untyped-def]
        return lambda a: zeros(a.shape, width)

    def unit(n):  # type: ignore[no-untyped-def]
        def make(n):  # type: ignore[no-untyped-def]
            out = zeros((n, n), width)
            for i in range(n):
                out[i, i] += 1.0
            return out

        return make

    def of_values(values):  # type: ignore[no-untyped-def]
        item = getattr(values, "dtype", None)
        if isinstance(item, Dual):

            def line(values):  # type: ignore[no-untyped-def]
                out = zeros((len(values),), width)
                for i in range(len(values)):
                    out[i] = values[i]
                return out

            return line
        if isinstance(getattr(item, "dtype", None), Dual):

            def table(values):  # type: ignore[no-untyped-def]
                out = zeros((len(values), len(values[0])), width)
                for i in range(len(values)):
                    for j in range(len(values[0])):
                        out[i, j] = values[i][j]
                return out

            return table
        return lambda values: np.array(values)

    makers = {
        np.zeros: of_shape(np.zeros, 0.0),
        np.empty: of_shape(np.empty, 0.0),
        np.ones: of_shape(np.ones, 1.0),
        np.zeros_like: like,
        np.empty_like: like,
        np.eye: unit,
        np.identity: unit,
        np.array: of_values,
        np.asarray: of_values,
    }
    return {original: substitute(original, make) for original, make in makers.items()}
