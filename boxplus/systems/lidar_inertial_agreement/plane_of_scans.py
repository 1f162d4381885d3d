"""The plane that most of every scan shows against gravity: what is left to tell a mounting by where no motion is found.

A start fails where the LiDAR's path is not found, and then neither rotations nor accelerations can contradict a mounting. Every
scan for itself still shows the ground, or the walls of a shaft, and these stand level or upright: most of them, if not as
exactly as several orthogonal directions together (`plane_tilt`), which this cannot replace.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.downsampling import VoxelFilter
from boxplus.sensors.gyro_attitude import GyroAttitude
from boxplus.sensors.imu import ImuSamples
from boxplus.sensors.scan import Scan
from boxplus.systems.lidar_inertial_agreement.plane_tilt import plane_directions, plane_normals

_SCANS, _MOST_POINTS = 10, 5000
_FEWEST_SCANS, _FEWEST_SAMPLES = 3, 10
_SEVERAL = 2  # stretches of the window by which gravity is found
_MOST = 0.5  # of the planar points lie in the plane
_STEEPEST_RAD = np.deg2rad(8.0)  # what roads climb, and what a walk's acceleration over a second or two tilts
_DEVIATIONS = 3.0


def tilted_plane(
    scans: Sequence[Scan], imu: ImuSamples, R_imu_lidar: NDArray[np.float64], config: RegistrationConfig
) -> str | None:
    """Whether the plane that most of the scans show is neither level nor upright; a sentence, None where it may be.

    Args:
        scans: consecutive sweeps, a second or more of them.
        imu: finite samples of the same stretch in order of time.
        R_imu_lidar: (3, 3) the mounting to judge.
        config: sizes of cells.
    """
    inside = (imu.time_ns >= scans[0].start_ns) & (imu.time_ns <= scans[-1].end_ns)
    if np.count_nonzero(inside) < _FEWEST_SAMPLES:
        return None
    attitude = GyroAttitude(imu.time_ns[inside], imu.gyro[inside])
    force = np.einsum("nij,nj->ni", attitude.at(imu.time_ns[inside]), imu.accel[inside])
    ups = [_unit(part.mean(axis=0)) for part in (force, *np.array_split(force, _SEVERAL))]
    # What accelerates the platform besides gravity hardly stays the same.
    std = 0.5 * float(np.arccos(np.clip(ups[1] @ ups[2], -1.0, 1.0)))
    tilts = []
    for k in np.unique(np.linspace(0, len(scans) - 1, _SCANS).astype(int)):
        middle_ns = np.array([(scans[k].start_ns + scans[k].end_ns) // 2])
        R_first_lidar = attitude.at(middle_ns)[0] @ R_imu_lidar
        tilts += _tilts(scans[k], R_first_lidar.T @ ups[0], config)
    if len(tilts) < _FEWEST_SCANS:
        return None
    tilt = float(np.median(tilts))
    std = float(np.hypot(std, 0.5 * np.ptp(np.quantile(tilts, [0.16, 0.84]))))
    if tilt < _STEEPEST_RAD + _DEVIATIONS * std:
        return None
    return (
        f"by the accelerometer and the given T_imu_lidar, the plane that makes up most of a scan is {np.degrees(tilt):.0f} deg "
        f"from level and from upright (median of {len(tilts)} scans): check T_imu_lidar, and that the topics are those of this "
        "mounting, unless the ground slopes as much"
    )


def _tilts(scan: Scan, up_lidar: NDArray[np.float64], config: RegistrationConfig) -> list[float]:
    """The angle of a scan's main plane from level or from upright, the lesser of both [rad]; nothing where it has none."""
    points = VoxelFilter(config.map_cell, _MOST_POINTS)(scan.p_lidar)[1].astype(np.float64)
    if not len(points):
        return []
    tree = IkdTree(cell_size=config.map_cell, rebuild="inplace")
    tree.insert(points, downsample=True)
    along = [abs(float(axis @ up_lidar)) for axis, share in plane_directions(plane_normals(tree)) if share > _MOST]
    return [float(min(np.arccos(min(value, 1.0)), np.arcsin(min(value, 1.0)))) for value in along]


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    unit: NDArray[np.float64] = vector / np.linalg.norm(vector)
    return unit
