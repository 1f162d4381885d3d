"""A cloud in feet, mirrored or lying on a side has the place that is seen, read as what it is; one of another place has none."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from boxplus.formats.clouds.ply import write_ply
from boxplus.manifolds import se3
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.maps.tiles.voxel_thinning import first_per_voxel
from boxplus.runs.saved_map.other_readings import other_reading
from boxplus.runs.saved_map.saved_map import open_saved_map
from boxplus.simulation.drifting_drive import DriftConfig, DriftingDrive, simulate_drifting_drive
from boxplus.simulation.worlds.worlds import hall
from boxplus.systems.localization.localizer import Localizer

CONFIG = LocalMapConfig(max_range=30.0)  # type: ignore[call-arg]
DRIFT = DriftConfig(channels=16, azimuth_steps=240, speed=1.5, step_m=0.5, corner_radius=0.8, max_range=40.0, height=1.6)


@cache
def walk(seed: int, first: float, last: float) -> DriftingDrive:
    return simulate_drifting_drive(hall(seed=seed), [[first, -5.0], [last, -5.0]], DRIFT, seed=3)


def cloud(seed: int) -> np.ndarray:
    drive = walk(seed, -16.0, 16.0)
    points = np.concatenate([se3.act(T, scan.astype(float)) for T, scan in zip(drive.T_world_body, drive.scans, strict=True)])
    return points[first_per_voxel(points.astype(np.float32), 0.2)]


def reading(path: Path, points: np.ndarray) -> str | None:
    """What is said of a map after a walk of 12 m along its route, the other way round, of which nothing was found in it."""
    write_ply(path, points.astype(np.float32))
    saved = open_saved_map(path, CONFIG)
    localizer, drive = Localizer(saved), walk(2, 8.0, -4.0)
    for time_ns, T, scan in zip(drive.time_ns, drive.T_odo_body, drive.scans, strict=True):
        assert localizer.push(int(time_ns), T, scan).T_map_body is None
    return other_reading(saved, localizer, CONFIG)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "name"),
    [
        (np.eye(3) / 0.3048, "in feet"),
        (np.diag([-1.0, 1.0, 1.0]), "mirrored"),
        (np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), "with y up"),
        (np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), "with y down"),
    ],
)
def test_what_is_wrong_with_a_cloud_is_named(tmp_path: Path, change: np.ndarray, name: str) -> None:
    text = reading(tmp_path / "map.ply", cloud(2) @ change.T)
    assert text is not None and text.startswith(f"read {name}, the map has what was seen (")


@pytest.mark.slow
def test_no_reading_has_what_is_not_there(tmp_path: Path) -> None:
    assert reading(tmp_path / "map.ply", cloud(1002)) is None
