"""Resident memory over a long simulated drive, with everything written to disk as `boxplus lio` does.

    python benchmarks/bench_memory.py [--minutes 30]

The map box is small (200 m), so that it is full, and points are deleted as fast as they come, after a few minutes; from
then on the slope of a straight line through the medians of each minute is what counts. Linux only (/proc/self/statm).
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

import numpy as np
from metrics import Metric, run_as_script

from boxplus.runs.lidar_inertial.config import MapConfig, RunConfig
from boxplus.runs.lidar_inertial.odometry_run import run_odometry
from boxplus.runs.run_loop import Progress
from boxplus.simulation import as_recording, simulate
from boxplus.systems.lidar_inertial_odometry.config import LioConfig

BOX_SIDE, DETECTION_RANGE = 200.0, 50.0
FULL_AFTER_MIN = 5.0
_STATM = Path("/proc/self/statm")


def resident_mb() -> float:
    """Resident memory of this process."""
    return int(_STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def measure(options: argparse.Namespace) -> list[Metric]:
    """Run the drive and fit the slope."""
    if not _STATM.exists():
        print("memory: skipped, needs /proc/self/statm")
        return []
    simulation = simulate("drive30", duration_s=60.0 * options.minutes)
    config = RunConfig(
        odometry=LioConfig(box_side=BOX_SIDE, detection_range=DETECTION_RANGE, threads=options.threads),
        map=MapConfig(ply=False, pcd=False),
    )
    samples: list[tuple[int, float]] = []
    began = time.perf_counter()

    def note(progress: Progress) -> None:
        if progress.stage == "odometry" and progress.count and (not samples or progress.count > samples[-1][0]):
            samples.append((progress.count, resident_mb()))
            if progress.count % 600 == 0:
                print(
                    f"{progress.count / 600:3.0f} min  {samples[-1][1]:7.1f} MB  {time.perf_counter() - began:6.0f} s", flush=True
                )

    with tempfile.TemporaryDirectory() as folder:
        summary = run_odometry(as_recording(simulation), Path(folder) / "run", config, progress=note)
    scans, memory = np.array(samples).T
    minute = scans * 1e-9 * round(1e9 / simulation.config.lidar.rate_hz) / 60.0
    whole = np.floor(minute)
    full = [m for m in np.unique(whole) if m >= min(FULL_AFTER_MIN, options.minutes // 3)]
    medians = [float(np.median(memory[whole == m])) for m in full]
    (slope, _), covariance = np.polyfit(full, medians, 1, cov=True) if len(full) > 3 else (np.polyfit(full, medians, 1), None)
    return [
        Metric("memory/slope", float(slope), "MB/min", bar=1.0, gated=False),
        Metric("memory/slope, standard error", np.nan if covariance is None else covariance[0, 0] ** 0.5, "MB/min", gated=False),
        Metric("memory/resident", medians[-1], "MB", tolerance=0.25),
        Metric("memory/lost scans", float(summary.status.get("lost", 0)), "scans", bar=0.0),
    ]


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--minutes", type=float, default=30.0, help="of the simulated drive")
    parser.add_argument("--threads", type=int, default=1)


if __name__ == "__main__":
    run_as_script(__doc__, measure, _arguments)
