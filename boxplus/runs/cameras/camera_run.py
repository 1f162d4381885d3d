"""What the loops of runs with cameras share: their trajectory, their sparse map, and the facts that every summary states."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.trajectory_writer import TrajectoryWriter
from boxplus.recordings.cameras.events import CameraEvent, CameraRecording
from boxplus.runs.cameras.facts import evidence_warnings, frame_timing, recording_facts
from boxplus.runs.cameras.folder import CameraRunFolder
from boxplus.runs.cameras.landmark_file import LandmarkFile
from boxplus.runs.cameras.summary import CameraSummary
from boxplus.runs.checkpoint import run_identity
from boxplus.runs.estimate_statistics import EstimateStatistics
from boxplus.runs.resumable_run import ResumableRun
from boxplus.runs.run_facts import State
from boxplus.runs.run_loop import Progress, peak_memory_mb, versions

EstimateT = TypeVar("EstimateT")
SummaryT = TypeVar("SummaryT", bound=CameraSummary)


class CameraRun(ResumableRun[CameraEvent, EstimateT, SummaryT]):
    """One run with cameras.

    Args:
        recording: opened; folder: claimed.
        config: the settings as text.
        progress: called after every event that was read.
        landmarks: the sparse map (N, 3) [m] as it is known when it is written.
    """

    def __init__(
        self,
        recording: CameraRecording,
        folder: CameraRunFolder,
        config: str,
        progress: Callable[[Progress], None],
        landmarks: Callable[[], NDArray[np.float32]],
    ) -> None:
        info = recording.info
        streams = [camera.source for camera in info.cameras] + ([] if info.imu is None else [info.imu.source])
        identity = run_identity(info, config, " and ".join(streams))
        super().__init__(recording, folder, identity, folder.frames, EstimateStatistics("frames"), progress)
        self._info, self._folder = info, folder
        self._landmark_file = LandmarkFile(folder.landmarks, landmarks)

    def open(self, stack: ExitStack) -> None:
        """See `RunLoop.open`."""
        super().open(stack)
        self._trajectory = stack.enter_context(TrajectoryWriter(self._folder.path, after_ns=self.written_until_ns))

    def between_events(self) -> None:
        """See `RunLoop.between_events`."""
        super().between_events()
        self.seconds["writing"] += self._landmark_file.write_if_due()

    def at_end(self, state: State) -> None:
        """See `RunLoop.at_end`."""
        self.seconds["writing"] += self._landmark_file.write()
        super().at_end(state)

    def shared_facts(self, state: State, error: str | None, *, with_imu: bool) -> dict[str, Any]:
        """What the summaries of all of these runs state."""
        counts = self.counts
        return {
            "versions": versions("rosbags", "opencv-python-headless"),
            "state": state,
            "error": error,
            "process": os.getpid(),
            "resumed": self.resumed,
            "started": self.started,
            "updated": datetime.now(UTC),
            "recording": recording_facts(self._info, self.recording.progress, with_imu=with_imu),
            "frames": counts.count,
            "status": dict(counts.status),
            "first_time_ns": counts.first_time_ns,
            "last_time_ns": counts.last_time_ns,
            "duration_s": counts.duration_s,
            "path_length_m": counts.path_length_m,
            "weak_intervals": counts.weak_intervals(),
            "timing": frame_timing(self),
            "peak_memory_mb": peak_memory_mb(),
            "warnings": [
                *counts.status_warnings(),
                *counts.warnings.facts(counts.first_time_ns),
                *evidence_warnings(self._info),
            ],
        }
