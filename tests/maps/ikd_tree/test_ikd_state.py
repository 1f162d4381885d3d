"""The ikd-tree against a brute-force set of points, under random sequences of operations, in all three kinds of rebuild."""

from __future__ import annotations

import os

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test

from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.ikd_tree import tree as ikd_tree
from tests.maps.ikd_tree.brute_force_map import BruteForceMap

MODES = ("incremental", "background", "inplace")
CELL = 0.3


def cloud(seed: int, size: int, shape: str) -> np.ndarray:
    """Points that a k-d tree finds easy or hard."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-3, 3, (size, 3))
    if shape == "plane":
        points[:, 2] = 0.5
    elif shape == "line":
        points[:, 1:] = (1.0, -2.0)
    elif shape == "lattice":
        points = np.round(points)
    elif shape == "same":
        points[:] = points[:1]
    elif shape == "path":  # a cluster that lies farther out for every seed
        points = points * 0.2 + (seed % 50, 0, 0)
    elif shape == "broken" and size:
        points[rng.integers(size)] = (np.nan, 0, np.inf)
        points[rng.integers(size)] = (1e9, 0, 0)
    return points


clouds = st.builds(
    cloud,
    st.integers(0, 10_000),
    st.integers(0, 150),
    st.sampled_from(("volume", "plane", "line", "lattice", "same", "path", "broken")),
)
corners = st.tuples(*[st.sampled_from((-4.0, -2.0, -0.5, 0.0, 0.3, 1.0))] * 3)
sides = st.tuples(*[st.sampled_from((0.0, 0.5, 2.0, 4.0, 60.0))] * 3)


class TreesAgainstBruteForce(RuleBasedStateMachine):
    """One tree of each kind goes through the same operations as a list of points."""

    @initialize(points=clouds)
    def build(self, points: np.ndarray) -> None:
        """Start from an array, with the same origin everywhere."""
        self.trees = [IkdTree(cell_size=CELL, rebuild=mode) for mode in MODES]
        self.truth = BruteForceMap(CELL)
        points = np.concatenate([[[0.0, 0.0, 0.0]] * 3, points[:1], points])
        for tree in self.trees:
            tree.build(points)
        self.truth.origin = self.trees[0].origin
        self.truth.insert(points)

    def each(self, operation: str, *arguments: object, **options: object) -> list[object]:
        """Do the same to every tree."""
        return [getattr(tree, operation)(*arguments, **options) for tree in self.trees]

    @rule(points=clouds)
    def insert(self, points: np.ndarray) -> None:
        reports = self.each("insert", points)
        inserted = self.truth.insert(points)
        assert all(report.inserted == inserted for report in reports)

    @rule(points=clouds)
    def insert_downsampled(self, points: np.ndarray) -> None:
        self.each("insert", points, downsample=True)
        self.truth.insert_downsampled(points)

    @rule(seed=st.integers(0, 1000), share=st.floats(0, 0.6))
    def delete_points(self, seed: int, share: float) -> None:
        rng = np.random.default_rng(seed)
        live = self.truth.points()
        chosen = live[rng.random(len(live)) < share] + rng.choice([0.0, 1e-9])
        assert set(self.each("delete_points", chosen)) == {self.truth.delete_points(chosen)}

    @rule(lo=corners, side=sides)
    def delete_box(self, lo: tuple[float, ...], side: tuple[float, ...]) -> None:
        hi = np.add(lo, side)
        assert set(self.each("delete_box", lo, hi)) == {self.truth.delete_box(lo, hi)}

    @rule(lo=corners, side=sides)
    def reinsert_box(self, lo: tuple[float, ...], side: tuple[float, ...]) -> None:
        hi = np.add(lo, side)
        assert set(self.each("reinsert_box", lo, hi)) == {self.truth.reinsert_box(lo, hi)}

    @rule(seed=st.integers(0, 1000), k=st.sampled_from((1, 2, 5, 9, 15, 16, 20)), limit=st.sampled_from((0.0, 0.4, 1.0, np.inf)))
    def nearest(self, seed: int, k: int, limit: float) -> None:
        rng = np.random.default_rng(seed)
        queries = np.concatenate([rng.uniform(-4, 4, (8, 3)), np.round(rng.uniform(-3, 3, (4, 3)))])
        distances, points = self.truth.nearest(queries, k, limit)
        for found in self.each("nearest", queries, k, max_distance=limit):
            np.testing.assert_array_equal(found.distances, distances)
            np.testing.assert_array_equal(found.points, points)
            np.testing.assert_array_equal(found.counts, np.isfinite(distances).sum(axis=1))

    @rule(lo=corners, side=sides)
    def search_box(self, lo: tuple[float, ...], side: tuple[float, ...]) -> None:
        hi = np.add(lo, side)
        for found in self.each("box_search", lo, hi):
            np.testing.assert_array_equal(found, self.truth.box_search(lo, hi))

    @rule(center=corners, radius=st.sampled_from((0.0, 0.5, 2.0)))
    def search_radius(self, center: tuple[float, ...], radius: float) -> None:
        for found in self.each("radius_search", center, radius):
            np.testing.assert_array_equal(found, self.truth.radius_search(center, radius))

    @invariant()
    def same_contents(self) -> None:
        if not hasattr(self, "trees"):
            return
        for tree in self.trees:
            tree.check_invariants()
            np.testing.assert_array_equal(tree.points(), self.truth.points())
            assert len(tree) == len(self.truth.points())

    def teardown(self) -> None:
        for tree in getattr(self, "trees", []):
            tree.close()


@pytest.mark.slow
@pytest.mark.parametrize("in_place", [40, 1500])
def test_trees_agree_with_brute_force(in_place: int, monkeypatch: pytest.MonkeyPatch) -> None:
    # Low thresholds make small trees go through everything that large ones do.
    monkeypatch.setattr(ikd_tree, "IN_PLACE", in_place)
    monkeypatch.setattr(ikd_tree, "_BUDGET", 50)
    monkeypatch.setattr(ikd_tree, "_BUDGET_PER_POINT", 2)
    compiled = os.environ.get("NUMBA_DISABLE_JIT", "0") == "0"
    run_state_machine_as_test(
        TreesAgainstBruteForce,
        settings=settings(
            max_examples=20 if compiled else 2,
            stateful_step_count=20 if compiled else 5,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        ),
    )


@pytest.mark.parametrize("mode", MODES)
def test_a_subtree_below_one_that_comes_into_balance_again_is_rebuilt(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # In the last batch the root loses its balance, then a subtree below it, then the root comes into balance again.
    monkeypatch.setattr(ikd_tree, "IN_PLACE", 40)
    monkeypatch.setattr(ikd_tree, "_BUDGET", 50)
    monkeypatch.setattr(ikd_tree, "_BUDGET_PER_POINT", 2)
    first = cloud(1, 48, "volume")
    with IkdTree(cell_size=CELL, rebuild=mode) as tree:
        tree.build(np.concatenate([[[0.0, 0.0, 0.0]] * 3, first[:1], first]))
        for points in (
            cloud(800, 103, "lattice"),
            cloud(0, 11, "same"),
            cloud(313, 92, "lattice"),
            cloud(458, 150, "lattice"),
        ):
            tree.insert(points)
            tree.check_invariants()


def test_balance_is_not_asked_for_while_a_rebuild_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ikd_tree, "IN_PLACE", 40)
    monkeypatch.setattr(ikd_tree, "_BUDGET", 1)
    monkeypatch.setattr(ikd_tree, "_BUDGET_PER_POINT", 0)
    rng = np.random.default_rng(2)
    left, right = rng.uniform(0.01, 0.99, (2, 240, 3))
    left[:, 0] *= 0.4
    right[:, 0] = np.linspace(0.5, 50.0, 240)
    with IkdTree(cell_size=1.0) as tree:
        tree.build(np.concatenate([left, right]), origin=(0, 0, 0))
        tree.insert(rng.uniform(60.0, 70.0, (400, 3)))
        tree.delete_box([0, 0, 0], [1, 1, 1])
        assert (
            tree.insert([[0.5, 0.5, 0.5]], downsample=True).inserted == 1
        )  # drops a cell in which lies all that was on the left
        tree.check_invariants()
        assert len(tree.box_search([0, 0, 0], [1, 1, 1])) == 1


@pytest.mark.parametrize("mode", MODES)
def test_a_cell_keeps_its_first_point_while_the_tree_is_rebuilt(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ikd_tree, "IN_PLACE", 100)
    monkeypatch.setattr(ikd_tree, "_BUDGET", 100)
    monkeypatch.setattr(ikd_tree, "_BUDGET_PER_POINT", 4)
    rng = np.random.default_rng(11)
    truth = BruteForceMap(CELL)
    with IkdTree(cell_size=CELL, rebuild=mode) as tree:
        for step in range(8 if os.environ.get("NUMBA_DISABLE_JIT", "0") == "0" else 2):
            # On a grid much finer than the cells, many points equal a split.
            batch = np.round(rng.uniform((-3 + 0.3 * step, -3, -0.5), (3 + 0.3 * step, 3, 0.5), (400, 3)) / 0.05) * 0.05
            tree.insert(batch, downsample=True)
            truth.origin = tree.origin
            truth.insert_downsampled(batch)
            if step % 3 == 2:
                assert tree.delete_box([-1, -1, -1], [0, 0, 1]) == truth.delete_box([-1, -1, -1], [0, 0, 1])
            tree.check_invariants()
            np.testing.assert_array_equal(tree.points(), truth.points())
