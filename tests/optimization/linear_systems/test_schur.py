"""Schur elimination of problems that bundle adjustment does not show: mixed sizes, several groups, fixed and invalid rows."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus import Euclidean, Problem, losses
from boxplus.residuals import Residual
from boxplus.residuals.whitening import Whitening
from tests.optimization.conftest import dense_normal_equations
from tests.optimization.linear_systems.test_linear_systems import inverse_blocks, model_of


class Bent(Residual):
    """r = t + sin 3t − b with t = Σ Aₛ xₛ, some rows singular: nonlinear enough for steps to be rejected."""

    def __init__(self, rng, dim, sizes, count, invalid=0.0):
        super().__init__(
            dim=dim,
            count=count,
            manifolds=tuple(Euclidean(size) for size in sizes),
            roles=tuple(f"x{k}" for k in range(len(sizes))),
            whitening=Whitening.of(dim, count, sigma=0.5),
            fixes_gauge=True,
        )
        self.A = [rng.standard_normal((count, dim, size)) for size in sizes]
        self.b = rng.standard_normal((count, dim))
        self.is_valid = rng.random(count) >= invalid

    def _sum(self, begin, end, x, index):
        return sum(np.einsum("nij,nj->ni", A[begin:end], v[k[begin:end]]) for A, v, k in zip(self.A, x, index, strict=True))

    def evaluate_into(self, begin, end, x, index, r, valid):
        t = self._sum(begin, end, x, index)
        valid[begin:end] = self.is_valid[begin:end]
        r[begin:end] = np.where(valid[begin:end, None], t + np.sin(3.0 * t) - self.b[begin:end], 0.0)

    def linearize_into(self, begin, end, x, index, r, jacobians, valid):
        self.evaluate_into(begin, end, x, index, r, valid)
        slope = (1.0 + 3.0 * np.cos(3.0 * self._sum(begin, end, x, index))) * valid[begin:end, None]
        for A, J in zip(self.A, jacobians, strict=True):
            J[begin:end] = slope[:, :, None] * A[begin:end]


def make(seed: int, points: int = 60, cameras: int = 12, observations: int = 600, spread: float = 0.1) -> Problem:
    """Points seen by cameras with shared intrinsics, in four groups; blocks in random order, some variables fixed."""
    rng = np.random.default_rng(seed)
    problem, blocks = Problem(), {}
    sizes = {"cameras": (6, cameras), "points": (3, points), "intrinsics": (4, 3), "others": (6, 5)}
    for name in rng.permutation(list(sizes)):
        size, count = sizes[name]
        blocks[name] = problem.add_variables(Euclidean(size), spread * rng.standard_normal((count, size)), name=str(name))

    def rows(name, count):
        return blocks[name][rng.integers(0, len(blocks[name]), count)]

    n, half = observations, observations // 2
    loss = losses.Huber(0.5)
    seen = Bent(rng, 2, (6, 3, 4), n, invalid=0.1)
    problem.add_residuals(seen, rows("cameras", n), rows("points", n), rows("intrinsics", n), loss=loss)
    # Two kept variables of one size, now and then the same one.
    problem.add_residuals(Bent(rng, 3, (3, 6, 6), half), rows("points", half), rows("cameras", half), rows("cameras", half))
    problem.add_residuals(Bent(rng, 3, (3, 6, 6), half), rows("points", half), rows("cameras", half), rows("others", half))
    for name, (size, count) in sizes.items():
        problem.add_residuals(Bent(rng, size, (size,), count), blocks[name], name=f"prior of {name}")
    problem.fix(blocks["points"][rng.random(points) < 0.2])
    for name, fixed in (("cameras", [0, cameras - 1]), ("intrinsics", [1]), ("others", [2])):
        problem.fix(blocks[name][fixed])
    return problem


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("solver", ["dense", "sparse", "schur"])
def test_steps_and_inverse_blocks(seed, solver):
    problem = make(seed)
    model = model_of(problem, solver)
    H, g = dense_normal_equations(problem)
    for damping in (None, np.linspace(0.1, 2.0, len(g))):
        whole = H if damping is None else H + np.diag(damping)
        np.testing.assert_allclose(model.solve(damping), np.linalg.solve(whole, -g), atol=1e-9)
        inverse, start = np.linalg.inv(whole), model.layout.start
        pairs = np.random.default_rng(0).integers(0, len(start) - 1, (60, 2))
        pairs[:9, 1] = pairs[:9, 0]
        for (i, j), block in zip(pairs, inverse_blocks(model, *pairs.T), strict=True):
            np.testing.assert_allclose(block, inverse[start[i] : start[i + 1], start[j] : start[j + 1]], atol=1e-9)


def test_blocks_of_the_inverse_are_symmetric_and_the_same_bits_on_several_threads():
    found = []
    for threads in (1, 3):
        model = make(1).solve(linear_solver="schur", threads=threads, max_iterations=2, initial_damping=1e-9)._problem
        model.solve(None)
        every = np.arange(len(model.layout.sizes))
        found.append([*inverse_blocks(model, every, every), *inverse_blocks(model, every[:-1], every[1:])])
        assert len(model.system.inverse_values(every[:0], every[:0])) == 0
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)
    for block in found[0][: len(every)]:
        np.testing.assert_array_equal(block, block.T)


@pytest.mark.parametrize("method", ["levenberg_marquardt", "dogleg"])
def test_rejected_steps_leave_no_trace(method):
    """A rejected step overwrites the Jacobians, which the elimination reads again for the next damping."""
    tried = {}
    for solver in ("dense", "sparse", "schur"):
        solution = make(seed=0, spread=0.5).solve(linear_solver=solver, method=method, max_iterations=20, initial_damping=1e-9)
        tried[solver] = solution.history
    accepted = [step.accepted for step in tried["dense"]]
    assert not all(accepted)
    for history in tried.values():
        assert [step.accepted for step in history] == accepted
        costs = [step.tried_cost for step in history]
        np.testing.assert_allclose(costs, [step.tried_cost for step in tried["dense"]], rtol=1e-6)


def test_mixed_sizes_on_several_threads_give_the_same_bits():
    results = []
    for threads in (1, 2, 4):
        problem = make(1, points=5000, cameras=40, observations=12_000)
        solution = problem.solve(linear_solver="schur", threads=threads, max_iterations=5, initial_damping=1e-9)
        results.append(b"".join(values.tobytes() for values in solution.values))
    assert results[0] == results[1] == results[2]
