"""Settings of a registration that what is seen asks for."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import with_cells_for, with_cells_for_all
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG


def _wall(distance: float, start_ns: int) -> Scan:
    """A cone of 60 deg that a wall fills."""
    grid = distance * np.tan(np.deg2rad(np.linspace(-30.0, 30.0, 60)))
    y, z = np.meshgrid(grid, grid)
    p = np.column_stack([np.full(y.size, distance), y.ravel(), z.ravel()]).astype(np.float32)
    return Scan(p, np.full(len(p), start_ns, np.int64), None, start_ns, start_ns + 50_000_000)


@pytest.mark.parametrize("nearest", range(0, 40, 7))
def test_the_nearest_scan_of_a_stretch_asks_for_finer_cells(nearest: int) -> None:
    scans = [_wall(6.0, 50_000_000 * k) for k in range(40)]
    assert with_cells_for_all(scans, CONFIG) == CONFIG
    # Who comes close stays so for a while.
    close = [_wall(0.6, scan.start_ns) if abs(k - nearest) < 8 else scan for k, scan in enumerate(scans)]
    found = with_cells_for_all(close, CONFIG)
    assert found.map_cell == with_cells_for(close[nearest], CONFIG).map_cell < CONFIG.map_cell


def test_without_scans_settings_stay() -> None:
    assert with_cells_for_all([], CONFIG) == CONFIG
