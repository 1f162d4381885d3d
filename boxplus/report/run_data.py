"""Everything a report shows, read back from the output folder of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.trajectory import Trajectory, read_trajectory
from boxplus.maps.tiles.store import TileStore
from boxplus.maps.tiles.voxel_thinning import first_per_voxel
from boxplus.runs.lidar_inertial.scan_log import read_scan_log
from boxplus.runs.lidar_inertial.summary import RunSummary, read_summary
from boxplus.runs.run_folder import RunFolder
from boxplus.runs.storage.row_log import RowLog

_MOST_POINTS = 25_000
_THIN_FROM = 10 * _MOST_POINTS


@dataclass(frozen=True, slots=True)
class RunData:
    """A run as its folder tells it.

    Attributes:
        folder: where it lies.
        summary: the facts; how far the run came is counted in the rows that can be read, not taken from a summary that a
            killed run left behind.
        seconds: (N,) float64, time of every scan since the first one [s].
        position: (N, 3) float64, of the IMU in the world [m].
        sigma: (N, 6) float64, standard deviations of the pose: rotation [rad], position [m].
        log: everything else per scan.
        map_points: (M, 3) float32, a thinned map, world frame [m].
        map_remarks: sentences on what of the map is incomplete.
    """

    folder: RunFolder
    summary: RunSummary
    seconds: NDArray[np.float64]
    position: NDArray[np.float64]
    sigma: NDArray[np.float64]
    log: RowLog
    map_points: NDArray[np.float32]
    map_remarks: tuple[str, ...]

    @property
    def status(self) -> NDArray[np.str_]:
        """(N,) ok, weak or lost."""
        return self.log.status


def load_run(folder: str | Path) -> RunData:
    """Read the output folder of a run, finished or not.

    Raises:
        InputError: no run's folder, or a run without a single scan.
    """
    run = RunFolder(Path(folder))
    summary = read_summary(run.summary)
    trajectory, scans = read_trajectory(run.trajectory, "csv"), read_scan_log(run.scans)
    count = min(len(trajectory), len(scans))  # a killed run may have written one row more to one of them
    if not count:
        raise InputError(
            "a run with at least one scan", f"none in {run.path} ({summary.describe_state()})", "see run.json for the reason"
        )
    scans = scans.first(count)
    points, remarks = _thinned_map(run)
    return RunData(
        folder=run,
        summary=_counted(summary, scans, trajectory.p[:count]),
        seconds=(scans.time_ns - scans.time_ns[0]) * 1e-9,
        position=trajectory.p[:count],
        sigma=sigmas_of(trajectory, count),
        log=scans,
        map_points=points,
        map_remarks=remarks,
    )


def _counted(summary: RunSummary, scans: RowLog, position: NDArray[np.float64]) -> RunSummary:
    """The summary of a run that did not end, brought up to its last row; it is written every few seconds only."""
    if summary.state != "running":
        return summary
    names, counts = np.unique(scans.status, return_counts=True)
    facts: dict[str, object] = {
        "scans": len(scans),
        "status": dict(zip(names.tolist(), counts.tolist(), strict=True)),
        "first_time_ns": int(scans.time_ns[0]),
        "last_time_ns": int(scans.time_ns[-1]),
        "duration_s": float(scans.time_ns[-1] - scans.time_ns[0]) * 1e-9,
        "path_length_m": float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum()),
    }
    return summary.model_copy(update=facts)


def sigmas_of(trajectory: Trajectory, count: int) -> NDArray[np.float64]:
    """(count, 6) standard deviations of the first poses: rotation [rad], position [m]."""
    if trajectory.covariance is None:
        return np.zeros((count, 6))
    return np.sqrt(np.maximum(np.diagonal(trajectory.covariance[:count], axis1=1, axis2=2), 0.0))


def _thinned_map(run: RunFolder) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """At most `_MOST_POINTS` points of the map, spread evenly, without holding all of it."""
    if not run.tiles.is_dir():
        return np.zeros((0, 3), np.float32), ()
    store = TileStore.open(run.tiles)
    stride = max(1, -(-store.point_count // _THIN_FROM))
    parts = [tile.points[::stride] for tile in store.iter_tiles()]
    points = np.concatenate(parts) if parts else np.zeros((0, 3), np.float32)
    voxel = 0.1
    while len(points) > _MOST_POINTS:
        points = points[first_per_voxel(points, voxel)]
        voxel *= 1.25
    return points, store.report
