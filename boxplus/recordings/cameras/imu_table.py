"""IMU samples from a table: EuRoC's `data.csv` and those with the same columns (Burri et al., IJRR 2016).

Columns: time [ns], angular velocity x y z [rad/s], specific force x y z [m/s²], as the format defines them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import RecordingError
from boxplus.recordings.cameras.info import ImuStream
from boxplus.recordings.cameras.options import CameraRecordingOptions
from boxplus.recordings.cameras.streams import rate_hz
from boxplus.recordings.imu_units import read_accel_unit, read_gyro_unit
from boxplus.recordings.info import Evidence
from boxplus.recordings.options import RecordingOptions
from boxplus.residuals.inertial.imu_noise import ImuNoise

_COLUMNS = 7
_ROW = np.dtype([("time_ns", np.int64), ("values", np.float64, (6,))])
_SHORTEST_STEP_NS = 2e4
"""50 kHz; a file with shorter steps counts in another unit."""


@dataclass(frozen=True, slots=True, eq=False)
class ImuTable:
    """Samples as they stand in the file.

    Attributes:
        source: the file's name.
        time_ns: (N,) int64.
        values: (N, 6) angular velocity and acceleration.
        unreadable: lines that are no sample.
    """

    source: str
    time_ns: NDArray[np.int64]
    values: NDArray[np.float64]
    unreadable: int


def read_imu_table(file: Path, source: str) -> ImuTable:
    """Read such a table; lines that are no sample are left out and counted.

    Raises:
        RecordingError: no such file, or no sample in it.
    """
    try:
        text = file.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise RecordingError(f"IMU samples in {source}", f"{error.strerror}", "check the folder") from None
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if lines and not lines[0].lstrip()[:1].isdigit():
        lines = lines[1:]  # Kalibr writes the names of the columns without a mark
    unreadable = 0
    try:
        rows = np.loadtxt(lines, delimiter=",", dtype=_ROW, ndmin=1) if lines else np.empty(0, _ROW)
    except ValueError:
        kept = []
        for line in lines:
            try:
                cells = line.split(",")
                if len(cells) != _COLUMNS:
                    raise ValueError(line)
                kept.append((int(cells[0]), tuple(map(float, cells[1:]))))
            except ValueError:
                unreadable += 1
        rows = np.array(kept, _ROW)
    if not len(rows):
        raise RecordingError(
            f"IMU samples in {source}: time [ns], angular velocity [rad/s], acceleration [m/s2]",
            f"{unreadable} lines that are none",
            "check the file",
        )
    if len(rows) > 1 and float(np.median(np.abs(np.diff(rows["time_ns"])))) < _SHORTEST_STEP_NS:
        step = float(np.median(np.abs(np.diff(rows["time_ns"]))))
        raise RecordingError(
            f"times in nanoseconds in {source}", f"a median step of {step:g}", "convert the times to nanoseconds"
        )
    return ImuTable(source, np.ascontiguousarray(rows["time_ns"]), np.ascontiguousarray(rows["values"]), unreadable)


def imu_stream(
    table: ImuTable, noise: ImuNoise | None, noise_source: str, options: CameraRecordingOptions
) -> tuple[ImuStream, list[Evidence]]:
    """The stream of a table, its units checked against gravity.

    Raises:
        RecordingError, AmbiguityError: as `read_accel_unit`.
    """
    stated = RecordingOptions(gyro_unit=options.gyro_unit, accel_unit=options.accel_unit)
    accel_unit, accel_evidence = read_accel_unit(table.values[:, 3:], stated)
    gyro_unit, gyro_evidence = read_gyro_unit(table.values[:, :3], stated)
    evidence = [gyro_evidence, accel_evidence]
    if table.unreadable:
        text = f"{table.unreadable} lines of {table.source} are no sample: not used"
        evidence.append(Evidence("messages", f"{table.unreadable} rejected", "warning", text))
    if noise is None:
        text = "the recording does not say: an estimator must be told"
        evidence.append(Evidence("imu_noise", "unknown", "warning", text))
    else:
        evidence.append(Evidence("imu_noise", "known", "ok", f"from {noise_source}"))
    count, rate = len(table.time_ns), rate_hz(table.time_ns.tolist())
    return ImuStream(table.source, "", count, rate, gyro_unit, accel_unit, noise, noise_source if noise else ""), evidence
