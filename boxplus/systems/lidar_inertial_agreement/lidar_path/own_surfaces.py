"""How much of a scan lies on surfaces that it shows itself: where that is little, no scan can be laid upon another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from boxplus.filtering.nav_state import NavState
from boxplus.maps.plane_measurement import PlaneMeasurement
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.lidar.downsampling import VoxelFilter
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.shifted_scans import unmoved_map
from boxplus.systems.lidar_inertial_agreement.lidar_path.tracks.scan_fit import MOST_MAP_POINTS, MOST_POINTS

_LITTLE = 0.1
_FEWEST = 500  # points of a scan
_NEAREST_M, _FARTHEST_M = 0.3, 300.0  # median range: points may be in another unit


def share_on_own_surfaces(scan: Scan, config: RegistrationConfig) -> float:
    """Of the thinned points of a scan, those that lie on planes of its own map, 0 to 1.

    Few rings on bare ground lie metres apart, and a line is no plane: a vehicle with sixteen of them, alone in a field, has 0.005
    to 0.095, one in a street, a wood or a room 0.4 and more, and with sixty-four of them in a field 0.3.

    Args:
        scan: as it was measured. config: with the cells that suit it (`registration.with_cells_for`).
    """
    tree = unmoved_map([scan], VoxelFilter(config.map_cell, MOST_MAP_POINTS), config)
    points = VoxelFilter(max(config.scan_voxel, config.map_cell), MOST_POINTS)(scan.p_lidar)[0]
    measurement = PlaneMeasurement(points, tree, config, with_extrinsic=False)
    return measurement.at(NavState.identity().pack(), rematch=True).used / max(len(points), 1)


def show_little(scans: Sequence[Scan], config: RegistrationConfig) -> str:
    """Why scans like these cannot be laid upon each other, wherever they were taken, a clause; empty where they can.

    The one that shows most of the first, the middle and the last counts; nothing is said of scraps, and of lengths that no LiDAR
    measures.

    Args:
        scans: consecutive sweeps, at least one; config: as of `share_on_own_surfaces`.
    """
    some = [scans[0], scans[len(scans) // 2], scans[-1]]
    if any(len(scan) < _FEWEST or not _NEAREST_M < _median_range(scan) < _FARTHEST_M for scan in some):
        return ""
    share = max(share_on_own_surfaces(scan, config) for scan in some)
    if share >= _LITTLE:
        return ""
    return (
        f"only {100.0 * share:.0f} % of the points of a scan lie on a surface that it shows, too few to lay one scan upon "
        "another (few rings on bare ground, or too little near)"
    )


def _median_range(scan: Scan) -> float:
    return float(np.median(np.linalg.norm(scan.p_lidar, axis=1)))
