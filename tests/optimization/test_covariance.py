"""Covariances against dense inverses and pseudo-inverses, and against the scatter of estimates."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus import SE3, Euclidean, InputError, Pinhole, Problem, SE3Left, SingularProblemError, losses
from boxplus.manifolds import se3
from boxplus.optimization.losses import loss_at
from boxplus.optimization.observability import null_space
from boxplus.residuals import Prior, RelativePose, Reprojection
from tests.optimization.conftest import dense_normal_equations, make_ring, make_scene

SOLVERS = ("dense", "sparse", "schur")


def inverse_of(problem, solution, inverse=np.linalg.inv):
    """H⁻¹ at a solution, by NumPy."""
    for group in problem.groups:
        group.linearize(solution.values, 1)
    return inverse(dense_normal_equations(problem)[0])


@pytest.mark.parametrize("linear_solver", SOLVERS)
def test_joint_covariance_is_the_submatrix_of_the_inverse(linear_solver):
    scene = make_scene(points=12)
    solution = scene.problem.solve(linear_solver=linear_solver)
    joint = solution.joint_covariance(scene.points[[3, 1]], scene.cameras[[4, 0, 2]])
    inverse = inverse_of(scene.problem, solution)
    points, cameras = 18 + 3 * np.array([3, 1]), np.array([12, 0])
    places = np.concatenate([np.arange(p, p + 3) for p in points] + [np.arange(c, c + 6) for c in cameras])
    own = np.concatenate([np.arange(12), np.arange(18, 24)])  # cameras[0] is fixed
    np.testing.assert_allclose(joint[np.ix_(own, own)], inverse[np.ix_(places, places)], rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(joint[12:18], 0.0)
    np.testing.assert_array_equal(joint, joint.T)


@pytest.mark.parametrize("linear_solver", SOLVERS)
def test_where_all_is_determined_the_search_for_free_directions_may_be_left_out(linear_solver, monkeypatch):
    scene = make_scene(points=12)
    solution = scene.problem.solve(linear_solver=linear_solver, examine=False)
    assert not solution.notes
    selected = scene.points[[3, 1]], scene.cameras[[4, 0, 2]]
    with monkeypatch.context() as patch:
        patch.setattr("boxplus.optimization.covariance.find_null_space", None)
        quick = solution.joint_covariance(*selected, is_determined=True)
    np.testing.assert_allclose(quick, solution.joint_covariance(*selected), rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize("linear_solver", SOLVERS)
@pytest.mark.parametrize("is_determined", [False, True])
def test_the_response_to_slopes_is_the_inverse_times_them(linear_solver, is_determined):
    scene = make_scene(points=12)
    solution = scene.problem.solve(linear_solver=linear_solver, examine=False)
    rng = np.random.default_rng(0)
    slopes = [rng.normal(size=(len(block), block.manifold.dof)) for block in scene.problem.blocks]
    moved = solution.response(slopes, is_determined=is_determined)
    free = np.concatenate([~block.is_fixed.repeat(block.manifold.dof) for block in scene.problem.blocks])
    expected = np.zeros(len(free))
    expected[free] = inverse_of(scene.problem, solution) @ np.concatenate([g.ravel() for g in slopes])[free]
    np.testing.assert_allclose(np.concatenate([m.ravel() for m in moved]), expected, rtol=1e-6, atol=1e-9)


def test_what_is_not_determined_is_said_whatever_was_promised():
    problem = Problem()
    free = problem.add_variables(Euclidean(2), np.zeros((1, 2)))
    problem.add_residuals(Prior(Euclidean(2), np.zeros(2), information=np.diag([1.0, 0.0])), free)
    solution = problem.solve(examine=False)
    with pytest.raises(SingularProblemError, match="no covariance of"):
        solution.joint_covariance(free, is_determined=True)


def test_standard_deviations_are_roots_of_the_diagonal(scene):
    solution = scene.problem.solve()
    sigma = solution.standard_deviations(scene.points)
    np.testing.assert_allclose(sigma**2, np.einsum("kii->ki", solution.covariance(scene.points[:])), rtol=1e-12)
    np.testing.assert_array_equal(solution.standard_deviations(scene.cameras)[:2], 0.0)


def test_the_null_space_is_looked_for_once(scene, monkeypatch):
    found = []
    true = null_space.find_null_space
    monkeypatch.setattr("boxplus.optimization.covariance.find_null_space", lambda problem: found.append(1) or true(problem))
    solution = scene.problem.solve()
    first = [solution.covariance(point) for point in scene.points]
    again = solution.covariance(scene.points)
    assert len(found) == 1
    np.testing.assert_allclose(np.concatenate(first), again, rtol=1e-6)
    # A later solve takes the system elsewhere; the first solution still answers for its own point.
    scene.problem.solve(max_iterations=1)
    np.testing.assert_array_equal(solution.covariance(scene.points), again)
    assert len(found) == 1


@pytest.mark.parametrize("linear_solver", SOLVERS)
def test_what_a_free_direction_does_not_move_keeps_its_covariance(linear_solver):
    scene = make_scene(cameras=4, points=20, start_noise=0.0)
    T, p = scene.truth
    camera = Pinhole(400.0, 410.0, 320.0, 240.0)
    problem = Problem()
    cameras = problem.add_variables(SE3Left, T, name="cameras")
    points = problem.add_variables(Euclidean(3), p, name="points")
    pairs = np.array([(c, k) for k in range(20) for c in range(4) if c == 0 or k not in (7, 13)])
    pixels = camera.project(se3.act(T[pairs[:, 0]], p[pairs[:, 1]]))[0]
    problem.add_residuals(Reprojection(camera, pixels), cameras[pairs[:, 0]], points[pairs[:, 1]], name="pixels")
    problem.fix(cameras[:2])
    solution = problem.solve(linear_solver=linear_solver)
    others = np.setdiff1d(np.arange(20), [7, 13])
    blocks = solution.covariance(points[others])
    pseudo = inverse_of(problem, solution, np.linalg.pinv)
    for k, block in zip(others, blocks, strict=True):
        at = 12 + 3 * k
        np.testing.assert_allclose(block, pseudo[at : at + 3, at : at + 3], rtol=1e-5, atol=1e-10)
    np.testing.assert_allclose(solution.covariance(cameras[3])[0], pseudo[6:12, 6:12], rtol=1e-5, atol=1e-12)
    with pytest.raises(SingularProblemError, match=r"no covariance of points\[7\]: .* along their viewing rays"):
        solution.covariance(points[[6, 7]])
    with pytest.raises(SingularProblemError, match=r"no covariance of points\[13\]"):
        solution.joint_covariance(points[13], cameras[3])


def test_a_component_without_gauge_leaves_the_others_alone():
    ring, loose = make_ring(6), make_ring(5, seed=3)
    ring.problem.fix(ring.poses[0])
    expected = ring.problem.solve().covariance(ring.poses)
    other = ring.problem.add_variables(SE3, loose.truth, name="drifting")
    source = loose.problem.groups[0]
    i, j = (c.rows for c in source.connections)
    ring.problem.add_residuals(RelativePose(source.residual.measured, sigma=0.01), other[i], other[j], name="loose")
    solution = ring.problem.solve()
    np.testing.assert_allclose(solution.covariance(ring.poses), expected, rtol=1e-5, atol=1e-12)
    with pytest.raises(SingularProblemError, match=r"nothing ties drifting\[0…4\] to the world"):
        solution.covariance(other[2])


def test_covariance_is_the_scatter_of_the_estimates():
    # 400 estimates of a chain from noise of the stated size: their scatter, in the tangent at the truth, has H⁻¹ as covariance.
    rng = np.random.default_rng(5)
    truth = SE3.random(rng, 4)
    i, j = np.array([0, 1, 2, 0]), np.array([1, 2, 3, 3])
    between = se3.compose(se3.inverse(truth[i]), truth[j])
    sigma = np.array([0.01, 0.02, 0.01, 0.05, 0.02, 0.03])
    errors = []
    for _ in range(400):
        problem = Problem()
        poses = problem.add_variables(SE3, truth)
        measured = SE3.boxplus(between, sigma * rng.standard_normal((4, 6)))
        problem.add_residuals(RelativePose(measured, sigma=sigma), poses[i], poses[j])
        problem.fix(poses[0])
        solution = problem.solve()
        errors.append(SE3.boxminus(truth[1:], solution[poses[1:]]).reshape(-1))
    covariance = solution.joint_covariance(poses[1:])
    error = np.array(errors)
    nees = np.einsum("ni,ij,nj->n", error, np.linalg.inv(covariance), error)
    assert abs(nees.mean() - 18.0) < 4.0 * np.sqrt(2.0 * 18.0 / 400)


def test_losses_weigh_the_covariance():
    loss = losses.Cauchy(1.0)
    values = np.array([[0.0], [0.1], [0.4], [3.0]])
    problem = Problem()
    x = problem.add_variables(Euclidean(1), [[0.1]])
    problem.add_residuals(Prior(Euclidean(1), values), x[0], loss=loss)
    solution = problem.solve()
    information = 0.0
    for s in (values[:, 0] - solution[x][0, 0]) ** 2:
        _, first, second = loss_at(loss.code, loss.scale, s)
        exact = first + 2.0 * s * second
        information += exact if exact >= 0.5 * first else first
    assert solution.covariance(x[0])[0, 0, 0] == pytest.approx(1.0 / information, rel=1e-6)


def test_wrong_requests_are_refused(scene):
    solution = scene.problem.solve()
    with pytest.raises(InputError, match="as many second variables"):
        solution.covariance(scene.points[[0, 1]], scene.cameras[3])
    with pytest.raises(InputError, match="at least one selection"):
        solution.joint_covariance()


def test_what_was_factorised_is_used_again_until_something_else_is():
    ring = make_ring(count=30)
    ring.problem.fix(ring.poses[0])
    solution = ring.problem.solve(linear_solver="sparse")
    slopes = [np.random.default_rng(0).standard_normal((30, 6))]
    first = solution.covariance(ring.poses, is_determined=True)
    model = solution._problem
    count = model.factorization
    (moved,) = solution.response(slopes, is_determined=True)
    np.testing.assert_array_equal(solution.covariance(ring.poses, is_determined=True), first)
    assert model.factorization == count
    model.factorize(np.full(model.layout.dof, 1e3))  # as of a step that is rejected afterwards
    np.testing.assert_array_equal(solution.response(slopes, is_determined=True)[0], moved)
    np.testing.assert_array_equal(solution.covariance(ring.poses, is_determined=True), first)
    assert model.factorization == count + 2


@pytest.mark.parametrize("is_determined", [False, True])
@pytest.mark.parametrize("change", ["weights", "loss"])
def test_other_weights_than_it_was_solved_with_are_refused(change, is_determined):
    """H would be that of another problem, or that of this one where nothing had been linearised since."""
    problem = Problem()
    x = problem.add_variables(Euclidean(1), [[0.1]])
    group = problem.add_residuals(Prior(Euclidean(1), [[0.0], [1.0]]), x[0])
    solution = problem.solve()
    if change == "weights":
        problem.set_weights(group, [0.5, 0.5])
    else:
        group.set_loss(losses.Cauchy(1.0))
    with pytest.raises(InputError, match="losses and weights that the problem was solved with – got others of 'Prior"):
        solution.covariance(x, is_determined=is_determined)
    if change == "weights":
        again = problem.solve(start=solution, max_iterations=0)
        np.testing.assert_allclose(again.covariance(x, is_determined=is_determined)[0], [[1.0]])
        problem.set_weights(group, None)
    else:
        group.set_loss(losses.Squared())
    np.testing.assert_allclose(solution.covariance(x, is_determined=is_determined)[0], [[0.5]])
