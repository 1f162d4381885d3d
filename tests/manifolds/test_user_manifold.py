"""Manifolds given by compiled functions: as the shipped ones in all they do, and refused where they are none."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numba.core import config as numba_config

import boxplus as bp
from boxplus.manifolds.quaternion import exp_scalars, multiply_scalars, normalized_scalars
from boxplus.manifolds.so3 import log_quaternion

compiles = pytest.mark.skipif(bool(numba_config.DISABLE_JIT), reason="what is not compiled is not differentiated")


def turned(x, delta):
    w, a, b, c = exp_scalars(delta[0], delta[1], delta[2])
    w, a, b, c = multiply_scalars(x[0], x[1], x[2], x[3], w, a, b, c)
    return normalized_scalars(w, a, b, c)


def turn(x, base):
    w, a, b, c = multiply_scalars(base[0], -base[1], -base[2], -base[3], x[0], x[1], x[2], x[3])
    return log_quaternion(w, a, b, c)


def grown(x, delta):
    return np.array([x[0] * math.exp(delta[0])])


def growth(x, base):
    return (math.log(x[0] / base[0]),)


def growth_jacobian(x, other, J):
    J[0, 0] = 1.0


def _positive(x: np.ndarray) -> np.ndarray:
    if not (x > 0.0).all():
        raise bp.InputError("scales above zero", f"{x.min()}", "leave out what has no size")
    return x


def _rotations(**changes: Any) -> bp.UserManifold:
    given: dict[str, Any] = {"size": 4, "dof": 3, "plus": turned, "minus": turn, "identity": [1.0, 0.0, 0.0, 0.0]}
    return bp.UserManifold("Rotations", **{**given, **changes})


def _scale(**changes: Any) -> bp.UserManifold:
    given: dict[str, Any] = {"size": 1, "dof": 1, "plus": grown, "minus": growth, "identity": [1.0]}
    return bp.UserManifold("Scale", **{**given, "tangent_names": ("scale [1]",), "brought_onto": _positive, **changes})


def test_it_does_what_the_shipped_one_does() -> None:
    ours, theirs, rng = _rotations(), bp.UnitQuaternion, np.random.default_rng(0)
    x, y, delta = theirs.random(rng, 50), theirs.random(rng, 50), rng.normal(size=(50, 3))
    assert np.array_equal(ours.boxplus(x, delta), theirs.boxplus(x, delta))
    assert np.array_equal(ours.boxminus(x, y), theirs.boxminus(x, y))
    tolerance = 1e-6 if numba_config.DISABLE_JIT else 1e-12
    assert np.allclose(ours.boxplus_jacobian(x, delta), theirs.boxplus_jacobian(x, delta), atol=tolerance)
    assert np.allclose(ours.boxminus_jacobian(x, y), theirs.boxminus_jacobian(x, y), atol=tolerance)
    z = x.copy()
    ours.boxplus_into(z, delta, z)  # in place
    assert np.array_equal(z, ours.boxplus(x, delta))
    assert ours.random(rng, 3).shape == (3, 4) and ours.tangent_names == ("Rotations 0", "Rotations 1", "Rotations 2")


def test_jacobians_of_ones_own_are_taken() -> None:
    for scale in (_scale(), _scale(plus_jacobian=growth_jacobian, minus_jacobian=growth_jacobian)):
        assert np.allclose(scale.boxplus_jacobian([[2.0], [3.0]], [[0.1], [0.7]]), 1.0)
        assert np.allclose(scale.boxminus_jacobian([[2.0], [3.0]], [[0.1], [0.7]]), 1.0)


def test_equal_are_those_of_one_meaning() -> None:
    assert _scale() == _scale() and hash(_scale()) == hash(_scale()) and repr(_scale()) == "Scale"
    assert _scale() != _scale(minus_jacobian=growth_jacobian)
    assert _rotations() != bp.UnitQuaternion


@compiles
def test_residuals_on_it_are_differentiated_automatically() -> None:
    def stretched(pose, scale, z):
        x, y = scale[0] * (pose[5] - z[0]), scale[0] * pose[4] + z[1]
        return x * pose[0] - pose[2] * z[0], y * pose[1] + pose[3]

    rng = np.random.default_rng(1)
    z, scales = rng.normal(size=(20, 2)), np.exp(rng.normal(size=(20, 1)))
    Jacobians = []
    for rotations in (_rotations(), bp.UnitQuaternion):
        pose = bp.Product(rotations, bp.Euclidean(2))
        residual = bp.residuals.UserResidual(stretched, dim=2, manifolds=(pose, _scale()), data=(z,), jacobian="automatic")
        poses = np.column_stack([bp.UnitQuaternion.random(np.random.default_rng(2), 20), z])
        report = bp.check_jacobian(residual, poses, scales, tolerance=1e-8)
        assert report.passed, report
        Jacobians.append(residual.linearize(poses, scales).jacobians)
    for ours, theirs in zip(*Jacobians, strict=True):
        assert np.allclose(ours, theirs, atol=1e-13)


def test_a_problem_takes_it() -> None:
    def stretched(scale, length, measured):
        return scale[0] * length - measured

    lengths, scale = np.array([1.0, 2.0, 4.0]), _scale()
    problem = bp.Problem()
    scales = problem.add_variables(scale, [[10.0]], name="scale")
    problem.add_residuals(
        bp.residuals.UserResidual(stretched, dim=1, manifolds=(scale,), data=(lengths, 1.5 * lengths), sigma=0.01), scales
    )
    assert np.isclose(problem.solve()[scales][0, 0], 1.5)
    with pytest.raises(bp.InputError, match="scales above zero"):
        problem.add_variables(scale, [[-1.0]])


def test_what_is_no_manifold_is_refused() -> None:
    with pytest.raises(bp.InputError, match=r"expected \(x ⊞ δ\) ⊟ x = δ on Scale, at the identity"):
        _scale(minus=lambda x, base: (2.0 * math.log(x[0] / base[0]),))
    with pytest.raises(bp.InputError, match="expected 1 tangent_names – got 2"):
        _scale(tangent_names=("a", "b"))
    with pytest.raises(bp.InputError, match="a plus of 2 arguments"):
        _scale(plus=lambda x: x)
    with pytest.raises(bp.InputError, match="dof ≥ 1"):
        _scale(dof=0)


def _plane(**changes: Any) -> bp.UserManifold:
    given: dict[str, Any] = {"plus": _moved, "minus": _way, "identity": [0.0, 0.0]}
    return bp.UserManifold("Plane", size=2, dof=2, **{**given, **changes})


def _moved(x, delta):
    return x[0] + delta[0], x[1] + delta[1]


def _moved_unless_small(x, delta):
    if math.sqrt(delta[0] ** 2 + delta[1] ** 2) < 1e-12:
        return x[0], x[1]
    return x[0] + delta[0], x[1] + delta[1]


def _way(x, base):
    return x[0] - base[0], x[1] - base[1]


def _way_unless_near(x, base):
    dx, dy = x[0] - base[0], x[1] - base[1]
    return (0.0, 0.0) if math.sqrt(dx * dx + dy * dy) < 1e-12 else (dx, dy)


def _unit_jacobian(x, other, J):
    J[0, 0] = J[1, 1] = 1.0


def _half_jacobian(x, other, J):
    J[0, 0] = J[1, 1] = 0.5


@compiles
def test_a_branch_at_zero_that_loses_the_derivative_is_refused() -> None:
    own = {"plus_jacobian": _unit_jacobian, "minus_jacobian": _unit_jacobian}
    for functions in ({"plus": _moved_unless_small}, {"minus": _way_unless_near}):
        with pytest.raises(bp.InputError, match=r"1 at δ = 0 on Plane.*got \[\[0.0, 0.0\], .* from the derivatives.*if n < eps"):
            _plane(**functions)
    with pytest.raises(bp.InputError, match=r"derivatives \[\[1.0, 0.0\], .* of x ⊞ δ at δ = 0 on Plane.*got \[\[0.0, 0.0\]"):
        _plane(plus=_moved_unless_small, **own)  # residuals would be differentiated with it all the same
    plane = _plane(minus=_way_unless_near, **own)
    problem = bp.Problem()
    point = problem.add_variables(plane, [[1.0, 2.0]])
    problem.add_residuals(bp.residuals.Prior(plane, [[1.0, 2.0]], sigma=0.5), point)
    assert np.allclose(problem.solve().covariance(point), 0.25 * np.eye(2))


def test_a_jacobian_of_ones_own_that_is_wrong_at_zero_is_refused() -> None:
    for role in ("plus_jacobian", "minus_jacobian"):
        with pytest.raises(bp.InputError, match=rf"got \[\[0.5, 0.0\], \[0.0, 0.5\]\] at x = .* from {role}"):
            _plane(**{role: _half_jacobian})


@compiles
def test_a_branch_that_chooses_a_factor_is_taken() -> None:
    def turned_by_factor(x, delta):
        n = math.sqrt(delta[0] ** 2 + delta[1] ** 2 + delta[2] ** 2)
        s = math.sin(0.5 * n) / n if n > 1e-9 else 0.5
        w, a, b, c = math.cos(0.5 * n), s * delta[0], s * delta[1], s * delta[2]
        return multiply_scalars(x[0], x[1], x[2], x[3], w, a, b, c)

    ours, theirs = _rotations(plus=turned_by_factor), bp.UnitQuaternion
    x = theirs.random(np.random.default_rng(3), 20)
    assert np.allclose(ours.boxplus_jacobian(x, np.zeros((20, 3))), np.eye(3), atol=1e-12)
    assert np.allclose(ours.boxminus_jacobian(x, x), np.eye(3), atol=1e-12)


@compiles
def test_functions_that_do_not_fit_are_refused() -> None:
    with pytest.raises(bp.InputError, match="expected 1 numbers from"):
        _scale(plus=lambda x, delta: (x[0], x[0]))
    with pytest.raises(bp.InputError, match="None at times"):
        _scale(plus=lambda x, delta: None if x[0] < 0.0 else (x[0] * math.exp(delta[0]),))
    with pytest.raises(bp.InputError, match=r"can be differentiated automatically.*give plus_jacobian"):
        _scale(plus=lambda x, delta: (x[0] * math.exp(delta[0]) + 0 * int(delta[0]),))
    with pytest.raises(bp.InputError, match=r"indices within x \(1,\) and delta \(1,\)"):
        _scale(plus=lambda x, delta: (x[0] * math.exp(delta[3]),), plus_jacobian=growth_jacobian, minus_jacobian=growth_jacobian)
