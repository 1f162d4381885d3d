"""5-NN within 2.24 m in a static planar city of 500,000 points, 100,000 scan-ordered queries: ikd-tree and scipy side by side.

    python benchmarks/bench_knn_static.py [--points 500000] [--queries 100000] [--repeats 7] [--json FILE]

The two are timed in turn in one process and compared by the median of the ratios. Exactness is checked against scipy on the
same float32 coordinates.
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

RANGE = 2.24
EXTENT = 200.0  # half the side of the city [m]
BLOCK = 40.0  # a street every so many metres, 12 m wide, between facades 20 m high


def planar_city(rng: np.random.Generator, size: int) -> NDArray[np.float64]:
    """Points on the ground and on the facades, uniform by area, 2 cm noise."""
    streets = int(2 * EXTENT / BLOCK)
    ground_area = (2 * EXTENT) ** 2
    facade_area = 2 * (streets + 1) * 2 * EXTENT * 20.0 * 0.6
    ground = int(size * ground_area / (ground_area + facade_area))
    facades = size - ground
    points = np.zeros((size, 3))
    points[:ground, :2] = rng.uniform(-EXTENT, EXTENT, (ground, 2))
    across = rng.integers(0, streets + 1, facades) * BLOCK - EXTENT + rng.choice([-6.0, 6.0], facades)
    along, height = rng.uniform(-EXTENT, EXTENT, facades), rng.uniform(0.0, 20.0, facades)
    turned = (rng.random(facades) < 0.5)[:, None]
    points[ground:] = np.where(turned, np.stack([across, along, height], axis=1), np.stack([along, across, height], axis=1))
    return points + rng.normal(0.0, 0.02, points.shape)


def scans(rng: np.random.Generator, size: int) -> NDArray[np.float64]:
    """Scans of a 32-channel LiDAR in the streets, column by column as the sensor delivers them, 5 cm off the surfaces."""
    azimuth = np.repeat(np.linspace(0.0, 2 * np.pi, 1024, endpoint=False), 32)
    elevation = np.tile(np.radians(np.linspace(-16.0, 15.0, 32)), 1024)
    direction = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1)
    ground = np.where(direction[:, 2] < 0, 1.8 / np.maximum(-direction[:, 2], 1e-9), np.inf)
    reach = np.minimum(ground, 6.0 / np.maximum(np.abs(direction[:, 0]), 1e-9))
    seen = reach < 100.0
    hits = direction[seen] * reach[seen, None]
    parts: list[NDArray[np.float64]] = []
    while sum(map(len, parts)) < size:
        sensor = np.array([rng.integers(-4, 4) * BLOCK, rng.uniform(-0.6, 0.6) * EXTENT, 1.8])
        parts.append(hits + sensor)
    queries = np.concatenate(parts)[:size]
    return queries + rng.normal(0.0, 0.05, queries.shape)


def main() -> None:
    """Time both and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=500_000)
    parser.add_argument("--queries", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    points = planar_city(rng, options.points).astype(np.float32).astype(np.float64)
    queries = scans(rng, options.queries).astype(np.float32).astype(np.float64)
    tree, pair, opponent = IkdTree(points), IkdTree(points, threads=2), cKDTree(points)
    found = tree.nearest(queries, 5, max_distance=RANGE)
    distances, _ = opponent.query(queries, 5, distance_upper_bound=RANGE)
    exact = bool(np.allclose(found.distances, distances, rtol=1e-4, atol=1e-5))
    pair.nearest(queries, 5, max_distance=RANGE)
    rows = []
    for _ in range(options.repeats):
        row = []
        for search in (
            lambda: tree.nearest(queries, 5, max_distance=RANGE),
            lambda: pair.nearest(queries, 5, max_distance=RANGE),
            lambda: opponent.query(queries, 5, distance_upper_bound=RANGE, workers=1),
        ):
            start = time.perf_counter()
            search()
            row.append(time.perf_counter() - start)
        rows.append(row)
    one, two, scipy = 1e6 * np.array(rows).T / options.queries
    results = {
        "ours_us": float(np.median(one)),
        "ours_two_threads_us": float(np.median(two)),
        "scipy_us": float(np.median(scipy)),
        "ratio": float(np.median(one / scipy)),
        "ratio_two_threads": float(np.median(two / scipy)),
        "exact": float(exact),
    }
    for key, value in results.items():
        print(f"{key:24} {value:.4g}")
    if options.json:
        options.json.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
