"""The ikd-tree as the map of a LiDAR odometry: 5-NN of every batch, then its downsampled insertion, along a path.

    python benchmarks/bench_map_dynamic.py [--batches 1000] [--json FILE]

Times are processor times of the calling thread, so that other work on the machine counts as little as possible (with
`background`, the rebuild's own thread is not in them). Queries are compared with scipy's static cKDTree built on the same
contents (its building time not counted), in the same run, on one thread, each after an untimed search of the batch before.
Prints ratios and times, and writes them as JSON.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from boxplus.maps.ikd_tree import IkdTree

CELL = 0.5
RANGE = 2.24
BATCH = 2000
STEP = 0.3  # [m] of the path per batch


def street_batch(rng: np.random.Generator, x: float, size: int = BATCH) -> NDArray[np.float64]:
    """A scan in a street along x: ground and two facades with gaps, in the order of a spinning LiDAR, 2 cm noise."""
    azimuth = np.sort(rng.uniform(-np.pi, np.pi, size))
    elevation = np.radians(rng.choice(np.linspace(-16.0, 15.0, 32), size))
    direction = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1)
    facade = 8.0 + 4.0 * (np.floor((x + direction[:, 0] * 20.0) / 15.0) % 3)
    ground = np.where(direction[:, 2] < 0, 1.8 / np.maximum(-direction[:, 2], 1e-9), np.inf)
    reach = np.minimum(np.minimum(ground, facade / np.maximum(np.abs(direction[:, 1]), 1e-9)), 80.0)
    return direction * reach[:, None] + (x, 0.0, 1.8) + rng.normal(0.0, 0.02, (size, 3))


def brute_force_contents(batches: list[NDArray[np.float64]], origin: NDArray[np.float64]) -> NDArray[np.float32]:
    """What downsampled insertion of the batches must leave: the first point of each cell."""
    first: dict[tuple[int, ...], tuple[np.float32, ...]] = {}
    for batch in batches:
        xyz = (batch - origin).astype(np.float32)
        cells = np.floor((xyz.astype(np.float64) + origin) / CELL)
        for cell, point in zip(map(tuple, cells.astype(int).tolist()), xyz, strict=True):
            first.setdefault(cell, tuple(point))
    contents = np.array(list(first.values()), np.float32)
    return contents[np.lexsort(contents.T[::-1])]


def run_stream(batches: list[NDArray[np.float64]], mode: str) -> tuple[IkdTree, dict[str, float]]:
    """Feed the batches to a tree; returns it with its times."""
    tree = IkdTree(cell_size=CELL, rebuild=mode)
    insert, query, static, memory = [], [], [], []
    for number, batch in enumerate(batches):
        start = time.thread_time()
        tree.nearest(batch, 5, max_distance=RANGE)
        middle = time.thread_time()
        tree.insert(batch, downsample=True)
        end = time.thread_time()
        query.append(middle - start)
        insert.append(end - middle)
        if len(tree) > 20_000:
            memory.append(tree.memory_bytes / len(tree))
        if number % 20 == 19:
            opponent = cKDTree(tree.points())
            following = batches[min(number + 1, len(batches) - 1)]
            pair = []
            for search in (
                lambda points: opponent.query(points, 5, distance_upper_bound=RANGE, workers=1),  # noqa: B023
                lambda points: tree.nearest(points, 5, max_distance=RANGE),
            ):
                search(batch)  # untimed: as in the stream, the caches hold the batch before, not the building of cKDTree
                start = time.thread_time()
                search(following)
                pair.append(time.thread_time() - start)
            static.append(pair)
    theirs, ours = np.array(static).T
    times = 1e3 * np.array(insert)
    return tree, {
        "query_us": 1e6 * float(np.median(query)) / BATCH,
        "query_ratio_to_scipy": float(ours.sum() / theirs.sum()),
        "scipy_query_us": 1e6 * float(np.median(theirs)) / BATCH,
        "insert_ms_median": float(np.median(times)),
        "insert_ms_p99": float(np.percentile(times, 99)),
        "insert_ms_worst": float(times.max()),
        "bytes_per_point_median": float(np.median(memory)),
        "bytes_per_point_peak": max(memory),
        "points": len(tree),
    }


def large_map_times(rng: np.random.Generator) -> dict[str, float]:
    """Build of a million points, deletion of a 20 m cube, and what a plain conversion of as many points costs."""
    points = rng.uniform(-100.0, 100.0, (1_000_000, 3)) * (1.0, 1.0, 0.1)
    builds, deletes, copies = [], [], []
    for _ in range(3):
        start = time.thread_time()
        tree = IkdTree(points)
        builds.append(time.thread_time() - start)
        for corner in rng.uniform(-80.0, 60.0, (3, 3)) * (1.0, 1.0, 0.0) - (0.0, 0.0, 10.0):
            start = time.thread_time()
            tree.delete_box(corner, corner + 20.0)
            deletes.append(time.thread_time() - start)
        start = time.thread_time()
        points.astype(np.float32)
        copies.append(time.thread_time() - start)
    return {
        "build_1m_s": min(builds),
        "copy_1m_s": min(copies),
        "box_delete_ms": 1e3 * float(np.median(deletes)),
        "build_bytes_per_point": tree.memory_bytes / 1_000_000,
    }


def main() -> None:
    """Run all and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batches", type=int, default=1000)
    parser.add_argument("--modes", nargs="+", default=["incremental", "background", "inplace"])
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    warm = IkdTree(cell_size=CELL)
    for step in range(60):
        warm.nearest(street_batch(rng, float(step)), 5)
        warm.insert(street_batch(rng, 3.0 * step), downsample=True)
    warm.delete_box([0, 0, 0], [1, 1, 1])
    batches = [street_batch(rng, STEP * step) for step in range(options.batches)]
    results: dict[str, dict[str, float]] = {"large map": large_map_times(rng)}
    for mode in options.modes:
        tree, times = run_stream(batches, mode)
        with tree:
            expected = brute_force_contents(batches, tree.origin)
            same = np.array_equal((tree.points() - tree.origin).astype(np.float32), expected)
        results[mode] = {**times, "same_as_brute_force": float(same)}
    for name, values in results.items():
        print(name)
        for key, value in values.items():
            print(f"  {key:24} {value:.4g}")
    if options.json:
        options.json.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
