"""Rays through a map: what was not there all the time goes, what was only seen at a flat angle stays."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.manifolds import quaternion
from boxplus.maps.seen_through import SeenThrough, SeenThroughConfig
from boxplus.simulation.worlds.world import Solid, World, box, rectangle

Rays = tuple[NDArray[np.float64], NDArray[np.float64]]

ROOM = [
    rectangle((0.0, 0.0, 0.0), (60.0, 20.0)),
    box((0.0, 10.1, 2.0), (60.0, 0.2, 4.0)),
    box((0.0, -10.1, 2.0), (60.0, 0.2, 4.0)),
    box((30.1, 0.0, 2.0), (0.2, 20.0, 4.0)),
    box((-30.1, 0.0, 2.0), (0.2, 20.0, 4.0)),
    box((5.0, 6.0, 0.6), (0.4, 0.4, 1.2)),
]
CAR = box((0.0, 4.0, 0.8), (4.0, 1.8, 1.5))


def stretch(solids: list[Solid], begin: float, seed: int) -> Rays:
    """Rays of five scans along x, a metre apart."""
    world, random = World(solids, cell_m=4.0), np.random.default_rng(seed)
    azimuth, elevation = np.meshgrid(np.linspace(-np.pi, np.pi, 400, endpoint=False), np.deg2rad(np.linspace(-25, 15, 24)))
    a, e = azimuth.ravel() + random.uniform(0, 0.1), elevation.ravel()
    rays = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    origins, ends = [], []
    for k in range(5):
        position = np.array([begin + k, 0.0, 1.5])
        ranges, _ = world.cast(rays, quaternion.to_matrix([1.0, 0.0, 0.0, 0.0])[None], position[None], 60.0)
        hit = np.isfinite(ranges)
        length = ranges[hit] + random.normal(0.0, 0.02, int(hit.sum()))
        ends.append(position + rays[hit] * length[:, None])
        origins.append(np.broadcast_to(position, ends[-1].shape))
    return np.concatenate(origins), np.concatenate(ends)


@pytest.fixture(scope="module")
def days() -> list[list[Rays]]:
    """Three stretches with a car, three without."""
    return [[stretch(ROOM + more, 5.0 * k - 8.0, 10 * day + k) for k in range(3)] for day, more in enumerate(([CAR], []))]


@pytest.fixture(scope="module")
def seen(days: list[list[Rays]]) -> SeenThrough:
    seen = SeenThrough(np.concatenate([ends for day in days for _, ends in day]), sessions=2)
    for day, stretches in enumerate(days):
        for origins, ends in stretches:
            seen.add_stretch(day, origins, ends)
    return seen


def of_car(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.asarray((np.abs(points - [0.0, 4.0, 0.8]) <= [2.1, 1.0, 0.85]).all(axis=1) & (points[:, 2] > 0.3))


def test_a_car_that_left_is_removed_and_nothing_else(days: list[list[Rays]], seen: SeenThrough) -> None:
    points = np.concatenate([ends for day in days for _, ends in day])
    removed, car = seen.is_removed(points), of_car(points)
    assert removed[car].mean() > 0.9
    assert removed[~car & ~(np.abs(points - [0.0, 4.0, 0.8]) <= [2.4, 1.3, 1.0]).all(axis=1)].mean() < 1e-4


def test_what_stays_is_never_seen_through(days: list[list[Rays]]) -> None:
    rays = days[1] + [stretch(ROOM, 5.0 * k - 8.0, 70 + k) for k in range(3)]
    still = SeenThrough(np.concatenate([ends for _, ends in rays]))
    for origins, ends in rays:
        still.add_stretch(0, origins, ends)
    assert still.is_moving.mean() < 1e-4


def test_the_change_between_sessions_is_a_cluster_of_its_size(seen: SeenThrough) -> None:
    vanished, appeared = seen.changes(0, 1)
    assert appeared.mean() < 1e-3
    (car, *others) = seen.clusters(vanished, least=10)
    low, high = seen.middle[car].min(axis=0), seen.middle[car].max(axis=0)
    np.testing.assert_allclose(0.5 * (low + high)[:2], [0.0, 4.0], atol=0.5)
    assert not others and (high - low)[0] == pytest.approx(4.0, abs=0.6)
    back = seen.changes(1, 0)
    assert (back[1] == vanished).all() and (back[0] == appeared).all()


def test_one_stretch_is_not_enough(days: list[list[Rays]]) -> None:
    points = np.concatenate([ends for day in days for _, ends in day])
    once = SeenThrough(points, config=SeenThroughConfig(least_stretches=2))
    once.add_stretch(0, *days[1][1])
    assert once.through.any() and not once.is_moving.any()


def test_a_voxel_that_is_hit_too_says_nothing() -> None:
    """A fence of posts: some rays hit it, others go through between them."""
    wall = np.column_stack([np.full(400, 8.0), np.linspace(-2, 2, 400), np.full(400, 1.0)])
    fence = np.column_stack([np.full(80, 4.0), np.linspace(-1, 1, 80), np.full(80, 1.0)])
    seen = SeenThrough(np.concatenate([wall, fence]), config=SeenThroughConfig(least_rays=1, least_stretches=1))
    origin = np.array([0.0, 0.0, 1.0])
    ends = np.concatenate([wall, fence])
    seen.add_stretch(0, np.broadcast_to(origin, ends.shape), ends)
    assert not seen.is_moving.any()
    seen.add_stretch(0, np.broadcast_to(origin, wall.shape), wall)
    assert seen.is_removed(fence).mean() > 0.8 and not seen.is_removed(wall).any()
