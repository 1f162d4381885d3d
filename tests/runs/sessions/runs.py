"""Folders as `boxplus slam` leaves them, written from a simulated drive without running the odometry."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from boxplus.formats.output import make_folder
from boxplus.formats.trajectory_writer import TrajectoryWriter
from boxplus.manifolds import quaternion, se3
from boxplus.maps.local_maps.builder import LocalMapBuilder
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.maps.local_maps.folder import LocalMapFolder
from boxplus.runs.lidar_inertial.summary import ExtrinsicFacts, RecordingFacts, RunSummary
from boxplus.runs.slam.folder import SlamFolder
from boxplus.runs.slam.graph_file import write_graph
from boxplus.runs.slam.spool import ScanSpool, SpooledScan
from boxplus.runs.slam.summary import SlamSummary
from boxplus.simulation.drifting_drive import DriftConfig, DriftingDrive, simulate_drifting_drive
from boxplus.simulation.worlds.world import World
from boxplus.systems.slam.correction import Correction
from boxplus.systems.slam.outcome import SlamOutcome

NOW = datetime(2026, 1, 1, tzinfo=UTC)


def written_run(
    path: Path,
    world: World,
    route: ArrayLike,
    config: DriftConfig,
    seed: int,
    state: Literal["finished", "interrupted"] = "finished",
    maps_config: LocalMapConfig | None = None,
) -> DriftingDrive:
    """The run of a drive; its frame is where the first scan was. Returns the drive."""
    drive = simulate_drifting_drive(world, route, config, seed)
    folder = SlamFolder(path)
    start = se3.inverse(drive.T_world_body[0])
    poses = se3.compose(np.broadcast_to(start, drive.T_odo_body.shape), drive.T_odo_body)
    make_folder(folder.odometry.path)
    stored, builder = LocalMapFolder(folder.local_maps), LocalMapBuilder(maps_config)
    spool, maps = ScanSpool(folder.spool, 0.2), []
    with TrajectoryWriter(path) as writer:
        for time_ns, T, scan in zip(drive.time_ns.tolist(), poses, drive.scans, strict=True):
            made = builder.push(time_ns, T, np.zeros((6, 6)), scan)
            spool.append(SpooledScan(time_ns, T, scan, None))
            writer.append(time_ns, quaternion.to_matrix(T[:4]), T[4:], np.zeros((6, 6)), "ok")
            maps += made
            if made:
                spool.forget()
    maps += builder.flush()
    spool.close()
    for local_map in maps:
        stored.write(local_map)
    T_odo, none = np.stack([m.T_odo_map for m in maps]), np.zeros((len(maps), 6, 6))
    correction = Correction(np.array([m.time_ns for m in maps]), T_odo, T_odo, none, none, none)
    write_graph(folder.graph, SlamOutcome(correction, [], None))
    SlamSummary(versions={}, state=state, started=NOW, updated=NOW, recording=str(path)).write(folder.summary)
    here = np.eye(4).tolist()
    recording = RecordingFacts(
        path=str(path), format="simulated", lidar_topic="points", imu_topic="imu", duration_s=1.0, messages=1
    )
    extrinsic = ExtrinsicFacts(source="given", text="", estimation="off", T_imu_lidar_start=here)
    RunSummary(
        versions={}, state="finished", process=1, started=NOW, updated=NOW, recording=recording, extrinsic=extrinsic
    ).write(folder.odometry.summary)
    return drive
