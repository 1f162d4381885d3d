"""What `run.json` says of what the motion has shown of LiDAR and IMU."""

from __future__ import annotations

from dataclasses import asdict

from boxplus.runs.lidar_inertial.summary import ShownFacts
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from boxplus.systems.lidar_odometry.odometry import LidarOdometry


def sensor_facts(odometry: LidarInertialOdometry | LidarOdometry) -> list[ShownFacts]:
    """Part by part; nothing before the start, and of a LiDAR alone."""
    if not isinstance(odometry, LidarInertialOdometry) or odometry.start is None:
        return []
    return [ShownFacts(**asdict(part)) for part in odometry.consistency.shown]
