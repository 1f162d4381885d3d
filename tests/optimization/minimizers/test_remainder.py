"""How far from its minimum a solve ended: told where a limit or a stall left it there, and not where it is as good as there."""

from __future__ import annotations

import re

import numpy as np
import pytest

import boxplus as bp
from boxplus.optimization.minimizers.remainder import _trend


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
            claimed = float(re.search(r"together are (\S+) standard deviations", told)[1])
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
    assert _trend([10.0, 9.0, 8.5]) == 0.0  # too few to see a sequence
    assert _trend([10.0, 10.0, 10.0, 9.0, 7.0, 4.0, 0.0]) == 0.0  # nor is this one
