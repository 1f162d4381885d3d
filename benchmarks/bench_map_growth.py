"""FAST-LIO2's experiments on its map: time per scan against the size of the map, and tree against tree.

    python benchmarks/bench_map_growth.py [--batches 1000]

First the odometry on the simulated drive, with a map that only grows: the time per scan in the last eighth of the drive
over that in an early eighth, per filtered point. A map whose cost is logarithmic hardly shows.

Then a LiDAR stream along a street (as in bench_map_dynamic.py): every batch of 2,000 points is searched for (5-NN) and then
inserted. The opponent, a static tree (scipy's cKDTree), has to be built anew for every batch; it takes its turn on the same
contents every 20th batch. Processor time, one thread.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from bench_map_dynamic import BATCH, CELL, RANGE, STEP, street_batch
from contestants import Boxplus
from metrics import Metric, run_as_script
from scipy.spatial import cKDTree

from boxplus.maps.ikd_tree import IkdTree
from boxplus.simulation import simulate
from boxplus.systems.lidar_inertial_odometry.config import LioConfig

EVERY = 20


def time_against_size(duration: float | None) -> list[Metric]:
    """The odometry on a drive that never returns."""
    simulation = simulate("drive", duration_s=duration)
    config = LioConfig(T_imu_lidar=simulation.T_imu_lidar.tolist(), scan_voxel=0.5, map_cell=0.5, max_points=1_000_000)
    seconds_per_point, sizes = [], []
    for last in (False, True):  # the first time some of it is compiled
        ours = Boxplus(config)
        for index, event in enumerate(simulation):
            before = len(ours.seconds)
            estimates = ours.push(event)
            if len(ours.seconds) > before and last:
                seconds_per_point.append(ours.seconds[-1] / max(estimates[0].points_filtered, 1))
                sizes.append(len(ours.odometry.map))
            if not last and index > 60:
                break
    part = len(sizes) // 8
    early, late = slice(part, 2 * part), slice(-part, None)
    us_early, us_late = (1e6 * float(np.median(seconds_per_point[s])) for s in (early, late))
    points_early, points_late = (float(np.median(sizes[s])) for s in (early, late))
    return [
        Metric("map_growth/map, early in the drive", points_early, "points", gated=False),
        Metric("map_growth/map, late in the drive", points_late, "points", gated=False),
        Metric("map_growth/time per filtered point, late", us_late, "us", opponent="early", opponent_value=us_early),
    ]


def tree_against_tree(batches: int) -> list[Metric]:
    """Search and insertion, against search in a tree that is built anew."""
    rng = np.random.default_rng(0)
    tree = IkdTree(cell_size=CELL, rebuild="incremental")
    ours: list[float] = []
    rows: list[tuple[int, float, float]] = []
    for number in range(batches):
        batch = street_batch(rng, STEP * number)
        contents = tree.points() if number % EVERY == EVERY - 1 else None
        began = time.process_time()
        tree.nearest(batch, 5, max_distance=RANGE)
        tree.insert(batch, downsample=True)
        ours.append(time.process_time() - began)
        if contents is not None:
            began = time.process_time()
            cKDTree(contents).query(batch, 5, distance_upper_bound=RANGE)
            rows.append((len(contents), float(np.median(ours[-EVERY:])), time.process_time() - began))
    metrics = []
    for share in (0.1, 0.3, 1.0):
        chosen = np.array(rows[: max(round(share * len(rows)), 1)][-5:])
        size, mine, theirs = np.median(chosen, axis=0)
        metrics.append(
            Metric(
                f"map_growth/search and insertion of {BATCH}, {share:.0%} of the path",
                1e3 * mine,
                "ms",
                opponent=f"cKDTree rebuilt, {size:.0f} points",
                opponent_value=1e3 * theirs,
            )
        )
    return metrics


def measure(options: argparse.Namespace) -> list[Metric]:
    """Both experiments."""
    return time_against_size(options.duration) + tree_against_tree(options.batches)


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--batches", type=int, default=1000)
    parser.add_argument("--duration", type=float, help="only the first seconds of the drive")


if __name__ == "__main__":
    run_as_script(__doc__, measure, _arguments)
