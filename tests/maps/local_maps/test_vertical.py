"""The vertical that surfaces show, of worlds that are turned, and what is said where they show none."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.manifolds import quaternion, se3, so3
from boxplus.maps.local_maps.builder import LocalMapBuilder
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.maps.local_maps.vertical import find_vertical
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


def test_surfaces_that_leave_it_open_leave_the_guess() -> None:
    guess = np.array([0.1, 0.0, np.sqrt(0.99)])
    random = np.random.default_rng(1)
    cloud = random.uniform(-5.0, 5.0, (4000, 3)).astype(np.float32)
    assert find_vertical(cloud[:5], guess) is guess  # hardly a point
    wall = random.uniform(-5.0, 5.0, (4000, 3)) * np.array([1.0, 0.0, 1.0])  # across y: as upright for any turn about y
    up = find_vertical(wall.astype(np.float32), guess)
    assert abs(up[1]) < 1e-3 and degrees_between(up, guess) < 3.0
