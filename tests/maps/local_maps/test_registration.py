"""Registration of local maps against ground truth, and its covariance by NEES."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.maps.local_maps.config import LocalMapRegistrationConfig
from boxplus.maps.local_maps.registration import Surface, approach, register
from boxplus.maps.tiles.voxel_thinning import first_per_voxel
from boxplus.simulation.worlds.world import World
from boxplus.simulation.worlds.worlds import city, corridor, hall
from boxplus.systems.slam.rivals import rival_shifts


def seen(world: World, T: NDArray[np.float64], random: np.random.Generator, rays: int = 12_000) -> Surface:
    """What a sensor at a pose (7,) sees within 40 m, ranges to 2 cm."""
    z = random.uniform(-0.5, 0.3, rays)
    azimuth = random.uniform(0.0, 2.0 * np.pi, rays)
    level = np.sqrt(1.0 - z**2)
    d = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), z])
    R = np.stack([se3.act(T, axis) - T[4:] for axis in np.eye(3)], axis=1)
    ranges, _ = world.cast(d, R[None], T[None, 4:], 40.0)
    hit = np.isfinite(ranges)
    points = (d[hit] * (ranges[hit] + random.normal(0.0, 0.02, hit.sum()))[:, None]).astype(np.float32)
    return Surface.of(points[first_per_voxel(points, 0.2)])  # as a local map is


def pose(random: np.random.Generator, x: float, y: float) -> NDArray[np.float64]:
    yaw = random.uniform(-np.pi, np.pi)
    return np.array([np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw), x, y, 1.6])


@pytest.mark.slow
def test_visits_are_laid_over_each_other_within_the_covariance() -> None:
    """From up to half a metre and 3° off. NEES of six degrees of freedom: below 6 where the floor speaks, never far above."""
    nees = []
    for seed in range(8):
        random = np.random.default_rng(seed)
        world = city(2, 2, seed=seed)
        a, b = pose(random, 60.0, 40.0), pose(random, 60.0 + random.uniform(-2.0, 2.0), 40.0 + random.uniform(-2.0, 2.0))
        T = se3.compose(se3.inverse(a), b)
        start = se3.compose(T, se3.exp(random.normal(0.0, np.repeat([0.02, 0.2], 3))))
        found = register(seen(world, b, random), seen(world, a, random), start)
        assert found is not None and len(found.weak) == 0 and min(found.overlap) > 0.5
        xi = se3.log(se3.compose(se3.inverse(T), found.T_target_source))
        assert np.linalg.norm(xi[3:]) < 0.05 and np.linalg.norm(xi[:3]) < 0.005
        nees.append(xi @ np.linalg.solve(found.covariance, xi))
        np.testing.assert_allclose(found.information @ found.covariance, np.eye(6), atol=1e-6)
    assert np.mean(nees) < 2.0 * 6.0


def test_walls_half_a_metre_off_are_no_outliers_beside_a_floor_that_fits() -> None:
    """From the middle of a cell of 1 m, along either axis of a hall, whose floor is most of what is seen."""
    config, errors = LocalMapRegistrationConfig(), []
    for seed in range(3):
        random = np.random.default_rng(seed)
        world = hall(seed=seed)
        T = np.array([1.0, 0.0, 0.0, 0.0, random.uniform(-8.0, 8.0), random.uniform(-4.0, 4.0), 1.6])
        there, here = seen(world, T, random), seen(world, T, random)
        for x, y in ((0.45, 0.0), (0.0, 0.45), (-0.35, 0.35)):
            found = approach(here, there, np.array([1.0, 0.0, 0.0, 0.0, x, y, 0.0]), config)
            assert found is not None
            errors.append(np.linalg.norm(found[4:]))
    assert max(errors) < 0.1


def test_a_bent_map_is_less_certain() -> None:
    random = np.random.default_rng(0)
    world, T = city(2, 2, seed=0), pose(random, 60.0, 40.0)
    a, b = seen(world, T, random), seen(world, T, random)
    still = np.array([1.0, 0, 0, 0, 0, 0, 0])
    bend = np.diag(np.repeat([1e-6, 0.04**2], 3))
    stiff, bent = register(a, b, still), register(a, b, still, deformation=bend)
    assert stiff is not None and bent is not None
    np.testing.assert_allclose(bent.covariance, stiff.covariance + bend, rtol=1e-6, atol=1e-12)


def test_along_a_smooth_corridor_nothing_is_measured() -> None:
    random = np.random.default_rng(1)
    world = corridor()
    start = np.array([1.0, 0, 0, 0, 1.0, 0.05, 0.0])  # a metre along it, which nothing tells
    T = np.array([1.0, 0, 0, 0, 0.0, 0.0, 1.2])
    found = register(seen(world, T, random), seen(world, T, random), start)
    assert found is not None and len(found.weak) == 1
    assert abs(found.weak[0, 3]) > 0.95
    assert abs(found.T_target_source[4] - 1.0) < 0.1 and abs(found.T_target_source[5]) < 0.02
    along = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    across = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    assert along @ found.information @ along < 1e-2 * (across @ found.information @ across)
    assert along @ found.covariance @ along > 1.0


def test_points_without_planes_are_no_registration() -> None:
    random = np.random.default_rng(2)
    few = Surface.of(random.normal(0.0, 10.0, (200, 3)).astype(np.float32))
    assert register(few, few, np.array([1.0, 0, 0, 0, 0, 0, 0])) is None


@pytest.mark.parametrize("sigma, count", [(4.0, 1), (0.1, 0)])
def test_rows_of_columns_have_rivals_as_far_as_one_may_be_off(sigma: float, count: int) -> None:
    """Columns 8 m apart along x: shifts by 8 m are rivals where the odometry knows the place to 4 m, none where to 10 cm."""
    random = np.random.default_rng(3)
    x = np.repeat(8.0 * np.arange(8), 200)
    columns = np.column_stack([x, np.zeros_like(x), np.zeros_like(x)]) + random.uniform(-0.3, 0.3, (len(x), 3)) * [1, 1, 5]
    still = np.array([1.0, 0, 0, 0, 0, 0, 0])
    points = columns.astype(np.float32)
    covariance = np.diag([sigma**2, 0.1**2])
    shifts = rival_shifts(points, points, still, cell=0.5, least=1.5, sigma=covariance, share=0.6, count=2)
    assert len(shifts) == 2 * count
    if count:
        np.testing.assert_allclose(np.sort(shifts[:, 0]), [-8.0, 8.0], atol=0.5)


def test_an_odometry_that_knows_nothing_has_no_more_rivals_than_places_that_overlap() -> None:
    """After a minute without data its standard deviation is kilometres, and images of all shifts within would be terabytes."""
    random = np.random.default_rng(4)
    points = (random.uniform(-1.0, 1.0, (4000, 3)) * [20.0, 10.0, 2.0]).astype(np.float32)
    still = np.array([1.0, 0, 0, 0, 0, 0, 0])
    found = [
        rival_shifts(points, points, still, cell=0.5, least=1.5, sigma=sigma**2 * np.eye(2), share=0.1, count=3)
        for sigma in (100.0, 1e6)
    ]
    assert len(found[0]) == 3
    np.testing.assert_array_equal(*found)
