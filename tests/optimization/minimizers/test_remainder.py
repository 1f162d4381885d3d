"""How far from its minimum a solve ended: told where a limit or a stall left it there, and not where it is as good as there."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import boxplus as bp
from boxplus.optimization.linear_systems.least_squares import LeastSquares
from boxplus.optimization.minimizers.remainder import _trend
from tests.small_problems import loop_graph


def ranges(seed: int, noise: float = 0.1, far: float = 3.0) -> bp.Problem:
    """A place from its distances to twelve others, with a start that is off by `far`."""
    rng = np.random.default_rng(seed)
    beacons = rng.uniform(-10.0, 10.0, (12, 2))
    measured = np.linalg.norm(beacons - [1.0, 2.0], axis=1) + noise * rng.normal(size=12)
    problem = bp.Problem()
    x = problem.add_variables(bp.Euclidean(2), [[1.0 + far, 2.0 - far]], name="x")
    residual = bp.residuals.UserResidual(
        lambda p: (np.linalg.norm(p - beacons, axis=1) - measured)[:, None] / noise,
        dim=1,
        manifolds=(bp.Euclidean(2),),
        count=12,
        is_batch=True,
    )
    problem.add_residuals(residual, x[np.zeros(12, int)], name="ranges")
    return problem


@pytest.mark.parametrize("seed", range(4))
def test_what_is_told_is_how_far_the_minimum_is(seed: int) -> None:
    problem = ranges(seed)
    best = problem.solve()
    covariance = best.covariance(problem.blocks[0])[0]
    for steps in range(4):
        solution = problem.solve(max_iterations=steps)
        off = (solution.values[0] - best.values[0])[0]
        sigmas = np.sqrt(off @ np.linalg.solve(covariance, off) / max(2.0 * best.cost / 10.0, 0.01))
        told = solution.unconverged()
        assert (told is not None) == (sigmas > 1.0), (steps, sigmas, told)
        if told is not None:
            assert solution.limit == "steps" and told in solution.summary()
            claimed = float(re.search(r"x\[0\] is (\S+) standard deviations of its own", told)[1])
            assert claimed < 1.5 * sigmas, (steps, claimed, sigmas)  # far away the errors are no noise, and it is more


def test_a_limit_at_the_minimum_is_none() -> None:
    problem = ranges(0)
    best = problem.solve()
    again = problem.solve(start=best, max_iterations=0, gradient_tolerance=0.0)
    assert (again.status, again.limit, again.unconverged()) == ("stopped", "steps", None)
    assert problem.solve(time_limit_s=1e-9).limit == "time"
    stopped = problem.solve(callback=lambda step: True)
    assert (stopped.status, stopped.limit, stopped.unconverged()) == ("stopped", None, None)  # who stops it knows


def test_a_stall_far_up_is_told() -> None:
    problem = bp.Problem()
    line = bp.Euclidean(1)
    x = problem.add_variables(line, [1.0], name="x")
    wrong = bp.residuals.UserResidual(
        lambda x: 10.0 * x, dim=1, manifolds=(line,), count=1, is_batch=True, jacobian=lambda x: (np.full((len(x), 1, 1), -10.0),)
    )
    problem.add_residuals(wrong, x, name="wrong slope")
    solution = problem.solve()
    assert solution.status == "stalled"
    assert "no minimum was reached" in solution.unconverged() and "check_jacobian" in solution.unconverged()


def test_small_steps_of_a_slow_way_are_summed_up() -> None:
    for factor in (0.5, 0.8, 0.95):
        costs = 10.0 + 3.0 * factor ** np.arange(40)
        assert _trend(costs) == pytest.approx(costs[-1] - 10.0, rel=1e-6)
    fast = 10.0 + np.array([4.0e6, 4.0e5, 3.0e4, 2.0e3, 50.0, 1.0, 1e-3, 1e-6, 1e-9])
    assert _trend(fast) < 1e-5  # falls that shrink ever faster: the large ones of long ago say nothing
    assert _trend([10.0, 9.0, 8.5]) == 0.0  # too few to see a sequence
    assert _trend([10.0, 10.0, 10.0, 9.0, 7.0, 4.0, 0.0]) == 0.0  # nor is this one


@pytest.mark.parametrize(("k", "w"), [(1000.0, 3.0), (10.0, 1.0)])
def test_the_floor_of_a_curved_valley_is_far_from_its_end(k: float, w: float) -> None:
    """Along y = x² the cost follows short steps alone, which promise next to nothing: no reason to take them for the last."""
    problem = bp.Problem()
    plane = bp.Euclidean(2)
    x = problem.add_variables(plane, [-1.0, 1.0], name="x")
    valley = bp.residuals.UserResidual(
        lambda p: np.stack([k * (p[:, 1] - p[:, 0] ** 2), w * (1.0 - p[:, 0])], axis=1),
        dim=2,
        manifolds=(plane,),
        count=1,
        is_batch=True,
    )
    problem.add_residuals(valley, x, name="valley")
    for steps in (0, 5, 10, 20, 40):
        solution = problem.solve(max_iterations=steps)
        left = np.sqrt(2.0 * solution.cost)  # the cost ends at zero, and the errors are as large as was said
        told = solution.unconverged()
        assert (told is not None) == (solution.limit is not None and left > 1.0), (steps, left, told)


def test_a_pose_graph_is_as_far_off_as_its_covariances_say() -> None:
    graph = loop_graph(2)
    problem = bp.Problem()
    x = problem.add_variables(bp.SE2, graph.poses, name="poses")
    edges = bp.residuals.RelativePose2D(graph.measurements, information=graph.information)
    problem.add_residuals(edges, x[graph.edges[:, 0]], x[graph.edges[:, 1]], name="edges")
    problem.fix(x[0])
    best = problem.solve()
    variance = 2.0 * best.cost / (3 * len(graph.edges) - 3 * (len(graph.poses) - 1))
    compared = 0
    for steps in range(4):
        solution = problem.solve(max_iterations=steps)
        u = bp.SE2.boxminus(best.values[0], solution.values[0])[1:]
        C = solution.covariance(x)[1:]
        off = np.sqrt(np.einsum("ni,nij,nj->n", u, np.linalg.inv(C), u) / variance)
        remainder = solution.remainder()
        if not 1.0 < off.max() < 10.0:  # far away residuals are no noise, and the model is another
            assert (remainder is None or remainder.variables[0].max() < 1.0) == (off.max() < 1.0)
            continue
        compared += 1
        assert 0.8 * off.max() < remainder.variables[0].max() < 1.25 * off.max()
    assert compared


def many_places(count: int, off: float, dof: int = 2, seed: int = 0) -> tuple[bp.Problem, np.ndarray]:
    """As many places, each measured six times, and starts that are off by `off` of the standard deviations of that."""
    rng = np.random.default_rng(seed)
    at = rng.uniform(-1.0, 1.0, (count, dof))
    problem = bp.Problem()
    x = problem.add_variables(bp.Euclidean(dof), at, name="x")
    measured = np.repeat(at, 6, axis=0) + 0.1 * rng.normal(size=(6 * count, dof))
    problem.add_residuals(
        bp.residuals.Prior(bp.Euclidean(dof), measured, sigma=0.1), x[np.repeat(np.arange(count), 6)], name="seen"
    )
    best = measured.reshape(count, 6, dof).mean(axis=1)
    direction = rng.normal(size=(count, dof))
    return problem, best + off * 0.1 / np.sqrt(6.0) * direction / np.linalg.norm(direction, axis=1, keepdims=True)


@pytest.mark.parametrize(("count", "together"), [(50, 4.0), (20_000, 80.0)])
def test_many_that_are_each_as_good_as_at_the_minimum_are_none(count: int, together: float) -> None:
    """All together they are many standard deviations off, and the more the more there are: no reason to doubt any."""
    problem, start = many_places(count, off=0.7)
    solution = problem.solve(start=[start], max_iterations=0)
    remainder = solution.remainder()
    assert remainder is not None and remainder.total > together
    assert remainder.variables[0].max() < 1.0 and solution.unconverged() is None
    assert np.median(remainder.variables[0]) == pytest.approx(0.7, abs=0.05)


def test_one_of_many_that_is_far_is_named_with_how_far() -> None:
    problem, start = many_places(20_000, off=0.3)
    start[1234] += [0.07, -0.05]
    best = problem.solve(start=[start])
    solution = problem.solve(start=[start], max_iterations=0)
    off = start[1234] - best.values[0][1234]
    sigmas = float(np.linalg.norm(off)) / (0.1 / np.sqrt(6.0))
    assert f"x[1234] is {sigmas:.1f} standard deviations of its own away from there" in (solution.unconverged() or "")
    assert solution.unconverged(apart_from=problem.blocks[0][1234]) is None


@pytest.mark.parametrize("seed", range(4))
def test_one_among_many_that_are_nearly_as_far_is_found(seed: int) -> None:
    """20,000 places at 0.97, one of which is beyond."""
    problem, start = many_places(20_000, off=0.97, seed=seed)
    best = problem.solve(start=[start]).values[0]
    start[777] = best[777] + 1.5 / 0.97 * (start[777] - best[777])
    solution = problem.solve(start=[start], max_iterations=0)
    assert "x[777] is 1.5 standard deviations of its own away from there" in (solution.unconverged() or "")


def test_what_others_do_not_tell_is_not_sampled() -> None:
    """Places that nothing joins are all as far off as they are, without the scatter of samples."""
    problem, start = many_places(2_000, off=0.9)
    away = problem.solve(start=[start], max_iterations=0).remainder().variables[0]
    assert np.ptp(away) < 1e-6 * away.max()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("off", "farthest"), [(0.85, 0.85), (0.6, 1.2), (0.85, 1.5)])
def test_places_that_tell_each_other_where_they_are_are_not_counted_for_their_scatter(
    off: float, farthest: float, seed: int
) -> None:
    """Each is known by its neighbours alone, so that samples scatter, and alike for a hundred of them at once."""
    rng, plane, count = np.random.default_rng(seed), bp.Euclidean(2), 3_000
    problem = bp.Problem()
    x = problem.add_variables(plane, np.zeros((count, 2)), name="x")
    steps = bp.residuals.UserResidual(
        lambda a, b, d: (b - a - d) / 0.01,
        dim=2,
        manifolds=(plane, plane),
        data=(0.01 * rng.normal(size=(count - 1, 2)),),
        is_batch=True,
    )
    problem.add_residuals(steps, x[np.arange(count - 1)], x[np.arange(1, count)], name="steps")
    problem.add_residuals(bp.residuals.Prior(plane, rng.normal(size=(count, 2)), sigma=1.0), x, name="seen")
    best = problem.solve()
    away = np.full(count, off)
    away[77] = farthest
    start = best.values[0] + 0.5**0.5 * away[:, None] * best.standard_deviations(x)
    told = problem.solve(start=[start], max_iterations=0).unconverged()
    if farthest == off:
        assert told is None
        return
    claimed = re.search(r"x\[77\] is (\S+) standard deviations of its own away from there(.*): allow", told or "")
    assert float(claimed[1]) == pytest.approx(farthest, rel=0.1) and claimed[2] == ""


@pytest.mark.parametrize("lone", [False, True])
def test_what_is_plainly_far_takes_few_solves(lone: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each is seen by a product with the Jacobian; all 2,000 are three standard deviations off, or one is."""
    problem, start = many_places(2_000, off=3.0)
    if lone:
        best = problem.solve(start=[start]).values[0]
        start[:1999] = best[:1999] + 0.05 * (start[:1999] - best[:1999])
    solution = problem.solve(start=[start], max_iterations=0)
    seen, product = [], LeastSquares.product
    monkeypatch.setattr(LeastSquares, "product", lambda self, x: (seen.append(1), product(self, x))[1])
    assert "standard deviations of its own away" in (solution.unconverged() or "")
    assert len(seen) < 30


@pytest.mark.parametrize("dof", [3, 28, 31, 40])
def test_variables_of_many_degrees_of_freedom_are_asked_as_well(dof: int) -> None:
    problem, start = many_places(40, off=0.5, dof=dof)
    best = problem.solve(start=[start]).values[0]
    assert problem.solve(start=[start], max_iterations=0).unconverged() is None
    start[7] = best[7] + 3.0 * (start[7] - best[7])
    solution = problem.solve(start=[start], max_iterations=0)
    assert "x[7] is 1.5 standard deviations of its own away from there" in (solution.unconverged() or "")
    assert np.median(solution.remainder().variables[0]) == pytest.approx(0.5, abs=0.1)


def test_none_is_farther_than_all_together() -> None:
    problem, start = many_places(2, off=0.9, dof=3)
    remainder = problem.solve(start=[start], max_iterations=0).remainder()
    assert remainder is not None
    assert max(away.max() for away in (*remainder.variables, *remainder.residuals)) <= remainder.total


def test_what_was_removed_since_is_not_asked() -> None:
    problem, start = many_places(20, off=2.0)
    solution = problem.solve(start=[start], max_iterations=0)
    assert solution.unconverged() is not None
    problem.remove(problem.blocks[0][3])
    with pytest.raises(bp.InputError, match="removed since"):
        solution.remainder()


def test_what_is_known_between_variables_is_asked_as_well() -> None:
    """Of a long chain poses are hardly known, and the steps between them well: where one of these is off, it is told."""
    problem, count = bp.Problem(), 400
    x = problem.add_variables(bp.Euclidean(1), np.where(np.arange(count) < 200, 0.0, 2.5)[:, None], name="x")
    problem.fix(x[0])
    step = bp.residuals.UserResidual(
        lambda a, b: (b - a) / 1.0, dim=1, manifolds=(bp.Euclidean(1),) * 2, count=count - 1, is_batch=True
    )
    problem.add_residuals(step, x[:-1], x[1:], name="steps")
    solution = problem.solve(max_iterations=0)
    assert solution.remainder().variables[0].max() < 1.0
    assert "what steps[199] sees of x[199] and x[200] is 2.5 standard deviations of its own" in solution.unconverged()


def test_the_joint_history_of_two_descents_is_not_read_as_one() -> None:
    problem = ranges(0)
    best = problem.solve()
    again = problem.solve(start=best, max_iterations=0, gradient_tolerance=0.0)
    slow = [replace(best.history[0], cost=best.cost + 5.0 * (0.9**k - 0.9**12), number=k) for k in range(12)]
    joined = replace(again, history=(*slow, *again.history))
    assert joined.unconverged() is not None  # read as one, the long way down seems to go on
    assert replace(joined, descent=len(slow)).unconverged() is None
