"""Cost of a scan: everything the odometry does, against one 5-NN pass of scipy's cKDTree over the same points and map.

    python benchmarks/bench_scan.py [--rounds 3]

The recording is the simulated walk (16 channels, about 26,000 raw points a scan, 0.5 m filter, a map of about 100,000
points). Before every 20th scan the map's points are taken and a cKDTree is built from them (not timed); right after the
scan the tree is asked for the 5 nearest neighbours of the scan's filtered points at the estimated pose, within 2.236 m.
One thread is timed by processor time, two by the wall clock.
The distribution over scans comes from passes without the opponent, whose work would push ours out of the caches.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from contestants import Boxplus, Event
from metrics import Metric, run_as_script
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from boxplus.sensors.lidar.downsampling import VoxelFilter
from boxplus.simulation import Simulation, simulate
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate

VOXEL = 0.5
EVERY = 20


@dataclass
class Pass:
    """One run over the recording: seconds per scan, ours and (every so often) the opponent's, and what was done."""

    ours: list[float] = field(default_factory=list)
    pairs: list[tuple[float, float]] = field(default_factory=list)
    stages: dict[str, list[float]] = field(default_factory=dict)
    filtered: list[int] = field(default_factory=list)
    map_points: int = 0


def filtered_world(estimate: Estimate, voxel_filter: VoxelFilter) -> NDArray[np.float64]:
    """The scan's filtered points at the estimated pose, (n, 3)."""
    state = estimate.state
    p_imu = voxel_filter(estimate.p_lidar)[0] @ state.R_imu_lidar.T + state.p_imu_lidar
    return p_imu @ state.R_world_imu.T + state.p_world_imu


def run_pass(events: Sequence[Event], config: LioConfig, *, opponent: bool) -> Pass:
    """Feed the events; every `EVERY`-th scan the opponent follows ours at once."""
    # The machine is shared: one thread is timed by what a processor worked for it, two by the wall clock.
    clock = time.thread_time if config.threads == 1 else time.perf_counter
    ours, voxel_filter = Boxplus(config, clock), VoxelFilter(config.scan_voxel)
    result = Pass()
    tree: cKDTree | None = None
    for event in events:
        before = len(ours.seconds)
        estimates = ours.push(event)
        if len(ours.seconds) == before:
            continue
        (estimate,) = estimates
        result.filtered.append(estimate.points_filtered)
        for stage, seconds in estimate.timing_s.items():
            result.stages.setdefault(stage, []).append(seconds)
        if tree is not None:
            points = filtered_world(estimate, voxel_filter)
            began = clock()
            tree.query(points, 5, distance_upper_bound=config.max_neighbour_distance, workers=config.threads)
            result.pairs.append((ours.seconds[-1], clock() - began))
        due = opponent and len(ours.seconds) % EVERY == EVERY - 1
        tree = cKDTree(ours.odometry.map.points()) if due else None
    result.ours = ours.seconds
    result.map_points = len(ours.odometry.map)
    return result


def config_for(simulation: Simulation, threads: int) -> LioConfig:
    """Our settings at the filter size that is compared; everything else is the default."""
    return LioConfig(
        T_imu_lidar=tuple(map(tuple, simulation.T_imu_lidar.tolist())),
        scan_voxel=VOXEL,
        map_cell=VOXEL,
        max_points=1_000_000,
        threads=threads,
    )


def measure(options: argparse.Namespace) -> list[Metric]:
    """All passes, interleaved."""
    simulation = simulate("walk", duration_s=options.duration)
    events = list(simulation)
    passes: dict[str, list[Pass]] = {"1 thread": [], "2 threads": [], "alone": []}
    for threads in (1, 2):  # compiles
        run_pass(events[:40], config_for(simulation, threads), opponent=True)
    for round_number in range(options.rounds):
        passes["1 thread"].append(run_pass(events, config_for(simulation, 1), opponent=True))
        passes["2 threads"].append(run_pass(events, config_for(simulation, 2), opponent=True))
        passes["alone"].append(run_pass(events, config_for(simulation, 1), opponent=False))
        print(f"round {round_number + 1} of {options.rounds}", flush=True)
    metrics = []
    for name in ("1 thread", "2 threads"):
        ours, theirs = np.median([np.median(1e3 * np.array(one.pairs), axis=0) for one in passes[name]], axis=0)
        bar = 0.8 if name == "1 thread" else None
        metrics.append(
            Metric(f"scan/total, {name}", ours, "ms", bar=bar, opponent=f"cKDTree 5-NN, {name}", opponent_value=theirs)
        )
    alone = passes["alone"]
    tail = float(np.median([np.percentile(one.ours, 99) / np.median(one.ours) for one in alone]))
    metrics.append(Metric("scan/99th percentile / median", tail, "ratio", bar=3.0, tolerance=0.5))
    median_ms = float(np.median([1e3 * np.median(one.ours) for one in alone]))
    metrics.append(Metric("scan/total alone, 1 thread", median_ms, "ms", gated=False))
    for stage in alone[0].stages:
        stage_ms = float(np.median([1e3 * np.median(one.stages[stage]) for one in alone]))
        metrics.append(Metric(f"scan/stage: {stage}", stage_ms, "ms", gated=False))
    metrics.append(Metric("scan/map", alone[0].map_points, "points", gated=False))
    metrics.append(Metric("scan/filtered points", float(np.median(alone[0].filtered)), "points", gated=False))
    return metrics


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--duration", type=float, help="only the first seconds of the walk")


if __name__ == "__main__":
    run_as_script(__doc__, measure, _arguments)
