"""LiDAR-inertial odometry over a whole recording, with every result on disk as soon as it is known."""

from __future__ import annotations

import functools
import os
import platform
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Protocol

import boxplus
from boxplus._jit import on_compilation
from boxplus.errors import BoxplusError, InputError, OutputError, printable
from boxplus.formats.output import atomic_file
from boxplus.formats.trajectory_writer import TrajectoryWriter
from boxplus.maps.tiles.store import TileStore, merge
from boxplus.maps.tiles.writer import TileWriter
from boxplus.recordings.recording import Recording
from boxplus.runs.checkpoint import Checkpoint, CheckpointWriter, cut_to_whole_rows, read_checkpoint, run_identity
from boxplus.runs.config import RunConfig, dump_run_config
from boxplus.runs.extrinsic import Extrinsic, choose_extrinsic
from boxplus.runs.run_folder import RunFolder, claim_run_folder
from boxplus.runs.run_summary import (
    ExtrinsicFacts,
    MapFacts,
    RecordingFacts,
    RunSummary,
    StartFacts,
    State,
    TimingFacts,
    WarningFacts,
)
from boxplus.runs.scan_log import ScanLogWriter
from boxplus.runs.statistics import RunStatistics
from boxplus.sensors.imu import ImuSamples
from boxplus.sensors.scan import Scan
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry

_SUMMARY_EVERY_S = 2.0


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a run is.

    Attributes:
        share: of the recording, 0 to 1.
        scans: estimates so far.
        status: of the last scan, or "starting".
        compiling: name of the kernel that is being compiled, or None.
        stage: "odometry" or "merging the map".
    """

    share: float
    scans: int
    status: str
    compiling: str | None = None
    stage: str = "odometry"


class View(Protocol):
    """Something that shows estimates while they come."""

    def show(self, estimate: Estimate) -> None:
        """Show one scan."""


def run_odometry(
    recording: Recording,
    folder: str | Path | RunFolder,
    config: RunConfig | None = None,
    *,
    extrinsic: Extrinsic | None = None,
    overwrite: bool = False,
    resume: bool = False,
    progress: Callable[[Progress], None] | None = None,
    view: View | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> RunSummary:
    """Run LiDAR-inertial odometry over a recording and write trajectory, map and facts to a folder.

    Memory stays constant: every estimate goes to disk at once and is forgotten. A run that is killed leaves everything up
    to its last scan; `run.json` then says so. The report is drawn from the folder, by `boxplus.report.write_report`.

    Args:
        recording: opened.
        folder: created; see docs/output_folder.md for what it holds. Or what `claim_run_folder` yields, where the caller has to
            do more in it before other runs may.
        config: settings; each has a default.
        extrinsic: from `choose_extrinsic`; None chooses.
        overwrite: replace the results of an earlier run in the folder.
        resume: go on with a run that was killed or interrupted, from its last checkpoint.
        progress: called after every event that was read.
        view: shown every estimate.
        should_stop: asked between events; True ends the run in good order, with the state "interrupted".

    Returns:
        The facts of the run, as in `run.json`.

    Raises:
        InputError: the folder holds something else, or another process is writing there; nothing to resume, or a run over
            another recording or with other settings.
        OutputError: the folder cannot be written or the disk is full; what was written before is intact.
        RecordingError: nothing could be read.
    """
    config = config or RunConfig()
    claimed = (
        nullcontext(folder) if isinstance(folder, RunFolder) else claim_run_folder(folder, overwrite=overwrite, resume=resume)
    )
    with claimed as run_folder:
        extrinsic = extrinsic or choose_extrinsic(recording, config.odometry)
        config = config.model_copy(update={"odometry": extrinsic.applied_to(config.odometry)})
        run = _Run(recording, run_folder, config, extrinsic, progress or (lambda _: None), view)
        if resume:
            run.resume()
        return run.execute(should_stop or (lambda: False))


class _Run:
    """One run: its writers, its clock and its counts."""

    def __init__(
        self,
        recording: Recording,
        folder: RunFolder,
        config: RunConfig,
        extrinsic: Extrinsic,
        progress: Callable[[Progress], None],
        view: View | None,
    ) -> None:
        self._recording = recording
        self._folder = folder
        self._config = config
        self._extrinsic = extrinsic
        self._progress = progress
        self._view = view
        self._odometry = LidarInertialOdometry(config.odometry)
        self._tiles: TileWriter | None = None
        self._statistics = RunStatistics()
        if extrinsic.warning:
            self._statistics.warnings.add(extrinsic.warning)
        self._started = datetime.now(UTC)
        self._began = time.perf_counter()
        self._identity = run_identity(recording.info, dump_run_config(config, recording.info))
        self._events, self._resumed = 0, 0
        self._written_until_ns: int | None = None
        self._odometry_ended: float | None = None
        self._seconds = dict.fromkeys(("reading", "odometry", "writing", "merging"), 0.0)
        self._summary_due = 0.0
        self._compiled = 0
        self._registered = 0
        self._merged: int | None = None
        self._stage = "odometry"
        self._status = "starting"

    def resume(self) -> None:
        """Go on from the checkpoint in the folder.

        Scans that came after it are estimated again, and written where their rows are not there yet.
        """
        checkpoint = read_checkpoint(self._folder, self._identity)
        self._written_until_ns = cut_to_whole_rows(self._folder, checkpoint.statistics.scans)
        self._odometry.restore(checkpoint.odometry)
        self._statistics, self._registered = checkpoint.statistics, checkpoint.registered
        self._events, self._resumed = checkpoint.events, checkpoint.resumed + 1

    def execute(self, should_stop: Callable[[], bool]) -> RunSummary:
        """Everything; see `run_odometry`."""
        with atomic_file(self._folder.config) as file:
            file.write(self._identity["config"].encode())
        self._write_summary("running")
        try:
            state = self._process(should_stop)
            self._odometry_ended = time.perf_counter()
            if state == "finished" and not self._statistics.scans:
                raise self._nothing_found()
            self._merge_map()
        except BaseException as problem:
            named = str(problem) if isinstance(problem, BoxplusError) else f"{type(problem).__name__}: {problem}"
            with suppress(OutputError):  # the disk may be full; then the facts of a moment ago stay
                if isinstance(problem, KeyboardInterrupt):
                    self._write_summary("interrupted")
                else:
                    self._write_summary("failed", named)
            raise
        return self._write_summary(state)

    def _process(self, should_stop: Callable[[], bool]) -> State:
        """Every event through the odometry, every estimate to disk."""
        map_config = self._config.map
        with ExitStack() as stack:
            stack.enter_context(on_compilation(self._on_compilation))
            after_ns = self._written_until_ns
            trajectory = stack.enter_context(TrajectoryWriter(self._folder.path, after_ns=after_ns))
            scan_log = stack.enter_context(ScanLogWriter(self._folder.scans, go_on=after_ns is not None))
            checkpoints = CheckpointWriter(self._folder.checkpoint)
            if map_config.save:
                tiles = TileWriter(self._folder.tiles, tile_size=map_config.tile_size, voxel=map_config.voxel)
                self._tiles = stack.enter_context(tiles)
                tiles.stored = TileStore.open(self._folder.tiles).point_count if self._resumed else 0
            events = iter(self._recording)
            for _ in range(self._events):
                next(events, None)
            while not should_stop():
                began = time.perf_counter()
                event = next(events, None)
                read = time.perf_counter()
                self._seconds["reading"] += read - began
                estimates = self._odometry.flush() if event is None else self._push(event)
                self._seconds["odometry"] += time.perf_counter() - read
                for estimate in estimates:
                    self._keep(estimate, trajectory, scan_log)
                self._show_progress()
                if event is None:
                    self._folder.checkpoint.unlink(missing_ok=True)
                    return "finished"
                self._events += 1
                if checkpoints.is_due:
                    checkpoints.write(self._checkpoint())
                if time.perf_counter() > self._summary_due:
                    self._write_summary("running")
            checkpoints.write(self._checkpoint())
        return "interrupted"

    def _checkpoint(self) -> Checkpoint:
        odometry = self._odometry.snapshot()
        return Checkpoint(self._identity, self._events, self._resumed, self._registered, self._statistics, odometry)

    def _push(self, event: Scan | ImuSamples) -> list[Estimate]:
        self._statistics.add_event(event)
        return self._odometry.push_scan(event) if isinstance(event, Scan) else self._odometry.push_imu(event)

    def _keep(self, estimate: Estimate, trajectory: TrajectoryWriter, scan_log: ScanLogWriter) -> None:
        """Write one estimate. Points of a lost scan do not enter the map: nobody knows where they belong."""
        began = time.perf_counter()
        state = estimate.state
        is_new = self._written_until_ns is None or estimate.time_ns > self._written_until_ns
        if is_new:
            trajectory.append(estimate.time_ns, state.R_world_imu, state.p_world_imu, estimate.pose_covariance, estimate.status)
            scan_log.append(estimate)
        if self._tiles is not None and estimate.status != "lost":
            if is_new:
                self._tiles.append(estimate.points_world(), estimate.intensity)
            self._registered += len(estimate.p_lidar)
        self._statistics.add(estimate)
        self._status = estimate.status
        self._seconds["writing"] += time.perf_counter() - began
        if self._view is not None:
            self._view.show(estimate)

    def _merge_map(self) -> None:
        settings = self._config.map
        if self._tiles is None or not (settings.ply or settings.pcd) or not self._statistics.scans:
            return
        self._stage = "merging the map"
        self._show_progress()
        began = time.perf_counter()
        ply, pcd = self._folder.map_ply if settings.ply else None, self._folder.map_pcd if settings.pcd else None
        self._merged = merge(self._folder.tiles, ply, pcd)
        self._seconds["merging"] = time.perf_counter() - began

    def _on_compilation(self, kernel: str) -> None:
        self._compiled += 1
        self._show_progress(kernel)

    def _show_progress(self, compiling: str | None = None) -> None:
        share, scans = self._recording.progress, self._statistics.scans
        self._progress(Progress(share, scans, self._status, compiling, self._stage))

    def _nothing_found(self) -> InputError:
        statistics = self._statistics
        reasons = [f"{count} × {reason}" for reason, count in self._odometry.counters.items()]
        reasons += self._odometry.time_steps
        if self._odometry.start_problem:
            reasons.append(self._odometry.start_problem)
        return InputError(
            "scans that IMU samples cover, and a start the filter can find",
            f"{statistics.scans_read} scans and {statistics.imu_samples_read} IMU samples, none of them usable "
            f"({'; '.join(reasons) or 'no reason counted'})",
            "see 'boxplus inspect' for what is wrong with the recording",
        )

    def _write_summary(self, state: State, error: str | None = None) -> RunSummary:
        summary = self._summarize(state, error)
        summary.write(self._folder.summary)
        self._summary_due = time.perf_counter() + _SUMMARY_EVERY_S
        return summary

    def _summarize(self, state: State, error: str | None) -> RunSummary:
        statistics, start, info = self._statistics, self._odometry.start, self._recording.info
        origin = statistics.first_time_ns
        return RunSummary(
            versions=_versions(),
            state=state,
            error=error,
            process=os.getpid(),
            resumed=self._resumed,
            started=self._started,
            updated=datetime.now(UTC),
            recording=RecordingFacts(
                path=printable(str(info.path.resolve())),
                format=info.format,
                lidar_topic=printable(info.lidar_topic),
                imu_topic=printable(info.imu_topic),
                duration_s=info.duration_s,
                messages=info.message_count,
                progress=self._recording.progress,
                evidence=[{"key": e.key, "value": e.value, "verdict": e.verdict, "text": e.text} for e in info.evidence],
            ),
            extrinsic=ExtrinsicFacts(
                source=self._extrinsic.source,
                text=self._extrinsic.text,
                estimation=self._config.odometry.extrinsic_estimation,
                T_imu_lidar_start=self._extrinsic.T_imu_lidar.tolist(),
                T_imu_lidar_end=statistics.T_imu_lidar.tolist() if statistics.scans else None,
            ),
            start=None if start is None else StartFacts(kind=start.kind, text=start.text, duration_s=start.duration_s),
            scans=statistics.scans,
            status=dict(statistics.status),
            first_time_ns=origin,
            last_time_ns=statistics.last_time_ns,
            duration_s=statistics.duration_s,
            path_length_m=statistics.path_length_m,
            scans_read=statistics.scans_read,
            imu_samples_read=statistics.imu_samples_read,
            contradiction=self._odometry.contradiction or self._extrinsic.contradiction or None,
            rejected={
                "recording": self._recording.rejected,
                "odometry": dict(self._odometry.counters),
                "points": dict(statistics.rejected_points),
            },
            weak_intervals=statistics.weak_intervals(),
            imu_gaps=statistics.imu_gaps(),
            scan_gaps=statistics.scan_gaps(),
            timing=self._timing(),
            map=MapFacts(
                registered_points=self._registered,
                stored_points=self._tiles.stored if self._tiles is not None else 0,
                merged_points=self._merged,
                rejected_points=self._tiles.rejected if self._tiles is not None else 0,
                voxel_m=self._config.map.voxel,
            ),
            peak_memory_mb=_peak_memory_mb(),
            warnings=[
                *(WarningFacts(text=text, count=1) for text in self._odometry.time_steps),
                *statistics.status_warnings(),
                *statistics.warnings.facts(origin),
                *(
                    WarningFacts(text=f"{e.key}: {e.text}", count=1)
                    for e in info.evidence
                    if e.verdict != "ok" and e.key != "T_imu_lidar"
                ),
            ],
        )

    def _timing(self) -> TimingFacts:
        now = time.perf_counter()
        elapsed = (self._odometry_ended or now) - self._began
        return TimingFacts(
            scan_ms=self._statistics.scan_ms(),
            stages_ms=self._statistics.stages_ms(),
            reading_s=self._seconds["reading"],
            odometry_s=self._seconds["odometry"],
            writing_s=self._seconds["writing"],
            merging_s=self._seconds["merging"],
            total_s=now - self._began,
            real_time_factor=self._statistics.duration_s / elapsed,
            compiled_kernels=self._compiled,
        )


@functools.cache
def _versions() -> dict[str, str]:
    versions = {"boxplus": boxplus.__version__, "python": platform.python_version(), "platform": platform.platform()}
    return versions | {name: metadata.version(name) for name in ("numpy", "numba", "scipy", "rosbags")}


def _peak_memory_mb() -> float | None:
    """Of this process, where the system tells."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
