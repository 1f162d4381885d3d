"""The other files of a calibration: Kalibr's target, and an IMU's samples with its noise."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from boxplus.errors import InputError, RecordingError
from boxplus.recordings.cameras.calibration import imu_noise, read_yaml
from boxplus.recordings.cameras.imu_table import imu_stream, read_imu_table
from boxplus.recordings.cameras.options import CameraRecordingOptions
from boxplus.recordings.imu_units import ACCEL_SCALE, GYRO_SCALE
from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.camera_calibration.target import AprilGrid

_SMALLEST_TAG_M, _LARGEST_TAG_M = 0.004, 2.0


def read_target(path: str | Path) -> AprilGrid:
    """A target in Kalibr's form: target_type aprilgrid, tagCols, tagRows, tagSize [m], tagSpacing.

    Raises:
        InputError: no such file, another kind of target, numbers that make none, tags of no size in metres.
    """
    content = read_yaml(Path(path))
    kind = str(content.get("target_type", ""))
    if kind != "aprilgrid":
        raise InputError("target_type: 'aprilgrid'", f"{kind or 'none'!r} in {Path(path).name}", "boxplus knows no other target")
    try:
        target = AprilGrid(
            rows=int(content["tagRows"]),
            columns=int(content["tagCols"]),
            tag_size=float(content["tagSize"]),
            spacing=float(content["tagSpacing"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            "tagRows, tagCols, tagSize [m] and tagSpacing", f"{type(error).__name__} {error} in {Path(path).name}", "complete it"
        ) from None
    if not _SMALLEST_TAG_M <= target.tag_size <= _LARGEST_TAG_M:
        raise InputError(
            f"tagSize from {_SMALLEST_TAG_M:g} to {_LARGEST_TAG_M:g} m",
            f"{target.tag_size:g} in {Path(path).name}",
            "give the edge of a tag in metres: 88 mm are 0.088; every length of the calibration scales with it",
        )
    return target


@dataclass(frozen=True, slots=True, eq=False)
class ImuInput:
    """An IMU as its files have it.

    Attributes:
        samples: in order, each time once.
        noise: its densities.
        notes: how the table was read: units, noise.
        left_out: what of it was not used as it stands, with counts.
    """

    samples: ImuSamples
    noise: ImuNoise
    notes: tuple[str, ...]
    left_out: tuple[str, ...]


def read_imu(samples: str | Path, noise: str | Path) -> ImuInput:
    """An IMU: a table as EuRoC's `data.csv`, and Kalibr's file with its noise densities.

    Raises:
        InputError: files that are missing or of another form, or units that are not to be told.
    """
    table = read_imu_table(Path(samples), Path(samples).name)
    content = read_yaml(Path(noise))
    block = content.get("imu0", content)
    densities = imu_noise(block) if isinstance(block, dict) else None
    if densities is None:
        raise RecordingError(
            "gyroscope_noise_density, gyroscope_random_walk, accelerometer_noise_density and accelerometer_random_walk",
            f"not all of them, or not positive, in {Path(noise).name}",
            "give Kalibr's imu.yaml",
        )
    stream, evidence = imu_stream(table, densities, Path(noise).name, CameraRecordingOptions())
    order = np.argsort(table.time_ns, kind="stable")
    late = int(np.count_nonzero(table.time_ns < np.maximum.accumulate(table.time_ns)))
    left_out = [fact.text for fact in evidence if fact.verdict != "ok"]
    if late:
        left_out.append(f"{late} samples of {table.source} stand after later ones: put in order")
    order = order[np.concatenate([[True], np.diff(table.time_ns[order]) > 0])]
    if len(order) < len(table.time_ns):
        left_out.append(f"{len(table.time_ns) - len(order)} samples of {table.source} repeat a time: the first of each is used")
    gyro = table.values[order, :3] * GYRO_SCALE[stream.gyro_unit]
    accel = table.values[order, 3:] * ACCEL_SCALE[stream.accel_unit]
    return ImuInput(
        ImuSamples.from_arrays(table.time_ns[order], gyro, accel),
        densities,
        tuple(f"{fact.value}: {fact.text}" for fact in evidence if fact.verdict == "ok"),
        tuple(left_out),
    )
