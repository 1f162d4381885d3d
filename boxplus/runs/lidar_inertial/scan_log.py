"""One row a scan on disk: everything an estimate says besides the pose. Written as the run goes on, read by the report."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.filtering.nav_state import T_BA, T_BW, T_P_L, T_THETA_L, T_V
from boxplus.manifolds import quaternion
from boxplus.runs.storage.row_log import Columns, RowLog, RowLogWriter, read_row_log, xyz
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate, Status

SHARES = tuple(f"share_{axis}" for axis in ("rx", "ry", "rz", "px", "py", "pz"))
"""Of every axis of the pose, the share of its information that came from the LiDAR (`Estimate.lidar_share`)."""

SCAN_COLUMNS = Columns(
    numbers=(
        *xyz("velocity", "bias_gyro", "bias_accel", "gravity"),
        *("imu_lidar_qw", "imu_lidar_qx", "imu_lidar_qy", "imu_lidar_qz"),
        *xyz("imu_lidar_p", "sigma_velocity", "sigma_bias_gyro", "sigma_bias_accel", "sigma_imu_lidar_r", "sigma_imu_lidar_p"),
        *SHARES,
        *("points_raw", "points_filtered", "points_used", "residual_rms", "iterations", "converged", "total_ms"),
    ),
    texts=("rejected", "timing_ms", "weak_directions", "warnings"),
    statuses=get_args(Status),
    program="boxplus lio",
)
"""Columns of `scans.csv`. SI units (m, s, rad) but for milliseconds where the name says so; `rejected` and `timing_ms` hold
`name=value` pairs, `weak_directions` and `warnings` sentences, all separated by `; `."""


_POSITION = re.compile(r"position along \(([^)]*)\)")  # as `WeakDirection` says it


class ScanLogWriter(RowLogWriter):
    """Appends one row per estimate to `scans.csv`; see `RowLogWriter`.

    Args:
        path: the file.
        go_on: after the rows of an earlier writer.
    """

    def __init__(self, path: Path, *, go_on: bool = False) -> None:
        super().__init__(path, SCAN_COLUMNS, go_on=go_on)

    def append(self, estimate: Estimate) -> None:
        """Write one row.

        Raises:
            OutputError: the disk is full; the row is taken back.
        """
        state, sigma = estimate.state, np.sqrt(np.maximum(estimate.covariance.diagonal(), 0.0))
        numbers = np.concatenate(
            [
                *(state.v_world_imu, state.bias_gyro, state.bias_accel, state.gravity_world),
                *(quaternion.from_matrix(state.R_imu_lidar[None])[0], state.p_imu_lidar),
                *(sigma[at : at + 3] for at in (T_V, T_BW, T_BA, T_THETA_L, T_P_L)),
                estimate.lidar_share,
                [estimate.points_raw, estimate.points_filtered, estimate.points_used, estimate.residual_rms],
                [estimate.iterations, estimate.converged, 1e3 * sum(estimate.timing_s.values())],
            ]
        )
        self.append_row(
            estimate.time_ns,
            estimate.status,
            numbers.tolist(),
            [
                "; ".join(f"{reason}={count}" for reason, count in estimate.rejected.items()),
                "; ".join(f"{stage}={1e3 * seconds:.4f}" for stage, seconds in estimate.timing_s.items()),
                "; ".join(str(direction) for direction in estimate.weak_directions),
                "; ".join(estimate.warnings),
            ],
        )


def read_scan_log(path: str | Path) -> RowLog:
    """Read `scans.csv`; see `read_row_log`.

    Raises:
        InputError: not such a file.
    """
    return read_row_log(path, SCAN_COLUMNS)


def unmeasured(log: RowLog) -> NDArray[np.float64]:
    """(N, 3, 3) sums of t tᵀ over the directions that each scan left open, t the part along the world's axes; see `OdometryRows`.

    Raises:
        InputError: a direction is none.
    """
    sums = np.zeros((len(log), 3, 3))
    for row, text in enumerate(log.texts["weak_directions"]):
        for vector in _POSITION.findall(text):
            try:
                t = np.array([float(part) for part in vector.split(",")])
                sums[row] += np.outer(t, t)
            except ValueError as error:
                raise InputError("directions of three numbers in scans.csv", f"({vector})", "run 'boxplus lio' again") from error
    return sums
