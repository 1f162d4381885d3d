"""Values and derivatives of the elementary functions, of plain numbers: what is known of each, in one table.

At a corner (|x| or the hypotenuse at 0) the derivative is 0, the mean of those of all sides; where a function has none (√x at 0,
the angle of a vector of length 0) it is infinite or NaN.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np

_LN2, _LN10 = math.log(2.0), math.log(10.0)
_BY_ERF = 2.0 / math.sqrt(math.pi)

Slope = Callable[..., tuple[float, ...]]


def _sqrt(x: float) -> tuple[float, float]:
    root = math.sqrt(x)
    return root, 0.5 / root


def _exp(x: float) -> tuple[float, float]:
    power = math.exp(x)
    return power, power


def _tan(x: float) -> tuple[float, float]:
    tangent = math.tan(x)
    return tangent, 1.0 + tangent * tangent


def _tanh(x: float) -> tuple[float, float]:
    inverse = 1.0 / math.cosh(x)
    return math.tanh(x), inverse * inverse


UNARY: list[tuple[tuple[Any, ...], Slope]] = [
    ((math.sqrt, np.sqrt), _sqrt),
    ((math.sin, np.sin), lambda x: (math.sin(x), math.cos(x))),
    ((math.cos, np.cos), lambda x: (math.cos(x), -math.sin(x))),
    ((math.tan, np.tan), _tan),
    ((math.asin, np.arcsin), lambda x: (math.asin(x), 1.0 / math.sqrt((1.0 - x) * (1.0 + x)))),
    ((math.acos, np.arccos), lambda x: (math.acos(x), -1.0 / math.sqrt((1.0 - x) * (1.0 + x)))),
    ((math.atan, np.arctan), lambda x: (math.atan(x), 1.0 / (1.0 + x * x))),
    ((math.sinh, np.sinh), lambda x: (math.sinh(x), math.cosh(x))),
    ((math.cosh, np.cosh), lambda x: (math.cosh(x), math.sinh(x))),
    ((math.tanh, np.tanh), _tanh),
    ((math.asinh, np.arcsinh), lambda x: (math.asinh(x), 1.0 / math.sqrt(x * x + 1.0))),
    ((math.acosh, np.arccosh), lambda x: (math.acosh(x), 1.0 / math.sqrt((x - 1.0) * (x + 1.0)))),
    ((math.atanh, np.arctanh), lambda x: (math.atanh(x), 1.0 / ((1.0 - x) * (1.0 + x)))),
    ((math.exp, np.exp), _exp),
    ((math.expm1, np.expm1), lambda x: (math.expm1(x), math.exp(x))),
    ((math.log, np.log), lambda x: (math.log(x), 1.0 / x)),
    ((math.log1p, np.log1p), lambda x: (math.log1p(x), 1.0 / (1.0 + x))),
    ((np.log2,), lambda x: (math.log(x) / _LN2, 1.0 / (x * _LN2))),
    ((math.log10, np.log10), lambda x: (math.log10(x), 1.0 / (x * _LN10))),
    ((math.erf,), lambda x: (math.erf(x), _BY_ERF * math.exp(-x * x))),
    ((math.erfc,), lambda x: (math.erfc(x), -_BY_ERF * math.exp(-x * x))),
    ((abs, math.fabs, np.abs, np.absolute, np.fabs), lambda x: (math.fabs(x), np.sign(x))),
    ((np.square,), lambda x: (x * x, 2.0 * x)),
    ((math.degrees, np.degrees, np.rad2deg), lambda x: (math.degrees(x), 180.0 / math.pi)),
    ((math.radians, np.radians, np.deg2rad), lambda x: (math.radians(x), math.pi / 180.0)),
    # Constant but where they jump.
    ((np.floor,), lambda x: (np.floor(x), 0.0)),
    ((np.ceil,), lambda x: (np.ceil(x), 0.0)),
    ((np.trunc,), lambda x: (np.trunc(x), 0.0)),
    ((np.rint,), lambda x: (np.rint(x), 0.0)),
    ((np.sign,), lambda x: (np.sign(x), 0.0)),
]


def _atan2(y: float, x: float) -> tuple[float, float, float]:
    square = x * x + y * y
    return math.atan2(y, x), x / square, -y / square


def _hypot(x: float, y: float) -> tuple[float, float, float]:
    length = math.hypot(x, y)
    return (length, x / length, y / length) if length > 0.0 else (length, 0.0, 0.0)


def _modulo(a: float, b: float) -> tuple[float, float, float]:
    """a − ⌊a/b⌋ b, which jumps where a/b is whole."""
    rest = a % b
    return rest, 1.0, (rest - a) / b


def _fmod(a: float, b: float) -> tuple[float, float, float]:
    rest = np.fmod(a, b)
    return rest, 1.0, (rest - a) / b


def power(x: float, y: float) -> tuple[float, float, float]:
    value = x**y
    return value, y * x ** (y - 1.0) if y != 0.0 else 0.0, value * math.log(x)


def power_of_integer(x: float, n: int) -> tuple[float, float, float]:
    """xⁿ; its slope by n is not asked for."""
    return x**n, n * x ** (n - 1) if n != 0 else 0.0, 0.0


BINARY: list[tuple[tuple[Any, ...], Slope]] = [
    ((math.atan2, np.arctan2), _atan2),
    ((math.hypot, np.hypot), _hypot),
    ((operator.mod, np.mod, np.remainder), _modulo),
    ((np.fmod,), _fmod),
    ((operator.floordiv, np.floor_divide), lambda a, b: (a // b, 0.0, 0.0)),
    (
        (math.copysign, np.copysign),
        lambda x, y: (math.copysign(x, y), math.copysign(1.0, x) * math.copysign(1.0, y), 0.0),
    ),
    ((np.minimum,), lambda a, b: (b, 0.0, 1.0) if b < a else (a, 1.0, 0.0)),
    ((np.maximum,), lambda a, b: (b, 0.0, 1.0) if b > a else (a, 1.0, 0.0)),
]

POWERS: tuple[Any, ...] = (operator.pow, operator.ipow, pow, math.pow, np.power)

TESTS: tuple[Any, ...] = (math.isnan, math.isinf, math.isfinite, np.isnan, np.isinf, np.isfinite)
"""What is asked of the value alone."""
