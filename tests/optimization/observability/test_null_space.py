"""Null spaces of random linear problems against NumPy's, with what they move and the covariances that remain."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus import Euclidean, Problem, SingularProblemError
from boxplus.optimization.linear_systems.elimination import choose_system
from boxplus.optimization.linear_systems.least_squares import LeastSquares
from boxplus.optimization.observability.null_space import find_null_space
from boxplus.optimization.solver_options import SolverOptions
from boxplus.optimization.terms.layout import Layout
from boxplus.residuals.residual import Residual
from boxplus.residuals.whitening import Whitening
from tests.optimization.conftest import dense_normal_equations, make_ring


class Linear(Residual):
    """r = A x_a + B x_b + c with matrices of one's own for every residual."""

    def __init__(self, A, B, c):
        self.A, self.B, self.c = A, B, c
        super().__init__(
            dim=A.shape[1],
            count=len(A),
            manifolds=(Euclidean(A.shape[2]), Euclidean(B.shape[2])),
            roles=("a", "b"),
            whitening=Whitening.of(A.shape[1], len(A)),
        )

    def evaluate_into(self, begin, end, x, index, r, valid):
        a, b = x[0][index[0][begin:end]], x[1][index[1][begin:end]]
        r[begin:end] = np.einsum("nij,nj->ni", self.A[begin:end], a) + np.einsum("nij,nj->ni", self.B[begin:end], b)
        r[begin:end] += self.c[begin:end]
        valid[begin:end] = True

    def linearize_into(self, begin, end, x, index, r, jacobians, valid):
        self.evaluate_into(begin, end, x, index, r, valid)
        jacobians[0][begin:end], jacobians[1][begin:end] = self.A[begin:end], self.B[begin:end]


def random_problem(seed: int) -> Problem:
    """Two blocks, few residuals of dimension 1 or 2, units far apart, some variables fixed, some only measured in part."""
    rng = np.random.default_rng(seed)
    problem = Problem()
    widths = rng.integers(1, 4, 2)
    counts = rng.integers(1, 6, 2)
    blocks = [
        problem.add_variables(Euclidean(int(w)), rng.standard_normal((n, w)), name=name)
        for w, n, name in zip(widths, counts, "uv", strict=True)
    ]
    units = [10.0 ** rng.uniform(-3, 3, w) for w in widths]
    for _ in range(rng.integers(1, 4)):
        a, b = rng.integers(0, 2, 2)
        n, dim = int(rng.integers(1, 8)), int(rng.integers(1, 3))
        i, j = rng.integers(0, counts[a], n), rng.integers(0, counts[b], n)
        if a == b:  # one variable in both places may cancel to rounding
            i, j = i[i != j], j[i != j]
            n = len(i)
        if not n:
            continue
        kind = rng.integers(0, 3)
        A, B = rng.standard_normal((n, dim, widths[a])), rng.standard_normal((n, dim, widths[b]))
        if kind == 0 and widths[a] == widths[b]:
            B = -A  # only differences are measured
        if kind == 1:
            A[:, :, 0] = 0.0
        A, B = A * units[a], B * units[b]
        problem.add_residuals(Linear(A, B, rng.standard_normal((n, dim))), blocks[a][i], blocks[b][j])
    if rng.random() < 0.5:
        problem.fix(blocks[0][0])
    return problem


def model_of(problem: Problem, linear_solver: str = "dense") -> LeastSquares:
    layout = Layout(problem.blocks)
    model = LeastSquares(
        layout, problem.groups, choose_system(layout, problem.groups, SolverOptions(linear_solver=linear_solver)), 1
    )
    model.start([block.values for block in problem.blocks])
    return model


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_random_problems(seed):
    problem = random_problem(seed)
    layout = Layout(problem.blocks)
    if layout.dof == 0 or not problem.groups:
        return
    model = model_of(problem)
    H, g = dense_normal_equations(problem)
    scale = np.sqrt(np.where(np.diag(H) > 0.0, np.diag(H), 1.0))
    curvature, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    if ((curvature > 1e-12) & (curvature < 1e-6)).any():
        return  # neither clearly determined nor clearly free
    free = vectors[:, curvature < 1e-12] / scale[:, None]
    space = find_null_space(model)
    assert len(space.pivots) == free.shape[1] == len(np.unique(space.pivots))
    assert space.is_empty == (free.shape[1] == 0)
    if free.shape[1]:
        scaled = np.abs(free * scale[:, None])
        share = np.maximum(np.abs(free) / np.abs(free).max(), scaled / scaled.max()).max(axis=1)
        reach = np.array([share[layout.start[k] : layout.start[k + 1]].max() for k in range(len(layout.sizes))])
        clear = (reach > 1e-4) | (reach < 1e-9)
        np.testing.assert_array_equal(space.moves[clear], reach[clear] > 1e-4)

    solution = problem.solve(linear_solver="dense")
    pseudo = np.linalg.pinv(H / np.outer(scale, scale), rcond=1e-9, hermitian=True) / np.outer(scale, scale)
    for block, number in zip(problem.blocks, layout.number, strict=True):
        for row in np.flatnonzero(number >= 0):
            k = number[row]
            own = slice(layout.start[k], layout.start[k + 1])
            if space.moves[k]:
                with pytest.raises(SingularProblemError, match="the problem does not determine its variables: "):
                    solution.covariance(block[int(row)])
            else:
                expected = pseudo[own, own]
                tolerance = 1e-5 * np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
                assert (np.abs(solution.covariance(block[int(row)])[0] - expected) <= tolerance + 1e-300).all()

    if free.shape[1] and np.abs(g).max() > 1e-6 * np.abs(H).max():
        with pytest.raises(SingularProblemError):
            problem.solve(method="gauss_newton", linear_solver="dense")


@pytest.mark.parametrize("linear_solver", ["dense", "sparse"])
def test_directions_are_free_and_apart(linear_solver):
    ring = make_ring(7)
    model = model_of(ring.problem, linear_solver)
    (shared,) = find_null_space(model).shared
    assert shared.directions.shape == (42, 6) and shared.is_complete
    for direction in shared.directions.T:
        v = np.zeros(42)
        v[shared.index] = direction
        assert model.curvature(v) < 1e-18 * float(v @ (model.system.diagonal * v))


def test_null_spaces_are_the_same_on_every_run():
    found = [find_null_space(model_of(make_ring(9).problem, "sparse")) for _ in range(2)]
    assert found[0].shared[0].directions.tobytes() == found[1].shared[0].directions.tobytes()
