"""Planes kept from scan to scan: when they are taken over, and when they are forgotten."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.filtering.nav_state import NavState
from boxplus.maps.first_arrivals import FirstArrivals
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.known_planes import NEIGHBOURS, NO_CELL, PLANE, KnownPlanes, key_of, place_of
from boxplus.maps.plane_measurement import PlaneMeasurement
from boxplus.maps.registration_config import RegistrationConfig

CELL = 0.25
HALF = 0.5 * CELL
seeds = st.integers(0, 2**32 - 1)
X = NavState.identity().pack()


def _floor(random: np.random.Generator, count: int, noise: float = 0.01) -> np.ndarray:
    """Points (count, 3) of a floor of 6 by 6 m, 1.05 m below the sensor."""
    return np.insert(random.uniform(-3.0, 3.0, (count, 2)), 2, -1.05 + noise * random.normal(size=count), axis=1)


def _measure(points: np.ndarray, tree: IkdTree, known: KnownPlanes | None, threads: int = 1) -> PlaneMeasurement:
    config = RegistrationConfig(map_cell=CELL, threads=threads)
    return PlaneMeasurement(points.astype(np.float32), tree, config, with_extrinsic=False, known=known)


def _tree(points: np.ndarray) -> IkdTree:
    tree = IkdTree(cell_size=CELL)
    tree.insert(points, downsample=True)
    return tree


def test_a_scan_at_the_same_places_needs_no_map() -> None:
    random = np.random.default_rng(1)
    tree, known, points = _tree(_floor(random, 4000)), KnownPlanes(), _floor(random, 300)
    cells = np.floor(points.astype(np.float32).astype(np.float64) / HALF).astype(int)
    places = [int(place_of(key_of(*cell), len(known.keys))) for cell in cells.tolist()]
    points = points[np.unique(places, return_index=True)[1]]
    assert len(points) > 250
    first = _measure(points, tree, known).at(X, rematch=True)
    again = _measure(points, IkdTree(cell_size=CELL), known).at(X, rematch=True)
    assert first.used > 0.9 * len(points)
    assert again.used == first.used
    assert np.array_equal(again.A, first.A)
    assert np.array_equal(again.b, first.b)
    nothing = _measure(points, IkdTree(cell_size=CELL), None)
    assert nothing.at(X, rematch=True).used == 0
    assert nothing.rejected() == {"fewer than five map points near": len(points)}


def test_a_plane_is_for_points_that_lie_on_it() -> None:
    """The lower edge of a cell of 0.125 m lies 5 cm below a floor: a point there takes its plane, one 12 cm off does not."""
    random = np.random.default_rng(2)
    floor = _floor(random, 4000, noise=0.0)
    floor[:, 2] = -1.0
    tree, known = _tree(floor), KnownPlanes()
    on = np.array([[0.55, 0.55, -0.998]])
    assert _measure(on, tree, known).at(X, rematch=True).used == 1
    empty = IkdTree(cell_size=CELL)
    assert _measure(on + np.array([0.01, 0.01, 0.08]), empty, known).at(X, rematch=True).used == 1
    assert _measure(on + np.array([0.01, 0.01, 0.12]), empty, known).at(X, rematch=True).used == 0
    assert _measure(on + np.array([HALF, 0.0, 0.0]), empty, known).at(X, rematch=True).used == 0


def test_what_changes_the_map_makes_its_planes_be_forgotten() -> None:
    random = np.random.default_rng(3)
    arrivals, tree = FirstArrivals(CELL), IkdTree(cell_size=CELL)
    arrivals.insert_into(tree, _floor(random, 4000), 0)
    points = _floor(random, 200)
    _measure(points, tree, arrivals.planes).at(X, rematch=True)

    def left() -> np.ndarray:
        measurement = _measure(points, IkdTree(cell_size=CELL), arrivals.planes)
        measurement.at(X, rematch=True)
        return measurement._fate == 0

    before = left()
    assert before.mean() > 0.9
    new = np.array([[0.1, 0.1, -0.8]])
    assert arrivals.insert_into(tree, new, 2_000_000_000) == (1, 0)
    cells = np.floor(points.astype(np.float32).astype(np.float64) / HALF)
    beside = (np.abs(cells - np.floor(new / HALF)) <= 2).all(axis=1)
    assert beside.any()
    np.testing.assert_array_equal(left(), before & ~beside)
    arrivals.forget_map()
    assert not left().any()


def test_other_cells_of_the_map_need_other_planes() -> None:
    known = KnownPlanes()
    known.use_cells(CELL)
    known.remember(np.array([key_of(1, 2, 3)]), np.ones((1, PLANE)), np.ones((1, NEIGHBOURS, 3), np.float32))
    known.use_cells(CELL)
    assert np.count_nonzero(known.keys != NO_CELL) == 1
    known.use_cells(0.5 * CELL)
    assert np.count_nonzero(known.keys != NO_CELL) == 0


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_the_table_against_a_dictionary(seed: int) -> None:
    """So small that cells push one another out: what is there is the newest plane of its cell, and nothing near a change."""
    random = np.random.default_rng(seed)
    known, written = KnownPlanes(bits=6), {}
    known.use_cells(2.0)  # cells of a metre
    for number in range(6):
        cells = random.integers(-4, 4, (15, 3))
        keys = np.array([key_of(*cell) for cell in cells.tolist()], np.uint64)
        keys[random.integers(0, 15)] = NO_CELL
        planes = np.tile(number + np.arange(15.0)[:, None] / 100.0, (1, PLANE))
        known.remember(keys, planes, np.zeros((15, NEIGHBOURS, 3), np.float32))
        written |= {key: (cell, value) for key, cell, value in zip(keys.tolist(), cells, planes[:, 0], strict=True)}
        written.pop(int(NO_CELL), None)
        changed = random.uniform(-4.0, 4.0, (2, 3))
        known.forget_near(changed)
        for key, (cell, _) in list(written.items()):
            if (np.abs(cell - np.floor(changed)) <= 2).all(axis=1).any():
                del written[key]
        there = {int(key): float(plane[0]) for key, plane in zip(known.keys, known.planes, strict=True) if key != NO_CELL}
        assert there.items() <= {key: value for key, (_, value) in written.items()}.items()


@pytest.mark.parametrize("threads", [2, 3])
def test_the_number_of_threads_does_not_change_a_bit(threads: int) -> None:
    random = np.random.default_rng(5)
    tree = _tree(_floor(random, 4000))
    scans = [_floor(random, 3000) for _ in range(3)]
    tables = KnownPlanes(), KnownPlanes()
    for scan in scans:
        one, several = (_measure(scan, tree, known, count) for known, count in zip(tables, (1, threads), strict=True))
        first, second = one.at(X, rematch=True), several.at(X, rematch=True)
        assert np.array_equal(first.A, second.A)
        assert np.array_equal(first.b, second.b)
        assert np.array_equal(tables[0].keys, tables[1].keys)
