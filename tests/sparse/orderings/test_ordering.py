"""Elimination orders: validity and exact costs against brute force, quality against SuperLU's minimum degree."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sparse
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from boxplus.errors import InputError
from boxplus.sparse.orderings.ordering import Ordering, order

METHODS = ("minimum_degree", "nested_dissection", "natural", "auto")


def lower(count: int, edges: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Block CSC of the lower triangle, diagonal included, of the graph with the given edges."""
    edges = edges.reshape(-1, 2)
    edges = edges[edges[:, 0] != edges[:, 1]]
    diagonal = np.arange(count)
    rows, columns = np.r_[edges.max(axis=1), diagonal], np.r_[edges.min(axis=1), diagonal]
    matrix = sparse.csc_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    return matrix.indptr.astype(np.int64), matrix.indices.astype(np.int64)


def eliminate(
    count: int, edges: NDArray[np.int64], sizes: NDArray[np.int64], permutation: NDArray[np.int64]
) -> tuple[int, float]:
    """Nonzeros and operations of a factorisation, by eliminating in a dense boolean matrix."""
    filled = np.eye(count, dtype=bool)
    for i, j in edges.reshape(-1, 2):
        filled[i, j] = filled[j, i] = True
    filled = filled[np.ix_(permutation, permutation)]
    widths = sizes[permutation]
    nonzeros, flops = 0, 0.0
    for k in range(count):
        below = np.flatnonzero(filled[k, k + 1 :]) + k + 1
        filled[np.ix_(below, below)] = True
        for scalar in range(widths[k]):
            length = int(widths[k] - scalar + widths[below].sum())
            nonzeros, flops = nonzeros + length, flops + float(length) ** 2
    return nonzeros, flops


@st.composite
def graphs(draw: st.DrawFn) -> tuple[int, NDArray[np.int64], NDArray[np.int64]]:
    count = draw(st.integers(1, 24))
    node = st.integers(0, count - 1)
    edges = draw(st.lists(st.tuples(node, node), max_size=3 * count))
    sizes = draw(st.lists(st.integers(1, 7), min_size=count, max_size=count))
    return count, np.array(edges, np.int64).reshape(-1, 2), np.array(sizes)


def check(result: Ordering, count: int, edges: NDArray[np.int64], sizes: NDArray[np.int64]) -> None:
    assert sorted(result.permutation) == list(range(count))
    assert result.permutation.dtype == np.int64
    nonzeros, flops = eliminate(count, edges, sizes, result.permutation)
    assert result.fill == nonzeros
    assert result.flops == pytest.approx(flops)


@given(graphs(), st.sampled_from(METHODS))
def test_orders_are_permutations_and_their_costs_exact(graph: tuple[int, NDArray, NDArray], method: str) -> None:
    count, edges, sizes = graph
    check(order(*lower(count, edges), sizes, method), count, edges, sizes)


@given(graphs())
def test_a_postorder_changes_no_cost(graph: tuple[int, NDArray, NDArray]) -> None:
    count, edges, sizes = graph
    result = order(*lower(count, edges), sizes, "natural")
    assert (result.fill, result.flops) == pytest.approx(eliminate(count, edges, sizes, np.arange(count)))


@pytest.mark.parametrize("count", [40, 300])
def test_minimum_degree_survives_many_merges_and_compactions(count: int) -> None:
    # Overlapping cliques: long element lists, supervariables and mass eliminations in one graph.
    rng = np.random.default_rng(count)
    cliques = [rng.choice(count, 8, replace=False) for _ in range(count)]
    edges = np.array([(i, j) for clique in cliques for i in clique for j in clique if i < j])
    sizes = rng.integers(1, 10, count)
    check(order(*lower(count, edges), sizes, "minimum_degree"), count, edges, sizes)


@pytest.mark.parametrize("method", METHODS)
def test_trees_are_eliminated_without_fill(method: str) -> None:
    count = 60
    path = np.column_stack([np.arange(count - 1), np.arange(1, count)])
    star = np.column_stack([np.full(count - 1, 30), np.delete(np.arange(count), 30)])
    rng = np.random.default_rng(1)
    tree = np.column_stack([np.arange(1, count), [rng.integers(0, i) for i in range(1, count)]])
    for edges in (path, star, tree):
        result = order(*lower(count, edges), np.full(count, 3), method)
        check(result, count, edges, np.full(count, 3))
        if method in ("minimum_degree", "auto"):
            assert result.fill == count * 6 + (count - 1) * 9


def test_hubs_come_last() -> None:
    count = 3000
    leaves = np.arange(2, count)
    edges = np.concatenate([np.column_stack([np.full(count - 2, hub), leaves]) for hub in (0, 1)])
    result = order(*lower(count, edges), np.ones(count, np.int64), "minimum_degree")
    assert set(result.permutation[-2:]) == {0, 1}
    assert result.fill == 3 * (count - 2) + 3


@pytest.mark.parametrize("method", METHODS)
def test_graphs_without_edges(method: str) -> None:
    empty = order([0], [], [], method)
    assert (len(empty.permutation), empty.fill, empty.flops) == (0, 0, 0.0)
    single = order([0, 1], [0], [6], method)
    assert (list(single.permutation), single.fill) == ([0], 21)
    alone = order([0, 0, 0, 0], [], [2, 3, 4], method)
    assert sorted(alone.permutation) == [0, 1, 2] and alone.fill == 3 + 6 + 10


def test_entries_may_repeat_and_the_diagonal_be_missing() -> None:
    with_diagonal = order([0, 3, 5, 6], [0, 1, 2, 1, 2, 2], [6, 6, 6])
    bare = order([0, 4, 5, 5], [2, 1, 1, 2, 2], [6, 6, 6])
    assert bare.fill == with_diagonal.fill == 18 * 19 // 2


def test_auto_keeps_the_cheaper_order() -> None:
    node = np.arange(14**3).reshape(14, 14, 14)
    edges = np.concatenate(
        [np.stack([np.moveaxis(node, a, 0)[1:].ravel(), np.moveaxis(node, a, 0)[:-1].ravel()], axis=1) for a in range(3)]
    )
    cube = (*lower(node.size, edges), np.full(node.size, 6))
    path = (*lower(500, np.stack([np.arange(499), np.arange(1, 500)], axis=1)), np.full(500, 6))
    assert order(*cube).flops < 0.9 * order(*cube, "minimum_degree").flops
    assert order(*cube).method == "nested_dissection"
    assert order(*path).method == "minimum_degree"


@pytest.mark.parametrize("name", ["torus3D", "cubicle", "sphere2500", "parking-garage", "manhattan", "intel"])
def test_minimum_degree_is_as_good_as_that_of_superlu(shared_data: Path, name: str) -> None:
    lines = (shared_data / "graphs" / f"{name}.g2o").read_text().splitlines()
    ids = np.array([line.split()[1:3] for line in lines if line.startswith("EDGE")], np.int64)
    names, edges = np.unique(ids, return_inverse=True)
    count = len(names)
    col_start, row = lower(count, edges.reshape(-1, 2))
    below = sparse.csc_matrix((np.full(len(row), -1.0), row, col_start), shape=(count, count))
    matrix = (below + below.T + sparse.diags(np.full(count, 1000.0))).tocsc()
    factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    ours = order(col_start, row, np.ones(count, np.int64), "minimum_degree")
    assert ours.fill <= 1.2 * factors.L.nnz


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0, 1], [0], [6, 6]), "expected col_start with 3 entries rising from 0 to 1, one more than sizes – got 2 entries"),
        (([0, 2, 1], [0], [6, 6]), "rising from 0 to 1"),
        (
            ([0, 1, 2], [1, 0], [6, 6]),
            "block rows of the lower triangle, at least their column and below 2 – got row 0 in column 1",
        ),
        (([0, 1, 2], [1, 2], [6, 6]), "got row 2 in column 1"),
        (([0, 1, 2], [0, 1], [6, 0]), r"expected positive block sizes – got 0 \(block 1\)"),
        (([0, 1, 2], [0.0, 1.0], [6, 6]), "expected row as a vector of integers – got float64"),
        (([0, 1, 2], [0, 1], [6, 6], "best"), "expected method auto, minimum_degree, nested_dissection or natural – got 'best'"),
    ],
)
def test_bad_input_is_refused(arguments: tuple, message: str) -> None:
    with pytest.raises(InputError, match=message):
        order(*arguments)
