"""Dual numbers in compiled code: every function and operation against differences, and what has no derivative is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
import pytest
from numba.core import config as numba_config

from boxplus.differentiation import slopes
from boxplus.errors import InputError
from boxplus.manifolds.euclidean import Euclidean
from boxplus.optimization.jacobian_check import check_jacobian
from boxplus.residuals.user.residual import UserResidual

pytestmark = pytest.mark.skipif(bool(numba_config.DISABLE_JIT), reason="what is not compiled is not differentiated")


def _automatic(function: Callable[..., Any], dim: int, size: int, count: int = 1, data: tuple[Any, ...] = ()) -> UserResidual:
    return UserResidual(
        function, dim=dim, manifolds=(Euclidean(size),), data=data, count=None if data else count, jacobian="automatic"
    )


def _agrees(function: Callable[..., Any], dim: int, x: np.ndarray) -> None:
    report = check_jacobian(_automatic(function, dim, x.shape[1], len(x)), x, tolerance=1e-8)
    assert report.passed, report


def _named(function: Any) -> str:
    return f"{'np' if isinstance(function, np.ufunc) else 'math'}.{function.__name__}"


# Where a function is defined and smooth, a number between −1 and 1 is mapped to.
_PLACES = {"acosh": "2 + t", "arccosh": "2 + t", **dict.fromkeys(("sqrt", "log", "log2", "log10"), "1.5 + t")}


def test_every_function_of_one_number() -> None:
    # The first name of each; the others are registered in the same loop.
    known = [next(key for key in keys if key is not abs) for keys, _ in slopes.UNARY] + [np.sin, np.sqrt]
    values = [f"{_named(key)}({_PLACES.get(key.__name__, '0.9 * t')})" for key in known]
    scope: dict[str, Any] = {"math": math, "np": np}
    exec(f"def f(x):\n    t = x[0]\n    return {', '.join(values)}, abs(t), -t, +t, float(t)", scope)
    _agrees(scope["f"], len(values) + 4, np.array([[-0.83], [-0.31], [0.17], [0.72]]))


def test_every_function_of_two_numbers() -> None:
    names = [_named(keys[-1]) for keys, _ in slopes.BINARY] + ["math.atan2", "math.hypot"]
    values = [f"{name}({a}, {b})" for name in names for a, b in (("s", "t"), ("s", "1.7"), ("1.3", "t"))]
    values += [f"{a} {sign} {b}" for sign in ("+", "-", "*", "/", "%", "//") for a, b in (("s", "t"), ("s", "3"), ("2", "t"))]
    scope: dict[str, Any] = {"math": math, "np": np}
    exec(f"def f(x):\n    s, t = x[0], x[1]\n    return {', '.join(values)}", scope)
    x = np.array([[0.6, 1.1], [-0.6, 1.1], [-0.7, -1.25], [1.4, -0.8]])
    _agrees(scope["f"], len(values), x)


def test_powers_and_choices() -> None:
    def f(x):
        s, t = x[0], x[1]
        n = 3 if t > 0.0 else -2
        u = s
        u **= 2
        return (
            s**2,
            s**0,
            s**-1,
            s**n,
            t**n,
            abs(s) ** t,
            2.0**t,
            pow(abs(s), 0.5),
            u,
            min(s, t),
            max(s, 0.5, t),
            math.pow(abs(s), t),
        )

    _agrees(f, 12, np.array([[0.6, 1.1], [-0.6, 1.3], [-0.7, -1.3], [1.4, -0.8]]))


def test_numbers_and_dual_numbers_meet_in_loops_and_branches() -> None:
    @numba.njit
    def smooth(a, b):
        if a > b:
            return a * a - b
        return b

    def f(x):
        total, product = 0.0, 1
        for k in range(len(x)):
            total += x[k] * math.sin(x[k])
            product *= x[k] + k
            total -= 1
        total /= 2
        constant = 7.0 if x[0] > 0.0 else 5.0
        if x[1] != x[0] and not math.isnan(total) and x[0] <= 10 and np.isfinite(x[1]):
            constant = x[1]
        return total, product, smooth(x[0], x[1]), smooth(1.0, 2.0), constant

    _agrees(f, 5, np.array([[0.6, 1.1, 0.3], [-0.6, -1.3, 0.2]]))


def test_arrays() -> None:
    A = np.arange(6.0).reshape(3, 2)

    @numba.njit
    def filled(x):
        out = np.empty(3)
        for i in range(3):
            out[i] = x[i % 2] * i
        return out

    def f(x):
        R = np.zeros((2, 2))
        R[0, 0], R[0, 1], R[1, 0], R[1, 1] = math.cos(x[0]), -math.sin(x[0]), x[1], 2.0
        y = R @ x + 2.0 * x / 3.0 - x**2
        z = filled(x)
        E = np.eye(3)
        E[0:2, 1] = x
        E[2] = z
        which = np.zeros(2, dtype=np.int64)
        which[0] = 1
        both = np.array([[x[0], x[1]], [1.0, x[0] * x[1]]])
        return np.array(
            [
                np.linalg.norm(A @ x - z),
                np.sum(np.sin(y) * x),
                (R.T @ both)[0, 1] + np.dot(x, y) + (y @ R)[1],
                np.cross(z, np.array([x[0], 1.0, x[1]]))[1],
                E.reshape(9)[4] + E.copy()[2, 2] + x[1:][0],
                y[which[0]] + np.sum(np.ones(2) * x) - np.sum(-np.exp(x) / x),
                np.vdot(np.zeros_like(x) + x, np.asarray([1.0, 2.0])),
            ]
        )

    _agrees(f, 7, np.array([[0.6, 1.1], [-0.6, 1.3]]))


def test_more_directions_than_one_run_carries() -> None:
    def f(x, weights):
        total, product = 0.0, 1.0
        for k in range(len(x)):
            total += weights[k] * math.sin(x[k])
            product *= math.cos(0.1 * x[k])
        return total, product

    rng = np.random.default_rng(0)
    for size in (1, 12, 13, 31):
        residual = _automatic(f, 2, size, data=(rng.normal(size=(3, size)),))
        report = check_jacobian(residual, rng.normal(size=(3, size)), tolerance=1e-8)
        assert report.passed, report


def test_what_stands_still_has_no_derivative_where_the_slope_is_infinite() -> None:
    def f(x):
        return math.sqrt(x[0] * 0.0) + x[1], math.hypot(0.0 * x[0], 0.0) + x[1], x[1] ** 1

    J = _automatic(f, 3, 2).linearize([3.0, 4.0]).jacobians[0][0]
    assert np.array_equal(J, [[0.0, 1.0], [0.0, 1.0], [0.0, 1.0]])


def test_corners_have_the_mean_of_their_sides_and_poles_none() -> None:
    def f(x):
        return math.sqrt(x[0] * x[0] + x[1] * x[1]), math.hypot(x[0], x[1]), abs(x[0]), math.sqrt(x[1]), math.atan2(x[0], x[1])

    J = _automatic(f, 5, 2).linearize([0.0, 0.0]).jacobians[0][0]
    assert np.array_equal(J[:3], np.zeros((3, 2)))
    assert J[3, 0] == 0.0 and np.isinf(J[3, 1]) and np.isnan(J[4]).all()


def test_powers_of_zero() -> None:
    def f(x):
        return x[0] ** 0.0, x[0] ** 0, x[0] ** 1.0, x[0] ** 1, x[0] ** 2.5, np.power(x[0], 0.0), math.pow(x[0], x[1])

    J = _automatic(f, 7, 2).linearize([0.0, 0.0]).jacobians[0][0]
    assert np.array_equal(J[:6, 0], [0.0, 0.0, 1.0, 1.0, 0.0, 0.0]) and J[6, 0] == 0.0


@numba.njit
def _rounded(x):
    return int(x)


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (lambda x: _rounded(x[0]) * x[1], r"int\(dual"),
        (lambda x: np.linalg.inv(np.eye(2) * x[0])[0, 0], r"inv"),
        (lambda x: math.gamma(x[0]), r"gamma"),
    ],
)
def test_what_cannot_be_differentiated_is_refused_or_said(function: Callable[..., Any], reason: str) -> None:
    with pytest.raises(InputError, match=reason) as caught:
        _automatic(function, 1, 2)
    assert 'jacobian="differences"' in str(caught.value)
    residual = UserResidual(function, dim=1, manifolds=(Euclidean(2),), count=1)
    assert residual.jacobian_kind == "numeric"
    assert "differences, not automatically" in residual.jacobian_note
