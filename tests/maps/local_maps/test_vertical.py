"""The vertical that surfaces show, of worlds that are turned, and what is said where they show none."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.manifolds import quaternion, se3, so3
from boxplus.maps.local_maps.builder import LocalMapBuilder
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.maps.local_maps.vertical import find_vertical
from boxplus.maps.tiles.voxel_thinning import first_per_voxel
from boxplus.simulation.drifting_drive import DriftConfig, DriftingDrive, simulate_drifting_drive
from boxplus.simulation.worlds.worlds import city, yard

UP = np.array([0.0, 0.0, 1.0])
CONFIG = DriftConfig(channels=16, azimuth_steps=180)


def drive_in(world: str) -> DriftingDrive:
    built = city(1, 1, seed=4) if world == "city" else yard(60.0, seed=4)
    return simulate_drifting_drive(built, [[0, 0], [25, 0]], CONFIG, seed=2)


def degrees_between(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


@pytest.mark.parametrize("world", ["city", "yard"])
@pytest.mark.parametrize("tilt_deg", [0.0, 8.0, 25.0, 40.0])
@pytest.mark.parametrize("about", [(1.0, 0.0, 0.0), (-0.6, 0.8, 0.0)])
def test_the_vertical_is_found_however_the_lidar_leans(world: str, tilt_deg: float, about: tuple[float, float, float]) -> None:
    drive = drive_in(world)
    R = so3.exp(np.radians(tilt_deg) * np.array(about))
    builder, made = LocalMapBuilder(LocalMapConfig(length=10.0)), []
    leaning = np.concatenate([quaternion.from_matrix(R.T), np.zeros(3)])
    T_odo = se3.compose(drive.T_odo_body, leaning)
    for time_ns, T, scan in zip(drive.time_ns.tolist(), T_odo, drive.scans, strict=True):
        made += builder.push(time_ns, T, np.zeros((6, 6)), (scan @ R.T).astype(np.float32), None)
    ups = quaternion.to_matrix(np.stack([local_map.T_odo_map[:4] for local_map in made]))[:, :, 2]
    assert len(made) >= 2 and degrees_between(ups[0], UP) < 0.3
    np.testing.assert_allclose(ups[1:], ups[:1].repeat(len(made) - 1, axis=0), atol=1e-12)  # told once, then carried on


def walls_and_floor(noise: float, seed: int) -> NDArray[np.float64]:
    """Of a room of 10 x 10 m, with a sensor at its middle, 1.3 m above the floor."""
    random = np.random.default_rng(seed)
    floor, along, across = (random.uniform(-5.0, 5.0, (15_000, 3)) for _ in range(3))
    floor[:, 2], along[:, 1], across[:, 0] = -1.3, 5.0, -5.0
    above = [wall[(wall[:, 2] > -1.3) & (wall[:, 2] < 1.7)] for wall in (along, across)]
    cloud = np.concatenate([floor, *above])
    return random.permutation(cloud + random.normal(0.0, noise, cloud.shape))


def turned(cloud: NDArray[np.float64], tilt_deg: float) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    R = so3.exp(np.radians(tilt_deg) * np.array([0.6, 0.8, 0.0]))
    return np.ascontiguousarray((cloud @ R.T).astype(np.float32)), R @ UP


@pytest.mark.parametrize("voxel", [0.05, 0.1, 0.2, 0.5])
@pytest.mark.parametrize("noise", [0.01, 0.03])
def test_neither_small_voxels_nor_noise_hide_the_planes(voxel: float, noise: float) -> None:
    for seed in (11, 12):
        cloud, up = turned(walls_and_floor(noise, seed), 15.0)
        found = find_vertical(cloud[first_per_voxel(cloud, voxel)], UP)
        assert found is not None and degrees_between(found, up) < 0.5


def bushes(random: np.random.Generator) -> NDArray[np.float64]:
    return random.uniform(-10.0, 10.0, (60, 3))[random.integers(0, 60, 20_000)] + random.normal(0.0, 0.4, (20_000, 3))


def balls(random: np.random.Generator) -> NDArray[np.float64]:
    away = random.normal(size=(20_000, 3))
    away *= 1.5 / np.linalg.norm(away, axis=1, keepdims=True)
    return random.uniform(-10.0, 10.0, (40, 3))[random.integers(0, 40, 20_000)] + away


def shards(random: np.random.Generator) -> NDArray[np.float64]:
    """Planes, in any direction."""
    R = so3.exp(random.normal(0.0, 2.0, (60, 3)))
    flat = random.uniform(-1.0, 1.0, (60, 300, 3)) * np.array([1.0, 1.0, 0.0])
    return (flat @ np.swapaxes(R, 1, 2) + random.uniform(-10.0, 10.0, (60, 1, 3))).reshape(-1, 3)


def pipe(random: np.random.Generator) -> NDArray[np.float64]:
    around = random.uniform(0.0, 2.0 * np.pi, 20_000)
    return np.stack([random.uniform(-15.0, 15.0, 20_000), 3.0 * np.cos(around), 3.0 * np.sin(around)], axis=1)


def wall(random: np.random.Generator) -> NDArray[np.float64]:
    """As upright for any turn about its normal."""
    return random.uniform(-5.0, 5.0, (8_000, 3)) * np.array([1.0, 0.0, 1.0])


def two_walls(random: np.random.Generator) -> NDArray[np.float64]:
    return wall(random) + np.array([0.0, 4.0, 0.0]) * random.integers(0, 2, (8_000, 1))


@pytest.mark.parametrize("scene", [bushes, balls, shards, pipe, wall, two_walls])
@pytest.mark.parametrize(("seed", "tilt_deg"), [(11, 0.0), (12, 20.0)])
def test_what_leaves_it_open_shows_nothing(
    scene: Callable[[np.random.Generator], NDArray[np.float64]], seed: int, tilt_deg: float
) -> None:
    cloud = scene(np.random.default_rng(seed))
    assert find_vertical(turned(cloud, tilt_deg)[0], UP) is None
    assert find_vertical(cloud[:5].astype(np.float32), UP) is None  # hardly a point


def test_a_slope_under_all_that_is_seen_passes_for_level() -> None:
    slope = np.random.default_rng(4).uniform(-10.0, 10.0, (20_000, 3)) * np.array([1.0, 1.0, 0.0])
    cloud, normal = turned(slope, 8.0)
    found = find_vertical(cloud, UP)
    assert found is not None and degrees_between(found, normal) < 0.1 and degrees_between(found, UP) > 7.9


NOTHING = np.zeros((0, 3))


@pytest.mark.parametrize("first", [NOTHING, bushes(np.random.default_rng(5))])
@pytest.mark.parametrize("looks_anew", [False, True])
def test_it_is_looked_for_until_a_map_shows_it(first: NDArray[np.float64], looks_anew: bool) -> None:
    """And carried on from there, or looked for again."""
    room, up = turned(walls_and_floor(0.01, 6), 15.0)
    leaning, other_up = turned(walls_and_floor(0.01, 7), 25.0)  # as an odometry that has drifted sees it
    seen = [first, first, room, bushes(np.random.default_rng(8)), leaning, leaning]
    builder, made = LocalMapBuilder(LocalMapConfig(length=1.0), looks_anew=looks_anew), []
    for k, cloud in enumerate(seen):
        for step in range(2):  # the next map begins with the scan that completes this one, without its points
            T = np.array([1.0, 0.0, 0.0, 0.0, 2.0 * k + step, 0.0, 0.0])
            points = cloud if step == 0 or k == 0 else NOTHING
            made += builder.push(1 + 2 * k + step, T, np.zeros((6, 6)), points, None)
    shown = [local_map.is_level for local_map in made]
    ups = [quaternion.to_matrix(local_map.T_odo_map[:4])[:, 2] for local_map in made]
    begun = shown.index(True)
    assert begun >= 2 and all(shown[begun:])
    assert all(degrees_between(guess, UP) < 1e-6 for guess in ups[:begun])
    assert degrees_between(ups[begun], up) < 0.5
    np.testing.assert_allclose(ups[begun + 1], ups[begun], atol=1e-12)
    if looks_anew:
        assert degrees_between(ups[-1], other_up) < 0.5
    else:
        np.testing.assert_allclose(ups[-1], ups[begun], atol=1e-12)


def test_a_vertical_that_is_said_is_never_looked_for() -> None:
    builder = LocalMapBuilder(LocalMapConfig(length=1.0))
    for k in range(2):
        made = builder.push(k, np.array([1.0, 0.0, 0.0, 0.0, 2.0 * k, 0.0, 0.0]), np.zeros((6, 6)), NOTHING, UP)
    assert [local_map.is_level for local_map in made] == [True]
