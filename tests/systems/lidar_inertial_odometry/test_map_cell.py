"""Cells of the map for what a scan sees: surfaces all over and near are mapped finer, everything else as the settings say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.manifolds import so3
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.lidar.downsampling import VoxelFilter
from boxplus.systems.lidar_inertial_odometry.map_cell import map_cell_for

CONFIG = RegistrationConfig()
seeds = st.integers(0, 2**32 - 1)


def _cell(points: np.ndarray, config: RegistrationConfig = CONFIG) -> float:
    thinned = VoxelFilter(config.scan_voxel)(points.astype(np.float32))[0]
    return map_cell_for(thinned, config.scan_voxel, config)


def _box(random: np.random.Generator, size_m: float, per_m2: float) -> np.ndarray:
    """Points on the six faces of a box, turned anyhow."""
    faces = []
    for axis in range(3):
        for side in (-0.5, 0.5):
            face = random.uniform(-0.5, 0.5, (int(per_m2 * size_m**2), 3)) * size_m
            face[:, axis] = side * size_m
            faces.append(face)
    return np.concatenate(faces) @ so3.exp(random.normal(size=3)).T


@settings(max_examples=15, deadline=None)
@given(seeds)
def test_a_small_room_that_is_seen_all_over_has_finer_cells(seed: int) -> None:
    random = np.random.default_rng(seed)
    assert _cell(_box(random, random.uniform(1.0, 2.5), 400.0)) == 0.125


@settings(max_examples=15, deadline=None)
@given(seeds)
def test_a_large_room_keeps_the_cells_of_the_settings(seed: int) -> None:
    random = np.random.default_rng(seed)
    assert _cell(_box(random, random.uniform(5.0, 9.0), 400.0)) == CONFIG.map_cell


@settings(max_examples=15, deadline=None)
@given(seeds, st.floats(5.0, 40.0))
def test_points_far_apart_do_not_fill_finer_cells(seed: int, side_m: float) -> None:
    points = np.random.default_rng(seed).uniform(0.0, side_m, (700, 3))
    assert _cell(points) == CONFIG.map_cell


@settings(max_examples=15, deadline=None)
@given(seeds, st.floats(0.01, 0.1))
def test_no_cell_is_so_small_that_noise_makes_its_planes(seed: int, range_sigma: float) -> None:
    points = _box(np.random.default_rng(seed), 1.0, 900.0)
    config = RegistrationConfig(range_sigma=range_sigma, scan_voxel=0.05)
    cell = _cell(points, config)
    assert cell >= 4.0 * range_sigma or cell == config.map_cell
    assert config.map_cell / cell in (1.0, 2.0, 4.0)


def test_more_cells_are_halved_where_surfaces_lie_closer_together_than_they_do() -> None:
    random = np.random.default_rng(3)
    sheets = random.uniform(0.0, 3.5, (9, 4000, 3))
    apart, close = sheets.copy(), sheets.copy()
    apart[..., 2], close[..., 2] = np.arange(9)[:, None] * 1.0, np.arange(9)[:, None] * 0.16
    cells = [len(VoxelFilter(CONFIG.map_cell)(sheet.reshape(-1, 3).astype(np.float32))[0]) for sheet in (apart, close)]
    assert 1000 < cells[1] < cells[0] < 2000
    assert _cell(apart.reshape(-1, 3)) == CONFIG.map_cell
    assert _cell(close.reshape(-1, 3)) == 0.5 * CONFIG.map_cell


@pytest.mark.parametrize("voxel", [0.25, 0.4])
def test_voxels_as_large_as_the_cells_say_nothing_about_finer_ones(voxel: float) -> None:
    points = _box(np.random.default_rng(0), 1.5, 400.0)
    assert _cell(points, RegistrationConfig(scan_voxel=voxel, map_cell=0.25)) == 0.25


def test_nothing_seen() -> None:
    assert map_cell_for(np.zeros((0, 3), np.float32), 0.15, CONFIG) == CONFIG.map_cell
