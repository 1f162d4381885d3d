"""Dense, sparse and Schur systems: each against NumPy on the same Jacobians, with and without damping."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus import SE3Left, SingularProblemError
from boxplus.optimization.linear_systems.elimination import choose_system
from boxplus.optimization.linear_systems.least_squares import LeastSquares
from boxplus.optimization.solver_options import SolverOptions
from boxplus.optimization.terms.layout import Layout
from boxplus.residuals import Prior
from boxplus.sparse.inverse_blocks import split_blocks
from tests.optimization.conftest import dense_normal_equations, make_ring, make_scene


def model_of(problem, linear_solver):
    layout = Layout(problem.blocks)
    options = SolverOptions(linear_solver=linear_solver)
    model = LeastSquares(layout, problem.groups, choose_system(layout, problem.groups, options), 1)
    model.start([block.values for block in problem.blocks])
    return model


def problems():
    scene = make_scene()
    scene.problem.fix(scene.points[[4, 7]])
    scene.problem.add_residuals(Prior(SE3Left, scene.cameras.values[3:], sigma=0.1), scene.cameras[3:])
    ring = make_ring()
    ring.problem.fix(ring.poses[3])
    return {"scene": scene.problem, "ring": ring.problem}


def inverse_blocks(model, first, second):
    """Of H⁻¹ for pairs of variables."""
    sizes = model.layout.sizes
    return split_blocks(model.system.inverse_values(first, second), sizes[first], sizes[second])


@pytest.mark.parametrize(
    ("name", "solver"), [(n, s) for n in ("scene", "ring") for s in ("dense", "sparse", "schur") if (n, s) != ("ring", "schur")]
)
@pytest.mark.parametrize("damped", [False, True])
def test_steps_and_inverse_blocks_equal_those_of_the_dense_matrix(name, solver, damped):
    problem = problems()[name]
    model = model_of(problem, solver)
    H, g = dense_normal_equations(problem)
    np.testing.assert_allclose(model.system.gradient, g, rtol=1e-10, atol=1e-9 * np.abs(g).max())
    np.testing.assert_allclose(model.system.diagonal, np.diag(H), rtol=1e-12)
    D = np.linspace(0.1, 2.0, len(g)) * np.diag(H) if damped else None
    whole = H + np.diag(D) if damped else H
    np.testing.assert_allclose(model.solve(D), np.linalg.solve(whole, -g), rtol=1e-7, atol=1e-10)
    inverse = np.linalg.inv(whole)
    start = model.layout.start
    pairs = np.random.default_rng(0).integers(0, len(start) - 1, (40, 2))
    pairs[:5, 1] = pairs[:5, 0]
    for (i, j), block in zip(pairs, inverse_blocks(model, *pairs.T), strict=True):
        expected = inverse[start[i] : start[i + 1], start[j] : start[j + 1]]
        np.testing.assert_allclose(block, expected, rtol=1e-6, atol=1e-8 * np.abs(inverse).max())


def test_schur_is_chosen_for_scenes_and_refused_where_it_is_impossible():
    scene = make_scene(points=100)
    assert "Schur elimination of 100 'points'" in scene.problem.solve().linear_solver
    ring = make_ring()
    ring.problem.fix(ring.poses[0])
    with pytest.raises(ValueError, match="no two of which share a residual"):
        ring.problem.solve(linear_solver="schur")
    assert "dense" in ring.problem.solve().linear_solver
    assert "sparse" in make_ring(40).problem.solve().linear_solver


def test_covariance_is_the_inverse_of_the_normal_matrix_and_zero_where_known():
    scene = make_scene()
    for solver in ("dense", "sparse", "schur"):
        solution = scene.problem.solve(linear_solver=solver)
        covariance = solution.covariance(scene.points[[0, 5]])
        cross = solution.covariance(scene.points[[0, 5]], scene.cameras[[3, 4]])
        known = solution.covariance(scene.cameras[[0]])
        for group in scene.problem.groups:
            group.linearize(solution.values, 1)
        inverse = np.linalg.inv(dense_normal_equations(scene.problem)[0])
        at = 6 * 3  # three free cameras come first
        np.testing.assert_allclose(covariance[1], inverse[at + 15 : at + 18, at + 15 : at + 18], rtol=1e-6)
        np.testing.assert_allclose(cross[0], inverse[at : at + 3, 6:12], rtol=1e-6, atol=1e-12)
        np.testing.assert_array_equal(known, np.zeros((1, 6, 6)))


def test_covariance_of_an_unobservable_direction_is_refused_with_its_name():
    scene = make_scene()
    scene.problem.free(scene.cameras)
    solution = scene.problem.solve()
    with pytest.raises(SingularProblemError, match=r"no covariance of points\[0\].* any rigid motion and the scale of them"):
        solution.covariance(scene.points[0])
