"""LiDAR-inertial odometry over a recording, and where each scan is in a saved map."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from boxplus._arguments import as_settings
from boxplus.errors import printable
from boxplus.formats.output import atomic_file
from boxplus.formats.trajectory_writer import TrajectoryWriter
from boxplus.manifolds import quaternion, se3
from boxplus.recordings.recording import Recording
from boxplus.runs.lidar_inertial.extrinsic import Extrinsic
from boxplus.runs.lidar_inertial.odometry_run import View, run_odometry
from boxplus.runs.lidar_inertial.summary import RunSummary
from boxplus.runs.localization.config import LocalizationRunConfig, dump_localization_config
from boxplus.runs.localization.folder import LocalizationFolder, claim_localization_folder
from boxplus.runs.localization.logs import LocalizationLog, SearchLog, candidate_texts
from boxplus.runs.localization.summary import LocalizationSummary
from boxplus.runs.run_loop import Progress, versions
from boxplus.runs.saved_map.other_readings import other_reading
from boxplus.runs.saved_map.saved_map import SavedMap
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate
from boxplus.systems.localization.localizer import Localization, Localizer


@dataclass(frozen=True, slots=True, eq=False)
class LocalizationResult:
    """What a run in a saved map leaves in memory.

    Attributes:
        summary: as in `run.json`; odometry: that of the odometry.
        saved: the map.
    """

    summary: LocalizationSummary
    odometry: RunSummary
    saved: SavedMap


def run_localization(
    recording: Recording,
    folder: str | Path | LocalizationFolder,
    saved: SavedMap,
    config: LocalizationRunConfig | None = None,
    *,
    extrinsic: Extrinsic | None = None,
    overwrite: bool = False,
    accept_doubts: bool = False,
    progress: Callable[[Progress], None] | None = None,
    view: View | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> LocalizationResult:
    """Run the odometry, and find and follow it in a saved map; write the poses in the map's frame.

    Args:
        recording: opened.
        folder: created; see docs/output_folder.md for what it holds. Or what `claim_localization_folder` yields.
        saved: from `open_saved_map`.
        config: settings; each has a default.
        accept_doubts: of the map, which the run that wrote it says: they are warnings then, and no reason to distrust the poses.
        extrinsic, overwrite, progress, view, should_stop: as for `run_odometry`.

    Raises:
        InputError: what `run_odometry` refuses.
        OutputError: the folder cannot be written or the disk is full.
        RecordingError: nothing could be read.
    """
    config = as_settings(LocalizationRunConfig, config)
    if not recording.info.imu_topic:
        config.odometry.of_lidar_alone()  # refuses what it refuses before anything is written
    claimed = (
        nullcontext(folder) if isinstance(folder, LocalizationFolder) else claim_localization_folder(folder, overwrite=overwrite)
    )
    started = datetime.now(UTC)
    with claimed as own, ExitStack() as stack:
        with atomic_file(own.config) as file:
            file.write(dump_localization_config(config).encode())
        began = time.perf_counter()
        localizer = Localizer(saved, config.localization)
        beside = _Beside(localizer, own, stack, view, has_gravity=bool(recording.info.imu_topic))
        beside.search_s = time.perf_counter() - began
        odometry = run_odometry(
            recording, own.odometry.path, config.of_odometry(), extrinsic=extrinsic, overwrite=overwrite, progress=progress,
            view=beside, should_stop=should_stop,
        )  # fmt: skip
        reading = None
        if beside.found_ns is None and odometry.contradiction_of_sensors is None:
            if progress is not None:
                progress(Progress(1.0, 0, "scans", "", stage="reading the map in other ways"))
            reading = other_reading(saved, localizer, config.local_maps)
        summary = _summary(started, recording, odometry, saved, beside, accept_doubts, reading)
        summary.write(own.summary)
    return LocalizationResult(summary, odometry, saved)


class _Beside:
    """Sees every estimate of the odometry, and writes where it is in the map."""

    def __init__(
        self, localizer: Localizer, folder: LocalizationFolder, stack: ExitStack, view: View | None, *, has_gravity: bool
    ) -> None:
        self.localizer, self._has_gravity = localizer, has_gravity
        self._view = view
        self._trajectory = stack.enter_context(TrajectoryWriter(folder.path))
        self._log = stack.enter_context(LocalizationLog(folder.log))
        self._searches = stack.enter_context(SearchLog(folder.searches))
        self.status: Counter[str] = Counter()
        self.first_ns: int | None = None
        self.found_ns: int | None = None
        self.searches = 0
        self.losses: list[str] = []
        self.search_s = self.tracking_s = 0.0
        self.T_map_world: list[float] | None = None

    def show(self, estimate: Estimate) -> None:
        """See `View`."""
        began = time.perf_counter()
        state = estimate.state
        T_odo_imu = np.concatenate([quaternion.from_matrix(state.R_world_imu), state.p_world_imu])
        R, t = state.R_imu_lidar.astype(np.float32), state.p_imu_lidar.astype(np.float32)
        lost_before = self.localizer.losses
        up = -state.gravity_world if self._has_gravity else None
        p_imu = estimate.p_lidar @ R.T + t
        found = self.localizer.push(estimate.time_ns, T_odo_imu, p_imu, up, lost=estimate.status == "lost")
        self.first_ns = estimate.time_ns if self.first_ns is None else self.first_ns
        if self.localizer.losses > lost_before:
            self.losses.append(f"{(estimate.time_ns - self.first_ns) * 1e-9:.1f} s: {self.localizer.lost_because}")
        self._write(found, T_odo_imu)
        if found.status == "searching" or found.search is not None:
            self.search_s += time.perf_counter() - began
        else:
            self.tracking_s += time.perf_counter() - began
        if self._view is not None:
            self._view.show(estimate)

    def _write(self, found: Localization, T_odo_imu: np.ndarray) -> None:
        self.status[found.status] += 1
        self._log.append(found)
        if found.search is not None:
            self.searches += 1
            self._searches.append(found.search)
        self.T_map_world = None
        if found.T_map_body is not None and found.covariance is not None:
            self.found_ns = found.time_ns if self.found_ns is None else self.found_ns
            R = quaternion.to_matrix(found.T_map_body[:4])
            turn = np.eye(6)  # positions of the file are along the map's axes
            turn[3:, 3:] = R
            covariance = turn @ found.covariance @ turn.T
            self._trajectory.append(found.time_ns, R, found.T_map_body[4:], covariance, found.status)
            self.T_map_world = se3.compose(found.T_map_body, se3.inverse(T_odo_imu)).tolist()


def _summary(
    started: datetime,
    recording: Recording,
    odometry: RunSummary,
    saved: SavedMap,
    beside: _Beside,
    accept_doubts: bool,
    reading: str | None,
) -> LocalizationSummary:
    search = beside.localizer.last_search
    warnings = [printable(f"the map is damaged: {text}") for text in saved.damage]
    accepted = [*saved.accepted, *(saved.doubts if accept_doubts else [])]
    warnings += [printable(f"the run that wrote the map says against it, which somebody accepted: {text}") for text in accepted]
    texts: list[str] = []
    if beside.T_map_world is None:
        # Where sensors contradict each other, what they saw lies nowhere: poses at which some of it fits would mislead.
        texts = [] if search is None or odometry.contradiction_of_sensors is not None else candidate_texts(search)
        never = "not found" if beside.found_ns is None else "lost at the end, and not found again"
        why = "nothing was collected for long enough to be looked for" if search is None else search.verdict
        if odometry.contradiction_of_sensors is not None:
            why = f"{why or 'see losses'}; sensors contradict each other, and what they saw may fit nowhere: repair that first"
        if reading is not None:
            why = reading
        warnings.append(f"{never}: {why or 'see losses'}")
    return LocalizationSummary(
        versions=versions("rosbags"),
        state=odometry.state,
        started=started,
        updated=datetime.now(UTC),
        recording=printable(str(recording.info.path.resolve())),
        map=printable(str(saved.path.resolve())),
        map_kind=saved.kind,
        map_report=[printable(text) for text in saved.report],
        map_origin=saved.origin.tolist(),
        places=len(saved.local_maps),
        contradiction=odometry.contradiction_of_sensors,
        scans=odometry.scans,
        status=dict(beside.status),
        found_after_s=None if beside.found_ns is None or beside.first_ns is None else (beside.found_ns - beside.first_ns) * 1e-9,
        searches=beside.searches,
        losses=beside.losses,
        doubt=beside.localizer.doubt,
        map_doubts=[] if accept_doubts else [printable(text) for text in saved.doubts],
        best_candidates=texts,
        T_map_world=beside.T_map_world,
        search_s=beside.search_s,
        tracking_s=beside.tracking_s,
        warnings=warnings,
    )
