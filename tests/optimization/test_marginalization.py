"""Marginalisation: exact where residuals are linear, to first order elsewhere, and consistent over a sliding window."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus import SE2, SE3, Euclidean, InputError, Line3D, Problem, SE3Left, check_jacobian, losses
from boxplus.manifolds import se3
from boxplus.optimization.marginalization import marginalize
from boxplus.residuals import Prior, RelativePose, UserResidual
from boxplus.residuals.marginal_prior import MarginalPrior
from tests.optimization.conftest import dense_normal_equations, make_scene

PLANE = Euclidean(2)


def difference(a, b, m):
    return np.array([b[0] - a[0] + 0.3 * a[1] - m[0], b[1] - 0.5 * a[1] - m[1]])


def linear_chain(rng, count=6, loss=None):
    """Marks in a row with a prior on the first; group 'steps' between neighbours and over one."""
    problem = Problem()
    marks = problem.add_variables(PLANE, rng.standard_normal((count, 2)), name="marks")
    i = np.concatenate([np.arange(count - 1), np.arange(count - 2)])
    j = np.concatenate([np.arange(1, count), np.arange(2, count)])
    data = rng.standard_normal((len(i), 2))
    problem.add_residuals(Prior(PLANE, [[1.0, 2.0]], sigma=0.5), marks[0], name="anchor")
    steps = UserResidual(difference, manifolds=(PLANE, PLANE), dim=2, data=(data,), sigma=0.7)
    problem.add_residuals(steps, marks[i], marks[j], name="steps", loss=loss)
    return problem, marks, (i, j, data)


def rest_of(marks, edges, marginal, leaving, start, loss=None):
    """The next problem: the marks that stay, the steps that were not absorbed, and the prior."""
    i, j, data = edges
    staying = np.setdiff1d(np.arange(len(start)), leaving)
    new = np.full(len(start), -1)
    new[staying] = np.arange(len(staying))
    problem = Problem()
    block = problem.add_variables(PLANE, start[staying], name="marks")
    keep = ~marginal.absorbed["steps"]
    steps = UserResidual(difference, manifolds=(PLANE, PLANE), dim=2, data=(data[keep],), sigma=0.7)
    problem.add_residuals(steps, block[new[i[keep]]], block[new[j[keep]]], name="steps", loss=loss)
    if not marginal.absorbed["anchor"].any():
        problem.add_residuals(Prior(PLANE, [[1.0, 2.0]], sigma=0.5), block[new[0]], name="anchor")
    problem.add_residuals(marginal.residual, *(block[new[c.rows]] for c in marginal.connections), name="marginal")
    return problem, block, staying


@pytest.mark.parametrize("leaving", [[0], [0, 1], [2], [1, 4], [5]])
def test_minimum_and_covariance_of_a_linear_problem_stay_exact(leaving):
    rng = np.random.default_rng(0)
    problem, marks, edges = linear_chain(rng)
    whole = problem.solve()
    start = rng.standard_normal(marks.values.shape)  # linear: any point of linearisation serves
    marginal = marginalize(problem, marks[leaving], at=[start])
    small, block, staying = rest_of(marks, edges, marginal, leaving, start)
    solution = small.solve()
    np.testing.assert_allclose(solution[block], whole[marks][staying], atol=1e-8)
    np.testing.assert_allclose(solution.joint_covariance(block), whole.joint_covariance(marks[staying]), rtol=1e-7, atol=1e-10)
    assert marginal.residual.fixes_gauge == (0 in leaving)


def test_one_at_a_time_equals_all_at_once():
    rng = np.random.default_rng(1)
    problem, marks, edges = linear_chain(rng)
    whole = problem.solve()
    first = marginalize(problem, marks[0], at=whole)
    second, block, _ = rest_of(marks, edges, first, [0], marks.values)
    marginal = marginalize(second, block[0], at=second.solve())
    both = marginalize(problem, [marks[0], marks[1]], at=whole)

    def information(prior):
        return prior.J.T @ prior.J

    np.testing.assert_allclose(information(marginal.residual), information(both.residual), rtol=1e-8, atol=1e-10)


def test_the_prior_is_the_schur_complement():
    scene = make_scene(cameras=8, points=10)
    solution = scene.problem.solve()
    marginal = marginalize(scene.problem, [scene.points], at=solution)
    for group in scene.problem.groups:
        group.linearize(solution.values, 1)
    H, g = dense_normal_equations(scene.problem)
    A, B, C = H[:36, :36], H[:36, 36:], np.linalg.inv(H[36:, 36:])
    J, r0 = marginal.residual.J, marginal.residual.r0
    np.testing.assert_allclose(J.T @ J, A - B @ C @ B.T, rtol=1e-7, atol=1e-6)
    np.testing.assert_allclose(J.T @ r0, g[:36] - B @ C @ g[36:], rtol=1e-5, atol=1e-4)
    assert marginal.absorbed["pixels"].all() and len(marginal.connections) == 6
    assert marginal.residual.roles[0] == "cameras[2]"


def test_undetermined_directions_take_no_information_with_them():
    # A point seen once says nothing about the camera; and a chain that nothing anchors leaves a relative prior.
    scene = make_scene(points=1)
    marginal = marginalize(scene.problem, scene.points[0])
    seen = int((~scene.cameras.is_fixed[scene.problem.groups[0].connections[0].rows]).sum())
    assert marginal.residual.count <= 2 * seen
    T = SE3.random(np.random.default_rng(0), 3)
    problem = Problem()
    poses = problem.add_variables(SE3, T, name="poses")
    problem.add_residuals(
        RelativePose(se3.compose(se3.inverse(T[[0, 0]]), T[[1, 2]])), poses[[0, 0]], poses[[1, 2]], name="odometry"
    )
    prior = marginalize(problem, poses[0]).residual
    assert prior.count == 6 and not prior.fixes_gauge
    alone = Problem()
    x = alone.add_variables(SE3, T[:2], name="x")
    alone.add_residuals(RelativePose(se3.compose(se3.inverse(T[:1]), T[1:2])), x[0], x[1], name="odometry")
    gone = marginalize(alone, x[0])
    assert gone.residual is None and gone.connections == () and gone.absorbed["odometry"].all()


@pytest.mark.parametrize("solved", [True, False])
def test_jacobians_of_the_prior(solved):
    rng = np.random.default_rng(3)
    manifolds = (SE3, SE3Left, SE2, Line3D, Euclidean(9))
    x0 = [m.random(rng, 1)[0] for m in manifolds]
    dof = sum(m.dof for m in manifolds)
    prior = MarginalPrior(manifolds, x0, rng.standard_normal((7, dof)), rng.standard_normal(7))
    x = [m.boxplus(a, 0.5 * rng.standard_normal(m.dof)) for m, a in zip(manifolds, x0, strict=True)]
    rows = x if solved else [np.tile(a, (7, 1)) for a in x]
    assert check_jacobian(prior, *rows).passed


def test_robust_losses_are_weighed_in():
    rng = np.random.default_rng(4)
    loss = losses.Cauchy(3.0)
    problem, marks, edges = linear_chain(rng, loss=loss)
    whole = problem.solve(cost_tolerance=1e-14)
    marginal = marginalize(problem, marks[0], at=whole)
    small, block, staying = rest_of(marks, edges, marginal, [0], whole[marks], loss=loss)
    solution = small.solve(cost_tolerance=1e-14)
    np.testing.assert_allclose(solution[block], whole[marks][staying], atol=1e-5)


def test_a_sliding_window_stays_consistent():
    """A window of 5 poses over an odometry of 40 with links over one and over three: NEES of the newest pose over many runs."""
    rng = np.random.default_rng(0)
    sigma = np.array([0.01] * 3 + [0.03] * 3)
    step = se3.exp(np.array([0.0, 0.02, 0.12, 1.0, 0.0, 0.05]))
    truth = [SE3.identity()]
    for _ in range(39):
        truth.append(se3.compose(truth[-1], step))
    truth = np.array(truth)
    pairs = np.array([(k, k + d) for d in (1, 3) for k in range(40 - d)])
    between = se3.compose(se3.inverse(truth[pairs[:, 0]]), truth[pairs[:, 1]])
    nees, distance = [], []
    for _ in range(30):
        measured = SE3.boxplus(between, sigma * rng.standard_normal((len(pairs), 6)))
        batch = Problem()
        poses = batch.add_variables(SE3, truth)
        batch.add_residuals(RelativePose(measured, sigma=sigma), poses[pairs[:, 0]], poses[pairs[:, 1]])
        batch.fix(poses[0])
        reference = batch.solve()

        estimate, window, prior = [truth[0]], [0], None
        for newest in range(1, 40):
            odometry = measured[newest - 1]
            estimate.append(se3.compose(estimate[newest - 1], odometry))
            window.append(newest)
            problem = Problem()
            block = problem.add_variables(SE3, np.array([estimate[k] for k in window]), name="window")
            if window[0] == 0:
                problem.fix(block[0])
            inside = np.flatnonzero(np.isin(pairs, window).all(axis=1))
            a, b = np.searchsorted(window, pairs[inside].T)
            problem.add_residuals(RelativePose(measured[inside], sigma=sigma), block[a], block[b], name="edges")
            if prior is not None:
                problem.add_residuals(prior[0], *(block[window.index(k)] for k in prior[1]), name="prior")
            solution = problem.solve()
            for k, x in zip(window, solution[block], strict=True):
                estimate[k] = x
            if len(window) == 5 and newest < 39:
                left = marginalize(problem, block[0], at=solution)
                prior = (left.residual, [window[int(c.rows[0])] for c in left.connections])
                window = window[1:]
        error = SE3.boxminus(truth[39], solution[block][-1])
        nees.append(error @ np.linalg.solve(solution.covariance(block[4])[0], error))
        spread = np.sqrt(np.diag(reference.covariance(poses[39])[0]))
        distance.append(np.abs(SE3.boxminus(reference[poses][39], solution[block][-1]) / spread).max())
    assert abs(np.mean(nees) - 6.0) < 4.0 * np.sqrt(12.0 / 30)
    assert np.max(distance) < 0.1  # of a standard deviation, from the estimate of all 40 poses together


def test_wrong_use_is_refused():
    rng = np.random.default_rng(0)
    problem = linear_chain(rng)[0]
    with pytest.raises(InputError, match="variables to marginalise"):
        marginalize(problem, [])
    with pytest.raises(InputError, match="stack J over the variables"):
        MarginalPrior([PLANE], [[0.0, 0.0]], np.zeros((2, 3)), np.zeros(2))
    with pytest.raises(InputError, match="a point x0 for each"):
        MarginalPrior([PLANE], [], np.zeros((2, 2)), np.zeros(2))
    with pytest.raises(InputError, match="NaN"):
        MarginalPrior([PLANE], [[0.0, 0.0]], np.full((2, 2), np.nan), np.zeros(2))
