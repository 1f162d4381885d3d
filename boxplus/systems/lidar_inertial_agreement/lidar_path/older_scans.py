"""A scan against some older ones alone: what no scan shows against the one before it.

Planes that noise or the pattern of the beams has made move along with the sensor: each scan fits the map, which the last ones
have made, and a path is held back, pulled aside or tilted, a little with every scan. Scans a second apart do not share the
pattern.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.degeneracy import strong_covariance
from boxplus.filtering.nav_state import TANGENT, boxminus_into
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.plane_measurement import PlaneMeasurement
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import align

_STEPS = 6  # of the registration, which begins close by
_FLOOR = np.repeat([3e-4, 3e-3], 3) ** 2  # rad², m²: surfaces are no planes
_LEAST_USED = 100  # points on planes
_LEAST_ON_MAP = 0.25  # of the points: the old scans show the same place
_LEAST_FITTING = 0.9  # of the points with a plane
_LARGEST_SIGMA_M = 0.05  # of the registration, or it says nothing


def map_of(old_world: Sequence[NDArray[np.float64]], config: RegistrationConfig) -> IkdTree:
    """The map that older scans make, of the points (m, 3) of each of them, in the world."""
    tree = IkdTree(cell_size=config.map_cell, rebuild="inplace")
    tree.insert(np.concatenate(old_world), downsample=True)
    return tree


def register_to(
    old: IkdTree, x: NDArray[np.float64], p_lidar: NDArray[np.float32], config: RegistrationConfig
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Where a scan would lie if only some older scans were known.

    Args:
        old: the map of them.
        x: (36,) packed state to begin at; p_lidar: (n, 3) the scan, LiDAR frame.
        config: of the registration.

    Returns:
        The motion (6,) from x, [θ about the IMU's axes, p along the world's], and its covariance (6, 6), both without the
        directions that the older scans do not determine; None where they fit too little of the scan.
    """
    at = x.copy()
    measurement = PlaneMeasurement(p_lidar, old, config, with_extrinsic=False, confirm=True)
    directions = align(at, measurement, config, steps=_STEPS)
    if directions is None or directions.weak.all() or measurement.fitting_share < _LEAST_FITTING:
        return None
    information = measurement.at(at, rematch=False)
    if information.used < _LEAST_USED or measurement.on_map_share < _LEAST_ON_MAP:
        return None
    covariance = strong_covariance(information.A, directions) + np.diag(_FLOOR)
    if float(np.linalg.eigvalsh(covariance[3:, 3:])[-1]) > _LARGEST_SIGMA_M**2:
        return None
    delta = np.zeros(TANGENT)
    boxminus_into(at, x, delta)
    return delta[:6], covariance


def deviations_of(delta: NDArray[np.float64], covariance: NDArray[np.float64]) -> float:
    """How far a motion (6,) [θ, p] is from none, by its covariance (6, 6): √(δᵀ C⁻¹ δ) of rotation or position, the larger."""
    parts = (slice(0, 3), slice(3, 6))
    return float(np.sqrt(max(float(delta[part] @ np.linalg.solve(covariance[part, part], delta[part])) for part in parts)))
