"""One row a frame on disk: everything an estimate says besides the pose. Written as the run goes on, read by the report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import get_args

import numpy as np

from boxplus.runs.storage.row_log import Columns, RowLog, RowLogWriter, read_row_log, xyz
from boxplus.systems.visual_inertial_odometry.estimate import Status, VioEstimate

FRAME_COLUMNS = Columns(
    numbers=(
        *xyz("velocity", "bias_gyro", "bias_accel", "sigma_velocity", "sigma_bias_gyro", "sigma_bias_accel"),
        *("tracked", "new", "landmarks", "lines_tracked", "is_keyframe", "time_offset_s", "total_ms"),
    ),
    texts=("rejected", "timing_ms", "reasons"),
    statuses=get_args(Status),
    program="boxplus vio",
)
"""Columns of `frames.csv`. SI units (m, s, rad) but for milliseconds where the name says so; `rejected` and `timing_ms` hold
`name=value` pairs, `reasons` sentences, all separated by `; `."""


class FrameLogWriter(RowLogWriter):
    """Appends one row per estimate to `frames.csv`; see `RowLogWriter`.

    Args:
        path: the file.
        go_on: after the rows of an earlier writer.
    """

    def __init__(self, path: Path, *, go_on: bool = False) -> None:
        super().__init__(path, FRAME_COLUMNS, go_on=go_on)

    def append(self, estimate: VioEstimate, timing_s: Mapping[str, float]) -> None:
        """Write one row.

        Args:
            timing_s: of the frame, by stage.

        Raises:
            OutputError: the disk is full; the row is taken back.
        """
        sigma = np.sqrt(np.maximum(np.diag(estimate.covariance), 0.0))
        numbers = np.concatenate(
            [
                *(estimate.velocity_world, estimate.gyro_bias, estimate.accel_bias),
                *(sigma[6:9], sigma[9:12], sigma[12:15]),
                [estimate.tracked, estimate.new, len(estimate.landmark_ids), estimate.lines_tracked, estimate.is_keyframe],
                [estimate.time_offset_s, 1e3 * sum(timing_s.values())],
            ]
        )
        self.append_row(
            estimate.time_ns,
            estimate.status,
            numbers.tolist(),
            [
                "; ".join(f"{reason}={count}" for reason, count in estimate.rejected.items()),
                "; ".join(f"{stage}={1e3 * seconds:.4f}" for stage, seconds in timing_s.items()),
                "; ".join(estimate.reasons),
            ],
        )


def read_frame_log(path: str | Path) -> RowLog:
    """Read `frames.csv`; see `read_row_log`.

    Raises:
        InputError: not such a file.
    """
    return read_row_log(path, FRAME_COLUMNS)
