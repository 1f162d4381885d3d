"""A curved valley, as a tilt of the window against a bias is one: hardly damped steps across it are refused, again and again."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import boxplus as bp
from boxplus.manifolds.euclidean import Euclidean
from boxplus.optimization.problem import Problem
from boxplus.residuals.user.residual import UserResidual
from boxplus.systems.visual_inertial_odometry.frame_solver import FrameSolver

_STEPS = 4
_FLOOR = 200.0  # of the cost: noise that no solution removes, as corners have


def _bend(x: Any) -> Any:
    return np.array([1e3 * (x[1] - x[0] * x[0]), 1.0 - x[0]])


def _floor(x: Any) -> Any:
    return np.array([math.sqrt(2.0 * _FLOOR) + 0.0 * x[0]])


def _valley(x: float) -> Problem:
    """Rosenbrock's, much narrower: its floor is y = x², it ends at (1, 1)."""
    problem = bp.Problem()
    variables = problem.add_variables(Euclidean(2), np.array([[x, x * x]]))
    problem.add_residuals(UserResidual(_bend, dim=2, manifolds=(Euclidean(2),), count=1), variables)
    problem.add_residuals(UserResidual(_floor, dim=1, manifolds=(Euclidean(2),), count=1), variables)
    return problem


def test_it_goes_on_where_hardly_damped_steps_are_refused() -> None:
    problem, solver = _valley(-1.0), FrameSolver()
    alone = problem.solve(max_iterations=_STEPS, initial_damping=1e-10, examine=False)
    assert not any(step.accepted for step in alone.history[1:])
    solution = solver.solve(problem, _STEPS)
    assert solution.cost < solution.cost_initial


def test_frame_after_frame_it_follows_the_valley() -> None:
    problem, solver, moved = _valley(-1.0), FrameSolver(), 0
    for _ in range(60):
        solution = solver.solve(problem, _STEPS)
        assert solution.cost <= solution.cost_initial
        moved += any(step.accepted for step in solution.history[1:])
        problem.set_values(solution)
    assert moved >= 15
    x, y = problem.blocks[0].values[0]
    assert x > -0.8
    assert y == pytest.approx(x * x, abs=1e-3)


def test_what_is_at_its_minimum_is_left_alone() -> None:
    solution = FrameSolver().solve(_valley(1.0), _STEPS)
    assert solution.status == "converged"
    assert solution.cost == pytest.approx(_FLOOR)
