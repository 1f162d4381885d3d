"""Sim(3) against the matrix exponential, its Jacobians against differences, its small steps against ⊞."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.linalg import expm

import boxplus as bp
from boxplus.manifolds import quaternion, sim3, so3
from boxplus.manifolds.tangents.step import step_into, tangent_steps

ANGLES = [0.0, 1e-9, 1e-4, 0.5, 2.0, 3.0, np.pi - 1e-6]
GROWTHS = [0.0, 1e-9, -1e-4, 0.3, -2.0, 5.99, 6.01, -14.0]
seeds = st.integers(0, 2**32 - 1)


def matrix(S):
    M = np.eye(4)
    M[:3, :3] = S[7] * quaternion.to_matrix(S[:4])
    M[:3, 3] = S[4:7]
    return M


def hat(xi):
    M = np.zeros((4, 4))
    M[:3, :3] = so3.hat(xi[:3]) + xi[6] * np.eye(3)
    M[:3, 3] = xi[3:6]
    return M


def tangent(seed, angle, growth):
    xi = np.random.default_rng(seed).normal(size=7)
    xi[:3] *= angle / np.linalg.norm(xi[:3])
    xi[6] = growth
    return xi


@pytest.mark.parametrize("angle", [1e-5, 0.7, 3.1])
@pytest.mark.parametrize("growth", [0.0, 1e-6, -3.0, 9.0])
def test_integrals(angle, growth):
    def integral(f):
        return quad(lambda t: np.exp(growth * t) * f(t), 0.0, 1.0, epsabs=0.0, epsrel=1e-13)[0]

    expected = [
        integral(lambda t: 1.0),
        integral(lambda t: np.sin(angle * t) / angle),
        integral(lambda t: 2.0 * (np.sin(0.5 * angle * t) / angle) ** 2),
    ]
    np.testing.assert_allclose(sim3.integrals(angle, growth), expected, rtol=1e-12)


@given(st.sampled_from(ANGLES), st.sampled_from(GROWTHS[:-1]), seeds)
@settings(max_examples=40)
def test_exp_is_the_matrix_exponential_and_log_its_inverse(angle, growth, seed):
    xi = tangent(seed, angle, growth)
    expected = expm(hat(xi))
    S = sim3.exp(xi)
    np.testing.assert_allclose(matrix(S), expected, atol=1e-11 * np.abs(expected).max())
    np.testing.assert_allclose(sim3.log(S), xi, atol=1e-9 if angle > 3.0 else 1e-12 * max(1.0, np.abs(xi).max()))


@given(st.sampled_from(ANGLES[:-1]), st.sampled_from(GROWTHS[:5]), seeds)
@settings(max_examples=30)
def test_jacobians(angle, growth, seed):
    xi, h = tangent(seed, angle, growth), 1e-3
    S = sim3.exp(xi)

    def at(d):
        return bp.Sim3.boxminus(sim3.exp(xi + d), S)

    steps = h * np.eye(7)
    numeric = np.stack([(8 * (at(d) - at(-d)) - (at(2 * d) - at(-2 * d))) / (12 * h) for d in steps], axis=-1)
    J = bp.Sim3.boxplus_jacobian(bp.Sim3.identity(), xi)
    np.testing.assert_allclose(J, numeric, atol=1e-8 * max(1.0, np.abs(J).max()))
    inverse = bp.Sim3.boxminus_jacobian(S, bp.Sim3.identity())
    np.testing.assert_allclose(inverse @ J, np.eye(7), atol=1e-9 * max(1.0, np.abs(J).max() * np.abs(inverse).max()))


def test_it_is_a_group_that_acts_on_points():
    rng = np.random.default_rng(0)
    A, B, p = bp.Sim3.random(rng, 20), bp.Sim3.random(rng, 20), rng.normal(size=(20, 3))
    np.testing.assert_allclose(sim3.act(sim3.compose(A, B), p), sim3.act(A, sim3.act(B, p)), rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(sim3.act(sim3.inverse(A), sim3.act(A, p)), p, atol=1e-11)
    for S, x, y in zip(A, p, sim3.act(A, p), strict=True):
        np.testing.assert_allclose((matrix(S) @ [*x, 1.0])[:3], y, atol=1e-12)
    difference = bp.Sim3.boxminus(B, A)
    np.testing.assert_allclose(sim3.act(bp.Sim3.boxplus(A, difference), p), sim3.act(B, p), atol=1e-9)


@pytest.mark.parametrize("manifold", [bp.S2, bp.Sim3, bp.Product(bp.Sim3, bp.S2)], ids=str)
def test_small_steps_are_those_of_boxplus(manifold):
    steps = tangent_steps(manifold)
    for x in manifold.random(np.random.default_rng(1), 5):
        for k in range(manifold.dof):
            out = np.empty(manifold.size)
            step_into(steps, k, 0.3, np.cos(0.15), np.sin(0.15), x, out)
            np.testing.assert_allclose(out, manifold.boxplus(x, 0.3 * np.eye(manifold.dof)[k]), atol=1e-13)


def moved(S_a_b, p_b, p_a):
    w, x, y, z, s = S_a_b[0], S_a_b[1], S_a_b[2], S_a_b[3], S_a_b[7]
    a, b, c = quaternion.rotate(w, x, y, z, p_b[0], p_b[1], p_b[2])
    return s * a + S_a_b[4] - p_a[0], s * b + S_a_b[5] - p_a[1], s * c + S_a_b[6] - p_a[2]


def test_two_maps_are_joined_as_in_closed_form():
    """Umeyama, PAMI 1991: the least-squares similarity between two sets of points."""
    rng = np.random.default_rng(2)
    p_b = rng.normal(size=(40, 3))
    p_a = sim3.act(bp.Sim3.random(rng, 1)[0], p_b) + 0.01 * rng.normal(size=(40, 3))
    problem = bp.Problem()
    S = problem.add_variables(bp.Sim3, bp.Sim3.identity(), name="S_a_b")
    residual = bp.residuals.UserResidual(moved, dim=3, manifolds=(bp.Sim3,), data=(p_b, p_a), sigma=0.01)
    problem.add_residuals(residual, S)
    assert bp.check_jacobian(residual, bp.Sim3.random(rng, 1)[0]).passed
    found = problem.solve(cost_tolerance=1e-14)[S][0]
    b, a = p_b - p_b.mean(axis=0), p_a - p_a.mean(axis=0)
    U, D, Vt = np.linalg.svd(a.T @ b)
    sign = np.diag([1.0, 1.0, np.linalg.det(U @ Vt)])
    R, s = U @ sign @ Vt, np.trace(np.diag(D) @ sign) / (b * b).sum()
    np.testing.assert_allclose(found[7], s, rtol=1e-6)
    np.testing.assert_allclose(quaternion.to_matrix(found[:4]), R, atol=1e-6)
    np.testing.assert_allclose(found[4:7], p_a.mean(axis=0) - s * R @ p_b.mean(axis=0), atol=1e-6)


def test_no_scale_below_zero():
    S = bp.Sim3.identity()
    S[7] = -1.0
    with pytest.raises(bp.InputError, match="positive scale"):
        bp.Sim3.check("S", S)
