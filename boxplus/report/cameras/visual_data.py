"""Everything the report of a run with cameras shows, read back from its output folder."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.clouds.ply import read_ply
from boxplus.formats.trajectory import read_trajectory
from boxplus.report.run_data import sigmas_of
from boxplus.runs.cameras.folder import CameraRunFolder, DirectFolder, VioFolder
from boxplus.runs.cameras.landmark_file import read_lines
from boxplus.runs.direct import frame_log as direct_log
from boxplus.runs.direct.summary import DirectSummary, read_direct_summary
from boxplus.runs.storage.row_log import RowLog
from boxplus.runs.visual_inertial import frame_log as visual_log
from boxplus.runs.visual_inertial.summary import VioSummary, read_vio_summary

_MOST_POINTS, _MOST_LINES = 100_000, 10_000

SummaryT = TypeVar("SummaryT", VioSummary, DirectSummary)


@dataclass(frozen=True, slots=True)
class VisualData(Generic[SummaryT]):
    """A run with cameras as its folder tells it.

    Attributes:
        folder: where it lies.
        summary: the facts; how far the run came is counted in the rows that can be read.
        seconds: (N,) time of every frame since the first one with a state [s].
        position: (N, 3) of the IMU, or of a camera without one, in the world [m].
        sigma: (N, 6) standard deviations of the pose: rotation [rad], position [m].
        log: everything else per frame.
        map_points: (M, 3) the landmarks [m].
        map_lines: (L, 6) the ends of lines [m].
        evaluation: the comparison with a ground truth, or None.
    """

    folder: CameraRunFolder
    summary: SummaryT
    seconds: NDArray[np.float64]
    position: NDArray[np.float64]
    sigma: NDArray[np.float64]
    log: RowLog
    map_points: NDArray[np.float32]
    map_lines: NDArray[np.float32]
    evaluation: dict[str, Any] | None

    @property
    def status(self) -> NDArray[np.str_]:
        """(N,) ok, weak or lost."""
        return self.log.status


def load_visual_run(folder: str | Path) -> VisualData[VioSummary]:
    """Read the output folder of a run of 'boxplus vio', finished or not.

    Raises:
        InputError: no such folder, or a run without a single frame.
    """
    run = VioFolder(Path(folder))
    return _load(run, read_vio_summary(run.summary), visual_log.read_frame_log(run.frames))


def load_direct_run(folder: str | Path) -> VisualData[DirectSummary]:
    """Read the output folder of a run of 'boxplus vo', finished or not.

    Raises:
        InputError: no such folder, or a run without a single frame.
    """
    run = DirectFolder(Path(folder))
    return _load(run, read_direct_summary(run.summary), direct_log.read_frame_log(run.frames))


def _load(run: CameraRunFolder, summary: SummaryT, log: RowLog) -> VisualData[SummaryT]:
    trajectory = read_trajectory(run.trajectory, "csv")
    count = min(len(trajectory), len(log))  # a killed run may have written one row more to one of them
    if not count:
        raise InputError(
            "a run with at least one frame", f"none in {run.path} ({summary.describe_state()})", "see run.json for the reason"
        )
    log, position = log.first(count), trajectory.p[:count]
    if summary.state == "running":  # it is written every few seconds only
        names, counts = np.unique(log.status, return_counts=True)
        counted: dict[str, object] = {
            "frames": count,
            "status": dict(zip(names.tolist(), counts.tolist(), strict=True)),
            "duration_s": float(log.time_ns[-1] - log.time_ns[0]) * 1e-9,
            "path_length_m": float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum()),
        }
        summary = summary.model_copy(update=counted)
    points = read_ply(run.landmarks).points if run.landmarks.is_file() else np.zeros((0, 3), np.float32)
    lines = read_lines(run.lines) if isinstance(run, VioFolder) and run.lines.is_file() else np.zeros((0, 6), np.float32)
    evaluation = json.loads(run.evaluation.read_text(encoding="utf-8")) if run.evaluation.is_file() else None
    return VisualData(
        folder=run,
        summary=summary,
        seconds=(log.time_ns - log.time_ns[0]) * 1e-9,
        position=position,
        sigma=sigmas_of(trajectory, count),
        log=log,
        map_points=points[:: max(1, -(-len(points) // _MOST_POINTS))].astype(np.float32),
        map_lines=lines[:: max(1, -(-len(lines) // _MOST_LINES))],
        evaluation=evaluation,
    )
