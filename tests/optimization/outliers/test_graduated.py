"""Graduated non-convexity against a robust loss from a bad start, with more outliers than inliers."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus import SE2, SE3, SO3, Euclidean, InputError, Problem, SingularProblemError, losses
from boxplus.manifolds import se3
from boxplus.optimization.outliers.graduated import graduate
from boxplus.optimization.outliers.inlier_report import inlier_report
from boxplus.residuals import PointToPoint, Prior, RelativePose, RelativePose2D, UserResidual
from boxplus.simulation.pose_graphs import simulate_pose_graph

SIGMA = {"odometry": np.array([0.03] * 3 + [0.05] * 3), "closures": np.array([0.01] * 3 + [0.03] * 3)}


def drifting_ring(seed, outliers, count=60, closures=80):
    """Odometry that drifts around a ring, and closures of which a share is invented."""
    rng = np.random.default_rng(seed)
    step = se3.exp(np.array([0.0, 0.0, 2.0 * np.pi / count, 1.0, 0.0, 0.0]))
    truth = [SE3.identity()]
    for _ in range(count - 1):
        truth.append(se3.compose(truth[-1], step))
    truth = np.array(truth)
    weak, firm = SIGMA["odometry"], SIGMA["closures"]
    odometry = SE3.boxplus(se3.compose(se3.inverse(truth[:-1]), truth[1:]), weak * rng.standard_normal((count - 1, 6)))
    i, j = np.array([rng.choice(count, 2, replace=False) for _ in range(closures)]).T
    measured = SE3.boxplus(se3.compose(se3.inverse(truth[i]), truth[j]), firm * rng.standard_normal((closures, 6)))
    is_outlier = rng.permutation(closures) < outliers * closures
    measured[is_outlier] = SE3.boxplus(SE3.identity(), rng.uniform(-1, 1, (closures, 6)) * [1, 1, 3, 10, 10, 2])[is_outlier]
    start = [SE3.identity()]
    for z in odometry:
        start.append(se3.compose(start[-1], z))
    problem = Problem()
    poses = problem.add_variables(SE3, np.array(start), name="poses")
    k = np.arange(count - 1)
    problem.add_residuals(RelativePose(odometry, sigma=weak), poses[k], poses[k + 1], name="odometry")
    group = problem.add_residuals(RelativePose(measured, sigma=firm), poses[i], poses[j], name="closures")
    problem.fix(poses[0])
    return problem, poses, group, truth, is_outlier


def worst_position(solution, poses, truth):
    return np.linalg.norm(solution[poses][:, 4:] - truth[:, 4:], axis=1).max()


@pytest.mark.parametrize("outliers", [0.5, 0.6, 0.7])
def test_registration_from_a_bad_start_with_mostly_wrong_matches(outliers):
    reached = {"graduated": 0, "plain": 0}
    for seed in range(6):
        rng = np.random.default_rng(seed)
        p_source = rng.uniform(-1, 1, (100, 3))
        T = se3.exp(np.concatenate([rng.standard_normal(3), rng.uniform(-2, 2, 3)]))
        p_target = se3.act(T, p_source) + 0.01 * rng.standard_normal((100, 3))
        is_outlier = rng.permutation(100) < 100 * outliers
        p_target[is_outlier] = rng.uniform(-3, 3, (int(is_outlier.sum()), 3))
        problem = Problem()
        pose = problem.add_variables(SE3, SE3.identity()[None], name="T_target_source")
        group = problem.add_residuals(PointToPoint(p_source, p_target, sigma=0.01), pose[0], name="matches")
        found = graduate(problem, group)
        is_right = np.abs(SE3.boxminus(found.solution[pose][0], T)).max() < 0.02
        reached["graduated"] += is_right
        if is_right:
            assert (found.inliers["matches"] != ~is_outlier).sum() <= 3
        # The same loss from the same start, not graduated.
        group.set_loss(losses.GemanMcClure(found.thresholds["matches"]))
        reached["plain"] += np.abs(SE3.boxminus(problem.solve()[pose][0], T)).max() < 0.02
    assert reached["graduated"] == 6 and reached["plain"] <= 3


@pytest.mark.parametrize("outliers", [0.5, 0.6])
def test_closures_of_which_most_are_wrong(outliers):
    problem, poses, group, truth, is_outlier = drifting_ring(0, outliers)
    found = graduate(problem, group)
    assert worst_position(found.solution, poses, truth) < 0.5
    oracle = Problem()
    known = oracle.add_variables(SE3, truth)
    for own, rows in ((problem.groups[0], slice(None)), (group, ~is_outlier)):
        i, j = (c.rows[rows] for c in own.connections)
        oracle.add_residuals(RelativePose(own.residual.measured[rows], sigma=SIGMA[own.name]), known[i], known[j])
    oracle.fix(known[0])
    assert worst_position(found.solution, poses, oracle.solve()[known]) < 0.1
    assert (found.inliers["closures"] & is_outlier).sum() == 0
    assert (found.inliers["closures"] & ~is_outlier).sum() >= 0.9 * (~is_outlier).sum()
    assert found.weights["closures"][is_outlier].max() < 0.05
    assert [level.mu for level in found.levels] == sorted((level.mu for level in found.levels), reverse=True)
    assert found.levels[-1].mu == 1.0 and found.levels[-1].inliers == found.inliers["closures"].sum()


def test_rotation_averaging_from_a_start_without_meaning():
    rng = np.random.default_rng(1)
    truth = SO3.random(rng, 12)
    i, j = np.triu_indices(12, 1)
    R = truth.reshape(-1, 3, 3)
    measured = (np.swapaxes(R[i], 1, 2) @ R[j]).reshape(-1, 9)
    measured = SO3.boxplus(measured, 0.02 * rng.standard_normal((len(i), 3)))
    is_outlier = rng.permutation(len(i)) < 0.5 * len(i)
    measured[is_outlier] = SO3.random(rng, int(is_outlier.sum()))

    def error(A, B, Z):
        # Chordal: no logarithm that jumps at half a turn.
        r = np.zeros(9)
        for row in range(3):
            for column in range(3):
                predicted = 0.0
                for k in range(3):
                    for l in range(3):
                        predicted += A[3 * row + k] * Z[3 * k + l] * (1.0 if l == column else 0.0)
                r[3 * row + column] = predicted - B[3 * row + column]
        return r

    problem = Problem()
    start = truth.copy()
    start[1:] = SO3.random(rng, 11)
    rotations = problem.add_variables(SO3, start, name="rotations")
    residual = UserResidual(error, manifolds=(SO3, SO3), dim=9, data=(measured,), sigma=0.03)
    group = problem.add_residuals(residual, rotations[i], rotations[j], name="pairs")
    problem.fix(rotations[0])
    found = graduate(problem, [group], inlier_threshold=5.0)
    assert np.abs(SO3.boxminus(found.solution[rotations], truth)).max() < 0.05
    np.testing.assert_array_equal(found.inliers["pairs"], ~is_outlier)
    group.set_loss(losses.GemanMcClure(5.0))
    assert np.abs(SO3.boxminus(problem.solve()[rotations], truth)).max() > 0.5


def test_without_outliers_the_result_is_close_to_least_squares():
    problem, poses, group, _, _ = drifting_ring(2, 0.0)
    plain = problem.solve()
    found = graduate(problem, group)
    assert np.abs(SE3.boxminus(found.solution[poses], plain[poses])).max() < 0.05
    assert found.inliers["closures"].mean() > 0.95
    assert repr(group.loss) == f"GemanMcClure({found.thresholds['closures']:g})"
    assert problem.cost(found.solution) == pytest.approx(found.solution.cost, rel=1e-12)
    assert np.isfinite(found.solution.standard_deviations(poses)).all()


def test_options_hold_for_the_last_width():
    values = np.concatenate([np.random.default_rng(0).normal(2.0, 0.1, 20), [9.0, 9.1, -30.0]])[:, None]
    problem = Problem()
    x = problem.add_variables(Euclidean(1), [[50.0]], name="x")
    group = problem.add_residuals(Prior(Euclidean(1), values, sigma=0.1), x[0], name="readings")
    found = graduate(problem, group, method="gauss_newton", max_iterations=200)
    assert found.solution.method == "Gauss-Newton" and abs(found.solution[x][0, 0] - 2.0) < 0.1
    np.testing.assert_array_equal(np.flatnonzero(~found.inliers["readings"]), [20, 21, 22])
    problem.add_variables(Euclidean(1), [[0.0]], name="free")
    with pytest.raises(SingularProblemError, match=r"no residual touches free\[0\]"):
        graduate(problem, group, method="gauss_newton")


def test_wrong_use_is_refused():
    problem, _, group, _, _ = drifting_ring(0, 0.0, count=5, closures=4)
    other = drifting_ring(0, 0.0, count=5, closures=4)[2]
    for wrong, settings, message in (
        ([], {}, "groups of this problem"),
        (other, {}, "groups of this problem"),
        (group, {"inlier_threshold": 0.0}, "a positive inlier threshold"),
        (group, {"narrowing": 1.0}, "a narrowing above 1"),
    ):
        with pytest.raises(InputError, match=message):
            graduate(problem, wrong, **settings)


@pytest.mark.parametrize("loss", ["truncated", "geman_mcclure"])
def test_every_width_begins_at_the_start_and_tells_true_loops_from_false(loss):
    """From the minimum of the width before, both end in a folded map."""
    simulated = simulate_pose_graph(poses=400, seed=3, false_share=0.5, false_kind="mixed")
    problem, graph = Problem(), simulated.graph
    poses = problem.add_variables(SE2, graph.poses, name="poses")
    for name, rows in (("odometry", ~simulated.is_loop), ("loops", simulated.is_loop)):
        i, j = graph.edges[rows].T
        residual = RelativePose2D(graph.measurements[rows], information=graph.information[rows])
        problem.add_residuals(residual, poses[i], poses[j], name=name)
    problem.fix(poses[0])
    found = graduate(problem, problem.groups[1], loss=loss, inlier_threshold=4.5)
    right = ~simulated.is_false[simulated.is_loop]
    np.testing.assert_array_equal(found.inliers["loops"], right)
    report = found.reports["loops"]
    assert (report.kept, report.refused) == (right.sum(), (~right).sum()) and report.close == 0
    assert 0.3 < report.mean_square < 1.0 and report.purity > 0.95
    assert f"{right.sum()} of 400 loops kept" in report.sentence("loops")
    np.testing.assert_allclose(report.innovations**2, problem.groups[1].squares(found.solution.values))
    if loss == "truncated":
        np.testing.assert_array_equal(found.weights["loops"], right.astype(float))
        assert found.levels[-1].undecided == 0


def test_a_report_tells_bent_outliers_by_the_tail():
    rng = np.random.default_rng(0)
    clean = rng.chisquare(3, 5000)
    assert inlier_report(clean, 3, 4.0).purity > 0.98
    bent = np.concatenate([clean, rng.uniform(0.0, 4.0, 1000) ** 2])
    spoiled = inlier_report(bent, 3, 4.0)
    assert 0.83 < spoiled.purity < 0.95
    refused = inlier_report(np.array([1.0, 17.0, 1e6, np.inf]), 3, 4.0)
    assert (refused.kept, refused.refused, refused.close) == (1, 3, 1)


def test_a_hopeless_residual_may_begin_with_weight_zero():
    values = np.array([2.0, 2.1, 1.9, 2.05, 50.0])[:, None]
    problem = Problem()
    x = problem.add_variables(Euclidean(1), [[0.0]], name="x")
    group = problem.add_residuals(Prior(Euclidean(1), values, sigma=0.1), x[0], name="readings")
    found = graduate(problem, group, loss="truncated", weights={"readings": [1.0, 1.0, 0.0, 1.0, 0.0]})
    np.testing.assert_array_equal(found.inliers["readings"], [True, True, True, True, False])  # taken up again
    assert found.solution[x][0, 0] == pytest.approx(values[:4].mean(), rel=1e-9)
    for wrong in ({"readings": [1.0]}, {"readings": [2.0] * 5}, {"others": [1.0]}):
        with pytest.raises(InputError, match="weights"):
            graduate(problem, group, weights=wrong)
    with pytest.raises(InputError, match="geman_mcclure or truncated"):
        graduate(problem, group, loss="tukey")
