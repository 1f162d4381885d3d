"""The sparse Cholesky factorisation against dense linear algebra and scipy."""

import re
from pathlib import Path

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from boxplus.errors import InputError
from boxplus.formats.graphs.g2o import read_g2o
from boxplus.sparse import numeric_factor, subtrees
from boxplus.sparse.block_matrix import BlockPattern
from boxplus.sparse.cholesky import Analyses, NotPositiveDefinite, SparseCholesky


def random_matrix(seed: int, sizes: list[int], pairs: int) -> tuple[BlockPattern, NDArray[np.float64], NDArray[np.float64]]:
    """A positive definite matrix with random blocks: pattern, values, dense."""
    rng = np.random.default_rng(seed)
    n = len(sizes)
    i, j = (rng.integers(0, n, pairs), rng.integers(0, n, pairs)) if n else (np.zeros(0, int), np.zeros(0, int))
    pattern, _ = BlockPattern.from_pairs(sizes, i, j)
    return (pattern, *positive_definite(pattern, rng))


def positive_definite(pattern: BlockPattern, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Random values that make a pattern's matrix diagonally dominant, and the dense matrix."""
    values = rng.normal(size=pattern.value_start[-1])
    dense = pattern.to_scipy(values).toarray()
    diagonal = np.abs(dense).sum(axis=1) + rng.uniform(0.1, 1.0, len(dense))
    for k, size in enumerate(pattern.sizes):
        block = values[pattern.value_start[pattern.col_start[k]] :][: size * size].reshape(size, size)
        block[np.triu_indices(size, 1)] = np.nan  # never read
        np.fill_diagonal(block, diagonal[pattern.start[k] : pattern.start[k + 1]])
    return values, pattern.to_scipy(values).toarray()


def check(pattern: BlockPattern, values: NDArray[np.float64], dense: NDArray[np.float64], **options: object) -> SparseCholesky:
    cholesky = SparseCholesky(pattern, **options)  # type: ignore[arg-type]
    cholesky.factorize(values)
    rng = np.random.default_rng(1)
    for shape in ((len(dense),), (len(dense), 1), (len(dense), 5)):
        b = rng.normal(size=shape)
        np.testing.assert_allclose(dense @ cholesky.solve(b), b, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(cholesky.log_determinant(), np.linalg.slogdet(dense)[1], rtol=1e-12, atol=1e-12)
    return cholesky


@given(seed=st.integers(0, 10**6), sizes=st.lists(st.integers(1, 9), max_size=30), density=st.floats(0.0, 4.0))
def test_solves_any_block_matrix(seed: int, sizes: list[int], density: float) -> None:
    check(*random_matrix(seed, sizes, int(density * len(sizes))))


@pytest.mark.parametrize("ordering", ["auto", "nested_dissection", "minimum_degree", "natural"])
def test_every_ordering_solves(ordering: str) -> None:
    check(*random_matrix(3, [6] * 80, 160), ordering=ordering)


@given(seed=st.integers(0, 10**6))
def test_any_permutation_solves(seed: int) -> None:
    check(*random_matrix(seed, [3] * 20, 40), ordering=np.random.default_rng(seed).permutation(20))


SHAPES = {
    "empty": ([], [], []),
    "single block": ([7], [], []),
    "diagonal": ([2, 3, 6, 1], [], []),
    "dense": ([6] * 40, *np.tril_indices(40)),
    "one dense block of 300": ([300], [], []),
    "arrow to the first": ([6] * 60, range(60), [0] * 60),
    "arrow to the last": ([3] * 60, range(60), [59] * 60),
    "chain": ([6] * 200, range(199), range(1, 200)),
    "two components": ([5] * 20, [*range(9), *range(10, 19)], [*range(1, 10), *range(11, 20)]),
    "grid": (
        [6] * 400,
        [k for k in range(400) if k % 20 < 19] + list(range(380)),
        [k + 1 for k in range(400) if k % 20 < 19] + list(range(20, 400)),
    ),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_solves_special_structures(shape: str) -> None:
    pattern, _ = BlockPattern.from_pairs(*SHAPES[shape])
    check(pattern, *positive_definite(pattern, np.random.default_rng(0)))


def test_many_factorisations_with_one_analysis_are_the_same_bits() -> None:
    pattern, values, dense = random_matrix(5, [6, 3] * 60, 300)
    cholesky, b = SparseCholesky(pattern), np.ones(len(dense))
    cholesky.factorize(values)
    first = cholesky.solve(b)
    cholesky.factorize(4.0 * values)
    np.testing.assert_array_equal(cholesky.solve(b), first / 4.0)
    cholesky.factorize(values)
    np.testing.assert_array_equal(cholesky.solve(b), first)


@pytest.mark.parametrize("diagonal", [2.5, np.linspace(0.0, 3.0, 90)])
def test_adds_damping_to_the_diagonal(diagonal: float | NDArray[np.float64]) -> None:
    pattern, values, dense = random_matrix(6, [3] * 30, 60)
    cholesky = SparseCholesky(pattern)
    kept = values.copy()
    cholesky.factorize(values, diagonal=diagonal)
    damped = dense + np.diag(np.broadcast_to(diagonal, 90))
    b = np.ones(90)
    np.testing.assert_allclose(damped @ cholesky.solve(b), b, rtol=1e-10)
    np.testing.assert_array_equal(values, kept)


@pytest.mark.parametrize("bad", [-1.0, 0.0, np.nan, np.inf])
@pytest.mark.parametrize("block", [0, 7, 29])
def test_names_the_variable_that_is_not_determined(bad: float, block: int) -> None:
    pattern, _ = BlockPattern.from_pairs([3] * 30, [], [])
    values = np.tile(np.eye(3).ravel(), 30)
    values[9 * block + 4] = bad
    cholesky = SparseCholesky(pattern)
    with pytest.raises(NotPositiveDefinite, match=f"degree of freedom 1 of variable {block} – ") as caught:
        cholesky.factorize(values)
    assert (caught.value.block, caught.value.component) == (block, 1)
    np.testing.assert_equal(caught.value.pivot, bad)
    with pytest.raises(InputError, match="call factorize first"):
        cholesky.solve(np.ones(90))
    cholesky.factorize(np.tile(np.eye(3).ravel(), 30))
    np.testing.assert_array_equal(cholesky.solve(np.ones(90)), 1.0)


def test_refuses_what_does_not_fit() -> None:
    pattern, values, _ = random_matrix(7, [2] * 5, 5)
    with pytest.raises(InputError, match="permutation of 0 … 4"):
        SparseCholesky(pattern, ordering=np.array([0, 1, 2, 3, 3]))
    cholesky = SparseCholesky(pattern)
    with pytest.raises(InputError, match="call factorize first"):
        cholesky.log_determinant()
    with pytest.raises(InputError, match=f"expected {len(values)} values"):
        cholesky.factorize(values[1:])
    cholesky.factorize(values)
    with pytest.raises(InputError, match="right-hand side of 10 rows"):
        cholesky.solve(np.ones(9))


@given(seed=st.integers(0, 10**6), sizes=st.lists(st.integers(1, 7), min_size=1, max_size=25), density=st.floats(0.0, 3.0))
def test_blocks_of_the_inverse(seed: int, sizes: list[int], density: float) -> None:
    pattern, values, dense = random_matrix(seed, sizes, int(density * len(sizes)))
    cholesky = SparseCholesky(pattern)
    cholesky.factorize(values)
    inverse, start = np.linalg.inv(dense), pattern.start
    rng = np.random.default_rng(seed)
    every = np.arange(len(sizes))
    for i, j in [(every, every), tuple(rng.integers(0, len(sizes), (2, 40))), (every[:3], every[:1].repeat(len(every[:3])))]:
        for a, b, block in zip(i, j, cholesky.inverse_blocks(i, j), strict=True):
            expected = inverse[start[a] : start[a + 1], start[b] : start[b + 1]]
            np.testing.assert_allclose(block, expected, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("shape", ["grid", "dense", "arrow to the first", "chain", "one dense block of 300"])
def test_selected_inverse_of_large_structures(shape: str) -> None:
    pattern, _ = BlockPattern.from_pairs(*SHAPES[shape])
    values, dense = positive_definite(pattern, np.random.default_rng(0))
    cholesky = SparseCholesky(pattern)
    cholesky.factorize(values)
    i, j = pattern.row, pattern.column
    inverse, start = np.linalg.inv(dense), pattern.start
    for a, b, block in zip(i, j, cholesky.inverse_blocks(i, j), strict=True):
        np.testing.assert_allclose(block, inverse[start[a] : start[a + 1], start[b] : start[b + 1]], rtol=1e-9, atol=1e-12)


def test_blocks_of_the_inverse_follow_the_latest_factorisation() -> None:
    pattern, values, _ = random_matrix(8, [6] * 30, 60)
    cholesky, every = SparseCholesky(pattern), np.arange(30)
    cholesky.factorize(values)
    first = cholesky.inverse_blocks(every, every)
    cholesky.factorize(4.0 * values)
    for one, quarter in zip(first, cholesky.inverse_blocks(every, every), strict=True):
        np.testing.assert_array_equal(one / 4.0, quarter)
    with pytest.raises(InputError, match="pairs of variables from 0 to 29"):
        cholesky.inverse_blocks([0], [30])


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="the rounding of NumPy's products depends on their shape")  # type: ignore[attr-defined]
@pytest.mark.parametrize("threads", [2, 3])
def test_threads_change_no_bit(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subtrees, "WORTHWHILE", 0.0)
    monkeypatch.setattr(numeric_factor, "LARGE", 1e5)
    monkeypatch.setattr(numeric_factor, "ROWS", 40)
    for shape in (
        "grid",
        "dense",
        "one dense block of 300",
        "two components",
        "arrow to the first",
        "chain",
        "diagonal",
        "empty",
    ):
        pattern, _ = BlockPattern.from_pairs(*SHAPES[shape])
        values, dense = positive_definite(pattern, np.random.default_rng(0))
        alone, together = SparseCholesky(pattern), SparseCholesky(pattern, threads=threads)
        for cholesky in (alone, together):
            cholesky.factorize(values)
        b = np.arange(len(dense), dtype=np.float64)
        np.testing.assert_array_equal(alone.solve(b), together.solve(b))
        every = np.arange(len(pattern.sizes))
        for one, other in zip(alone.inverse_blocks(every, every), together.inverse_blocks(every, every), strict=True):
            np.testing.assert_array_equal(one, other)
    assert len(SparseCholesky(BlockPattern.from_pairs(*SHAPES["grid"])[0], threads=threads)._fronts.parts) > 3
    with pytest.raises(InputError, match="at least one thread"):
        SparseCholesky(pattern, threads=0)


@given(seed=st.integers(0, 10**6), scale=st.sampled_from([1e-12, 1.0, 1e12]))
def test_a_graph_without_gauge_is_singular(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    i, j = np.concatenate([[range(29), range(1, 30)], rng.integers(0, 30, (2, 40))], axis=1)
    i, j = i[i != j], j[i != j]
    pattern, index = BlockPattern.from_pairs([3] * 30, np.concatenate([i, j, i]), np.concatenate([i, j, j]))
    root = rng.normal(size=(len(i), 3, 3)) * scale
    square = root @ root.transpose(0, 2, 1)
    values = np.zeros((len(pattern.row), 3, 3))
    np.add.at(values, index.block, np.concatenate([square, square, -square]))
    cholesky = SparseCholesky(pattern)
    with pytest.raises(NotPositiveDefinite):
        cholesky.factorize(values.ravel())
    values[0] += 1e-6 * square[0] + 1e-6 * scale**2 * np.eye(3)
    cholesky.factorize(values.ravel())


@pytest.mark.parametrize("position", [10, 150, 299])
def test_a_large_front_names_its_failure_too(position: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(numeric_factor, "LARGE", 0.0)
    pattern, _ = BlockPattern.from_pairs([300], [], [])
    values = np.eye(300)
    values[position, position] = 0.0
    with pytest.raises(NotPositiveDefinite, match=f"degree of freedom {position} of variable 0"):
        SparseCholesky(pattern, threads=2).factorize(values.ravel())


def test_the_example_of_the_documentation_runs() -> None:
    page = Path(__file__).resolve().parents[2] / "docs" / "sparse_cholesky.md"
    scope: dict[str, NDArray[np.float64]] = {}
    exec(re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)[0], scope)
    np.testing.assert_allclose(scope["x"], 0.5)


STARS = {
    "landmarks of one camera": ([6] + [3] * 50, [0] * 50, range(1, 51)),
    "landmarks of several cameras": (
        [6] * 4 + [3] * 200,
        np.repeat(range(4, 204), 2),
        np.random.default_rng(0).integers(0, 4, 400),
    ),
    "a star of stars": ([6] * 13 + [3] * 120, [*[0] * 12, *np.repeat(range(1, 13), 10)], [*range(1, 13), *range(13, 133)]),
}


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("star", STARS)
def test_fronts_with_many_children(star: str, threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subtrees, "WORTHWHILE", 0.0)
    monkeypatch.setattr(numeric_factor, "LARGE", 100.0)
    sizes, i, j = STARS[star]
    pattern, _ = BlockPattern.from_pairs(sizes, i, j)
    values, dense = positive_definite(pattern, np.random.default_rng(0))
    cholesky = check(pattern, values, dense, threads=threads)
    assert cholesky._fronts.table["eager"].any()
    inverse, start, every = np.linalg.inv(dense), pattern.start, np.arange(len(pattern.sizes))
    for k, block in enumerate(cholesky.inverse_blocks(every, every)):
        np.testing.assert_allclose(block, inverse[start[k] : start[k + 1], start[k] : start[k + 1]], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("graph", ["tinyGrid3D", "smallGrid3D", "intel", "MIT", "manhattan", "parking-garage"])
@pytest.mark.parametrize("threads", [1, 2])
def test_agrees_with_superlu_on_pose_graphs(shared_data: Path, graph: str, threads: int) -> None:
    edges = read_g2o(shared_data / "graphs" / f"{graph}.g2o").edges
    rng = np.random.default_rng(0)
    i, j = edges.T
    dof = 3 if graph in ("intel", "MIT", "manhattan") else 6
    pattern, index = BlockPattern.from_pairs([dof] * (edges.max() + 1), np.concatenate([i, j, i]), np.concatenate([i, j, j]))
    first, second = rng.normal(size=(2, len(edges), dof, dof))
    squares = [first.transpose(0, 2, 1) @ first, second.transpose(0, 2, 1) @ second, first.transpose(0, 2, 1) @ second]
    blocks = np.concatenate(squares)
    blocks[index.transposed] = blocks[index.transposed].transpose(0, 2, 1)
    values = np.zeros((len(pattern.row), dof, dof))
    np.add.at(values, index.block, blocks)
    values[pattern.col_start[:-1]] += np.eye(dof)
    cholesky = SparseCholesky(pattern, threads=threads)
    cholesky.factorize(values.ravel())
    matrix = pattern.to_scipy(values.ravel())
    oracle, b = splu(matrix), rng.normal(size=(matrix.shape[0], 3))
    np.testing.assert_allclose(cholesky.solve(b), oracle.solve(b), rtol=1e-8, atol=1e-10)
    every = np.arange(0, len(pattern.sizes), max(1, len(pattern.sizes) // 50))
    for k, block in zip(every, cholesky.inverse_blocks(every, every), strict=True):
        unit = np.zeros((matrix.shape[0], dof))
        unit[dof * k : dof * (k + 1)] = np.eye(dof)
        np.testing.assert_allclose(block, oracle.solve(unit)[dof * k : dof * (k + 1)], rtol=1e-7, atol=1e-10)


def test_an_analysis_is_taken_over_where_it_would_be_the_same() -> None:
    pattern, values, dense = random_matrix(7, [3, 6, 2, 6, 6, 1], 9)
    known = Analyses()
    first = check(pattern, values, dense, known=known)
    twin = BlockPattern(pattern.sizes.copy(), pattern.col_start.copy(), pattern.row.copy())
    other_values, other_dense = positive_definite(twin, np.random.default_rng(8))
    again = check(twin, other_values, other_dense, known=known)
    assert again.analysis is first.analysis
    first.factorize(values)  # the values of the two are apart
    assert np.array_equal(again.solve(other_dense[0]), check(twin, other_values, other_dense).solve(other_dense[0]))
    another, *rest = random_matrix(9, [3, 6, 2, 6, 6, 1], 4)
    assert check(another, *rest, known=known).analysis is not first.analysis
    assert SparseCholesky(pattern, threads=2, known=known).analysis is not first.analysis
    order = np.arange(6)
    given = check(pattern, values, dense, ordering=order[::-1].copy(), known=known)
    assert given.analysis is not first.analysis
    assert SparseCholesky(pattern, known=known).analysis is first.analysis  # others came between


def test_the_last_analyses_are_kept_and_of_large_matrices_one() -> None:
    def chain(variables: int) -> BlockPattern:
        return BlockPattern.from_pairs(np.ones(variables, np.int64), np.arange(1, variables), np.arange(variables - 1))[0]

    known = Analyses()
    made = [SparseCholesky(chain(3 + k), known=known).analysis for k in range(9)]
    assert SparseCholesky(chain(4), known=known).analysis is made[1]
    assert SparseCholesky(chain(3), known=known).analysis is not made[0]  # nine were more than are kept
    large = SparseCholesky(chain(1001), known=known).analysis
    assert SparseCholesky(chain(1001), known=known).analysis is large
    assert SparseCholesky(chain(4), known=known).analysis is not made[1]
