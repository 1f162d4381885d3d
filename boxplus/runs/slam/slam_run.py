"""LiDAR-inertial odometry over a recording with loops closed beside it: the odometry's results, and the corrected ones."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError, printable
from boxplus.formats.output import atomic_file
from boxplus.formats.trajectory import read_trajectory
from boxplus.formats.trajectory_writer import TrajectoryWriter
from boxplus.manifolds import quaternion, se3
from boxplus.maps.local_maps.builder import LocalMapBuilder
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.maps.tiles.store import merge
from boxplus.maps.tiles.writer import TileWriter
from boxplus.recordings.recording import Recording
from boxplus.runs.extrinsic import Extrinsic
from boxplus.runs.odometry_run import View, run_odometry
from boxplus.runs.run_loop import Progress, versions
from boxplus.runs.run_summary import RunSummary
from boxplus.runs.slam.config import SlamRunConfig, dump_slam_config
from boxplus.runs.slam.folder import SlamFolder, claim_slam_folder
from boxplus.runs.slam.gnss_output import gnss_facts, gnss_warnings, lay_onto_earth, write_georeference
from boxplus.runs.slam.loop_file import Pairs, write_loops
from boxplus.runs.slam.spool import ScanSpool, SpooledScan
from boxplus.runs.slam.summary import SlamSummary
from boxplus.sensors.geodesy import require_utm
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate
from boxplus.systems.slam.correction import Correction
from boxplus.systems.slam.slam import Slam

_KINDS = {  # beginnings of the sentences that refuse a loop
    "looks alike": "looks alike, but the odometry excludes it",
    "too few": "too few points on planes",
    "the surfaces determine": "too few directions measured",
    "the maps overlap": "too little overlap",
    "surfaces lie": "surfaces do not fit",
    "the maps fit": "fits as well elsewhere",
    "contradicts": "contradicts other loops",
}


@dataclass(frozen=True, slots=True, eq=False)
class SlamResult:
    """What a run with loop closure leaves in memory.

    Attributes:
        summary: as in `run.json`; odometry: that of the odometry.
        slam: with all loops; maps: the local maps, `map_time_s` (n,) when they were since the first scan.
    """

    summary: SlamSummary
    odometry: RunSummary
    slam: Slam
    maps: list[LocalMap]
    map_time_s: NDArray[np.float64]


def run_slam(
    recording: Recording,
    folder: str | Path | SlamFolder,
    config: SlamRunConfig | None = None,
    *,
    forbidden: Pairs | None = None,
    forced: Pairs | None = None,
    extrinsic: Extrinsic | None = None,
    overwrite: bool = False,
    progress: Callable[[Progress], None] | None = None,
    view: View | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> SlamResult:
    """Run the odometry and close loops while it runs; write the corrected trajectory and map beside its own.

    Args:
        recording: opened.
        folder: created; see docs/output_folder.md for what it holds. Or what `claim_slam_folder` yields.
        config: settings; each has a default.
        forbidden, forced: pairs (query, place) of local maps, see `read_loop_decisions`.
        extrinsic, overwrite, progress, view, should_stop: as for `run_odometry`.

    Raises:
        InputError: the recording has no IMU; OpenCV, the extra `vision`, is not installed and density images are wanted; what
            `run_odometry` and `Slam` refuse.
        OutputError: the folder cannot be written or the disk is full.
        RecordingError: nothing could be read.
    """
    if not recording.info.imu_topic:
        raise InputError(
            "a recording with an IMU, which tells where down is", f"a LiDAR alone in {recording.info.path.name}",
            "run 'boxplus lio': it closes no loops, and needs no IMU",
        )  # fmt: skip
    config = config or SlamRunConfig()
    if config.gnss.utm:
        require_utm()
    slam = Slam(config.slam, forbidden=forbidden or (), forced=forced or ())
    claimed = nullcontext(folder) if isinstance(folder, SlamFolder) else claim_slam_folder(folder, overwrite=overwrite)
    started = datetime.now(UTC)
    with claimed as own, ScanSpool(own.spool, config.map.voxel) as spool:
        beside = _Beside(LocalMapBuilder(config.local_maps), slam, spool if config.map.save else None, view)
        odometry = run_odometry(
            recording, own.odometry.path, config.of_odometry(), extrinsic=extrinsic, overwrite=overwrite, progress=progress,
            view=beside, should_stop=should_stop,
        )  # fmt: skip
        beside.finish()
        began = time.perf_counter()
        earth = lay_onto_earth(recording, own, slam, config.gnss)
        correction = slam.correction()
        placed = correction if earth is None or earth.fit is None else correction.placed(earth.fit.T_enu_map)
        _write_trajectory(own, placed)
        if earth is not None:
            write_georeference(own, earth, config.gnss)
        stored = _write_map(own, config, spool, placed) if config.map.save else 0
        first_ns = odometry.first_time_ns or 0
        seconds = np.array([(m.time_ns - first_ns) * 1e-9 for m in beside.maps])
        write_loops(own.loops, slam.loops, seconds)
        with atomic_file(own.config) as file:
            file.write(dump_slam_config(config).encode())
        summary = _summary(started, recording, odometry, slam, correction, stored, beside.seconds, time.perf_counter() - began)
        if earth is not None:
            facts = gnss_facts(recording.info.gnss_topic, earth, correction)
            summary = summary.model_copy(update={"gnss": facts, "warnings": summary.warnings + gnss_warnings(earth)})
        summary.write(own.summary)
    return SlamResult(summary, odometry, slam, beside.maps, seconds)


class _Beside:
    """Sees every estimate of the odometry: local maps, loops, and the scans to be placed anew."""

    def __init__(self, builder: LocalMapBuilder, slam: Slam, spool: ScanSpool | None, view: View | None) -> None:
        self._builder, self._slam, self._spool, self._view = builder, slam, spool, view
        self.maps: list[LocalMap] = []
        self.seconds = 0.0

    def show(self, estimate: Estimate) -> None:
        """See `View`."""
        began = time.perf_counter()
        state = estimate.state
        T_odo_imu = np.concatenate([quaternion.from_matrix(state.R_world_imu), state.p_world_imu])
        # The odometry's error of the position is along the world's axes; that of SE(3) is along the body's.
        turn = np.eye(6)
        turn[3:, 3:] = state.R_world_imu.T
        p_imu = (estimate.p_lidar @ state.R_imu_lidar.T.astype(np.float32) + state.p_imu_lidar.astype(np.float32)).astype(
            np.float32
        )
        if estimate.status == "lost":  # nobody knows where its points belong
            p_imu = p_imu[:0]
        covariance = turn @ estimate.pose_covariance @ turn.T
        made = self._builder.push(estimate.time_ns, T_odo_imu, 0.5 * (covariance + covariance.T), p_imu, -state.gravity_world)
        if self._spool is not None and len(p_imu):
            self._spool.append(SpooledScan(estimate.time_ns, T_odo_imu, p_imu, estimate.intensity), estimate.points_world())
        self._take(made)
        self.seconds += time.perf_counter() - began
        if self._view is not None:
            self._view.show(estimate)

    def finish(self) -> None:
        """The last local map."""
        began = time.perf_counter()
        self._take(self._builder.flush())
        self.seconds += time.perf_counter() - began

    def _take(self, made: Iterable[LocalMap]) -> None:
        for local_map in made:
            self.maps.append(local_map)
            self._slam.add(local_map)
            if self._spool is not None:
                self._spool.forget()


def _write_trajectory(folder: SlamFolder, correction: Correction) -> None:
    """The odometry's poses, corrected; covariance (which closing loops can only make smaller) and status are the odometry's."""
    odometry = read_trajectory(folder.odometry.trajectory)
    poses = correction.apply(odometry.times, np.hstack([odometry.q_wxyz, odometry.p]))
    # Errors of positions are along the world's axes, and the world has turned.
    turns = np.tile(np.eye(6), (len(poses), 1, 1))
    turns[:, 3:, 3:] = quaternion.to_matrix(poses[:, :4]) @ quaternion.to_matrix(odometry.q_wxyz).transpose(0, 2, 1)
    none = np.zeros((6, 6))
    with TrajectoryWriter(folder.path) as writer:
        for k, (time_ns, T) in enumerate(zip(odometry.times.tolist(), poses, strict=True)):
            covariance = none if odometry.covariance is None else turns[k] @ odometry.covariance[k] @ turns[k].T
            status = "ok" if odometry.status is None else odometry.status[k]
            writer.append(time_ns, quaternion.to_matrix(T[:4]), T[4:], covariance, status)


def _write_map(folder: SlamFolder, config: SlamRunConfig, spool: ScanSpool, correction: Correction) -> int:
    """Tiles and merged files of the scans where closed loops put them; the odometry's own map stays as it is."""
    settings = config.map
    with TileWriter(folder.tiles, tile_size=settings.tile_size, voxel=settings.voxel) as tiles:
        for scan in spool.scans():
            T = correction.apply([scan.time_ns], scan.T_odo_body[None])[0]
            tiles.append(se3.act(T, scan.p_body.astype(np.float64)), scan.intensity)
        stored = tiles.stored
    if settings.ply or settings.pcd:
        merge(folder.tiles, folder.map_ply if settings.ply else None, folder.map_pcd if settings.pcd else None)
    return stored


def _summary(
    started: datetime,
    recording: Recording,
    odometry: RunSummary,
    slam: Slam,
    correction: Correction,
    stored: int,
    slam_s: float,
    writing_s: float,
) -> SlamSummary:
    accepted = [loop for loop in slam.loops if loop.is_accepted]
    shift = np.linalg.norm(correction.T_map[:, 4:] - correction.T_odo[:, 4:], axis=1)
    refused = Counter(_kind(loop.refusal) for loop in slam.loops if not loop.is_accepted)
    warnings = [] if accepted else ["no loop was closed: trajectory and map are those of the odometry"]
    if slam.doubt is not None:
        warnings.append(slam.doubt)
    return SlamSummary(
        versions=versions("rosbags", "opencv-python-headless"),
        state=odometry.state,
        started=started,
        updated=datetime.now(UTC),
        recording=printable(str(recording.info.path.resolve())),
        contradiction=odometry.contradiction,
        scans=odometry.scans,
        path_length_m=odometry.path_length_m,
        local_maps=len(correction.time_ns),
        loops_looked_at=len(slam.loops),
        loops_accepted=len(accepted),
        loops_forced=sum(loop.source == "forced" for loop in accepted),
        loops_refused=dict(refused),
        largest_shift_m=float(shift.max()),
        last_shift_m=float(shift[-1]),
        map_points=stored,
        slam_s=slam_s,
        writing_s=writing_s,
        warnings=warnings,
    )


def _kind(refusal: str | None) -> str:
    """What a sentence is about; a loop without one was refused by the graph."""
    if refusal is None:
        return "contradicts other loops"
    return next((kind for begin, kind in _KINDS.items() if refusal.startswith(begin)), "too far from the odometry")
