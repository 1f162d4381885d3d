"""A finished run of `boxplus slam` as a session: its local maps and loops, and its scans for the joint map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.output import advice_to_put_back
from boxplus.formats.trajectory import read_trajectory
from boxplus.manifolds import se3
from boxplus.maps.local_maps.folder import LocalMapFolder
from boxplus.runs.lidar_inertial.summary import RunSummary, read_summary
from boxplus.runs.sessions.repeated import RecordingIdentity
from boxplus.runs.slam.folder import PROGRAM, SlamFolder
from boxplus.runs.slam.graph_file import read_graph
from boxplus.runs.slam.spool import read_spool
from boxplus.runs.slam.summary import read_slam_summary
from boxplus.runs.storage.output_folder import program_of
from boxplus.systems.sessions.session import OwnLoop, Session
from boxplus.systems.slam.correction import Correction

Floats = NDArray[np.float64]

_ADVICE = "run 'boxplus slam' on the recording, to its end and with a map"


@dataclass(frozen=True, slots=True, eq=False)
class PlacedScan:
    """A scan in the world.

    Attributes:
        time_ns: absolute [ns].
        points: (N, 3) where its rays ended [m].
        intensity: (N,) or None.
        p_lidars: (L, 3) where its LiDARs were; lidar: (N,) which of them saw each point, None where a single one is known to.
    """

    time_ns: int
    points: Floats
    intensity: NDArray[np.float32] | None
    p_lidars: Floats
    lidar: NDArray[np.uint8] | None

    @property
    def origins(self) -> Floats:
        """(N, 3) where its rays began."""
        return self.p_lidars[np.zeros(len(self.points), np.uint8) if self.lidar is None else self.lidar]


@dataclass(frozen=True, slots=True, eq=False)
class SessionRun:
    """A run, opened.

    Attributes:
        folder: its output folder; session: what is aligned; correction: of its own loops.
        doubt: why the run itself is not to be trusted; None where nothing speaks against it.
        p_imu_lidars: (L, 3) its LiDARs in the frame of the poses, the first one first [m].
        identity: of its recording.
    """

    folder: SlamFolder
    session: Session
    correction: Correction
    doubt: str | None
    p_imu_lidars: Floats
    identity: RecordingIdentity

    def placed(self, T_world_map: Floats) -> Correction:
        """What takes poses of the odometry into the world in which the local maps are at T_world_map (n, 7)."""
        return Correction(self.correction.time_ns, self.correction.T_odo, T_world_map)

    def scans(self, T_world_map: Floats) -> Iterator[PlacedScan]:
        """Every scan that was kept, in that world.

        Raises:
            InputError: the file of scans is damaged.
        """
        placed = self.placed(T_world_map)
        for scan in read_spool(self.folder.spool):
            T = placed.apply([scan.time_ns], scan.T_odo_body[None])[0]
            points = se3.act(T, scan.p_body.astype(np.float64)).reshape(-1, 3)
            yield PlacedScan(scan.time_ns, points, scan.intensity, se3.act(T, self.p_imu_lidars), scan.lidar)

    def stretches(self, T_world_map: Floats) -> Iterator[tuple[Floats, Floats]]:
        """Origins and ends (n, 3) of the rays of each local map's stretch of way, in that world [m].

        Raises:
            InputError: the file of scans is damaged; nobody knows from which of several LiDARs its rays came.
        """
        ends_ns = np.array([local_map.end_ns for local_map in self.session.maps])
        number, origins, ends = 0, list[Floats](), list[Floats]()
        for scan in self.scans(T_world_map):
            own = int(np.searchsorted(ends_ns, scan.time_ns))
            if own != number and ends:
                yield np.concatenate(origins), np.concatenate(ends)
                origins, ends = [], []
            number = own
            if scan.lidar is None and len(self.p_imu_lidars) > 1:
                raise InputError(
                    f"scans that say which of the {len(self.p_imu_lidars)} LiDARs saw each point, as --remove-dynamic asks for",
                    f"none in {self.folder.spool}, of an earlier version of boxplus",
                    "run 'boxplus slam' again on the recording, or leave --remove-dynamic out",
                )
            origins.append(scan.origins)
            ends.append(scan.points)
        if ends:
            yield np.concatenate(origins), np.concatenate(ends)


def open_session_run(folder: str | Path, name: str, *, needs_scans: bool = True) -> SessionRun:
    """Open the output folder of a run as a session of a name.

    Args:
        needs_scans: for the joint map; without them its local maps alone are looked at.

    Raises:
        InputError: not a run of 'boxplus slam', one that did not come to its end, one whose scans or poses are not all there; a
            local map that is damaged.
    """
    own = SlamFolder(Path(folder))
    if not own.path.exists():
        advice = advice_to_put_back(own.path) or "check the path"
        raise InputError("the output folder of a run of 'boxplus slam'", f"nothing at {own.path}", advice)
    program = program_of(own.summary) if own.summary.is_file() else None
    if program != PROGRAM:
        raise InputError("the output folder of a run of 'boxplus slam'", f"{own.path} ({program or 'no run'})", _ADVICE)
    summary = read_slam_summary(own.summary)
    if summary.state != "finished":
        raise InputError("a run that came to its end", f"{own.path}: {summary.describe_state()}", "go on with it: --resume")
    odometry = read_summary(own.odometry.summary)
    if not odometry.has_imu:
        raise InputError(
            "runs with an IMU, which tells where down is in each of them", f"one of a LiDAR alone in {own.path}", "leave it out"
        )
    if needs_scans and not own.spool.is_file():
        raise InputError("a run that kept its scans", f"no {own.spool.name} in {own.path}", _ADVICE)
    if needs_scans and summary.spool_bytes is not None and (size := own.spool.stat().st_size) != summary.spool_bytes:
        raise InputError(f"the {summary.spool_bytes} bytes of {own.spool}", f"{size}: it was cut or changed", _ADVICE)
    stored, outcome = LocalMapFolder(own.local_maps), read_graph(own.graph)
    placed = outcome.placed  # in the frame of its trajectory and map, which is the Earth's where it was laid onto it
    # Steps are known as the run's own loops found: no better than was assumed, worse where these say that it drifts more.
    drift = max(outcome.drift_scale, 1.0)
    stored_maps = [stored[number] for number in range(len(placed.time_ns))]
    maps = [replace(local_map, covariance=drift * local_map.covariance) for local_map in stored_maps]
    if needs_scans:
        _refuse_cut_trajectory(own, max(local_map.end_ns for local_map in stored_maps))
    loops = [OwnLoop(loop.query, loop.place, loop.information) for loop in outcome.accepted]
    session = Session.of(name, maps, placed.T_map, loops)
    identity = RecordingIdentity.of(odometry, maps)
    return SessionRun(own, session, placed, summary.contradiction, _lidars(odometry), identity)


def _lidars(odometry: RunSummary) -> Floats:
    """(L, 3) where the LiDARs are in the frame of the poses [m]; all of them are held to the first one."""
    extrinsic = odometry.extrinsic
    T_imu_lidar = np.array(extrinsic.T_imu_lidar_end or extrinsic.T_imu_lidar_start)
    T_lidar_others = [np.array(lidar.T_lidar_other) for lidar in odometry.lidars] or [np.eye(4)]
    return np.array([(T_imu_lidar @ T)[:3, 3] for T in T_lidar_others])


def _refuse_cut_trajectory(own: SlamFolder, end_ns: int) -> None:
    """It goes as far as the local maps do: of a shorter one half a session would be in the joint map's folder."""
    trajectory = read_trajectory(own.trajectory)
    if trajectory.warnings or trajectory.times[-1] < end_ns:
        short = f"one that ends {(end_ns - int(trajectory.times[-1])) * 1e-9:.1f} s before its last local map"
        raise InputError(
            f"the trajectory of a whole run in {own.trajectory}",
            "; ".join(trajectory.warnings) or f"{short}: it was cut",
            _ADVICE,
        )


def session_names(folders: Sequence[Path]) -> list[str]:
    """A name for each folder: its own, with a number where an earlier one has it too."""
    seen: dict[str, int] = {}
    found = []
    for folder in folders:
        name = folder.resolve().name
        seen[name] = seen.get(name, 0) + 1
        found.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return found
