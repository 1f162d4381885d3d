"""What speaks against a solution: residuals that stand out, a χ² that nothing promises, Jacobians that are wrong."""

from __future__ import annotations

import numpy as np
import pytest

import boxplus as bp
from boxplus.residuals import Prior, UserResidual

PLANE = bp.Euclidean(2)
TRUTH = np.array([[1.0, 2.0], [-3.0, 4.0]])
SIGMA = 0.05


def distance(x, beacon, z):
    return np.hypot(x[0] - beacon[0], x[1] - beacon[1]) - z


def right(x, beacon, z, J):
    r = np.hypot(x[0] - beacon[0], x[1] - beacon[1])
    J[0, 0], J[0, 1] = (x[0] - beacon[0]) / r, (x[1] - beacon[1]) / r


def not_normalised(x, beacon, z, J):
    J[0, 0], J[0, 1] = x[0] - beacon[0], x[1] - beacon[1]


def halved(x, beacon, z, J):
    r = np.hypot(x[0] - beacon[0], x[1] - beacon[1])
    J[0, 0], J[0, 1] = 0.5 * (x[0] - beacon[0]) / r, 0.5 * (x[1] - beacon[1]) / r


def without_a_column(x, beacon, z, J):
    r = np.hypot(x[0] - beacon[0], x[1] - beacon[1])
    J[0, 0] = (x[0] - beacon[0]) / r


class Height(bp.residuals.Residual):
    """A residual of somebody's own class, whose Jacobian is `slope`."""

    def __init__(self, z, slope):
        self.z, self.slope = np.asarray(z, dtype=float), slope
        whitening = bp.residuals.Prior(bp.Euclidean(1), self.z[:, None], sigma=0.1).whitening
        super().__init__(dim=1, count=len(self.z), manifolds=(bp.Euclidean(1),), roles=("h",), whitening=whitening)

    def evaluate_into(self, begin, end, x, index, r, valid):
        r[begin:end, 0] = x[0][index[0][begin:end], 0] ** 2 - self.z[begin:end]
        valid[begin:end] = True

    def linearize_into(self, begin, end, x, index, r, jacobians, valid):
        self.evaluate_into(begin, end, x, index, r, valid)
        jacobians[0][begin:end, 0, 0] = self.slope * x[0][index[0][begin:end], 0]


def beacons(seed, jacobian=None, scale=1.0, sigma=SIGMA, wrong=None, loss=None):
    """Two places by their distances from twelve beacons each."""
    rng = np.random.default_rng(seed)
    at = np.tile(rng.uniform(-10.0, 10.0, (12, 2)), (2, 1))
    of = np.repeat([0, 1], 12)
    z = np.hypot(*(at - TRUTH[of]).T) + SIGMA * rng.standard_normal(24)
    if wrong is not None:
        z[wrong] += 4.0
    problem = bp.Problem()
    x = problem.add_variables(PLANE, scale * np.zeros((2, 2)), name="x")
    residual = UserResidual(
        distance, dim=1, manifolds=(PLANE,), data=(scale * at, scale * z), sigma=scale * sigma, jacobian=jacobian
    )
    problem.add_residuals(residual, x[of], name="ranges", loss=loss)
    return problem


def wrong_jacobians(solution):
    return [note for note in solution.notes if "contradict differences" in note]


@pytest.mark.parametrize("jacobian", [not_normalised, halved, without_a_column])
def test_a_jacobian_of_ones_own_that_is_wrong_is_told_wherever_the_search_ends(jacobian):
    for seed in (0, 1):
        (note,) = wrong_jacobians(beacons(seed, jacobian).solve())
        assert note.startswith("ranges: the Jacobians of 1") and "see check_jacobian" in note


@pytest.mark.parametrize("jacobian", [right, None, "differences"])
@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1.0, 1e3, 1e6])
def test_one_that_is_right_is_not_whatever_the_unit(jacobian, scale):
    solution = beacons(0, jacobian, scale).solve()
    assert wrong_jacobians(solution) == [] and solution.doubts() == ()


@pytest.mark.parametrize(("slope", "is_wrong"), [(2.0, False), (1.0, True), (-2.0, True)])
def test_classes_of_ones_own_are_looked_at_too(slope, is_wrong):
    problem = bp.Problem()
    h = problem.add_variables(bp.Euclidean(1), [1.5], name="h")
    problem.add_residuals(Height(np.linspace(3.9, 4.1, 40), slope), h[np.zeros(40, dtype=int)], name="heights")
    assert bool(wrong_jacobians(problem.solve())) == is_wrong


def test_wrong_measurements_under_least_squares_are_doubted():
    for seed in range(6):
        assert beacons(seed).solve().doubts() == ()
        solution = beacons(seed, wrong=[3]).solve()
        assert any("times what the standard deviations promise" in doubt for doubt in solution.doubts())
        assert solution.doubts()[0] in solution.summary()
        assert beacons(seed, wrong=[3], loss=bp.losses.Cauchy(2.385)).solve().doubts() == ()


def test_residuals_that_stand_out_are_listed_the_largest_first():
    rng = np.random.default_rng(3)
    measured = 2.0 + 0.1 * rng.standard_normal((200, 1))
    measured[[17, 40]] = [[9.0], [7.0]]
    for noise in ({"sigma": 0.1}, {}):  # judged by the others where no standard deviation is given
        problem = bp.Problem()
        x = problem.add_variables(bp.Euclidean(1), [0.0], name="x")
        problem.add_residuals(Prior(bp.Euclidean(1), measured, **noise), x[np.zeros(200, dtype=int)], name="levels")
        doubts = problem.solve().doubts()
        assert doubts[0].startswith("2 of the 200 residuals of levels (17, 40) are up to ")
        assert len(doubts) == (2 if noise else 1)


def test_standard_deviations_that_are_too_small_are_doubted():
    (doubt,) = beacons(1, sigma=SIGMA / 10.0).solve().doubts()
    assert doubt.startswith("χ² is ") and "20 degrees of freedom" in doubt
    assert beacons(1, sigma=SIGMA * 10.0).solve().doubts() == ()


def test_a_way_down_that_nan_blocks_is_called_that():
    def root(x, z):
        return np.sqrt(x[0] - 1.0) - z

    problem = bp.Problem()
    x = problem.add_variables(bp.Euclidean(1), [1.5], name="x")
    problem.add_residuals(UserResidual(root, dim=1, manifolds=(bp.Euclidean(1),), data=([-1.0],), sigma=0.1), x)
    solution = problem.solve()
    assert solution.status == "stalled" and "lead to residuals that are NaN or infinite" in solution.reason
    assert solution[x][0, 0] >= 1.0


def test_an_incremental_problem_says_what_speaks_against_its_estimate():
    for wrong, loss in ((False, None), (True, None), (True, bp.losses.Tukey(4.685))):
        rng = np.random.default_rng(5)
        problem = bp.IncrementalProblem()
        poses = problem.add_variables(bp.SE2, [0.0, 0.0, 0.0], fixed=True, name="poses")
        step = np.array([np.pi / 2.0, 1.0, 0.0])
        for k in range(1, 40):
            measured = bp.SE2.boxplus(step, 0.01 * rng.standard_normal(3))
            new = problem.extend(poses, bp.manifolds.se2.compose(problem.estimate(poses[k - 1])[0], measured))
            problem.add_residuals(bp.residuals.RelativePose2D(measured, sigma=0.01), poses[k - 1], new, name="odometry")
            if k >= 4:
                closed = 0.01 * rng.standard_normal(3) + ([0.0, 3.0, 0.0] if wrong and k == 20 else [0.0, 0.0, 0.0])
                problem.add_residuals(bp.residuals.RelativePose2D(closed, sigma=0.01), poses[k - 4], new, loss=loss, name="loops")
            problem.update()
        doubts = problem.solution().doubts
        if not wrong:
            assert doubts == ()
        elif loss is None:
            assert any("loops" in doubt for doubt in doubts) and any("promise" in doubt for doubt in doubts)
        else:  # loop closures that were refused on the way are not taken up again
            assert any("of the residuals of loops have weight below" in doubt for doubt in doubts)
