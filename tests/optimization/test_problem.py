"""`Problem`: minima against SciPy, the methods against each other, and what wrong use is told."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares

from boxplus import SE3, Euclidean, InputError, NotFiniteError, Problem, SE3Left, SingularProblemError, SolverOptions, losses
from boxplus.residuals import Prior, RelativePose, Residual
from boxplus.residuals.whitening import Whitening
from tests.optimization.conftest import make_ring, make_scene

METHODS = ("levenberg_marquardt", "gauss_newton", "dogleg")


def scipy_minimum(problem, loss="linear") -> float:
    """½ Σ r² at the minimum that SciPy finds over the tangents at the start."""
    start = [block.values for block in problem.blocks]
    free = [np.flatnonzero(~block.is_fixed) for block in problem.blocks]

    def moved(delta):
        values, at = [], 0
        for block, rows, x in zip(problem.blocks, free, start, strict=True):
            width = len(rows) * block.manifold.dof
            y = x.copy()
            y[rows] = block.manifold.boxplus(x[rows], delta[at : at + width].reshape(len(rows), -1))
            values.append(y)
            at += width
        return values

    def residuals(delta):
        problem.cost(moved(delta))
        return np.concatenate([group.r.reshape(-1) for group in problem.groups])

    size = sum(len(rows) * block.manifold.dof for rows, block in zip(free, problem.blocks, strict=True))
    return float(least_squares(residuals, np.zeros(size), method="trf", x_scale="jac", ftol=1e-14, xtol=1e-14, gtol=1e-12).cost)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_ring_reaches_the_minimum_that_scipy_finds(ring, method):
    ring.problem.fix(ring.poses[0])
    solution = ring.problem.solve(method=method)
    assert solution.status == "converged"
    assert solution.cost == pytest.approx(scipy_minimum(ring.problem), rel=1e-8)
    assert np.abs(SE3.boxminus(solution[ring.poses], ring.truth)).max() < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("linear_solver", ("dense", "sparse", "schur"))
def test_scene_reaches_the_minimum_that_scipy_finds(linear_solver):
    scene = make_scene(cameras=4, points=15)
    solution = scene.problem.solve(linear_solver=linear_solver)
    assert solution.status == "converged"
    assert solution.linear_solver.lower().startswith(linear_solver)
    assert solution.cost == pytest.approx(scipy_minimum(scene.problem), rel=1e-7)


def test_noise_free_problems_are_solved_exactly():
    ring = make_ring(noise=1e-12, start_noise=0.2)
    ring.problem.fix(ring.poses[0])
    np.testing.assert_allclose(SE3.boxminus(ring.problem.solve()[ring.poses], ring.truth), 0.0, atol=1e-9)
    scene = make_scene(noise=0.0)
    solution = scene.problem.solve(cost_tolerance=0.0)
    np.testing.assert_allclose(SE3Left.boxminus(solution[scene.cameras], scene.truth[0]), 0.0, atol=1e-7)
    np.testing.assert_allclose(solution[scene.points], scene.truth[1], atol=1e-6)


def test_fixed_variables_do_not_move_and_can_be_freed(scene):
    solution = scene.problem.solve()
    np.testing.assert_array_equal(solution[scene.cameras[:2]], scene.cameras.values[:2])
    scene.problem.free(scene.cameras[1])
    scene.problem.add_residuals(Prior(SE3Left, scene.truth[0][1:2], sigma=10.0), scene.cameras[[1]])
    freed = scene.problem.solve()
    assert np.abs(freed[scene.cameras[1]] - scene.cameras.values[1]).max() > 0.0
    assert freed.cost < solution.cost


def test_accepted_cost_never_rises_and_history_tells_the_story(scene):
    solution = scene.problem.solve()
    costs = [step.cost for step in solution.history]
    assert all(after <= before for before, after in pairwise(costs))
    assert solution.history[0].cost == solution.cost_initial
    assert solution.history[-1].cost == solution.cost == scene.problem.cost(solution)
    assert [step.number for step in solution.history] == list(range(len(costs)))
    assert str(solution.iterations) in solution.summary()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("share", (1e-1, 1e-3, 1e-6))
def test_a_step_of_which_little_is_expected_is_not_tried(method, share):
    scene = make_scene()
    whole = scene.problem.solve(method=method, cost_tolerance=1e-12)
    short = scene.problem.solve(method=method, cost_tolerance=1e-12, expected_tolerance=share)
    assert short.status == "converged" and "is expected to lower the cost" in short.reason
    assert short.iterations < whole.iterations
    # Steps shrink from the first that is left out on: what is left of the cost is less than twice what that one promises.
    assert whole.cost <= short.cost < whole.cost * (1.0 + 2.0 * share)
    assert short.cost == scene.problem.cost(short)


@pytest.mark.parametrize("linear_solver", ("sparse", "schur"))
def test_the_number_of_threads_does_not_change_a_bit(linear_solver):
    results = []
    for threads in (1, 2, 3):
        scene = make_scene(cameras=6, points=5000)
        solution = scene.problem.solve(linear_solver=linear_solver, threads=threads, max_iterations=6)
        results.append([values.tobytes() for values in solution.values])
    assert results[0] == results[1] == results[2]


def test_limits_and_callback_stop_and_say_so(scene):
    assert "iteration limit of 2" in scene.problem.solve(max_iterations=2, cost_tolerance=0.0).reason
    assert scene.problem.solve(time_limit_s=1e-9).reason.startswith("time limit")
    seen = []
    solution = scene.problem.solve(callback=lambda step: seen.append(step) or step.number == 1)
    assert solution.status == "stopped" and "callback" in solution.reason
    assert [step.number for step in seen] == [0, 1]


def test_a_second_solve_starts_where_it_is_told(scene):
    first = scene.problem.solve()
    again = scene.problem.solve(start=first)
    assert again.iterations <= 2
    assert again.timing_s["analysis"] < first.timing_s["analysis"]
    assert again.cost == pytest.approx(first.cost, rel=1e-9)


def test_points_behind_a_camera_are_counted(scene):
    values = scene.points.values.copy()
    values[3] = [0.0, 0.0, -5.0]
    solution = scene.problem.solve(start=[scene.cameras.values, values])
    seen = int((scene.problem.groups[0].connections[1].rows == 3).sum())
    assert solution.invalid == {"pixels": seen}
    assert f"{seen} residuals of group 'pixels' could not be evaluated" in solution.summary()
    np.testing.assert_array_equal(solution[scene.points[3]][0], values[3])


class Walled(Residual):
    """r = x − target where x > wall, else singular; `slope` is what its Jacobian claims, 1 in truth."""

    def __init__(self, target: float, wall: float, slope: float = 1.0) -> None:
        line = Euclidean(1)
        super().__init__(dim=1, count=1, manifolds=(line,), roles=("x",), whitening=Whitening.of(1, 1))
        self.target, self.wall, self.slope = target, wall, slope

    def evaluate_into(self, begin, end, x, index, r, valid):
        at = x[0][index[0][begin:end], 0]
        valid[begin:end] = at > self.wall
        r[begin:end, 0] = np.where(at > self.wall, at - self.target, 0.0)

    def linearize_into(self, begin, end, x, index, r, jacobians, valid):
        self.evaluate_into(begin, end, x, index, r, valid)
        jacobians[0][begin:end, 0, 0] = np.where(valid[begin:end], self.slope, 0.0)


@pytest.mark.parametrize("method", METHODS)
def test_a_step_that_makes_a_residual_invalid_is_not_taken(method):
    problem = Problem()
    x = problem.add_variables(Euclidean(1), [[3.0]])
    problem.add_residuals(Walled(target=-1.0, wall=0.0), x)
    solution = problem.solve(method=method)
    assert solution[x][0, 0] > 0.0
    assert solution.status != "converged"
    assert method == "gauss_newton" or "makes residuals invalid" in solution.reason


@pytest.mark.parametrize("method", ["levenberg_marquardt", "dogleg"])
def test_a_wrong_jacobian_stalls_and_does_not_converge(method):
    problem = Problem()
    x = problem.add_variables(Euclidean(1), [[1.0]])
    problem.add_residuals(Walled(target=5.0, wall=-1e9, slope=-1.0), x)
    solution = problem.solve(method=method)
    assert solution.status == "stalled" and "check_jacobian" in solution.reason
    assert solution[x][0, 0] == 1.0


def test_a_jacobian_that_becomes_nan_on_the_way_is_named():
    class Breaking(Walled):
        def linearize_into(self, begin, end, x, index, r, jacobians, valid):
            super().linearize_into(begin, end, x, index, r, jacobians, valid)
            jacobians[0][np.abs(r[:, 0]) < 1.0] = np.nan

    for method in METHODS:
        problem = Problem()
        x = problem.add_variables(Euclidean(1), [[3.0]], name="x")
        problem.add_residuals(Breaking(target=1.0, wall=-1e9), x, name="breaking")
        with pytest.raises(NotFiniteError, match=r"Jacobian with respect to x .* of group 'breaking'"):
            problem.solve(method=method)


def test_a_start_where_nothing_can_be_evaluated_is_refused():
    problem = Problem()
    x = problem.add_variables(Euclidean(1), [[-3.0]])
    problem.add_residuals(Walled(target=1.0, wall=0.0), x)
    with pytest.raises(InputError, match="none that can"):
        problem.solve()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("sigma", [1e-6, 1.0, 1e6])
def test_units_do_not_decide_what_is_converged(method, sigma):
    problem = Problem()
    x = problem.add_variables(Euclidean(1), [[0.0]])
    problem.add_residuals(Prior(Euclidean(1), [[5.0], [7.0]], sigma=sigma), x[[0, 0]])
    solution = problem.solve(method=method)
    assert solution.status == "converged"
    assert solution[x][0, 0] == pytest.approx(6.0, rel=1e-6)


def test_the_analysis_is_that_of_the_next_solve(ring):
    problem = ring.problem
    assert problem.analysis(SolverOptions(linear_solver="dense")) is None
    options = SolverOptions(linear_solver="sparse")
    analysis = problem.analysis(options)
    assert analysis is not None and problem.solve(options)._problem.system.analysis is analysis


def test_values_are_nobody_elses(scene):
    problem, points = scene.problem, scene.points
    problem.fix(points)
    solution = problem.solve(max_iterations=0)
    assert not np.shares_memory(solution[points], points.values)
    other = make_scene().points
    for misuse in (lambda: solution[other], lambda: solution.covariance(other[0]), lambda: problem.fix(other)):
        with pytest.raises(InputError, match="variables of th"):
            misuse()
    problem.free(points[[]])
    assert points.is_fixed.all()
    with pytest.raises(ValueError, match="read-only"):
        points.is_fixed[0] = False


def test_fixed_variables_are_held_where_the_start_has_them():
    problem = Problem()
    x = problem.add_variables(Euclidean(1), [[1.0], [1.0]])
    problem.add_residuals(Prior(Euclidean(1), [[3.0], [5.0]]), x)
    first = problem.solve()
    problem.fix(x[0])
    second = problem.solve(start=first)
    assert second[x][0, 0] == first[x][0, 0] == pytest.approx(3.0)
    assert problem.cost(first) == first.cost


@pytest.mark.parametrize(
    "loss", [losses.Huber(1.0), losses.Cauchy(1.0), losses.GemanMcClure(2.0), losses.Tukey(4.0), losses.Welsch(2.0)]
)
def test_robust_losses_withstand_outliers(loss):
    rng = np.random.default_rng(1)
    values = np.concatenate([rng.normal(2.0, 0.1, 60), rng.normal(9.0, 0.5, 15)])[:, None]
    problem = Problem()
    x = problem.add_variables(Euclidean(1), [[2.4]])
    problem.add_residuals(Prior(Euclidean(1), values, sigma=0.1), x[0], loss=loss)
    solution = problem.solve()
    assert solution.status == "converged"
    assert abs(solution[x][0, 0] - 2.0) < 0.1
    # The gradient of ½ Σ ρ vanishes: differences of the cost on both sides of the minimum.
    step = 1e-4
    rise = [problem.cost([solution[x] + sign * step]) - solution.cost for sign in (1.0, -1.0)]
    assert min(rise) > 0.0 and abs(rise[0] - rise[1]) < 0.2 * max(rise)


def test_a_pose_graph_without_gauge_is_explained_before_and_while_solving(ring):
    assert "nothing ties poses[0…11] to the world" in ring.problem.defects()[0]
    with pytest.raises(SingularProblemError, match="only to each other"):
        ring.problem.solve(method="gauss_newton")
    solution = ring.problem.solve()
    assert solution.status == "converged"
    assert any("where the whole lies is arbitrary" in note for note in solution.notes)


def test_variables_without_residuals_are_named(ring):
    ring.problem.fix(ring.poses[0])
    ring.problem.add_variables(Euclidean(3), np.zeros((2, 3)), name="spare")
    assert ring.problem.defects() == ["no residual touches spare[0, 1]: fix them, remove them, or measure them"]


def test_nan_names_group_residual_and_inputs():
    problem = Problem()
    x = problem.add_variables(Euclidean(2), np.zeros((3, 2)), name="x")

    class Broken(Prior):
        def evaluate_into(self, begin, end, x, index, r, valid):
            super().evaluate_into(begin, end, x, index, r, valid)
            r[1] = np.nan

        def linearize_into(self, begin, end, x, index, r, jacobians, valid):
            super().linearize_into(begin, end, x, index, r, jacobians, valid)
            r[1] = np.nan

    problem.add_residuals(Broken(Euclidean(2), np.zeros((3, 2))), x, name="readings")
    with pytest.raises(NotFiniteError, match=r"residual of residual 1 of group 'readings' \(3 × Broken\), at .*x\[1\]"):
        problem.solve()


def test_wrong_use_is_refused_with_advice(ring):
    problem, poses = ring.problem, ring.poses
    edge = RelativePose(ring.truth[:1])
    with pytest.raises(InputError, match="the index dangles"):
        poses[[0, 99]]
    with pytest.raises(InputError, match="2 connections"):
        problem.add_residuals(edge, poses[0])
    with pytest.raises(InputError, match="one for each residual"):
        problem.add_residuals(edge, poses[0], poses[:3])
    with pytest.raises(InputError, match="variables of this problem"):
        problem.add_residuals(edge, poses[0], make_ring().poses[1])
    with pytest.raises(InputError, match="SE3"):
        problem.add_residuals(Prior(Euclidean(7), np.zeros((1, 7))), poses[0])
    with pytest.raises(InputError, match="new name"):
        problem.add_variables(Euclidean(1), [[0.0]], name="poses")
    with pytest.raises(InputError, match="at least one group"):
        Problem().solve()
    with pytest.raises(InputError, match="options or single settings"):
        problem.solve(SolverOptions(), max_iterations=3)
    with pytest.raises(ValueError, match="unknown_option"):
        problem.solve(unknown_option=1)
    problem.fix(poses)
    with pytest.raises(InputError, match="at least one free variable"):
        problem.solve()


def test_the_same_variable_twice_in_a_residual():
    problem = Problem()
    x = problem.add_variables(SE3, SE3.identity()[None])
    problem.add_residuals(RelativePose(SE3.identity()[None]), x[0], x[0])
    problem.add_residuals(Prior(SE3, SE3.boxplus(SE3.identity(), np.full(6, 0.1))[None]), x[0])
    solution = problem.solve()
    np.testing.assert_allclose(SE3.boxminus(solution[x], SE3.identity()), 0.1, atol=1e-8)


def test_a_group_without_residuals_says_nothing() -> None:
    problem = Problem()
    x = problem.add_variables(Euclidean(3), np.zeros((2, 3)), name="x")
    problem.add_residuals(Prior(Euclidean(3), np.ones((2, 3)), sigma=1.0), x)
    problem.add_residuals(Prior(Euclidean(3), np.zeros((0, 3)), sigma=1.0), x[[]])
    solution = problem.solve()
    assert np.allclose(solution.values[0], 1.0) and solution.covariance(x[0]) == pytest.approx(np.eye(3)[None])
