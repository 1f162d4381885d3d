"""One row a frame on disk: everything an estimate says besides the pose. Written as the run goes on, read by the report."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

from boxplus.runs.storage.row_log import Columns, RowLog, RowLogWriter, read_row_log
from boxplus.systems.direct_odometry.estimate import Estimate, Status

FRAME_COLUMNS = Columns(
    numbers=("keyframe", "is_keyframe", "overlap", "pixels", "sigma", "residual_ratio", "a", "b", "total_ms"),
    texts=("timing_ms", "reasons"),
    statuses=get_args(Status),
    program="boxplus vo",
)
"""Columns of `frames.csv`, as in `Estimate`; `sigma` and `b` in grey values; `timing_ms` holds `name=value` pairs, `reasons`
sentences, separated by `; `."""


class FrameLogWriter(RowLogWriter):
    """Appends one row per estimate to `frames.csv`; see `RowLogWriter`.

    Args:
        path: the file.
        go_on: after the rows of an earlier writer.
    """

    def __init__(self, path: Path, *, go_on: bool = False) -> None:
        super().__init__(path, FRAME_COLUMNS, go_on=go_on)

    def append(self, estimate: Estimate) -> None:
        """Write one row.

        Raises:
            OutputError: the disk is full; the row is taken back.
        """
        self.append_row(
            estimate.time_ns,
            estimate.status,
            [
                *(estimate.keyframe, estimate.is_keyframe, estimate.overlap, estimate.pixels, estimate.sigma),
                *(estimate.residual_ratio, *estimate.brightness, 1e3 * sum(estimate.timing_s.values())),
            ],
            [
                "; ".join(f"{stage}={1e3 * seconds:.4f}" for stage, seconds in estimate.timing_s.items()),
                "; ".join(estimate.reasons),
            ],
        )


def read_frame_log(path: str | Path) -> RowLog:
    """Read `frames.csv`; see `read_row_log`.

    Raises:
        InputError: not such a file.
    """
    return read_row_log(path, FRAME_COLUMNS)
