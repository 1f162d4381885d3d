"""The plane that most of every scan shows, against gravity and gyroscope: what is left to tell by where no motion is found.

A start fails where the LiDAR's path is not found, and then neither rotations nor accelerations can contradict a mounting. Every
scan for itself still shows the ground, or the walls of a shaft, and these stand level or upright: most of them, if not as
exactly as several orthogonal directions together (`plane_tilt`), which this cannot replace. And it moves in the scans as the
platform tilts, which the gyroscope has to show, whatever the mounting.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.inertial.gyro_attitude import GyroAttitude
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.downsampling import VoxelFilter
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import middle_of
from boxplus.systems.lidar_inertial_agreement.planes.surroundings import planar_points, plane_directions

_SCANS, _MOST_POINTS = 10, 5000
_FEWEST_SCANS, _FEWEST_SAMPLES = 3, 10
_SEVERAL = 2  # stretches of the window by which gravity is found
_MOST = 0.5  # of the planar points lie in the plane
_STEEPEST_RAD = np.deg2rad(8.0)  # what roads climb, and what a walk's acceleration over a second or two tilts
_DEVIATIONS = 3.0
_SCANS_OF_TILT, _FEWEST_OF_TILT = 20, 10
_LEAST_TILT_RAD, _TIMES = np.deg2rad(6.0), 4.0  # of the gyroscope, and over what the LiDAR sees


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
        middle_ns = np.array([middle_of(scans[k])])
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
        "mounting, unless the ground slopes as much or the platform brakes, speeds up or turns all the time"
    )


def untilted_plane(scans: Sequence[Scan], imu: ImuSamples, config: RegistrationConfig) -> str | None:
    """Whether the gyroscope tilts while what the LiDAR sees does not, under any mounting; a sentence, None where it may be sound.

    A turn about a single axis leaves a direction where it is, and proves nothing; nor does a bias, which is such a turn.

    Args:
        scans, imu, config: as for `tilted_plane`.
    """
    inside = (imu.time_ns >= scans[0].start_ns) & (imu.time_ns <= scans[-1].end_ns)
    if np.count_nonzero(inside) < _FEWEST_SAMPLES:
        return None
    attitude = GyroAttitude(imu.time_ns[inside], imu.gyro[inside])
    axes: list[NDArray[np.float64]] = []
    times_ns = []
    for k in np.unique(np.linspace(0, len(scans) - 1, _SCANS_OF_TILT).astype(int)):
        found = _main_plane(scans[k], config)
        if found is not None:
            axes.append(found if not axes or found @ axes[0] > 0.0 else -found)
            times_ns.append(middle_of(scans[k]))
    if len(axes) < _FEWEST_OF_TILT:
        return None
    seen = _spread(float(np.linalg.norm(np.mean(axes, axis=0))))
    # A direction of the world moves in the IMU's frame by no less than the one that moves least.
    turned = _spread(float(np.linalg.svd(attitude.at(np.array(times_ns)).mean(axis=0), compute_uv=False)[0]))
    if turned < _LEAST_TILT_RAD or turned < _TIMES * seen:
        return None
    return (
        f"the plane that makes up most of a scan stays within {np.degrees(seen):.1f} deg (rms of {len(axes)} scans) of where the "
        f"LiDAR sees it, while the gyroscope tilts every direction by {np.degrees(turned):.0f} deg at least: the IMU is not the "
        "one of this LiDAR (--imu-topic, --lidar-topic), or its unit is wrong (--gyro-unit)"
    )


def _spread(resultant: float) -> float:
    """The rms angle of unit vectors from their mean, by its length [rad]."""
    return float(np.sqrt(2.0 * max(1.0 - resultant, 0.0)))


def _tilts(scan: Scan, up_lidar: NDArray[np.float64], config: RegistrationConfig) -> list[float]:
    """The angle of a scan's main plane from level or from upright, the lesser of both [rad]; nothing where it has none."""
    axis = _main_plane(scan, config)
    if axis is None:
        return []
    along = min(abs(float(axis @ up_lidar)), 1.0)
    return [float(min(np.arccos(along), np.arcsin(along)))]


def _main_plane(scan: Scan, config: RegistrationConfig) -> NDArray[np.float64] | None:
    """(3,) unit normal, LiDAR frame, of the plane that most planar points of a scan lie in; None where it has none."""
    points = VoxelFilter(config.map_cell, _MOST_POINTS)(scan.p_lidar)[1].astype(np.float64)
    if not len(points):
        return None
    tree = IkdTree(cell_size=config.map_cell, rebuild="inplace")
    tree.insert(points, downsample=True)
    return next((axis for axis, share in plane_directions(planar_points(tree)[1]) if share > _MOST), None)


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    unit: NDArray[np.float64] = vector / np.linalg.norm(vector)
    return unit
