"""Marginalisation: exact where residuals are linear, to first order elsewhere, landmark by landmark as all at once."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus import SE2, SE3, Euclidean, InputError, Line3D, Problem, SE3Left, check_jacobian, losses, marginalize
from boxplus.manifolds import se3
from boxplus.residuals import Prior, RelativePose, RelativePose2D, UserResidual
from boxplus.residuals.marginal_prior import MarginalPrior
from tests.optimization.conftest import dense_normal_equations, make_scene

PLANE = Euclidean(2)
SPACE = Euclidean(3)


def difference(a, b, m):
    return np.array([b[0] - a[0] + 0.3 * a[1] - m[0], b[1] - 0.5 * a[1] - m[1]])


def projection(pose, point, m):
    return np.array([pose[0] + point[0] - 0.2 * point[2] * m[2] - m[0], pose[1] + 0.7 * pose[2] * m[2] + point[1] - m[1]])


def step(a, b, m):
    return b - a - m


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
    return problem, marks


def linear_window(seed, frames=5, points=12, share=0.7):
    """Frames of three numbers and points, seen linearly; a chain of frames with an anchor."""
    rng = np.random.default_rng(seed)
    problem = Problem()
    frame = problem.add_variables(SPACE, rng.standard_normal((frames, 3)), name="frames")
    point = problem.add_variables(SPACE, rng.standard_normal((points, 3)), name="points")
    i, j = np.nonzero(rng.random((frames, points)) < share)
    seen = UserResidual(projection, manifolds=(SPACE, SPACE), dim=2, data=(rng.standard_normal((len(i), 3)),), sigma=0.3)
    problem.add_residuals(seen, frame[i], point[j], name="seen")
    problem.add_residuals(Prior(SPACE, rng.standard_normal((points, 3)), sigma=5.0), point[:], name="about")
    problem.add_residuals(Prior(SPACE, rng.standard_normal(3), sigma=0.5), frame[0], name="anchor")
    chain = UserResidual(step, manifolds=(SPACE, SPACE), dim=3, data=(rng.standard_normal((frames - 1, 3)),))
    problem.add_residuals(chain, frame[:-1], frame[1:], name="chain")
    return problem, frame, point


def stacked(problem, gone):
    """[J_m, J_b, r] of the residuals that touch the variables `gone` (block number, row), by NumPy alone."""
    columns, end = {}, 0
    touched = []
    for group in problem.groups:
        group.linearize([block.values for block in problem.blocks], 1)
        hit = np.any([[(c.block.number, int(k)) in gone for k in c.rows] for c in group.connections], axis=0)
        touched.append(hit)
    met = {
        (c.block.number, int(k))
        for group, hit in zip(problem.groups, touched, strict=True)
        for c in group.connections
        for k in c.rows[hit]
        if not c.block.is_fixed[k]
    }
    for key in [*sorted(met & gone), *sorted(met - gone)]:
        columns[key] = end
        end += problem.blocks[key[0]].manifold.dof
    leaving = sum(problem.blocks[number].manifold.dof for number, _ in met & gone)
    parts = []
    for group, hit in zip(problem.groups, touched, strict=True):
        rows = np.zeros((group.residual.count, group.residual.dim, end + 1))
        for c, J in zip(group.connections, group.jacobians, strict=True):
            for n, k in enumerate(c.rows):
                at = columns.get((c.block.number, int(k)))
                if at is not None:
                    rows[n, :, at : at + J.shape[2]] += J[n]
        rows[:, :, -1] = group.r
        parts.append(rows[hit].reshape(-1, end + 1))
    return np.concatenate(parts), leaving


def dense_marginal(problem, *leaving):
    """Schur complement (H, g) of the blanket, by one dense QR and the pseudo-inverse."""
    gone = {(rows.block.number, int(k)) for rows in leaving for k in rows.rows}
    rows, m = stacked(problem, gone)
    Q, length, _ = np.linalg.svd(rows[:, :m], full_matrices=True)
    rank = int((length > 1e-9 * length.max()).sum())
    rest = Q[:, rank:].T @ rows[:, m:]
    return rest[:, :-1].T @ rest[:, :-1], rest[:, :-1].T @ rest[:, -1]


def information(marginal):
    J, r0 = marginal.prior.residual.J, marginal.prior.residual.r0
    return J.T @ J, J.T @ r0


def assert_close(a, b, rtol=1e-9):
    np.testing.assert_allclose(a, b, rtol=0.0, atol=rtol * np.abs(b).max())


@pytest.mark.parametrize("leaving", [[0], [0, 1], [2], [1, 4], [5]])
def test_minimum_and_covariance_of_a_linear_problem_stay_exact(leaving):
    rng = np.random.default_rng(0)
    problem, marks = linear_chain(rng)
    whole = problem.solve()
    staying = np.setdiff1d(np.arange(6), leaving)
    values, covariance = whole[marks[staying]], whole.joint_covariance(marks[staying])
    start = rng.standard_normal(marks.values.shape)  # linear: any point of linearisation serves
    marginal = marginalize(problem, marks[leaving], at=[start])
    assert list(marks.ids) == list(staying)
    solution = problem.solve()
    np.testing.assert_allclose(solution[marks[staying]], values, atol=1e-8)
    np.testing.assert_allclose(solution.joint_covariance(marks[staying]), covariance, rtol=1e-7, atol=1e-10)
    assert marginal.prior.residual.fixes_gauge == (0 in leaving)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 4), st.integers(1, 12))
def test_the_marginal_of_a_linear_problem_is_that_of_the_whole(seed, frames_leaving, points_leaving):
    rng = np.random.default_rng(seed)
    problem, frames, points = linear_window(seed)
    H, g = dense_normal_equations(problem_at(problem))
    leave_f, leave_p = np.arange(frames_leaving), rng.permutation(12)[:points_leaving]
    keep = np.concatenate(
        [np.arange(15).reshape(5, 3)[frames_leaving:].ravel(), 15 + np.delete(np.arange(36).reshape(12, 3), leave_p, 0).ravel()]
    )
    lose = np.setdiff1d(np.arange(51), keep)
    C = np.linalg.inv(H[np.ix_(lose, lose)])
    B = H[np.ix_(keep, lose)]
    marginalize(problem, [frames[leave_f], points[leave_p]], at=None)
    H_rest, g_rest = dense_normal_equations(problem_at(problem))
    assert_close(H_rest, H[np.ix_(keep, keep)] - B @ C @ B.T)
    assert_close(g_rest, g[keep] - B @ C @ g[lose], 1e-8)


def problem_at(problem):
    for group in problem.groups:
        group.linearize([block.values for block in problem.blocks], 1)
    return problem


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6))
def test_landmark_by_landmark_equals_all_at_once(seed):
    rng = np.random.default_rng(seed)
    scene = make_scene(cameras=7, points=30, seed=seed)
    problem = scene.problem
    problem.groups[0].set_loss(losses.Cauchy(1.0))
    problem.add_residuals(Prior(SE3Left, scene.cameras.values[3], sigma=0.1), scene.cameras[3])
    selected = [scene.points[rng.permutation(30)[: rng.integers(1, 31)]], scene.cameras[rng.permutation(7)[: rng.integers(0, 3)]]]
    H, g = dense_marginal(problem, *selected)
    found = information(marginalize(problem, [part for part in selected if len(part)], at=None))
    assert_close(found[0], H)
    assert_close(found[1], g)


@pytest.mark.slow
def test_many_rows_and_long_tracks_pass_through_the_batches():
    # A landmark with more rows than a batch holds, next to hundreds with few.
    rng = np.random.default_rng(0)
    problem = Problem()
    frame = problem.add_variables(SPACE, rng.standard_normal((4, 3)), name="frames")
    point = problem.add_variables(SPACE, rng.standard_normal((300, 3)), name="points")
    i = np.concatenate([rng.integers(0, 4, 400), rng.integers(0, 4, 900)])
    j = np.concatenate([np.zeros(400, dtype=int), rng.integers(0, 300, 900)])
    seen = UserResidual(projection, manifolds=(SPACE, SPACE), dim=2, data=(rng.standard_normal((1300, 3)),))
    problem.add_residuals(seen, frame[i], point[j], name="seen")
    H, g = dense_marginal(problem, point[:])
    found = information(marginalize(problem, point, at=None))
    assert_close(found[0], H)
    assert_close(found[1], g)


def test_one_at_a_time_equals_all_at_once():
    problem, marks = linear_chain(np.random.default_rng(1))
    other, others = linear_chain(np.random.default_rng(1))
    whole = problem.solve()
    marginalize(problem, marks[0], at=whole)
    one_by_one = marginalize(problem, marks[1], at=problem.solve())
    both = marginalize(other, [others[0], others[1]], at=whole.values)
    assert_close(information(one_by_one)[0], information(both)[0])
    assert one_by_one.absorbed == {"MarginalPrior_2": 1, "steps": 2} and both.absorbed == {"anchor": 1, "steps": 4}
    assert len(problem.groups) == 2  # the prior before is in the new one


def test_hundreds_of_variables_that_share_one_residual_leave_together():
    """More of them than a byte counts; each is then not taken for a landmark that goes alone."""
    count = 257
    rng = np.random.default_rng(3)
    J = rng.standard_normal((count, count)) + 10.0 * np.eye(count)
    problem = Problem()
    x = problem.add_variables(Euclidean(1), np.zeros((count, 1)), name="x")
    prior = MarginalPrior([Euclidean(1)] * count, [np.zeros(1)] * count, J, rng.standard_normal(count))
    problem.add_residuals(prior, *(x[k] for k in range(count)))
    left = marginalize(problem, x[1:], at=None).prior.residual
    assert left.J.shape == (1, 1)
    assert abs(left.J[0, 0]) == pytest.approx(1.0 / np.sqrt(np.linalg.inv(J.T @ J)[0, 0]), rel=1e-9)


def test_the_prior_is_the_schur_complement():
    scene = make_scene(cameras=8, points=10)
    solution = scene.problem.solve()
    for group in scene.problem.groups:
        group.linearize(solution.values, 1)
    H, g = dense_normal_equations(scene.problem)
    A, B, C = H[:36, :36], H[:36, 36:], np.linalg.inv(H[36:, 36:])
    count = scene.problem.groups[0].residual.count
    marginal = marginalize(scene.problem, [scene.points], at=solution)
    J, r0 = marginal.prior.residual.J, marginal.prior.residual.r0
    np.testing.assert_allclose(J.T @ J, A - B @ C @ B.T, rtol=1e-7, atol=1e-6)
    np.testing.assert_allclose(J.T @ r0, g[:36] - B @ C @ g[36:], rtol=1e-5, atol=1e-4)
    assert marginal.absorbed == {"pixels": count} and len(marginal.variables[0]) == 6
    assert marginal.prior.residual.roles[0] == "cameras[2]" and len(scene.points) == 0


def test_undetermined_directions_take_no_information_with_them():
    # A point seen once says nothing about the camera; and a chain that nothing anchors leaves a relative prior.
    scene = make_scene(points=1)
    seen = int((~scene.cameras.is_fixed[scene.problem.groups[0].connections[0].rows]).sum())
    assert marginalize(scene.problem, scene.points[0], at=None).prior.residual.dim <= 2 * seen
    T = SE3.random(np.random.default_rng(0), 3)
    problem = Problem()
    poses = problem.add_variables(SE3, T, name="poses")
    problem.add_residuals(
        RelativePose(se3.compose(se3.inverse(T[[0, 0]]), T[[1, 2]])), poses[[0, 0]], poses[[1, 2]], name="odometry"
    )
    prior = marginalize(problem, poses[0], at=None).prior.residual
    assert prior.dim == 6 and not prior.fixes_gauge
    alone = Problem()
    x = alone.add_variables(SE3, T[:2], name="x")
    alone.add_residuals(RelativePose(se3.compose(se3.inverse(T[:1]), T[1:2])), x[0], x[1], name="odometry")
    gone = marginalize(alone, x[0], at=None)
    assert gone.prior is None and gone.variables == () and gone.absorbed == {"odometry": 1} and alone.groups == []


@pytest.mark.parametrize("solved", [True, False])
def test_jacobians_of_the_prior(solved):
    rng = np.random.default_rng(3)
    manifolds = (SE3, SE3Left, SE2, Line3D, Euclidean(9))
    x0 = [m.random(rng, 1)[0] for m in manifolds]
    dof = sum(m.dof for m in manifolds)
    prior = MarginalPrior(manifolds, x0, rng.standard_normal((7, dof)), rng.standard_normal(7))
    x = [m.boxplus(a, (0.0 if solved else 0.5) * rng.standard_normal(m.dof)) for m, a in zip(manifolds, x0, strict=True)]
    assert check_jacobian(prior, *x).passed


def test_robust_losses_are_weighed_in():
    loss = losses.Cauchy(3.0)
    problem, marks = linear_chain(np.random.default_rng(4), loss=loss)
    whole = problem.solve(cost_tolerance=1e-14)
    marginalize(problem, marks[0], at=whole)
    solution = problem.solve(cost_tolerance=1e-14)
    np.testing.assert_allclose(solution[marks], whole[marks][1:], atol=1e-5)


def test_wrong_use_is_refused():
    problem, marks = linear_chain(np.random.default_rng(0))
    with pytest.raises(InputError, match="variables to marginalise"):
        marginalize(problem, [], at=None)
    with pytest.raises(InputError, match="variables of this problem"):
        marginalize(problem, linear_chain(np.random.default_rng(0))[1][0], at=None)
    with pytest.raises(InputError, match="keep the block's shape"):
        marginalize(problem, marks[0], at=[np.zeros((2, 2))])
    with pytest.raises(InputError, match="stack J over the variables"):
        MarginalPrior([PLANE], [[0.0, 0.0]], np.zeros((2, 3)), np.zeros(2))
    with pytest.raises(InputError, match="a point x0 for each"):
        MarginalPrior([PLANE], [], np.zeros((2, 2)), np.zeros(2))
    with pytest.raises(InputError, match="NaN"):
        MarginalPrior([PLANE], [[0.0, 0.0]], np.full((2, 2), np.nan), np.zeros(2))


def test_a_solution_of_another_problem_is_refused_though_its_shapes_fit():
    """Its values would be taken for those of this problem, and everything linearised at the wrong place."""

    def chain(first):
        problem = Problem()
        poses = problem.add_variables(SE2, [[0.0, first, 0.0], [0.0, first + 1.0, 0.0]], name="poses")
        problem.add_residuals(Prior(SE2, [0.0, first, 0.0], sigma=0.1), poses[0])
        problem.add_residuals(RelativePose2D([0.0, 1.0, 0.0], sigma=0.1), poses[0], poses[1])
        return problem, poses

    (problem, poses), (other, _) = chain(0.0), chain(50.0)
    with pytest.raises(InputError, match="expected a solution of this problem – got that of another one"):
        marginalize(problem, poses[0], at=other.solve())
    own = problem.solve()
    added = problem.add_variables(Euclidean(1), [0.0])  # since then; the solution is one of this problem all the same
    problem.add_residuals(Prior(Euclidean(1), [0.0], sigma=1.0), added)
    assert marginalize(problem, poses[0], at=own).prior is not None
