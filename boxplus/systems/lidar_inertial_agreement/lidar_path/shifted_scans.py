"""Whether scans of a LiDAR at rest would fit one another worse, had it moved along an axis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.iterated_update import Information
from boxplus.filtering.nav_state import NavState, P
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.plane_measurement import PlaneMeasurement
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.lidar.downsampling import VoxelFilter
from boxplus.sensors.lidar.scan import Scan

_COMPARED, _POINTS, _FEWEST = 3, 3000, 100  # scans at either end at most, points of one, and fewer of them say nothing
_APART_S = 0.55  # between the first ones and the last: less leaves slower motions unseen
_NEAR_M = 3.0  # what goes along with a LiDAR, a mast or who carries it, is nearer: it fits at rest whatever moves
_SHIFTS_M = (0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8)  # less is for the registrations to see: a third of a metre a second
_WORSE = 1.4  # times the cost; rings that lie askew on a smooth tunnel reach 1.3 at the least of these shifts
# Share of the points that comes to lie beside its place: so much for each metre of a shift, up to that of 0.4 m. Of a narrow
# view of a tunnel all lie on its wall, where nearly nothing costs anything: one in a hundred that a shift takes over the edge of
# the view, or off what its curves showed of the wall a second before, makes it cost half as much again.
_BESIDE_A_METRE, _BESIDE = 0.15, 0.06


def shifts_show(scans: Sequence[Scan], axis: NDArray[np.float64], config: RegistrationConfig) -> bool:
    """Whether the last scans fit the first ones clearly worse at any shift of 0.2 m and more along an axis than unmoved.

    Where surfaces that face it are hard to tell, as among stems and leaves, a shift still leaves everything beside its place.
    Along a tunnel or a street between smooth walls the scans fit as well. Motions of less than a third of a metre a second stay
    unseen, and what is repeated is told from the same by nothing here: registrations have to say that the scans lie still.

    Args:
        scans: some that may all have been taken from one place; False where the middles of the last and the first are not 0.55 s
            apart.
        axis: (3,) unit vector in the LiDAR's frame.
        config: of the LiDAR's noise and the sizes of cells.
    """
    count = min(_COMPARED, len(scans) // 2)
    first, last = scans[:count], scans[len(scans) - count :]
    if not count or (last[0].start_ns + last[-1].end_ns - first[0].start_ns - first[-1].end_ns) * 0.5e-9 < _APART_S:
        return False
    voxel_filter = VoxelFilter(max(config.scan_voxel, config.map_cell), _POINTS)
    tree, measurements = unmoved_map(first, voxel_filter, config), []
    for scan in last:
        points = voxel_filter(scan.p_lidar)[0]
        points = points[np.linalg.norm(points, axis=1) > _NEAR_M]
        if len(points) < _FEWEST:
            return False
        measurements.append(PlaneMeasurement(points, tree, config, with_extrinsic=False))
    unmoved = _cost(measurements, np.zeros(3), config)

    def is_worse(shift: float) -> bool:
        beside = min(_BESIDE_A_METRE * abs(shift), _BESIDE) * len(measurements) * config.plane_threshold**2
        return _cost(measurements, shift * axis, config) > max(_WORSE * unmoved, unmoved + beside)

    return all(is_worse(sign * shift) for shift in _SHIFTS_M for sign in (1.0, -1.0))


def unmoved_map(scans: Sequence[Scan], voxel_filter: VoxelFilter, config: RegistrationConfig) -> IkdTree:
    """The points of scans, thinned, as a LiDAR at rest has them."""
    tree = IkdTree(cell_size=config.map_cell, rebuild="inplace")
    for scan in scans:
        tree.insert(voxel_filter(scan.p_lidar)[1].astype(np.float64), downsample=True)
    return tree


def cost_of(fit: Information, share: float, config: RegistrationConfig) -> float:
    """Mean square of the residuals of a scan [m²], of which a share fits something; what does not counts as far off."""
    return share * fit.residual_rms**2 + (1.0 - share) * config.plane_threshold**2


def _cost(measurements: Sequence[PlaneMeasurement], shift: NDArray[np.float64], config: RegistrationConfig) -> float:
    """What it costs to shift scans (3,) [m], added up [m²]; a scan that has left the map fits what few planes it meets."""
    x, cost = NavState.identity().pack(), 0.0
    x[P : P + 3] = shift
    for measurement in measurements:
        fit = measurement.at(x, rematch=True)
        cost += cost_of(fit, fit.used / measurement.points, config)
    return cost
