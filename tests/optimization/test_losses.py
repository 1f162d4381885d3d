"""Losses: derivatives against differences, and Triggs' factors against the gradient and curvature they stand for."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import boxplus as bp
from boxplus import InputError, losses
from boxplus.optimization.losses import loss_at, triggs

ROBUST = [losses.Truncated, losses.Huber, losses.Cauchy, losses.Tukey, losses.GemanMcClure, losses.Welsch]


@pytest.mark.parametrize("make", ROBUST)
@given(s=st.floats(1e-3, 50.0), scale=st.floats(0.3, 4.0))
def test_derivatives(make, s, scale):
    loss = make(scale)
    if abs(s - scale**2) < 0.05 * s:  # Huber and Tukey have a kink or a jump of the second derivative there
        return
    h = 1e-4 * s
    value, first, second = loss_at(loss.code, scale, s)
    above, below = loss_at(loss.code, scale, s + h), loss_at(loss.code, scale, s - h)
    assert first == pytest.approx((above[0] - below[0]) / (2 * h), rel=1e-5, abs=1e-9)
    assert second == pytest.approx((above[1] - below[1]) / (2 * h), rel=1e-4, abs=1e-8)
    assert 0.0 <= value <= s * (1 + 1e-12)


@pytest.mark.parametrize("make", ROBUST)
def test_small_residuals_count_as_least_squares(make):
    value, first, _ = loss_at(make(1.0).code, 1.0, 1e-10)
    assert value == pytest.approx(1e-10, rel=1e-6) and first == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("make", ROBUST)
@given(length=st.floats(0.01, 6.0), scale=st.floats(0.5, 3.0))
def test_triggs_factors_give_the_exact_gradient_and_a_positive_curvature(make, length, scale):
    code = make(scale).code
    r = length * np.array([0.6, -0.8, 0.0])
    J = np.arange(12.0).reshape(3, 4) ** 0.5 - 1.3
    s = float(r @ r)
    _, first, second = loss_at(code, scale, s)
    _, root, alpha = triggs(code, scale, s)
    weighed = root / (1.0 - alpha) * r
    Jw = root * (J - alpha * np.outer(r, r @ J) / s)
    np.testing.assert_allclose(Jw.T @ weighed, first * J.T @ r, rtol=1e-10, atol=1e-12)
    exact = first * np.eye(3) + 2.0 * second * np.outer(r, r)
    used = exact if first + 2.0 * second * s >= 0.5 * first else first * np.eye(3)
    np.testing.assert_allclose(Jw.T @ Jw, J.T @ used @ J, rtol=1e-9, atol=1e-10)


def test_scales_are_checked_and_losses_print_as_they_are_written():
    with pytest.raises(InputError, match="Huber scale positive and finite – got 0"):
        losses.Huber(0.0)
    with pytest.raises(InputError, match="nan"):
        losses.Cauchy(float("nan"))
    assert repr(losses.Huber(1.5)) == "Huber(1.5)"
    assert repr(losses.Tukey(1.0).with_scale(2.0)) == "Tukey(2)"


def pseudo_huber(s):
    root = math.sqrt(1.0 + s)
    return 2.0 * root - 2.0, 1.0 / root, -0.5 / (root * root * root)


def own_cauchy(s):
    return math.log1p(s), 1.0 / (1.0 + s), -1.0 / (1.0 + s) ** 2


def registration(loss):
    rng = np.random.default_rng(0)
    p = rng.uniform(-1, 1, (60, 3))
    q = p + rng.normal(0.0, 0.01, p.shape)
    q[:6] += 1.0
    problem = bp.Problem()
    pose = problem.add_variables(bp.SE3, bp.SE3.boxplus(bp.SE3.identity(), np.full(6, 0.02)))
    problem.add_residuals(bp.residuals.PointToPoint(p, q, sigma=0.01), pose[0], loss=loss, name="matches")
    return problem, pose


def test_a_loss_of_ones_own_does_what_the_built_in_one_does():
    mine, pose = registration(losses.UserLoss(own_cauchy, scale=1.5))
    built_in, other_pose = registration(losses.Cauchy(1.5))
    found, expected = mine.solve(), built_in.solve()
    assert found.cost == pytest.approx(expected.cost, rel=1e-12) and found.iterations == expected.iterations
    np.testing.assert_allclose(found[pose], expected[other_pose], atol=1e-12)
    np.testing.assert_allclose(found.covariance(pose), expected.covariance(other_pose), rtol=1e-9, atol=1e-15)
    assert found.faded == expected.faded


def test_the_cost_of_a_loss_of_ones_own_is_minimal_at_its_solution():
    problem, pose = registration(losses.UserLoss(pseudo_huber, scale=1.5))
    solution = problem.solve(cost_tolerance=1e-14)
    s = (problem.groups[0].residual.evaluate(solution[pose][0]) ** 2).sum(axis=1) / 0.01**2
    assert solution.cost == pytest.approx(0.5 * 1.5**2 * (2.0 * np.sqrt(1.0 + s / 1.5**2) - 2.0).sum(), rel=1e-9)
    for step in 1e-4 * np.vstack([np.eye(6), -np.eye(6)]):
        assert problem.cost([bp.SE3.boxplus(solution[pose], step)]) > solution.cost


def test_what_forgets_is_known_to_forget():
    assert not losses.UserLoss(pseudo_huber).is_redescending
    assert losses.UserLoss(own_cauchy).is_redescending
    scaled = losses.UserLoss(own_cauchy).with_scale(2.5)
    assert repr(scaled) == "own_cauchy(2.5)" and scaled.function is own_cauchy


def test_an_incremental_problem_takes_it_too():
    z = np.array([[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
    found = []
    for loss in (losses.UserLoss(own_cauchy, scale=0.5), losses.Cauchy(0.5)):
        problem = bp.IncrementalProblem()
        poses = problem.add_variables(bp.SE3, np.tile(bp.SE3.identity(), (2, 1)))
        problem.add_residuals(bp.residuals.Prior(bp.SE3, bp.SE3.identity()[None], sigma=0.1), poses[0])
        problem.add_residuals(bp.residuals.RelativePose(z, sigma=0.1), poses[0], poses[1], loss=loss)
        problem.add_residuals(bp.residuals.RelativePose(z * [1, 1, 1, 1, 1.3, 1, 1], sigma=0.1), poses[0], poses[1], loss=loss)
        for _ in range(10):
            problem.update()
        found.append(problem.estimate(poses))
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)


def by_the_length(s):
    return 2.0 * math.sqrt(1.0 + s) - 2.0, math.sqrt(s) / math.sqrt(1.0 + s), 0.0


def of_two(s):
    return s, 1.0


def falling(s):
    return math.sin(s), math.cos(s), -math.sin(s)


def above_zero(s):
    return s + 1.0, 1.0, 0.0


def of_text(s):
    return "s", 1.0, 0.0


def wrong_curvature(s):
    return math.log1p(s), 1.0 / (1.0 + s), 1.0 / (1.0 + s) ** 2


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (by_the_length, "the derivative of by_the_length as ρ′"),
        (wrong_curvature, "the derivative of wrong_curvature as ρ″"),
        (of_two, "three numbers from of_two"),
        (of_text, "three numbers from of_text"),
        (falling, "does not fall"),
        (above_zero, "ρ\\(0\\) = 0"),
        (3.0, "a function of s"),
    ],
)
def test_a_wrong_loss_is_refused(function, message):
    with pytest.raises(InputError, match=message):
        losses.UserLoss(function)
