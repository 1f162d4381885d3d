"""The ikd-tree: scipy as oracle, border cases, threads, memory, and what it says about bad input."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial import cKDTree

from boxplus.errors import InputError
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.ikd_tree.check import InvariantError
from boxplus.maps.ikd_tree.search import STACK, STACK_DEPTH, has_within, knn5
from tests.maps.ikd_tree.brute_force_map import squares

compiled = os.environ.get("NUMBA_DISABLE_JIT", "0") == "0"
needs_compiler = pytest.mark.skipif(not compiled, reason="too many points for interpreted kernels")


@needs_compiler
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("k", [1, 5, 12])
def test_nearest_agrees_with_scipy(k: int, threads: int) -> None:
    rng = np.random.default_rng(k)
    points = rng.normal(0.0, (20.0, 20.0, 2.0), (30_000, 3)).astype(np.float32).astype(float)
    queries = rng.normal(0.0, (25.0, 25.0, 4.0), (5_000, 3)).astype(np.float32).astype(float)
    found = IkdTree(points, threads=threads).nearest(queries, k, max_distance=1.5)
    distances, _ = cKDTree(points).query(queries, np.arange(1, k + 1), distance_upper_bound=1.5)
    np.testing.assert_allclose(found.distances, distances, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(found.counts, np.isfinite(distances).sum(axis=1))
    exists = np.isfinite(distances)
    np.testing.assert_allclose(
        np.linalg.norm(found.points - queries[:, None], axis=2)[exists], distances[exists], rtol=1e-5, atol=1e-5
    )


def test_warm_start_finds_the_same_neighbours() -> None:
    rng = np.random.default_rng(1)
    tree = IkdTree(rng.uniform(-2, 2, (300, 3)))
    stack, xyz, sq = np.zeros(STACK_DEPTH, STACK), np.zeros((5, 3), np.float32), np.zeros(5, np.float32)
    for query in rng.uniform(-2, 2, (20, 3)).astype(np.float32):
        truth = np.sort(squares((tree.points() - tree.origin).astype(np.float32) - query))[:5]
        for bound in (np.float32(np.inf), truth[4]):
            assert knn5(tree.view(), *query, np.float32(bound), xyz, sq, stack) == 5
            np.testing.assert_array_equal(sq, truth)
            np.testing.assert_array_equal(squares(xyz - query), truth)
        assert knn5(tree.view(), *query, truth[2], xyz, sq, stack) == 3


def test_whether_enough_points_lie_within_a_distance() -> None:
    rng = np.random.default_rng(2)
    tree = IkdTree(rng.uniform(-2, 2, (400, 3)))
    tree.delete_box(np.array([0.0, 0.0, 0.0]), np.array([2.0, 2.0, 1.0]))
    stack = np.zeros(STACK_DEPTH, STACK)
    for query in rng.uniform(-2, 2, (20, 3)).astype(np.float32):
        ranked = np.sort(squares((tree.points() - tree.origin).astype(np.float32) - query))
        for count in (1, 5, 25):
            nearest, short = ranked[count - 1], np.nextafter(ranked[count - 1], np.float32(0))
            assert has_within(tree.view(), *query, nearest, count, stack)
            assert not has_within(tree.view(), *query, short, count, stack)
    assert not has_within(IkdTree().view(), *query, np.float32(100.0), 1, stack)


@settings(max_examples=50 if compiled else 3)
@given(arrays(np.float64, st.tuples(st.integers(0, 60), st.just(3)), elements=st.floats(allow_nan=True, width=64)))
def test_any_numbers_are_stored_or_counted(points: np.ndarray) -> None:
    tree = IkdTree(cell_size=1.0)
    for report in (tree.build(points), tree.insert(points), tree.insert(points, downsample=True)):
        assert sum(report[:4]) == len(report.stored) == len(points)
        assert np.count_nonzero(report.stored) == report.inserted
        assert np.isfinite(points[report.stored]).all()
        assert report.not_finite == np.sum(~np.isfinite(points).all(axis=1))
    tree.check_invariants()
    assert len(tree.points()) == len(tree)


def test_empty_tree_and_empty_input() -> None:
    tree = IkdTree(cell_size=0.5)
    assert len(tree) == 0 and tree.points().shape == (0, 3)
    assert tree.insert(np.empty((0, 3)))[:4] == (0, 0, 0, 0)
    assert tree.delete_box([0, 0, 0], [1, 1, 1]) == 0 and tree.delete_points([]) == 0
    found = tree.nearest([[1.0, 2.0, 3.0]], 2)
    assert np.isinf(found.distances).all() and np.isnan(found.points).all() and found.counts.tolist() == [0]
    assert tree.nearest(np.empty((0, 3)), 2).points.shape == (0, 2, 3)
    assert np.isnan(tree.bounds).all()
    tree.check_invariants()


def test_queries_that_are_not_finite_find_nothing() -> None:
    tree = IkdTree(np.zeros((3, 3)))
    assert tree.nearest([[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, 0]], 1).counts.tolist() == [0, 0, 1]


def test_boxes_are_half_open_and_balls_closed() -> None:
    tree = IkdTree([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    assert tree.box_search([0, 0, 0], [2, 1, 1])[:, 0].tolist() == [0.0, 1.0]
    assert tree.radius_search([0, 0, 0], 1.0)[:, 0].tolist() == [0.0, 1.0]
    assert tree.nearest([[0, 0, 0]], 3, max_distance=1.0).counts.tolist() == [2]
    assert tree.delete_box([1, 0, 0], [2, 1, 1]) == 1
    assert tree.bounds[1].tolist() == [2.0, 0.0, 0.0]


@needs_compiler
@pytest.mark.parametrize("mode", ["incremental", "background", "inplace"])
def test_a_long_path_gives_the_same_map_in_every_mode(mode: str) -> None:
    rng = np.random.default_rng(7)
    with IkdTree(cell_size=0.5, rebuild=mode) as tree, IkdTree(cell_size=0.5) as reference:
        for step in range(60):
            batch = rng.normal((2.0 * step, 0, 0), (8, 8, 1), (1500, 3))
            for each in (tree, reference):
                each.insert(batch, downsample=True)
                if step % 10 == 9:
                    each.delete_box([2.0 * step - 40, -50, -50], [2.0 * step - 20, 50, 50])
        np.testing.assert_array_equal(tree.points(), reference.points())
        for ours, theirs in zip(tree.nearest(batch, 5), reference.nearest(batch, 5), strict=True):
            np.testing.assert_array_equal(ours, theirs)
        assert tree.check_invariants() < 40


@needs_compiler
def test_the_height_stays_small_whatever_the_order() -> None:
    same = np.zeros((20_000, 3))
    line = np.linspace(0, 1000, 20_000)[:, None] * (1.0, 0.0, 0.0)
    for points in (same, line, line[::-1]):
        for mode in ("incremental", "inplace"):
            tree = IkdTree(rebuild=mode)
            for part in np.array_split(points, 40):
                tree.insert(part)
            assert tree.check_invariants() < 170
            assert len(tree.points()) == len(points)


@needs_compiler
def test_searches_on_many_threads_see_the_same_tree() -> None:
    rng = np.random.default_rng(3)
    tree = IkdTree(rng.uniform(-10, 10, (20_000, 3)))
    tree.delete_box([-5, -5, -5], [0, 0, 0])
    tree.reinsert_box([-4, -4, -4], [-1, -1, -1])  # leaves labels of both kinds behind
    queries = rng.uniform(-10, 10, (4_000, 3))
    expected = tree.nearest(queries, 5)
    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(lambda _: tree.nearest(queries, 5), range(8)):
            np.testing.assert_array_equal(found.points, expected.points)
    tree.check_invariants()


@needs_compiler
@pytest.mark.parametrize("mode", ["incremental", "background", "inplace"])
def test_memory_is_reclaimed_after_mass_deletion(mode: str) -> None:
    rng = np.random.default_rng(4)
    with IkdTree(rng.uniform(0, 100, (200_000, 3)), rebuild=mode) as tree:
        full = tree.memory_bytes
        assert full < 40 * len(tree)
        deleted = tree.delete_box([0, 0, 0], [90, 100, 100])
        for _ in range(400):
            tree.insert(rng.uniform(95, 100, (1, 3)))
        assert len(tree) == 200_000 - deleted + 400
        assert tree.memory_bytes < 0.25 * full
        assert tree.reinsert_box([0, 0, 0], [90, 100, 100]) == 0
        tree.check_invariants()


@needs_compiler
def test_memory_stays_bounded_in_a_sliding_map() -> None:
    rng = np.random.default_rng(5)
    tree = IkdTree()
    sizes = []
    for step in range(150):
        tree.insert(rng.uniform((step, 0, 0), (step + 1, 50, 50), (1000, 3)))
        tree.delete_box([step - 40, 0, 0], [step - 30, 50, 50])
        sizes.append(tree.memory_bytes)
    assert max(sizes[100:]) <= 1.2 * max(sizes[50:100])


def test_a_damaged_tree_is_recognised() -> None:
    tree = IkdTree(np.random.default_rng(6).uniform(0, 1, (200, 3)))
    tree.view().inner[0]["box"][0, 0] = 0.5
    with pytest.raises(InvariantError, match="I3"):
        tree.check_invariants()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: IkdTree(np.zeros((3, 2))), r"expected points as numbers of shape \(N, 3\) – got float64 of shape \(3, 2\)"),
        (lambda: IkdTree([["a", "b", "c"]]), "expected points as numbers"),
        (lambda: IkdTree(cell_size=0.0), "expected cell_size above 0 m – got 0.0"),
        (lambda: IkdTree(rebuild="later"), "expected rebuild as incremental, background or inplace – got 'later'"),
        (lambda: IkdTree(balance_ratio=0.4), r"expected balance_ratio in \(0.5, 1\) – got 0.4"),
        (lambda: IkdTree(delete_ratio=1.0), r"expected delete_ratio in \(0, 1\) – got 1.0"),
        (lambda: IkdTree(threads=0), "expected threads of at least 1 – got 0"),
        (lambda: IkdTree().insert(np.zeros((1, 3)), downsample=True), "expected a cell_size for a downsampled insert"),
        (lambda: IkdTree().nearest(np.zeros((1, 3)), 0), "expected k of at least 1 – got 0"),
        (lambda: IkdTree().nearest(np.zeros((1, 3)), 1, max_distance=-1.0), "expected max_distance of at least 0 m"),
        (lambda: IkdTree().radius_search([0, 0, 0], np.nan), "expected radius of at least 0 m – got nan"),
        (lambda: IkdTree().delete_box([0, 0], [1, 1, 1]), "expected lo as three numbers"),
        (lambda: IkdTree().box_search([0, 0, 0], [1, np.nan, 1]), "expected hi as three numbers"),
    ],
)
def test_bad_arguments_are_explained(call: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()
