"""A finished run of LiDAR-inertial odometry, refined: trajectory, map and facts in a folder of their own."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import as_settings
from boxplus.errors import BoxplusError, InputError, printable
from boxplus.filtering.nav_state import NavState
from boxplus.formats.output import atomic_file
from boxplus.formats.trajectory import Trajectory, read_trajectory
from boxplus.formats.trajectory_writer import TrajectoryWriter
from boxplus.manifolds import quaternion
from boxplus.maps.plane_voxels.thickness import Sharpness
from boxplus.maps.tiles.store import merge
from boxplus.maps.tiles.writer import TileWriter
from boxplus.recordings.open import open_recording
from boxplus.runs.lidar_inertial.config import RunConfig, load_run_config
from boxplus.runs.lidar_inertial.scan_log import read_scan_log, unmeasured
from boxplus.runs.lidar_inertial.summary import RunSummary, read_summary
from boxplus.runs.refinement.closed_run import ClosedRun, is_closed_run, read_closed_run
from boxplus.runs.refinement.config import RefineRunConfig, dump_refine_config
from boxplus.runs.refinement.folder import RefineFolder
from boxplus.runs.refinement.moved import moved_by
from boxplus.runs.refinement.summary import MapSharpness, RefinedReceiver, RefineSummary
from boxplus.runs.run_folder import RunFolder
from boxplus.runs.run_loop import peak_memory_mb, versions
from boxplus.systems.refinement.collecting import OdometryRows, collect
from boxplus.systems.refinement.finished_run import FinishedRun
from boxplus.systems.refinement.outside.loops import contradicted
from boxplus.systems.refinement.planes.point_store import PointStore
from boxplus.systems.refinement.planes.sightings import lidar_poses
from boxplus.systems.refinement.refinement import Refinement, refine
from boxplus.systems.refinement.state import RefinedState
from boxplus.systems.refinement.unshown import is_mostly_unshown

Floats = NDArray[np.float64]

_FEWEST_SCANS = 20
_DOUBTED = 5.0  # standard deviations of the run's, by which a pose moved


@dataclass(frozen=True, slots=True, eq=False)
class OdometryRun:
    """A run of `boxplus lio` as its folder tells it.

    Attributes:
        folder, summary, config: of it.
        trajectory: with covariance and status; rows: those of the odometry with velocities, biases and mounting.
        closed: the run of `boxplus slam` that it is part of, whose trajectory is meant then; None without.
    """

    folder: RunFolder
    summary: RunSummary
    config: RunConfig
    trajectory: Trajectory
    rows: OdometryRows
    closed: ClosedRun | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RefineResult:
    """What refining leaves in memory.

    Attributes:
        summary: as in `run.json`.
        time_ns: (N,) of the scans; T_before, T_after: (N, 7) T_world_imu of the run, and as it was refined, accepted or not.
    """

    summary: RefineSummary
    time_ns: NDArray[np.int64]
    T_before: Floats
    T_after: Floats


class _Stopped(Exception):
    """Somebody asked to stop."""


def read_odometry_run(folder: str | Path) -> OdometryRun:
    """Read the folder of `boxplus lio` or of `boxplus slam`.

    Raises:
        InputError: another folder; a run that goes on, without an IMU, whose sensors contradict each other, whose mounting is an
            assumption, too short, or most of whose scans were weak or lost.
    """
    path, closed = Path(folder), None
    if is_closed_run(path):
        closed, path = read_closed_run(path), path / "odometry"
    run = RunFolder(path)
    summary = read_summary(run.summary)
    if summary.state not in ("finished", "interrupted"):
        raise InputError("a run that has come to its end", summary.describe_state(), "let it finish, or run it again")
    if not summary.has_imu:
        raise InputError("a run with an IMU", f"one of a LiDAR alone in {path}", "refine runs of LiDAR and IMU")
    is_located = closed is not None and closed.is_located  # where the odometry alone did not know its place, satellites tell it
    contradiction = summary.contradiction_of_sensors if is_located else summary.contradiction
    if contradiction is not None:
        raise InputError("a run that can be trusted", contradiction, "repair that and run 'boxplus lio' again")
    if summary.extrinsic.source == "identity":
        raise InputError(
            "a run in which the mounting of the LiDAR is known", summary.extrinsic.text, "run 'boxplus lio' with --T-imu-lidar"
        )
    if summary.scans < _FEWEST_SCANS:
        raise InputError(f"a run of {_FEWEST_SCANS} scans at least", f"{summary.scans}", "refine a longer one")
    trajectory, log = read_trajectory(run.trajectory), read_scan_log(run.scans)
    meant = trajectory if closed is None else closed.trajectory
    if meant.covariance is None or not np.isfinite(meant.covariance).all():
        said = "none" if meant.covariance is None else "NaN or infinity"
        raise InputError("a covariance of every pose in trajectory.csv", f"{said} in {folder}", "run it again")
    times = trajectory.times
    if len(times) != len(log) or not np.array_equal(times, log.time_ns):
        raise InputError("the same scans in trajectory.csv and scans.csv", f"others in {path}", "run 'boxplus lio' again")
    if is_mostly_unshown(log.status) and not is_located:
        raise InputError(
            "a run whose surroundings showed every direction in half of its scans at least",
            f"{np.count_nonzero(log.status != 'ok')} of {len(log)} scans that were weak or lost in {path}",
            "what they left open nothing can refine but positions by satellite: 'boxplus slam' and refine its folder",
        )
    R = quaternion.to_matrix(trajectory.q_wxyz)
    R_L = quaternion.to_matrix(log.matrix(("imu_lidar_qw", "imu_lidar_qx", "imu_lidar_qy", "imu_lidar_qz")))
    v, b_w, b_a, g, p_L = [log.column(name) for name in ("velocity", "bias_gyro", "bias_accel", "gravity", "imu_lidar_p")]
    states = [NavState(R[k], trajectory.p[k], v[k], b_w[k], b_a[k], g[k], R_L[k], p_L[k]) for k in range(len(times))]
    points = log.column("points_raw").astype(np.int64)
    rows = OdometryRows(times, states, log.status, trajectory.covariance, unmeasured(log), points)
    return OdometryRun(run, summary, load_run_config(run.config), meant, rows, closed)


def refine_run(
    run: OdometryRun,
    folder: RefineFolder,
    config: RefineRunConfig | None = None,
    *,
    recording: str | Path | None = None,
    progress: Callable[[str, float], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> RefineResult:
    """Read the recording once more, refine the run, and write what came of it.

    Args:
        run: from `read_odometry_run`.
        folder: from `claim_refine_folder`.
        config: settings; each has a default.
        recording: where it is now, if not where it was.
        progress: called with the stage and the share of it that is done.
        should_stop: asked now and then; True ends the run without results, with the state "interrupted".

    Raises:
        InputError: the recording is not there, or another one.
        OutputError: the folder cannot be written or the disk is full.
    """
    return _RefineRun(run, folder, as_settings(RefineRunConfig, config), recording, progress, should_stop).execute()


class _RefineRun:
    def __init__(
        self,
        run: OdometryRun,
        folder: RefineFolder,
        config: RefineRunConfig,
        recording: str | Path | None,
        progress: Callable[[str, float], None] | None,
        should_stop: Callable[[], bool] | None,
    ) -> None:
        self._run, self._folder, self._config = run, folder, config
        self._recording = Path(recording if recording is not None else run.summary.recording.path)
        self._progress = progress or (lambda stage, share: None)
        self._should_stop = should_stop or (lambda: False)
        self._started = datetime.now(UTC)
        self._seconds: dict[str, float] = {}

    def execute(self) -> RefineResult:
        """Everything."""
        with atomic_file(self._folder.config) as file:
            file.write(dump_refine_config(self._config).encode())
        self._summary("running").write(self._folder.summary)
        none = np.zeros((0, 7))
        try:
            return self._refined()
        except _Stopped:
            summary = self._summary("interrupted")
            summary.write(self._folder.summary)
            return RefineResult(summary, np.zeros(0, dtype=np.int64), none, none)
        except BaseException as problem:
            named = str(problem) if isinstance(problem, BoxplusError) else f"{type(problem).__name__}: {problem}"
            self._summary("failed", error=named).write(self._folder.summary)
            raise

    def _refined(self) -> RefineResult:
        with PointStore(self._folder.points) as store:
            with self._timed("reading"):
                finished = self._collected(store)
            with self._timed("refining"):
                found = refine(finished, self._config.refinement, self._tell)
            scans = np.flatnonzero(finished.is_end)
            refusal = found.refusal
            with self._timed("writing"):
                self._write_trajectory(finished, found, scans, refusal is None)
                self._write_place()
                stored = self._write_map(finished, found.after) if refusal is None and self._config.map.save else 0
        summary = self._facts(finished, found, scans, refusal, stored)
        summary.write(self._folder.summary)
        before, after = found.before.T_world_imu[scans], found.after.T_world_imu[scans]
        return RefineResult(summary, finished.time_ns[scans], before, after)

    def _collected(self, store: PointStore) -> FinishedRun:
        closed = self._run.closed
        with open_recording(self._recording, self._run.config.recording) as opened:

            def stopped() -> bool:
                self._tell("reading", opened.progress)
                return False

            found = collect(
                iter(opened), self._run.rows, self._run.config.odometry, self._config.refinement, store, stopped
            )  # fmt: skip
            if closed is None:
                return found
            run, rows = self._run.trajectory, np.searchsorted(self._run.trajectory.times, found.time_ns)
            covariance = None if run.covariance is None else run.covariance[rows]
            placed = found.corrected(closed.outcome.placed, covariance)
            return replace(placed, loops=closed.loops(), fixes=closed.fixes(opened))

    def _write_trajectory(self, finished: FinishedRun, found: Refinement, scans: NDArray[np.int64], accepted: bool) -> None:
        """The refined poses with their covariances, or those of the run with what it has of them; status is the run's."""
        trajectory = self._run.trajectory
        rows = np.searchsorted(trajectory.times, finished.time_ns[scans])
        T = (found.after if accepted else found.before).T_world_imu[scans]
        R = quaternion.to_matrix(T[:, :4])
        with TrajectoryWriter(self._folder.path) as writer:
            for k, (scan, row) in enumerate(zip(scans.tolist(), rows.tolist(), strict=True)):
                if accepted:
                    covariance = found.pose_covariance[scan]
                else:
                    covariance = None if trajectory.covariance is None else trajectory.covariance[row]
                status = "ok" if trajectory.status is None else trajectory.status[row]
                writer.append(int(finished.time_ns[scan]), R[k], T[k, 4:], covariance, status)

    def _write_place(self) -> None:
        """`georeference.yaml` of the run: what is written lies on the Earth as the run does, with the same origin."""
        closed = self._run.closed
        if closed is not None and closed.folder.georeference.is_file():
            with atomic_file(self._folder.georeference) as file:
                file.write(closed.folder.georeference.read_bytes())

    def _write_map(self, finished: FinishedRun, state: RefinedState) -> int:
        """Tiles and merged files of the points that were kept."""
        settings = self._config.map
        T = lidar_poses(state.T_world_imu, state.T_imu_lidar)
        R = quaternion.to_matrix(T[:, :4])
        with TileWriter(self._folder.tiles, tile_size=settings.tile_size, voxel=settings.voxel) as tiles:
            for k, points in enumerate(finished.points):
                if len(points):
                    tiles.append(points.astype(np.float64) @ R[k].T + T[k, 4:])
                self._tell("writing the map", (k + 1) / len(finished))
            stored = tiles.stored
        if outputs := settings.merged_files(self._folder.map_ply, self._folder.map_pcd):
            merge(self._folder.tiles, outputs)
        return stored

    def _tell(self, stage: str, share: float) -> None:
        if self._should_stop():
            raise _Stopped
        self._progress(stage, share)

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self._seconds[stage] = time.perf_counter() - began

    def _facts(
        self, finished: FinishedRun, found: Refinement, scans: NDArray[np.int64], refusal: str | None, stored: int
    ) -> RefineSummary:
        before, after = found.before, found.after
        shift = np.linalg.norm(after.T_world_imu[scans, 4:] - before.T_world_imu[scans, 4:], axis=1)
        cosine = np.abs(np.einsum("ni,ni->n", after.T_world_imu[scans, :4], before.T_world_imu[scans, :4]))
        tilt = np.arccos(np.clip(before.gravity_direction @ after.gravity_direction, -1.0, 1.0))
        refused = f"not accepted, the trajectory is that of the run and no map was written: {refusal}"
        warnings = [*found.calibration.doubts, *self._notes()] if refusal is None else [refused]
        far = contradicted(found.loop_errors)
        if far.any() and finished.loops is not None:
            worst = int(np.argmax(found.loop_errors))
            which = f"{finished.loops.query[worst]} → {finished.loops.place[worst]}"
            warnings.append(
                f"{np.count_nonzero(far)} of {len(far)} loops lie up to {found.loop_errors[worst]:.0f} standard deviations "
                f"({which}) from where refining has put the visits: look at them in the report of 'boxplus slam'"
            )
        missing = len(self._run.rows.time_ns) - len(scans)
        if missing:
            warnings.append(f"{missing} scans of the run are not in the recording as it was read now, and are left out")
        return self._summary("finished").model_copy(
            update={
                "accepted": refusal is None,
                "refusal": refusal,
                "doubt": None if refusal is not None else self._doubt(finished, found, scans),
                "scans": len(scans),
                "keyframes": found.keyframes,
                "planes": found.planes,
                "cost": [(float(first), float(last)) for first, last in found.costs],
                "before": _as_facts(found.sharpness[0]),
                "after": _as_facts(found.sharpness[1]),
                "largest_shift_m": float(shift.max()),
                "largest_turn_deg": float(np.degrees(2.0 * np.arccos(np.clip(cosine.min(), 0.0, 1.0)))),
                "gravity_tilt_deg": float(np.degrees(tilt)),
                "T_imu_lidar_before": _matrix(before.T_imu_lidar),
                "T_imu_lidar_after": _matrix(after.T_imu_lidar),
                "extrinsic": found.calibration.extrinsic,
                "extrinsic_sigma": found.calibration.extrinsic_sigma.tolist(),
                "time_offset": found.calibration.time_offset,
                "time_offset_s": after.time_offset_s,
                "time_offset_sigma_s": found.calibration.time_offset_sigma,
                "loops": len(found.loop_errors),
                "loops_told_by_planes": int(found.loop_is_told.sum()),
                "loops_contradicted": int(np.count_nonzero(far)),
                "receiver": _receiver(finished, after),
                "map_points": stored,
                "warnings": warnings,
            }
        )

    def _notes(self) -> list[str]:
        """What is known of the run that makes its refinement less than it seems."""
        notes: list[str] = []
        if self._run.summary.extrinsic.source == "estimated":
            notes.append("the mounting of the LiDAR was estimated by the run: give --T-imu-lidar to 'boxplus lio' if it is known")
        if unshown := int(np.count_nonzero(self._run.rows.status != "ok")):
            notes.append(
                f"{unshown} scans were weak or lost: planes measure nothing that the surroundings did not show, and from the "
                "first of them on covariances are those of the run"
            )
        return notes

    def _doubt(self, finished: FinishedRun, found: Refinement, scans: NDArray[np.int64]) -> str | None:
        """What the run claimed, against where refining has put its poses."""
        trajectory = self._run.trajectory
        if trajectory.covariance is None:
            return None
        rows = np.searchsorted(trajectory.times, finished.time_ns[scans])
        before, after = found.before.T_world_imu[scans], found.after.T_world_imu[scans]
        closed = self._run.closed
        most = moved_by(before, after, trajectory.covariance[rows], None if closed is None else closed.summary.gnss)
        if most <= _DOUBTED:
            return None
        return f"poses moved by up to {most:.0f} standard deviations of what the run claimed: one of the two is wrong"

    def _summary(self, state: str, error: str | None = None) -> RefineSummary:
        return RefineSummary.model_validate(
            {
                "versions": versions("rosbags"),
                "state": state,
                "error": error,
                "started": self._started,
                "updated": datetime.now(UTC),
                "run": printable(str(self._run.folder.path.resolve())),
                "recording": printable(str(self._recording.resolve())),
                "seconds": dict(self._seconds),
                "peak_memory_mb": peak_memory_mb(),
            }
        )


def _as_facts(sharpness: Sharpness) -> MapSharpness:
    return MapSharpness(
        thickness_m=sharpness.thickness, entropy=sharpness.entropy, points=sharpness.points, planes=sharpness.planes
    )


def _matrix(T: Floats) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = quaternion.to_matrix(T[:4]), T[4:]
    rows: list[list[float]] = matrix.tolist()
    return rows


def _receiver(finished: FinishedRun, after: RefinedState) -> RefinedReceiver | None:
    receiver, fixes = after.receiver, finished.fixes
    if receiver is None or fixes is None:
        return None
    lever, sigma = receiver.lever.tolist(), receiver.sigma.tolist()
    return RefinedReceiver(
        fixes=len(fixes),
        heading_sigma_deg=math.degrees(sigma[2]),
        position_sigma_m=math.hypot(sigma[3], sigma[4]) / math.sqrt(2.0),
        lever_arm_m=(lever[0], lever[1], lever[2]),
        lever_arm_sigma_m=(sigma[6], sigma[7], sigma[8]),
        delay_s=receiver.delay_s,
        delay_sigma_s=sigma[9],
    )
