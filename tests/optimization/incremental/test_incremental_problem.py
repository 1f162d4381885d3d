"""An incremental problem against the whole problem solved anew: estimates, covariances, and what it refuses."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus import SE2, SE3, Euclidean, IncrementalProblem, InputError, Problem, SE3Left, SingularProblemError, losses
from boxplus.errors import NotFiniteError
from boxplus.manifolds import se2, se3
from boxplus.residuals import Prior, RelativePose, RelativePose2D
from boxplus.residuals.residual import Residual
from boxplus.residuals.whitening import Whitening
from boxplus.simulation.pose_graphs import simulate_pose_graph
from tests.small_problems import loop_graph

PLANE = Euclidean(2)


class Sum(Residual):
    """r = Σ xₖ aₖ − b over several points of the plane: linear, over as many variables as there are weights."""

    def __init__(self, a: np.ndarray, b: np.ndarray) -> None:
        self.a, self.b = a, b
        arity = a.shape[1]
        super().__init__(
            dim=2,
            count=len(a),
            manifolds=(PLANE,) * arity,
            roles=tuple("xyzuvw"[:arity]),
            whitening=Whitening.of(2, len(a), sigma=0.5),
            fixes_gauge=True,
        )

    def evaluate_into(self, begin, end, x, index, r, valid):
        r[begin:end] = sum(self.a[begin:end, k, None] * x[k][index[k][begin:end]] for k in range(len(x))) - self.b[begin:end]
        valid[begin:end] = True

    def linearize_into(self, begin, end, x, index, r, jacobians, valid):
        self.evaluate_into(begin, end, x, index, r, valid)
        for k, J in enumerate(jacobians):
            J[begin:end] = self.a[begin:end, k, None, None] * np.eye(2)


def feed(graph, problem: IncrementalProblem, steps, loss=None, at_most=None):
    """Pose by pose with the edges to earlier poses; calls `steps(k, poses)` after every update."""
    manifold, group, kind = (SE3, se3, RelativePose) if graph.dimension == 3 else (SE2, se2, RelativePose2D)
    start = manifold.identity() if graph.poses is None else graph.poses[0]
    poses = problem.add_variables(manifold, start, fixed=True, name="poses")
    for k in range(1, len(graph.ids) if at_most is None else at_most):
        own = np.flatnonzero(graph.edges.max(axis=1) == k)
        chain = own[(graph.edges[own] == [k - 1, k]).all(axis=1)][0]
        problem.extend(poses, group.compose(problem.estimate(poses[k - 1]), graph.measurements[chain][None]))
        i, j = graph.edges[own].T
        problem.add_residuals(kind(graph.measurements[own], information=graph.information[own]), poses[i], poses[j], loss=loss)
        steps(k, poses, problem.update())
    return poses


@settings(max_examples=60)
@given(st.data())
def test_linear_problems_are_solved_exactly_at_every_step(data: st.DataObject) -> None:
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    problem = IncrementalProblem(tolerance=0.0, wildfire=0.0, max_rounds=1)
    points = problem.add_variables(PLANE, rng.standard_normal((1, 2)), fixed=data.draw(st.booleans()), name="points")
    A, b = np.zeros((0, 0)), np.zeros((0, 2))
    for step in range(data.draw(st.integers(1, 14))):
        if step:
            problem.extend(
                points, rng.standard_normal((data.draw(st.integers(0, 3)), 2)), fixed=data.draw(st.integers(0, 9)) == 0
            )
        n = len(points)
        A = np.pad(A, ((0, 0), (0, n - A.shape[1])))
        connections = [[k] for k in range(n) if not (A[:, k] != 0).any()]  # what is new is measured by itself
        for _ in range(data.draw(st.integers(0, 4))):
            connections.append(rng.integers(0, n, rng.integers(1, 4)).tolist())  # a variable may come twice
        for connected in connections:
            weights, side = rng.standard_normal((1, len(connected))), rng.standard_normal((1, 2))
            problem.add_residuals(Sum(weights, side), *(points[[k]] for k in connected))
            row = np.zeros(n)
            np.add.at(row, connected, weights[0])
            A, b = np.vstack([A, row]), np.vstack([b, side])
        update = problem.update()
        free, values = ~points.is_fixed, problem.estimate(points)
        if free.any() and np.linalg.cond(A[:, free]) < 1e6:
            expected = np.linalg.lstsq(A[:, free], b - A[:, ~free] @ values[~free], rcond=None)[0]
            np.testing.assert_allclose(values[free], expected, rtol=0, atol=1e-9 * np.linalg.cond(A[:, free]) ** 2)
            joint = np.linalg.inv(A[:, free].T @ A[:, free]) * 0.25
            own = problem.joint_covariance(points)
            mine = np.flatnonzero(np.repeat(free, 2))
            np.testing.assert_allclose(own[np.ix_(mine, mine)], np.kron(joint, np.eye(2)), rtol=1e-6, atol=1e-9 * joint.max())
            assert not own[np.repeat(~free, 2)].any()
        assert update.eliminated <= free.sum()


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("loss", [None, losses.Huber(3.0), losses.Cauchy(2.0)])
def test_pose_graphs_stay_at_the_optimum_of_the_whole(dimension: int, loss: losses.Loss | None) -> None:
    graph = loop_graph(dimension)
    # Weights of a loss converge linearly: what is left is many times the last step.
    problem = IncrementalProblem(tolerance=1e-5 if loss is None else 1e-8, wildfire=1e-9, max_rounds=30)

    def compare(k, poses, update):
        for _ in range(10):
            update = update if update.is_settled else problem.update()
        assert update.is_settled
        if k % 5 and k < len(graph.ids) - 1:
            return
        whole = problem.as_problem()
        best = whole.solve(cost_tolerance=1e-15)
        assert problem.solution().cost == pytest.approx(best.cost, rel=1e-8, abs=1e-12)
        np.testing.assert_allclose(problem.estimate(poses), best[whole.blocks[0]], atol=2e-5)
        expected = best.joint_covariance(whole.blocks[0][[k, k // 2, 0]])
        np.testing.assert_allclose(problem.joint_covariance(poses[[k, k // 2, 0]]), expected, rtol=1e-3, atol=1e-7)
        np.testing.assert_allclose(problem.covariance(poses), best.covariance(whole.blocks[0]), rtol=1e-3, atol=1e-7)

    feed(graph, problem, compare, loss)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("dimension", [2, 3])
def test_the_defaults_keep_the_cost_within_a_thousandth(seed: int, dimension: int) -> None:
    graph = simulate_pose_graph(dimension=dimension, poses=220, loops=260, seed=seed).graph
    problem = IncrementalProblem()
    waiting, eliminated = [], []

    def compare(k, poses, update):
        waiting.append(update.waiting)
        eliminated.append(update.eliminated)
        if k % 60 == 0 or k == len(graph.ids) - 1:
            best = problem.as_problem().solve().cost
            assert problem.solution().cost == pytest.approx(best, rel=1e-3, abs=1e-9)

    feed(graph, problem, compare)
    assert np.mean(np.array(waiting) == 0) > 0.9
    assert np.median(eliminated) < 110  # not the whole problem


def test_small_changes_do_not_add_up_beyond_the_wildfire_threshold() -> None:
    """A far end of a chain that is pushed a little a hundred times, each time by less than the threshold."""
    lazy, exact = IncrementalProblem(wildfire=0.02), IncrementalProblem(wildfire=0.0)
    estimates = []
    for problem in (lazy, exact):
        points = problem.add_variables(PLANE, [[0.0, 0.0]], name="points")
        problem.add_residuals(Prior(PLANE, [0.0, 0.0], sigma=1.0), points)
        problem.extend(points, np.zeros((40, 2)))
        problem.add_residuals(Sum(np.tile([-1.0, 1.0], (40, 1)), np.zeros((40, 2))), points[0:40], points[1:41])
        problem.update()
        for k in range(200):
            end = problem.extend(points, np.zeros((1, 2)))
            problem.add_residuals(Sum(np.array([[-1.0, 1.0]]), np.zeros((1, 2))), points[40], end)
            problem.add_residuals(Sum(np.array([[1.0]]), np.array([[10.0, 1.0]])), end)
            assert problem.update().rounds == 1, k
        estimates.append(problem.estimate(points[:41]))
    # The tightest residual of a link has a standard deviation of 0.35 m, and 0.02 of that per link is what may be missing.
    assert np.abs(estimates[0] - estimates[1]).max() < 41 * 0.02 * 0.5
    assert np.abs(estimates[1]).max() > 5.0


def test_a_residual_that_hardly_counted_at_first_moves_its_variable_later() -> None:
    """What a variable is known by is taken from the weights of now: with those of the start 0.02 would stand for 2 m."""
    problem = IncrementalProblem(max_rounds=60)
    point = problem.add_variables(PLANE, [12.0, 0.0], name="point")
    problem.add_residuals(Prior(PLANE, [12.0, 0.0], sigma=100.0), point)
    problem.add_residuals(Prior(PLANE, [0.0, 0.0], sigma=0.1), point, loss=losses.GemanMcClure(10.0))
    problem.update()
    np.testing.assert_allclose(problem.estimate(point), [[0.0, 0.0]], atol=2 * 0.02 * 0.1)


def test_poses_on_other_sides_and_priors_go_together() -> None:
    graph = loop_graph(3)
    problem = IncrementalProblem(tolerance=1e-6, wildfire=0.0, max_rounds=30)
    poses = problem.add_variables(SE3Left, graph.poses, name="poses")
    marks = problem.add_variables(PLANE, [[1.0, 2.0], [3.0, 4.0]], name="marks")
    i, j = graph.edges.T
    edges = RelativePose(graph.measurements, information=graph.information)
    problem.add_residuals(edges, poses[i], poses[j], loss=losses.Huber(3.0), carry_over=True)
    problem.add_residuals(Prior(SE3, graph.poses[3], sigma=0.1), poses[3], carry_over=True)
    problem.add_residuals(Prior(PLANE, [[0.5, 0.5]] * 2, sigma=0.1), marks)
    assert problem.update().is_settled
    whole = problem.as_problem()
    best = whole.solve(cost_tolerance=1e-15)
    solution = problem.solution()
    assert solution.cost == pytest.approx(best.cost, rel=1e-8)
    np.testing.assert_allclose(solution[marks], [[0.5, 0.5]] * 2, atol=1e-12)
    np.testing.assert_allclose(solution[poses[3]], problem.estimate(poses[3]))
    expected = best.covariance(whole.blocks[0][5])
    np.testing.assert_allclose(problem.covariance(poses[5]), expected, rtol=1e-4, atol=1e-8)


def test_same_bits_on_every_run() -> None:
    graph = simulate_pose_graph(poses=120, loops=120, seed=5).graph
    runs = []
    for _ in range(2):
        problem = IncrementalProblem()
        poses = feed(graph, problem, lambda *_: None)
        runs.append((problem.estimate(poses), problem.covariance(poses[50])))
    for first, second in zip(*runs, strict=True):
        np.testing.assert_array_equal(first, second)


def test_an_update_without_anything_new_changes_nothing() -> None:
    graph = loop_graph(2)
    problem = IncrementalProblem()
    poses = feed(graph, problem, lambda *_: None)
    while not problem.update().is_settled:
        pass
    before = problem.estimate(poses)
    update = problem.update()
    assert (update.rounds, update.relinearized, update.eliminated) == (0, 0, 0)
    np.testing.assert_array_equal(problem.estimate(poses), before)


def test_what_is_off_waits_where_rounds_are_few() -> None:
    graph = loop_graph(2)
    problem = IncrementalProblem(max_rounds=1)
    poses = problem.add_variables(SE2, graph.poses[0], fixed=True)
    problem.extend(poses, SE2.random(np.random.default_rng(0), len(graph.ids) - 1) * [0.2, 1.0, 1.0])
    i, j = graph.edges.T
    problem.add_residuals(RelativePose2D(graph.measurements, information=graph.information), poses[i], poses[j])
    update = problem.update()
    assert update.rounds == 1
    assert update.waiting == problem.solution().waiting > 10
    assert not update.is_settled
    for _ in range(30):
        update = problem.update()
    assert update.is_settled
    assert problem.solution().cost == pytest.approx(problem.as_problem().solve().cost, rel=1e-3)


def test_variables_without_residuals_are_named() -> None:
    problem = IncrementalProblem()
    poses = problem.add_variables(SE2, [0.0, 0.0, 0.0], fixed=True, name="poses")
    problem.extend(poses, np.zeros((2, 3)))
    problem.add_residuals(RelativePose2D([0.0, 1.0, 0.0]), poses[0], poses[1])
    with pytest.raises(SingularProblemError, match=r"no residual touches poses\[2\]: fix them, or measure them"):
        problem.update()
    problem.add_residuals(RelativePose2D([0.0, 1.0, 0.0]), poses[1], poses[2])
    problem.update()
    np.testing.assert_allclose(problem.estimate(poses), [[0, 0, 0], [0, 1, 0], [0, 2, 0]], atol=1e-9)


@pytest.mark.parametrize("grown", [False, True])
def test_what_nothing_ties_to_the_world_is_named_and_may_be_tied_later(grown: bool) -> None:
    problem = IncrementalProblem()
    poses = problem.add_variables(SE2, [0.0, 0.0, 0.0], fixed=True, name="poses")
    if grown:
        problem.extend(poses, [0.0, 1.0, 0.0])
        problem.add_residuals(RelativePose2D([0.3, 1.0, 0.0]), poses[0], poses[1])
        problem.update()
    first = len(poses)
    problem.extend(poses, np.zeros((2, 3)))
    problem.add_residuals(RelativePose2D([0.0, 1.0, 0.0]), poses[first], poses[first + 1])
    before = problem.estimate(poses)
    with pytest.raises(SingularProblemError, match=rf"nothing ties poses\[{first}, {first + 1}\] to the world"):
        problem.update()
    np.testing.assert_array_equal(problem.estimate(poses), before)
    with pytest.raises(InputError, match="up to date"):
        problem.covariance(poses[0])
    problem.add_residuals(RelativePose2D([0.0, 0.0, 1.0]), poses[0], poses[first])
    assert problem.update().is_settled
    best = problem.as_problem().solve()
    assert problem.solution().cost == pytest.approx(best.cost, abs=1e-12)
    np.testing.assert_allclose(problem.estimate(poses[first + 1]), [[0.0, 1.0, 1.0]], atol=1e-6)


def test_a_residual_that_is_not_finite_is_named() -> None:
    problem = IncrementalProblem()
    points = problem.add_variables(PLANE, [0.0, 0.0], name="points")
    problem.add_residuals(Sum(np.array([[1.0], [np.nan]]), np.zeros((2, 2))), points)
    with pytest.raises(NotFiniteError, match=r"residual 1 of 'Sum_0' \(Sum\) at points\[0\]"):
        problem.update()


def test_input_is_checked_at_the_border() -> None:
    problem, other = IncrementalProblem(), IncrementalProblem()
    poses = problem.add_variables(SE2, [0.0, 0.0, 0.0], name="poses")
    foreign = other.add_variables(SE2, [0.0, 0.0, 0.0])
    edge = RelativePose2D([0.0, 1.0, 0.0])
    with pytest.raises(InputError, match=r"2 connections .*got 1"):
        problem.add_residuals(edge, poses)
    with pytest.raises(InputError, match="variables of this problem"):
        problem.add_residuals(edge, poses[0], foreign[0])
    with pytest.raises(InputError, match="1 rows of 'poses'"):
        problem.add_residuals(edge, poses[[0, 0]], poses[0])
    with pytest.raises(InputError, match="the index dangles"):
        problem.add_residuals(edge, poses[0], poses[1])
    with pytest.raises(InputError, match="T_world_i of RelativePose on SE3"):
        problem.add_residuals(RelativePose([1.0, 0, 0, 0, 0, 0, 0]), poses[0], poses[0])
    with pytest.raises(InputError, match="shape"):
        problem.extend(poses, [0.0, 1.0])
    with pytest.raises(InputError, match="variables of this problem"):
        problem.extend(foreign, [0.0, 1.0, 0.0])
    with pytest.raises(InputError, match="a new name"):
        problem.add_variables(SE2, [0.0, 0.0, 0.0], name="poses")
    with pytest.raises(InputError, match="at least one selection"):
        problem.joint_covariance()
    with pytest.raises(InputError, match=r"a setting of IncrementalOptions – got 'threshold'"):
        IncrementalProblem(threshold=0.1)
    with pytest.raises(InputError, match="options or single settings"):
        IncrementalProblem(other.options, tolerance=0.1)
    assert isinstance(problem.as_problem(), Problem)


def test_a_second_thread_is_refused() -> None:
    problem = IncrementalProblem()
    points = problem.add_variables(PLANE, [0.0, 0.0])
    refused = []

    class Slow(Sum):
        def linearize_into(self, *arguments):
            def second():
                try:
                    problem.update()
                except InputError as error:
                    refused.append(str(error))

            thread = threading.Thread(target=second)
            thread.start()
            thread.join()
            super().linearize_into(*arguments)

    problem.add_residuals(Slow(np.array([[1.0]]), np.zeros((1, 2))), points)
    problem.update()
    assert refused
    assert "one thread at a time in a IncrementalProblem" in refused[0]
