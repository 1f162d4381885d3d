"""A LiDAR alone: the recordings with their IMU left out, against the ground truth and KISS-ICP (extra `bench`).

    python benchmarks/bench_lidar_alone.py [--shared ../shared] [--only v103_velodyne ...]

Both get the same decoded scans, scan by scan in turn, on one thread; KISS-ICP with its own voxel size of 1 m, and with 0.25 m.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from bench_recordings import Case, ate_cm, cases, kitti_figures, race
from contestants import BoxplusAlone, Contestant, opponents
from metrics import Metric, run_as_script

from boxplus.recordings.open import open_recording
from boxplus.recordings.options import RecordingOptions

KISS = "KISS-ICP"
BAR = 0.3  # of KISS-ICP's time


def compare(case: Case, voxel: float) -> list[Metric]:
    """One recording, KISS-ICP at one voxel size, ours with its defaults."""
    makers: dict[str, Callable[[], Contestant]] = {"boxplus": lambda: BoxplusAlone(case.T_imu_lidar)}
    makers |= {name: make for name, make in opponents(voxel, case.T_imu_lidar, starts_at_rest=True).items() if name == KISS}
    with open_recording(case.path, RecordingOptions(imu_topic="none")) as recording:
        found = race(list(recording), makers)
    label = f"lidar_alone/{case.name}, {KISS} at {voxel:g} m"
    judge, figure, unit = (ate_cm, "ATE", "cm") if case.voxel_bars is not None else (_rotation_error, "1 s rotation error", "deg")
    ours, rival = judge(found["boxplus"], case), judge(found[KISS], case) if KISS in found else None
    metrics = [Metric(f"{label}: {figure}", ours, unit, "lower", 1.0, KISS if rival else "", rival, 0.1)]
    if KISS in found:
        medians = {name: 1e3 * float(np.median(contestant.seconds)) for name, contestant in found.items()}
        metrics.append(Metric(f"{label}: scan time", medians["boxplus"], "ms", "lower", BAR, KISS, medians[KISS]))
    return metrics


def _rotation_error(contestant: Contestant, case: Case) -> float:
    """Where the ground truth of the position is no better than a metre."""
    return kitti_figures(contestant, case)[1]


def measure(options: argparse.Namespace) -> list[Metric]:
    """Recording by recording."""
    metrics = []
    for case in cases(options.shared / "data" / "recordings", options.only):
        for voxel in (1.0, 0.25):
            metrics += compare(case, voxel)
        print(f"{case.name} done", flush=True)
    return metrics


def _arguments(parser: argparse.ArgumentParser) -> None:
    default = Path(__file__).resolve().parents[1].parent / "shared"
    parser.add_argument("--shared", type=Path, default=default, help="folder with data/recordings")
    parser.add_argument("--only", nargs="*", default=[], help="names of recordings")


if __name__ == "__main__":
    run_as_script(__doc__, measure, _arguments)
