"""What a run with loop closure leaves, as it was made or read again from its folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.local_maps.folder import LocalMapFolder
from boxplus.runs.lidar_inertial.summary import RunSummary, read_summary
from boxplus.runs.slam.folder import SlamFolder
from boxplus.runs.slam.graph_file import read_graph
from boxplus.runs.slam.summary import SlamSummary, read_slam_summary
from boxplus.systems.slam.outcome import SlamOutcome


@dataclass(frozen=True, slots=True, eq=False)
class SlamResult:
    """A run with loop closure.

    Attributes:
        folder: where it lies.
        summary: as in `run.json`; odometry: that of the odometry.
        outcome: where the local maps are, and every loop.
        maps: the local maps, which are read when asked for.
    """

    folder: SlamFolder
    summary: SlamSummary
    odometry: RunSummary
    outcome: SlamOutcome
    maps: LocalMapFolder

    @property
    def map_time_s(self) -> NDArray[np.float64]:
        """(n,) when the local maps were since the first scan."""
        return np.asarray((self.outcome.correction.time_ns - (self.odometry.first_time_ns or 0)) * 1e-9, dtype=np.float64)


def load_slam_result(folder: str | Path) -> SlamResult:
    """Read the output folder of a run that came so far that loops were closed.

    Raises:
        InputError: no folder of 'boxplus slam', or its loops were not closed yet.
    """
    own = SlamFolder(Path(folder))
    summary = read_slam_summary(own.summary)
    odometry = read_summary(own.odometry.summary)
    return SlamResult(own, summary, odometry, read_graph(own.graph), LocalMapFolder(own.local_maps))
