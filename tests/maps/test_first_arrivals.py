"""What the map keeps of a cell: the second scan's point, where it comes soon."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.filtering.nav_state import NavState
from boxplus.filtering.plane_information import USED, shared_information
from boxplus.manifolds import so3
from boxplus.maps.first_arrivals import FirstArrivals
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.plane_matching import PLANE, WEIGHT

CELL = 0.25
SOON_NS = 1_000_000_000


def _cell(p: np.ndarray, side: float) -> tuple[float, ...]:
    return (*np.floor(p / side).tolist(), side)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_second_scan_within_a_second_replaces_the_first_and_no_other_does(seed: int) -> None:
    """Against a dictionary of cells, with scans at irregular times and cells that are halved now and then."""
    random = np.random.default_rng(seed)
    tree, arrivals = IkdTree(cell_size=CELL), FirstArrivals(CELL)
    kept: list[np.ndarray] = []
    first: dict[tuple[float, ...], tuple[int, np.ndarray]] = {}
    now_ns = 0
    for _ in range(8):
        now_ns += int(random.choice([100_000_000, 700_000_000]))
        side = float(random.choice([CELL, CELL, 0.5 * CELL]))
        tree.cell_size = side
        points = random.uniform(-1.0, 1.0, (60, 3)) + np.array([5.0, -3.0, 0.0])
        counts = arrivals.insert_into(tree, points, now_ns)
        before = len(kept)
        first = {cell: (t, p) for cell, (t, p) in first.items() if now_ns - t <= SOON_NS}
        again = {_cell(p, side) for p in points} & first.keys()
        gone = [first.pop(cell)[1] for cell in again]
        kept = [p for p in kept if not any(p is q for q in gone)]
        taken = {_cell(p, side) for p in kept}
        stored = 0
        for p in points:
            cell = _cell(p, side)
            if cell not in taken:
                taken.add(cell)
                kept.append(p)
                stored += 1
                if cell not in again:
                    first[cell] = (now_ns, p)
        assert counts == (stored, len(gone))
        assert len(kept) == before + stored - len(gone)
        found = tree.points()
        np.testing.assert_allclose(found, np.array(sorted(kept, key=tuple)), atol=1e-6)
    tree.check_invariants()


def test_a_surface_that_comes_into_view_is_not_where_noise_first_reached_it() -> None:
    """A ceiling above a sensor that looks up by 22 degrees at most and rises: each scan sees a little more of it."""
    random = np.random.default_rng(5)
    plain = IkdTree(cell_size=0.125)
    tree, arrivals = IkdTree(cell_size=0.125), FirstArrivals(0.125)
    for k in range(20):
        height = 1.6 - 0.05 * k
        nearest = height / np.tan(np.radians(22.0))
        azimuth, away = random.uniform(-0.5, 0.5, 4000), nearest + random.uniform(0.0, 1.0, 4000)
        foot = np.column_stack([away * np.cos(azimuth), away * np.sin(azimuth), np.full(4000, height)])
        seen = foot * (1.0 + 0.03 * random.normal(size=(4000, 1)) / np.linalg.norm(foot, axis=1, keepdims=True))
        p_world = seen + np.array([0.0, 0.0, 0.06 - height])  # the ceiling lies in the middle of a cell
        plain.insert(p_world, downsample=True)
        arrivals.insert_into(tree, p_world, k * 100_000_000)

    def below_ceiling(of: IkdTree) -> float:
        points = of.points()
        entered = np.linalg.norm(points[:, :2], axis=1) < 1.6 / np.tan(np.radians(22.0)) - 0.1
        return float(0.06 - points[entered, 2].mean())

    assert below_ceiling(plain) > 0.005
    assert abs(below_ceiling(tree)) < 0.5 * below_ceiling(plain)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(20, 2500))
def test_information_that_rests_on_the_points_of_the_last_scan(seed: int, count: int) -> None:
    """Against sums over all planes in words, of neighbours in a map away from its origin."""
    random = np.random.default_rng(seed)
    tree, arrivals = IkdTree(cell_size=CELL), FirstArrivals(CELL)
    old, new = random.uniform(-2.0, 2.0, (2, 300, 3)) + np.array([30.0, -7.0, 2.0])
    arrivals.insert_into(tree, old, 0)
    before = tree.points()
    arrivals.insert_into(tree, new, 2 * SOON_NS)
    stored = tree.points()
    is_new = ~(np.abs(stored[:, None] - before[None]).max(axis=2) < 1e-6).any(axis=1)
    chosen = random.integers(0, len(stored), (count, 5))
    neighbours = (stored[chosen] - tree.origin).astype(np.float32)
    zero = np.zeros(3)
    x = NavState(
        so3.exp(random.normal(size=3)), zero, zero, zero, zero, zero, so3.exp(random.normal(size=3)), random.normal(size=3)
    )
    p_lidar, planes = random.normal(size=(count, 3)).astype(np.float32), np.zeros((count, PLANE))
    u = random.normal(size=(count, 3))
    planes[:, :3], planes[:, WEIGHT] = u / np.linalg.norm(u, axis=1)[:, None], random.uniform(1.0, 2.0, count)
    fate = random.integers(0, 3, count).astype(np.uint8)
    expected = np.zeros((2, 6, 6))
    for n in range(0, count, max(count // 1000, 1)):
        if fate[n] != USED:
            continue
        s = x.R_imu_lidar @ p_lidar[n] + x.p_imu_lidar
        h = np.concatenate([np.cross(s, x.R_world_imu.T @ planes[n, :3]), planes[n, :3]])
        said = planes[n, WEIGHT] * np.outer(h, h)
        expected += np.stack([said, is_new[chosen[n]].mean() * said])
    asked = slice(None, None, max(count // 1000, 1))
    newest = arrivals.are_newest(neighbours[asked].reshape(-1, 3) + tree.origin).reshape(-1, 5)
    found = shared_information(x.pack(), p_lidar[asked], planes[asked], fate[asked], newest)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)
