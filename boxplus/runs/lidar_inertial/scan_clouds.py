"""One cloud a scan, corrected for motion, on disk as soon as its pose is known."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from boxplus._settings import Settings
from boxplus.errors import InputError
from boxplus.formats.clouds.cloud_file import cloud_writer
from boxplus.formats.output import make_folder
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate

Ending = Literal["pcd", "ply", "las", "laz", "e57"]


class ScanCloudConfig(Settings):
    """Whether the scans are kept as clouds, and how."""

    frame: Literal["none", "body", "world"] = Field(
        "none",
        description="write every scan, corrected for motion, as a cloud: in the frame of the IMU (of a LiDAR alone: its own) at "
        "its pose, or in the world, without scans that are lost",
    )
    ending: Ending = Field("pcd", description="of these files")


class ScanCloudWriter:
    """Writes `TIME_NS.pcd` for each estimate into a folder: the name is the time in `trajectory.csv`.

    A file appears only when it is whole, and before the row of its pose; memory holds one scan.

    Args:
        folder: made where it does not exist.
        config: with a frame.
        lidars: that are merged; of several, each point has the number of its own.

    Raises:
        InputError: the library that the format needs is not installed, or the format has no place for those numbers.
        OutputError: the folder cannot be written.
    """

    def __init__(self, folder: Path, config: ScanCloudConfig, lidars: int = 1) -> None:
        self._folder, self._config = make_folder(folder), config
        first = cloud_writer(self._path(0))  # refuses now what it would refuse at the first scan
        first.abort()
        if lidars > 1 and not first.holds({"lidar": np.zeros(0, np.uint8)}):
            raise InputError(
                f"files for the scans of {lidars} LiDARs that can hold which of them saw a point (pcd, ply, las, laz)",
                f"scans.ending={config.ending}",
                "choose another ending; 'boxplus convert' makes such files of them, without the numbers",
            )

    def write(self, estimate: Estimate) -> None:
        """Write one scan; in the world those that are lost are left out: nobody knows where they belong.

        Raises:
            OutputError: the disk is full.
        """
        if self._config.frame == "world":
            if estimate.status == "lost":
                return
            points = estimate.points_world()
        else:
            state = estimate.state
            points = estimate.p_lidar @ state.R_imu_lidar.T + state.p_imu_lidar
        with cloud_writer(self._path(estimate.time_ns)) as writer:
            others = {} if estimate.lidar is None else {"lidar": estimate.lidar}
            held = writer.holds(others)
            writer.append(points.astype(np.float32), estimate.intensity, {name: others[name] for name in held})

    def _path(self, time_ns: int) -> Path:
        return self._folder / f"{time_ns}.{self._config.ending}"
