"""Everything that can be set for an odometry run, from a YAML file and from single values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

from pydantic import Field

from boxplus._settings import Settings
from boxplus.recordings.info import RecordingInfo
from boxplus.recordings.options import NO_IMU, NO_POINT_TIME, RecordingOptions
from boxplus.runs.lidar_inertial.scan_clouds import ScanCloudConfig
from boxplus.runs.settings_file import dump_settings, load_settings
from boxplus.systems.lidar_inertial_odometry.config import LioConfig


class MapConfig(Settings):
    """What is kept of the map on disk. The filter's own map in memory is not affected."""

    save: bool = Field(True, description="stream the registered points to map tiles while running")
    voxel: float | None = Field(
        0.1,
        ge=0.001,
        description="keep one point per voxel of this edge [m], which bounds the disk space; null keeps every point",
    )
    tile_size: float = Field(50.0, gt=0, description="edge of the cubic map tiles [m]")
    ply: bool = Field(True, description="merge the tiles to map.ply at the end")
    pcd: bool = Field(True, description="merge the tiles to map.pcd at the end")

    def merged_files(self, ply: Path, pcd: Path) -> list[Path]:
        """Those of the two that the tiles are to be merged to."""
        return [path for path, wanted in ((ply, self.ply), (pcd, self.pcd)) if wanted]


class RunConfig(Settings):
    """Settings of an odometry run; this is what `config.yaml` holds. None has to be given."""

    recording: RecordingOptions = Field(default_factory=lambda: RecordingOptions())
    odometry: LioConfig = Field(default_factory=lambda: LioConfig())  # type: ignore[call-arg]
    map: MapConfig = Field(default_factory=lambda: MapConfig())  # type: ignore[call-arg]
    scans: ScanCloudConfig = Field(default_factory=lambda: ScanCloudConfig())  # type: ignore[call-arg]

    def of_odometry(self) -> RunConfig:
        """The part that `boxplus lio` has, of settings that have more."""
        return RunConfig(recording=self.recording, odometry=self.odometry, map=self.map, scans=self.scans)


def load_run_config(
    path: str | Path | None = None,
    settings: Iterable[str] = (),
    overrides: Mapping[str, Mapping[str, object]] | None = None,
) -> RunConfig:
    """Settings of 'boxplus lio' from a YAML file, then single `key=value` texts, then overrides; see `load_settings`.

    Raises:
        InputError: the file cannot be read, a key is unknown, or a value is not valid.
    """
    return load_settings(RunConfig, path, settings, overrides)


_HEAD = (
    "# Settings of this run, those found from the data included: 'boxplus lio RECORDING --config FILE' repeats it.\n"
    "# For another recording delete the lines of section 'recording' that shall be found anew.\n"
)


def dump_run_config(config: RunConfig, info: RecordingInfo) -> str:
    """The text of `config.yaml`: everything as used, readings found from the data included, so that it repeats the run."""
    used = config.model_dump()
    found = used["recording"]
    is_bag = bool(info.lidar_topic) and any(topic.name == info.lidar_topic for topic in info.topics)
    if is_bag:
        found["lidar_topic"], found["imu_topic"] = info.lidar_topic, info.imu_topic or NO_IMU
        found["point_time_field"] = info.point_time.field or NO_POINT_TIME
        if info.point_time.field is not None:
            found["point_time_unit"], found["point_time_reference"] = info.point_time.unit, info.point_time.reference
        found["gyro_unit"], found["accel_unit"] = info.gyro_unit, info.accel_unit
        for other, read in zip(found["other_lidars"] or (), info.other_lidars, strict=False):
            other["T_lidar_other"] = read.T_lidar_other.tolist()
            other["point_time_field"] = read.point_time.field or NO_POINT_TIME
            if read.point_time.field is not None:
                other["point_time_unit"], other["point_time_reference"] = read.point_time.unit, read.point_time.reference
    return dump_settings(_HEAD, used)


def redump_run_config(path: Path) -> str:
    """The text of a `config.yaml` as it would be written now: settings that came since have their defaults.

    Raises:
        InputError: it cannot be read, or has a setting that is gone.
    """
    return dump_settings(_HEAD, load_run_config(path).model_dump())
