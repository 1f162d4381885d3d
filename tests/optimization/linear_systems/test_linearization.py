"""`Problem.linearize`: against differences of the cost, the solver's own step, and SciPy's solvers fed with it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.sparse.linalg import spsolve

import boxplus as bp
from boxplus.manifolds import se3


def chain(loss=None, held=(1, 5)):
    """Six poses, all pairs of neighbours and next neighbours measured, one pose fixed, components of another held."""
    rng = np.random.default_rng(0)
    T = bp.SE3.random(rng, 6)
    i, j = np.array([(a, b) for a in range(6) for b in range(a + 1, min(a + 3, 6))]).T
    measured = bp.SE3.boxplus(se3.compose(se3.inverse(T[i]), T[j]), 0.1 * rng.normal(size=(len(i), 6)))
    problem = bp.Problem()
    poses = problem.add_variables(bp.SE3, bp.SE3.boxplus(T, 0.2 * rng.normal(size=(6, 6))), name="poses")
    group = problem.add_residuals(bp.residuals.RelativePose(measured, sigma=0.1), poses[i], poses[j], loss=loss, name="edges")
    prior = problem.add_residuals(bp.residuals.Prior(bp.SE3, T[3:4], sigma=0.3), poses[3], name="prior")
    problem.fix(poses[0])
    if held:
        problem.fix(poses[4], components=held)
    return problem, poses, group, prior


def differences(problem, at, h=1e-6):
    """The gradient of `Problem.cost` by central differences, along the columns of a linearisation."""
    values = problem.values_at()
    steps = np.eye(at.jacobian.shape[1]) * h
    return np.array([(problem.cost(at.moved(d, values)) - problem.cost(at.moved(-d, values))) / (2 * h) for d in steps])


@pytest.mark.parametrize("loss", [None, bp.losses.Huber(0.5), bp.losses.Cauchy(1.0), bp.losses.Tukey(4.0)], ids=repr)
def test_gradient_and_cost_are_those_of_the_problem(loss):
    problem, *_ = chain(loss)
    at = problem.linearize()
    assert at.jacobian.shape == (6 * 10, 5 * 6 - 2)
    assert at.cost == pytest.approx(problem.cost(), rel=1e-14)
    np.testing.assert_allclose(at.gradient, differences(problem, at), rtol=1e-5, atol=1e-6 * np.abs(at.gradient).max())


def test_jacobian_is_the_derivative_of_the_residuals():
    problem, *_ = chain(bp.losses.Cauchy(1.0))
    at, values, h = problem.linearize(), problem.values_at(), 1e-6
    for k, d in enumerate(np.eye(at.jacobian.shape[1]) * h):
        ahead, behind = problem.linearize(at.moved(d, values)), problem.linearize(at.moved(-d, values))
        numeric = (ahead.residuals - behind.residuals) / (2 * h)
        np.testing.assert_allclose(at.jacobian[:, [k]].toarray()[:, 0], numeric, atol=1e-6)


def test_one_step_of_gauss_newton_is_the_solvers():
    problem, poses, *_ = chain()
    at = problem.linearize()
    moved = at.moved(-spsolve(at.hessian.tocsc(), at.gradient), problem.values_at())
    solution = problem.solve(method="gauss_newton", max_iterations=1)
    np.testing.assert_allclose(bp.SE3.boxminus(moved[0], solution[poses]), 0.0, atol=1e-10)


def test_scipy_solves_it_with_these_matrices():
    problem, poses, *_ = chain(held=())  # a component held in the body ends where the path to the minimum leads
    start = problem.linearize()

    def at(delta):
        return problem.linearize(start.moved(delta, problem.values_at()))

    # Far from the start the Jacobian of `at(delta)` belongs to the tangent there: SciPy takes differences of its own.
    delta = np.zeros(start.jacobian.shape[1])
    found = least_squares(lambda d: at(d).residuals, delta, xtol=1e-12, ftol=1e-12, gtol=1e-12)
    expected = problem.solve(cost_tolerance=1e-14)
    assert found.cost == pytest.approx(expected.cost, rel=1e-9)
    moved = start.moved(found.x, problem.values_at())
    np.testing.assert_allclose(bp.SE3.boxminus(moved[0], expected[poses]), 0.0, atol=1e-5)


def test_rows_and_columns_are_found_by_what_they_belong_to():
    problem, poses, group, prior = chain()
    at = problem.linearize()
    assert at.rows(group) == slice(0, 54) and at.rows(prior) == slice(54, 60)
    columns = at.columns(poses)
    assert (columns[0] == -1).all() and (columns[4] >= 0).tolist() == [True, False, True, True, True, False]
    assert sorted(columns[columns >= 0]) == list(range(28))
    touched = np.flatnonzero(np.abs(at.jacobian[at.rows(prior)].toarray()).max(axis=0))
    assert touched.tolist() == columns[3].tolist()
    other, stranger, other_group, _ = chain()
    with pytest.raises(bp.InputError, match="variables of this problem"):
        at.columns(stranger)
    with pytest.raises(bp.InputError, match="group of this problem"):
        at.rows(other_group)
    with pytest.raises(bp.InputError, match=r"delta of shape \(28,\)"):
        at.moved(np.zeros(30), other.values_at())


def test_what_counts_nothing_keeps_its_rows():
    problem, _, group, _ = chain()
    problem.remove(group[[2, 5]])
    weights = np.ones(9)
    weights[0] = 4.0
    problem.set_weights(group, weights)
    at = problem.linearize()
    gone = np.r_[12:18, 30:36]
    assert (at.weights[gone] == 0.0).all() and not at.residuals[gone].any() and at.jacobian[gone].nnz == 0
    assert at.cost == pytest.approx(problem.cost(), rel=1e-14)
    np.testing.assert_allclose(at.gradient, differences(problem, at), rtol=1e-5, atol=1e-5)


def test_a_solution_keeps_its_covariances():
    """Linearising elsewhere must not touch what a solution still reads."""
    problem, poses, *_ = chain()
    solution = problem.solve()
    problem.linearize()
    other, poses_2, *_ = chain()
    np.testing.assert_array_equal(solution.covariance(poses[2]), other.solve().covariance(poses_2[2]))


def test_refusals():
    problem, poses, *_ = chain()
    problem.fix(poses)
    with pytest.raises(bp.InputError, match="at least one free variable"):
        problem.linearize()
    bad = bp.Problem()
    x = bad.add_variables(bp.Euclidean(1), [[0.0]])
    residual = bp.residuals.UserResidual(lambda x: (1.0 / x[0],), dim=1, manifolds=(bp.Euclidean(1),), count=1)
    bad.add_residuals(residual, x)
    with pytest.raises(bp.NotFiniteError, match="residual 0"):
        bad.linearize()
