"""Directions: the axioms of ⊞ up to the opposite point, where ⊟ has no direction, and the geometry behind them."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import boxplus as bp
from boxplus.manifolds.sphere import tangent_basis

POLES = np.array([[0.0, 0, 1], [0, 0, -1], [1, 0, 0], [0, 1, 0], [0, -1, 0], [1e-9, 0, -1]])
ANGLES = st.one_of(st.sampled_from([0.0, 1e-8, 1e-3, 1.0 - 1e-9, 1.0 + 1e-9, 2.0, 3.0]), st.floats(0.0, 3.0))
SEEDS = st.integers(0, 2**32 - 1)


def point(rng: np.random.Generator) -> NDArray[np.float64]:
    return bp.S2.random(rng, 1)[0] if rng.random() < 0.7 else POLES[rng.integers(len(POLES))]


def tangent(rng: np.random.Generator, angle: float) -> NDArray[np.float64]:
    delta = rng.normal(size=2)
    return angle * delta / np.linalg.norm(delta)


def numeric(function, h: float = 1e-3) -> NDArray[np.float64]:  # type: ignore[no-untyped-def]
    columns = []
    for d in h * np.eye(2):
        columns.append((8 * (function(d) - function(-d)) - (function(2 * d) - function(-2 * d))) / (12 * h))
    return np.stack(columns, axis=-1)


@given(ANGLES, SEEDS)
def test_axioms(angle: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, delta = point(rng), tangent(rng, angle)
    y = bp.S2.boxplus(x, delta)
    np.testing.assert_allclose(np.linalg.norm(y), 1.0, atol=1e-15)
    np.testing.assert_allclose(bp.S2.boxplus(x, [0.0, 0.0]), x, atol=1e-15)
    np.testing.assert_allclose(bp.S2.boxminus(x, x), 0.0, atol=1e-15)
    np.testing.assert_allclose(bp.S2.boxminus(y, x), delta, atol=2e-14)
    np.testing.assert_allclose(np.arctan2(np.linalg.norm(np.cross(x, y)), x @ y), angle, atol=1e-14)
    z = point(rng)
    np.testing.assert_allclose(bp.S2.boxplus(x, bp.S2.boxminus(z, x)), z, atol=1e-14)


@given(st.floats(0.0, 2.8), SEEDS)
def test_jacobians(angle: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, delta = point(rng), tangent(rng, angle)
    y = bp.S2.boxplus(x, delta)
    J = bp.S2.boxplus_jacobian(x, delta)
    np.testing.assert_allclose(J, numeric(lambda d: bp.S2.boxminus(bp.S2.boxplus(x, delta + d), y)), atol=1e-9)
    K = bp.S2.boxminus_jacobian(y, x)
    np.testing.assert_allclose(K, numeric(lambda d: bp.S2.boxminus(bp.S2.boxplus(y, d), x)), atol=1e-7 * np.abs(K).max())
    np.testing.assert_allclose(K @ J, np.eye(2), atol=1e-12)


def test_the_basis_is_orthonormal() -> None:
    x = np.vstack([POLES[:5], bp.S2.random(np.random.default_rng(1), 50)])
    B = tangent_basis(x)
    frame = np.concatenate([B, x[:, :, None]], axis=2)
    np.testing.assert_allclose(frame.swapaxes(1, 2) @ frame, np.tile(np.eye(3), (len(x), 1, 1)), atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(frame), 1.0, atol=1e-15)


def test_opposite_points_are_half_a_circle_apart() -> None:
    x = bp.S2.random(np.random.default_rng(2), 20)
    np.testing.assert_allclose(np.linalg.norm(bp.S2.boxminus(-x, x), axis=1), np.pi, atol=1e-12)
    np.testing.assert_allclose(bp.S2.boxplus(x, bp.S2.boxminus(-x, x)), -x, atol=1e-12)


def test_what_is_a_direction() -> None:
    assert np.allclose(np.linalg.norm(bp.S2.check("g", [0.6, 0.0, 0.8001]), axis=1), 1.0, atol=1e-15)
    with pytest.raises(bp.InputError, match=r"expected g as unit vectors – got length 9\.81 in row 1 – divide it by its length"):
        bp.S2.check("g", [[0.0, 0.0, 1.0], [0.0, 0.0, -9.81]])
    with pytest.raises(bp.InputError, match=r"g of shape \(n, 3\) on S2"):
        bp.S2.check("g", [0.0, 1.0])
    assert pickle.loads(pickle.dumps(bp.S2)) == bp.S2 and len(bp.S2.tangent_names) == bp.S2.dof


def test_a_direction_is_estimated() -> None:
    """The mean of directions about a pole, from far off."""
    rng = np.random.default_rng(3)
    truth = np.array([0.0, 0.0, -1.0])
    seen = bp.S2.boxplus(truth, 0.01 * rng.normal(size=(400, 2)))
    problem = bp.Problem()
    g = problem.add_variables(bp.S2, [0.8, 0.0, -0.6])
    problem.add_residuals(bp.residuals.Prior(bp.S2, seen, sigma=0.01), g)
    solution = problem.solve()
    assert np.linalg.norm(bp.S2.boxminus(solution[g][0], truth)) < 3.0 * 0.01 / 20.0
    np.testing.assert_allclose(solution.standard_deviations(g)[0], 0.01 / 20.0, rtol=1e-3)
