"""LiDAR-inertial odometry, or that of a LiDAR alone, over a whole recording, with every result on disk as soon as it is known."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import ExitStack, nullcontext
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol, cast

from boxplus._arguments import as_settings
from boxplus.errors import InputError, RecordingError, printable
from boxplus.formats.trajectory_writer import TrajectoryWriter
from boxplus.maps.tiles.store import TileStore, merge
from boxplus.maps.tiles.writer import TileWriter
from boxplus.recordings.recording import Recording
from boxplus.runs.checkpoint import run_identity
from boxplus.runs.lidar_inertial.config import RunConfig, dump_run_config
from boxplus.runs.lidar_inertial.extrinsic import Extrinsic, choose_extrinsic
from boxplus.runs.lidar_inertial.first_lidar_alone import compare_by_first_alone
from boxplus.runs.lidar_inertial.lidar_facts import lidar_facts, lidar_warnings, watch_of
from boxplus.runs.lidar_inertial.scan_clouds import ScanCloudWriter
from boxplus.runs.lidar_inertial.scan_log import ScanLogWriter
from boxplus.runs.lidar_inertial.sensor_facts import sensor_facts
from boxplus.runs.lidar_inertial.statistics import RunStatistics
from boxplus.runs.lidar_inertial.summary import ExtrinsicFacts, MapFacts, RecordingFacts, RunSummary, TimingFacts
from boxplus.runs.resumable_run import ResumableRun
from boxplus.runs.run_facts import StartFacts, State, WarningFacts
from boxplus.runs.run_folder import RunFolder, claim_run_folder
from boxplus.runs.run_loop import Progress, peak_memory_mb, versions
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.sequencer import BEFORE_START, REPEATED
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from boxplus.systems.lidar_odometry.odometry import LidarOdometry
from boxplus.systems.several_lidars.watch import LidarWatch


class View(Protocol):
    """Something that shows estimates while they come."""

    def show(self, estimate: Estimate) -> None:
        """Show one scan."""


class Companion(View, Protocol):
    """Something that sees every estimate, and goes on from a checkpoint together with the run."""

    def snapshot(self) -> dict[str, object]:
        """What it holds after the estimates so far, as `write_state` takes it; only to be written at once."""

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a `snapshot`; estimates after it are shown again."""

    def finish(self) -> None:
        """The last estimate was shown. What is still held back goes to disk before `run.json` says that the run is finished."""


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
    companion: Companion | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> RunSummary:
    """Run odometry over a recording and write trajectory, map and facts to a folder.

    With an IMU it is `LidarInertialOdometry`, without one `LidarOdometry`.

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
        companion: the same, and goes on with the run where it is resumed.
        should_stop: asked between events; True ends the run in good order, with the state "interrupted".

    Returns:
        The facts of the run, as in `run.json`.

    Raises:
        InputError: the folder holds something else, or another process is writing there; nothing to resume, or a run over
            another recording or with other settings.
        OutputError: the folder cannot be written or the disk is full; what was written before is intact.
        RecordingError: nothing could be read.
    """
    config = as_settings(RunConfig, config)
    claimed = (
        nullcontext(folder) if isinstance(folder, RunFolder) else claim_run_folder(folder, overwrite=overwrite, resume=resume)
    )
    with claimed as run_folder:
        extrinsic = extrinsic or choose_extrinsic(recording, config.odometry, should_stop=should_stop)
        config = config.model_copy(update={"odometry": extrinsic.applied_to(config.odometry)})
        run = _Run(recording, run_folder, config, extrinsic, progress or (lambda _: None), view, companion)
        if resume:
            run.resume()
        return run.execute(should_stop or (lambda: False))


class _Run(ResumableRun[Scan | ImuSamples, Estimate, RunSummary]):
    """One run of LiDAR-inertial odometry: its writers, its map and its checkpoints."""

    def __init__(
        self,
        recording: Recording,
        folder: RunFolder,
        config: RunConfig,
        extrinsic: Extrinsic,
        progress: Callable[[Progress], None],
        view: View | None,
        companion: Companion | None,
    ) -> None:
        info = recording.info
        identity = run_identity(info, dump_run_config(config, info), f"{info.lidar_topic} and {info.imu_topic}")
        self._statistics = RunStatistics()
        super().__init__(recording, folder, identity, folder.scans, self._statistics, progress)
        self._recording = recording
        self._folder = folder
        self._config = config
        self._extrinsic = extrinsic
        self._view, self._companion = view, companion
        alone = not recording.info.imu_topic
        self._odometry = LidarOdometry(config.odometry) if alone else LidarInertialOdometry(config.odometry)
        self._watch = watch_of(recording)
        self._tiles: TileWriter | None = None
        self._scan_clouds: ScanCloudWriter | None = None
        if extrinsic.warning:
            self._statistics.warnings.add(extrinsic.warning)
        self.seconds["merging"] = 0.0
        self._registered = 0
        self._merged: int | None = None

    def snapshot(self) -> tuple[dict[str, object], dict[str, object]]:
        """See `ResumableRun.snapshot`."""
        companion = None if self._companion is None else self._companion.snapshot()
        return self._odometry.snapshot(), {"registered": self._registered, "watch": self._watch, "companion": companion}

    def restore(self, odometry: dict[str, Any], run: dict[str, Any]) -> None:
        """See `ResumableRun.restore`."""
        self._odometry.restore(odometry)
        self._statistics = cast(RunStatistics, self.counts)
        self._registered, self._watch = run["registered"], run["watch"]
        began_alone, goes_on_alone = run.get("companion") is None, self._companion is None
        if began_alone != goes_on_alone:
            began, now = ("'boxplus lio'" if alone else "'boxplus slam'" for alone in (began_alone, goes_on_alone))
            raise InputError(f"the command that the run began with, {began}", now, f"go on with {began}")
        if self._companion is not None:
            self._companion.restore(run["companion"])

    def open(self, stack: ExitStack) -> None:
        """See `RunLoop.open`."""
        super().open(stack)
        map_config, after_ns = self._config.map, self.written_until_ns
        self._trajectory = stack.enter_context(TrajectoryWriter(self._folder.path, after_ns=after_ns))
        self._scan_log = stack.enter_context(ScanLogWriter(self._folder.scans, go_on=after_ns is not None))
        if map_config.save:
            tiles = TileWriter(self._folder.tiles, tile_size=map_config.tile_size, voxel=map_config.voxel)
            self._tiles = stack.enter_context(tiles)
            tiles.stored = TileStore.open(self._folder.tiles).point_count if self.resumed else 0
        if self._config.scans.frame != "none":
            self._scan_clouds = ScanCloudWriter(
                self._folder.scan_clouds, self._config.scans, 1 + len(self._recording.info.other_lidars)
            )

    def push(self, event: Scan | ImuSamples) -> list[Estimate]:
        """See `RunLoop.push`."""
        self._statistics.add_event(event)
        if self._watch is not None and isinstance(event, Scan):
            self._watch.add_scan(event)
        return self._odometry.push_scan(event) if isinstance(event, Scan) else self._odometry.push_imu(event)

    def flush(self) -> list[Estimate]:
        """See `RunLoop.flush`."""
        return self._odometry.flush()

    def keep(self, estimate: Estimate) -> None:
        """Write one estimate. Points of a lost scan do not enter the map: nobody knows where they belong."""
        began = time.perf_counter()
        state = estimate.state
        is_new = self.is_new(estimate.time_ns)
        if is_new:
            if self._scan_clouds is not None:  # before the row: each row has its cloud, wherever the run is killed
                self._scan_clouds.write(estimate)
            pose = state.R_world_imu, state.p_world_imu
            self._trajectory.append(estimate.time_ns, *pose, estimate.pose_covariance, estimate.status)
            self._scan_log.append(estimate)
        if self._tiles is not None and estimate.status != "lost":
            if is_new:
                self._tiles.append(estimate.points_world(), estimate.intensity)
            self._registered += len(estimate.p_lidar)
        self._statistics.add(estimate)
        if self._watch is not None:
            for text in self._watch.add_estimate(estimate):
                self._statistics.warnings.add(text, estimate.time_ns)
        self.status = estimate.status
        self.seconds["writing"] += time.perf_counter() - began
        for viewer in (self._companion, self._view):
            if viewer is not None:
                viewer.show(estimate)

    def at_end(self, state: State) -> None:
        """See `RunLoop.at_end`."""
        if self._watch is not None and state == "finished":
            for text in self._last_words_of(self._watch):
                self._statistics.warnings.add(text)
        super().at_end(state)
        if self._companion is not None:
            self._companion.finish()

    def _last_words_of(self, watch: LidarWatch) -> list[str]:
        """What is left to say of several LiDARs. Without an IMU a clock that is off bends their common path, and is hardly seen
        along it: that of the first one by itself tells."""
        told = watch.finish()
        own = watch_of(self._recording)
        if own is None or watch.contradiction is not None or not isinstance(self._odometry, LidarOdometry):
            return told
        self.stage = "comparing the LiDARs"
        self.show_progress()
        try:
            found = compare_by_first_alone(self._recording.read_again(), own, determined=True)
        except RecordingError:  # what was read once is gone; it was told what the run itself saw
            return told
        if not all(windows for _, windows, _ in own.judgements().values()):
            return told
        self._watch = own
        return found

    def finish(self) -> None:
        """Merge the map."""
        outputs = self._config.map.merged_files(self._folder.map_ply, self._folder.map_pcd)
        if self._tiles is None or not outputs or not self._statistics.count:
            return
        self.stage = "merging the map"
        self.show_progress()
        began = time.perf_counter()
        self._merged = merge(self._folder.tiles, outputs)
        self.seconds["merging"] = time.perf_counter() - began

    def nothing_found(self) -> InputError:
        """See `RunLoop.nothing_found`."""
        statistics = self._statistics
        reasons = [f"{count} × {reason}" for reason, count in self._odometry.counters.items()]
        reasons += self._odometry.time_steps
        if self._odometry.start_problem:
            reasons.append(self._odometry.start_problem)
        reasons += [f"{entry.key}: {entry.text}" for entry in self._recording.info.evidence if entry.verdict == "error"]
        return InputError(
            "scans that IMU samples cover, and a start the filter can find",
            f"{statistics.scans_read} scans and {statistics.imu_samples_read} IMU samples, none of them usable "
            f"({'; '.join(reasons) or 'no reason counted'})",
            "see 'boxplus inspect' for what is wrong with the recording",
        )

    def summarize(self, state: State, error: str | None) -> RunSummary:
        """See `RunLoop.summarize`."""
        statistics, start, info = self._statistics, self._odometry.start, self._recording.info
        origin = statistics.first_time_ns
        lidars = lidar_facts(self._recording, self._watch, origin)
        sigma_deg, sigma_m = statistics.mounting_sigma if statistics.count else (None, None)
        return RunSummary(
            versions=versions("rosbags"),
            state=state,
            error=error,
            process=os.getpid(),
            resumed=self.resumed,
            started=self.started,
            updated=datetime.now(UTC),
            recording=RecordingFacts(
                path=printable(str(info.path.resolve())),
                format=info.format,
                lidar_topic=printable(info.lidar_topic),
                imu_topic=printable(info.imu_topic),
                duration_s=info.duration_s,
                messages=info.message_count,
                progress=self._recording.progress,
                first_points=statistics.first_points,
                evidence=[{"key": e.key, "value": e.value, "verdict": e.verdict, "text": e.text} for e in info.evidence],
            ),
            extrinsic=ExtrinsicFacts(
                source=self._extrinsic.source,
                text=self._extrinsic.text,
                estimation=self._config.odometry.extrinsic_estimation,
                T_imu_lidar_start=self._extrinsic.T_imu_lidar.tolist(),
                T_imu_lidar_end=statistics.T_imu_lidar.tolist() if statistics.count else None,
                sigma_end_deg=sigma_deg,
                sigma_end_m=sigma_m,
            ),
            sensors=sensor_facts(self._odometry),
            lidars=lidars,
            start=None if start is None else StartFacts(kind=start.kind, text=start.text, duration_s=start.duration_s),
            scans=statistics.count,
            status=dict(statistics.status),
            first_time_ns=origin,
            last_time_ns=statistics.last_time_ns,
            duration_s=statistics.duration_s,
            path_length_m=statistics.path_length_m,
            scans_read=statistics.scans_read,
            imu_samples_read=statistics.imu_samples_read,
            contradiction=self._contradiction,
            unknown_position=self._unknown_position,
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
            peak_memory_mb=peak_memory_mb(),
            warnings=[
                *(WarningFacts(text=text, count=1) for text in self._odometry.time_steps),
                *lidar_warnings(lidars, self._recording.time_steps),
                *statistics.status_warnings(),
                *statistics.imu_warnings(self._odometry.counters),
                *statistics.repeated_warnings(self._odometry.counters.get(REPEATED, 0)),
                *statistics.late_start_warnings(self._odometry.counters.get(BEFORE_START, 0), self._odometry.start_problem),
                *statistics.vague_warnings(self._mounting_sigma),
                *statistics.warnings.facts(origin),
                *(
                    WarningFacts(text=f"{e.key}: {e.text}", count=1)
                    for e in info.evidence
                    if e.verdict != "ok" and e.key != "T_imu_lidar"
                ),
            ],
        )

    @property
    def _contradiction(self) -> str | None:
        """Of the LiDARs among each other first: what else is contradicted may follow from it.

        Then what the first seconds of rotation contradict: the odometry compares shorter stretches, and with an estimate that may
        have left the truth by then, but also sees what comes later.
        """
        of_lidars = None if self._watch is None else self._watch.contradiction
        found = [self._extrinsic.contradiction, self._odometry.contradiction]
        told = [of_lidars, *(found if any(found) else [self._unknown_mounting])]
        return "; ".join(dict.fromkeys(text for text in told if text)) or self._unknown_position

    @property
    def _unknown_position(self) -> str | None:
        return self._statistics.unknown_position(self._mounting_sigma)

    @property
    def _unknown_mounting(self) -> str | None:
        if not self._extrinsic.unknown or not isinstance(self._odometry, LidarInertialOdometry):
            return None
        return None if self._odometry.consistency.mounting_borne_out else self._extrinsic.unknown

    @property
    def _mounting_sigma(self) -> tuple[float, float] | None:
        """Of T_imu_lidar at first, rotation [deg] and translation [m]; None where it is taken for exact or there is no IMU."""
        odometry = self._config.odometry
        if self._extrinsic.source == "none" or odometry.extrinsic_estimation == "off":
            return None
        return odometry.extrinsic_rotation_sigma_deg, odometry.extrinsic_translation_sigma

    def _timing(self) -> TimingFacts:
        return TimingFacts(
            scan_ms=self._statistics.estimate_ms(),
            stages_ms=self._statistics.stages_ms(),
            reading_s=self.seconds["reading"],
            odometry_s=self.seconds["odometry"],
            writing_s=self.seconds["writing"],
            merging_s=self.seconds["merging"],
            total_s=time.perf_counter() - self.began,
            real_time_factor=self.real_time_factor(),
            compiled_kernels=self.compiled,
        )
