"""Redescending losses from the minimum of a convex one, costs that do not saturate, and residuals that hardly count."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus import SE3, Euclidean, Problem, SolverOptions, losses
from boxplus.manifolds import se3
from boxplus.optimization.outliers.convex_start import convex_cost, convex_losses, solve_from_convex
from boxplus.residuals import PointToPoint, Prior

REDESCENDING = [
    losses.Tukey(4.685),
    losses.Welsch(2.985),
    losses.GemanMcClure(3.787),
    losses.Cauchy(2.385),
    losses.Truncated(4.0),
]


def registration(seed, loss, share=0.03, count=200):
    """Points matched with a share of wrong ones, from a start half a radian and a metre off: hundreds of standard deviations."""
    rng = np.random.default_rng(seed)
    p_source = rng.uniform(-1, 1, (count, 3))
    T = se3.exp(np.array([0.3, -0.4, 0.2, 0.8, -0.5, 0.4]))
    p_target = se3.act(T, p_source) + 0.01 * rng.standard_normal((count, 3))
    wrong = rng.permutation(count) < share * count
    p_target[wrong] = rng.uniform(-3, 3, (int(wrong.sum()), 3))
    problem = Problem()
    pose = problem.add_variables(SE3, SE3.identity(), name="T_target_source")
    problem.add_residuals(PointToPoint(p_source, p_target, sigma=0.01), pose[0], loss=loss, name="matches")
    return problem, pose, T, wrong


@pytest.mark.parametrize("loss", REDESCENDING, ids=lambda loss: loss.name)
def test_what_forgets_finds_the_minimum_after_what_does_not(loss):
    for seed in range(3):
        problem, pose, T, wrong = registration(seed, loss)
        found = solve_from_convex(problem)
        assert np.abs(SE3.boxminus(found[pose][0], T)).max() < 0.01
        assert found.status == "converged" and problem.groups[0].loss == loss
        assert found.faded["matches"] == pytest.approx(wrong.mean(), abs=0.011)
        assert not any("hardly count" in note for note in found.notes)


@pytest.mark.parametrize("loss", [losses.Tukey(4.685), losses.Welsch(2.985)], ids=lambda loss: loss.name)
def test_a_wrong_minimum_says_that_most_residuals_hardly_count(loss):
    problem, pose, T, _ = registration(0, loss)
    lost = problem.solve()
    assert np.abs(SE3.boxminus(lost[pose][0], T)).max() > 0.1
    assert lost.faded["matches"] > 0.5
    note = next(note for note in lost.notes if "hardly count" in note)
    assert "% of the residuals of matches have weight below 0.1 under" in note and note in lost.summary()
    # The saturating cost cannot tell the start from the minimum that it missed; the convex one can.
    right = solve_from_convex(problem)
    assert convex_cost(problem, right) < 0.1 * convex_cost(problem, lost)


@pytest.mark.parametrize("sigma, is_told", [(0.01, False), (0.004, True)], ids=["right", "too small"])
def test_noise_as_promised_hardly_counts_without_a_word(sigma, is_told):
    # Of six numbers ‖r‖² is above 9, where Cauchy(1) gives a weight of 0.1, in 17 of 100 cases by noise alone.
    rng = np.random.default_rng(5)
    z = rng.normal(0.0, 0.01, (400, 6))
    problem = Problem()
    x = problem.add_variables(Euclidean(6), np.zeros(6), name="x")
    prior = Prior(Euclidean(6), z, sigma=sigma)
    problem.add_residuals(prior, x[np.zeros(400, dtype=np.int64)], loss=losses.Cauchy(1.0), name="measured")
    found = problem.solve()
    assert found.faded["measured"] > 0.1
    assert any("hardly count" in note for note in found.notes) == is_told


def test_convex_and_plain_losses_are_solved_as_they_are():
    for loss in (None, losses.Huber(1.0)):
        one, pose, _, _ = registration(1, loss)
        two, other, _, _ = registration(1, loss)
        np.testing.assert_array_equal(solve_from_convex(one)[pose], two.solve()[other])
        assert convex_cost(one) == one.cost()
    assert solve_from_convex(registration(1, None)[0]).faded == {}


def test_losses_are_restored_whatever_happens():
    problem = registration(0, losses.Welsch(2.0))[0]
    with pytest.raises(RuntimeError), convex_losses(problem) as groups:
        assert repr(groups[0].loss) == "Huber(1.345)"
        raise RuntimeError
    assert repr(problem.groups[0].loss) == "Welsch(2)"


def test_limits_and_callback_hold_for_both_stages():
    seen = []
    problem, *_ = registration(0, losses.Welsch(2.985))
    stopped = solve_from_convex(problem, callback=lambda i: seen.append(i) or len(seen) == 2)
    assert stopped.status == "stopped" and "callback" in stopped.reason and len(seen) == 3
    short = registration(0, losses.Welsch(2.985))[0]
    solution = solve_from_convex(short, SolverOptions(max_iterations=3))
    assert solution.iterations == 0 and solution.status == "stopped"


def test_weights_count_residuals_and_zeros_leave_the_structure():
    rng = np.random.default_rng(0)
    values, counts = rng.standard_normal((40, 1)), rng.integers(0, 4, 40).astype(float)

    def mean(weights):
        problem = Problem()
        x = problem.add_variables(Euclidean(1), [[0.5]], name="x")
        group = problem.add_residuals(Prior(Euclidean(1), values), x[0], name="readings")
        problem.set_weights(group, weights)
        solution = problem.solve(method="gauss_newton")
        return problem, group, solution, solution[x][0, 0], solution.covariance(x)[0, 0, 0]

    problem, group, solution, found, variance = mean(counts)
    assert found == pytest.approx(np.average(values[:, 0], weights=counts), rel=1e-12)
    assert variance == pytest.approx(1.0 / counts.sum(), rel=1e-12)
    assert group.left_out is not None and (group.left_out == (counts == 0)).all()
    np.testing.assert_allclose(group.squares(solution.values), (values[:, 0] - found) ** 2, rtol=1e-12)
    problem.set_weights(group, None)
    assert problem.solve(method="gauss_newton").values[0][0, 0] == pytest.approx(values.mean(), rel=1e-12)
