"""First-estimate Jacobians: over a long drive the prior learns nothing that nobody measured."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus import SE3, InputError, Problem, SE3Left, check_jacobian, marginalize
from boxplus.manifolds import se3
from boxplus.optimization.marginalization.leak import world_gauge
from boxplus.residuals import Prior, RelativePose
from boxplus.residuals.marginal_prior import MarginalPrior
from tests.optimization.conftest import make_scene
from tests.optimization.marginalization.windows import Drive, drive, motion_residual, view_residual


def test_the_simulated_residuals_have_the_right_jacobians():
    world = Drive(0, 3)
    m = np.stack([world.moved(k) for k in (1, 2, 3)])
    T = SE3.boxplus(world.T, 0.2 * world.rng.standard_normal((4, 6)))
    assert check_jacobian(motion_residual(m), T[:3], world.v[:3], T[1:], world.v[1:]).passed
    ahead = np.array([6.0, 1.0, 1.0]) + world.rng.standard_normal((3, 3))
    assert check_jacobian(view_residual(np.zeros((3, 2))), SE3.identity(), ahead).passed


@pytest.mark.slow
def test_two_hundred_marginalisations_leak_nothing():
    _, _, leaks, _ = drive(0, 204, window=4)
    assert len(leaks) == 200 and not any(leak.is_anchored for leak in leaks)
    assert max(leak.worst for leak in leaks) < 1e-10  # rounding, as `Leak.relative` says: 1e-14 to 3e-12 by seed and BLAS
    assert leaks[-1].per_sigma[:3].min() > 1e9  # metres
    assert "yaw: one sigma of the prior is" in leaks[-1].sentences()[3]


def test_without_first_estimates_position_and_yaw_seem_measured():
    _, _, leaks, _ = drive(0, 40, first_estimates=False)
    assert leaks[0].worst < 1e-12  # the first prior is made at one point
    assert leaks[-1].worst > 1e-3
    assert leaks[-1].per_sigma[3] < 10.0  # degrees that the prior claims to know


def test_prior_and_residuals_are_linearised_at_the_first_estimate():
    rng = np.random.default_rng(0)
    T = SE3.random(rng, 3)
    problem = Problem()
    poses = problem.add_variables(SE3, T, name="poses")
    measured = SE3.boxplus(se3.compose(se3.inverse(T[:2]), T[1:]), 0.1 * rng.standard_normal((2, 6)))
    edges = problem.add_residuals(RelativePose(measured, sigma=0.1), poses[:-1], poses[1:], name="edges")
    problem.add_residuals(Prior(SE3, T[0], sigma=0.2), poses[0])
    first = marginalize(problem, poses[0], at=None)
    moved = SE3.boxplus(poses.values, 0.1 * rng.standard_normal((2, 6)))
    edges.linearize([moved], 1)
    np.testing.assert_allclose(
        edges.r[1] * 0.1, RelativePose(measured[1:], sigma=0.1).evaluate(moved[0], moved[1])[0], atol=1e-12
    )
    np.testing.assert_allclose(edges.jacobians[1][1] * 0.1, RelativePose(measured[1:]).linearize(T[1], moved[1]).jacobians[1][0])
    prior = first.prior
    prior.linearize([moved], 1)
    np.testing.assert_array_equal(prior.jacobians[0][0], prior.residual.J)
    np.testing.assert_allclose(prior.r[0], prior.residual.r0 + prior.residual.J @ SE3.boxminus(moved[0], T[1]), atol=1e-12)
    # Without the prior it is as any variable.
    problem.remove(prior)
    edges.linearize([moved], 1)
    np.testing.assert_allclose(
        edges.jacobians[1][1] * 0.1, RelativePose(measured[1:]).linearize(moved[0], moved[1]).jacobians[1][0]
    )


def test_a_prior_keeps_its_cost_when_a_variable_leaves_it():
    """r₀ belongs to x₀: after the variables moved, marginalising again changes neither cost differences nor first estimates."""
    rng = np.random.default_rng(1)
    manifolds, x0 = [SE3] * 3, SE3.random(rng, 3)
    problem = Problem()
    poses = problem.add_variables(SE3, x0, name="poses")
    known = MarginalPrior(manifolds, x0, rng.standard_normal((18, 18)), rng.standard_normal(18))
    problem.add_residuals(known, poses[0], poses[1], poses[2])
    moved = SE3.boxplus(x0, 0.2 * rng.standard_normal((3, 6)))
    marginal = marginalize(problem, poses[0], at=[moved])
    prior = marginal.prior.residual
    np.testing.assert_array_equal(prior.x0[0], x0[1])
    J, r = known.J, known.r0 + known.J @ np.concatenate([SE3.boxminus(moved[k], x0[k]) for k in range(3)])
    Q = np.linalg.svd(J[:, :6])[0][:, 6:]
    delta = np.concatenate([SE3.boxminus(moved[k], x0[k]) for k in (1, 2)])
    np.testing.assert_allclose(prior.J.T @ (prior.r0 + prior.J @ delta), J[:, 6:].T @ Q @ Q.T @ r, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("first_estimates", [True, False])
def test_a_sliding_window_stays_consistent(first_estimates):
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
    for _ in range(12):
        measured = SE3.boxplus(between, sigma * rng.standard_normal((len(pairs), 6)))
        batch = Problem()
        poses = batch.add_variables(SE3, truth)
        batch.add_residuals(RelativePose(measured, sigma=sigma), poses[pairs[:, 0]], poses[pairs[:, 1]])
        batch.fix(poses[0])
        reference = batch.solve()
        problem = Problem()
        window = problem.add_variables(SE3, truth[:1], name="window")
        problem.fix(window[0])
        for newest in range(1, 40):
            problem.extend(window, se3.compose(window.values[-1], measured[newest - 1]))
            fresh = np.flatnonzero((pairs[:, 1] == newest) & (pairs[:, 0] >= window.ids[0]))
            edges = RelativePose(measured[fresh], sigma=sigma)
            problem.add_residuals(edges, window[pairs[fresh, 0]], window[pairs[fresh, 1]])
            solution = problem.solve()
            problem.set_values(solution)
            if len(window) == 5 and newest < 39:
                marginalize(problem, window[:1], at=solution, first_estimates=first_estimates)
        error = SE3.boxminus(truth[39], solution[window[39]][0])
        nees.append(error @ np.linalg.solve(solution.covariance(window[39])[0], error))
        spread = np.sqrt(np.diag(reference.covariance(poses[39])[0]))
        distance.append(np.abs(SE3.boxminus(reference[poses][39], solution[window[39]][0]) / spread).max())
    assert abs(np.mean(nees) - 6.0) < 4.0 * np.sqrt(12.0 / 12)
    assert np.max(distance) < 0.15  # of a standard deviation, from the estimate of all 40 poses together


def test_the_gauge_of_cameras_and_points_has_seven_motions():
    scene = make_scene(cameras=6, points=30)
    scene.problem.free(scene.cameras)
    gauge = world_gauge({scene.cameras: "body_from_world", scene.points: "point"}, scale=True)
    assert gauge.names[-1] == "scale" and len(gauge.names) == 7
    leak = marginalize(scene.problem, [scene.cameras[0], scene.points[:20]], at=None, gauge=gauge).leak
    assert leak.worst < 1e-12 and not leak.is_anchored
    known = make_scene(cameras=6, points=30)
    gauge = world_gauge({known.cameras: "body_from_world", known.points: "point"})
    leak = marginalize(known.problem, known.points, at=None, gauge=gauge).leak  # seen from two cameras that are held
    assert leak.is_anchored and leak.worst > 1e-3


def test_a_prior_on_a_pose_is_an_anchor_and_no_leak():
    problem = Problem()
    poses = problem.add_variables(SE3, SE3.random(np.random.default_rng(0), 2), name="poses")
    problem.add_residuals(Prior(SE3, poses.values[0], sigma=0.5), poses[0])
    problem.add_residuals(RelativePose(se3.compose(se3.inverse(poses.values[:1]), poses.values[1:])), poses[0], poses[1])
    gauge = world_gauge({poses: "world_from_body"}, rotation="none")
    leak = marginalize(problem, poses[0], at=None, gauge=gauge).leak
    assert leak.is_anchored and leak.names == ("translation x", "translation y", "translation z")
    np.testing.assert_array_less(leak.per_sigma, 2.0)


def test_wrong_gauges_are_refused():
    problem = Problem()
    poses = problem.add_variables(SE3Left, SE3.identity(), name="poses")
    with pytest.raises(InputError, match="world_from_body, body_from_world"):
        world_gauge({poses: "point"})
    with pytest.raises(InputError, match="up as an axis"):
        world_gauge({poses: "world_from_body"}, up=(0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="rotation"):
        world_gauge({poses: "world_from_body"}, rotation="roll")
