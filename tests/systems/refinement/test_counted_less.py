"""The covariance of an estimate whose residuals count less than they are worth, against many estimates from noise."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.manifolds.euclidean import Euclidean
from boxplus.optimization.problem import Problem
from boxplus.optimization.solver_options import SolverOptions
from boxplus.residuals.prior import Prior
from boxplus.systems.refinement.counted_less import covariances_of

PLANE = Euclidean(2)


@pytest.mark.parametrize("seed", range(6))
def test_it_is_the_product_of_three(seed: int) -> None:
    """Measurements of one variable with information of any shape, some counted for less: H⁻¹ M H⁻¹ in closed form."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(9, 2, 2))
    information = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(2)
    w = np.where(random.uniform(size=9) < 0.5, random.uniform(0.05, 1.0, 9), 1.0)
    w[0] = 0.3
    problem = Problem()
    x = problem.add_variables(PLANE, np.zeros(2), name="x")
    # As refinement does: the weight is in the information already.
    less = problem.add_residuals(
        Prior(PLANE, random.normal(size=(9, 2)), information=w[:, None, None] * information), x[np.zeros(9, int)]
    )
    full = problem.add_residuals(Prior(PLANE, random.normal(size=2), information=2.0 * np.eye(2)), x)
    off = problem.add_residuals(Prior(PLANE, random.normal(size=2), information=50.0 * np.eye(2)), x)
    held = {off: np.zeros(1)}
    problem.set_weights(off, held[off])
    options = SolverOptions()
    y = problem.add_variables(PLANE, np.zeros(2), name="y")
    problem.add_residuals(Prior(PLANE, random.normal(size=2), information=4.0 * np.eye(2)), y)
    solution = problem.solve(options)
    before = solution.covariance(x)
    x_found, y_found = covariances_of(problem, solution, [x, y], {less: w}, held, options)
    found = x_found[0]
    H = (w[:, None, None] * information).sum(axis=0) + 2.0 * np.eye(2)
    M = (w[:, None, None] ** 2 * information).sum(axis=0) + 2.0 * np.eye(2)
    expected = np.linalg.inv(H) @ M @ np.linalg.inv(H)
    np.testing.assert_allclose(found, expected, rtol=0.02, atol=0.02 * np.abs(expected).max())
    assert (np.linalg.eigvalsh(found) < np.linalg.eigvalsh(np.linalg.inv(H))).all()
    np.testing.assert_allclose(y_found[0], 0.25 * np.eye(2), rtol=1e-9)
    # The solution itself is what it was: it was asked under other weights afterwards, and claimed 1.1 times the information.
    np.testing.assert_allclose(solution.covariance(x), before, rtol=1e-12)
    del full


def test_what_counts_in_full_has_the_inverse() -> None:
    problem = Problem()
    x = problem.add_variables(PLANE, np.zeros(2), name="x")
    group = problem.add_residuals(Prior(PLANE, np.ones(2), sigma=[0.5, 2.0]), x)
    options = SolverOptions()
    solution = problem.solve(options)
    (found,) = covariances_of(problem, solution, [x], {group: np.ones(1)}, {}, options)
    np.testing.assert_array_equal(found, solution.covariance(x))
