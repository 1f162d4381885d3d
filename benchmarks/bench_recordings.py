"""Recordings: accuracy and time per scan, against the ground truth and against RKO-LIO and KISS-ICP (extra `bench`).

    python benchmarks/bench_recordings.py [--shared ../shared] [--rounds 1] [--only v103_velodyne ...]

All systems get the same decoded scans and the same extrinsic, scan by scan in turn, with the same voxel size, on one thread.
A system that fails or drifts by more than a metre counts as such. The bars at 0.5 m and 0.25 m are what FAST_LIO in C++
reaches on these recordings with that filter.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from contestants import Boxplus, Contestant, Event, opponents, trajectory
from metrics import Metric, run_as_script
from numpy.typing import NDArray

from boxplus.evaluation.evaluation import evaluate
from boxplus.evaluation.rpe import Delta
from boxplus.formats.trajectory import Trajectory, read_trajectory
from boxplus.manifolds import quaternion
from boxplus.recordings.open import open_recording
from boxplus.runs.lidar_inertial.config import RunConfig
from boxplus.runs.lidar_inertial.odometry_run import run_odometry
from boxplus.simulation import simulate
from boxplus.systems.lidar_inertial_odometry.config import LioConfig

KITTI = "kitti_0926_0005_ros2"
KITTI_PATH_M = 70.8
# ATE [cm] with the 0.5 m filter, with the 0.25 m filter, with our defaults.
BARS = {
    "v103_velodyne": (1.5, 0.9, 1.0),
    "mh05_ouster_ros2": (0.85, 0.5, 0.6),
    "v201_livox": (6.0, 2.8, 3.0),
}
SIMULATED_BARS = {"walk": 1.6, "drive": 3.5}
REAL_TIME_BAR = 5.0


@dataclass(frozen=True)
class Case:
    """A recording with what is known about it."""

    name: str
    path: Path
    T_imu_lidar: NDArray[np.float64]
    truth: Trajectory
    voxel_bars: tuple[float, float, float] | None


def cases(folder: Path, only: Sequence[str]) -> list[Case]:
    """The recordings of the folder."""
    found = []
    for name, bars in BARS.items():
        path = next((p for p in (folder / name, folder / f"{name}.bag") if p.exists()), None)
        if path is not None:
            facts = json.loads((folder / f"{name}.json").read_text(encoding="utf-8"))
            T_imu_lidar = np.eye(4)
            T_imu_lidar[:3, :3], T_imu_lidar[:3, 3] = facts["R_imu_lidar"], facts["t_imu_lidar"]
            found.append(Case(name, path, T_imu_lidar, read_trajectory(folder / f"{name}.gt.tum", "tum"), bars))
    if (folder / KITTI).exists():
        rows = dict(
            line.split(":", 1) for line in (folder / f"{KITTI}.calib_imu_to_velo.txt").read_text(encoding="utf-8").splitlines()
        )
        T_lidar_imu = np.eye(4)
        # Seven digits are too few for RKO-LIO's check of a rotation: the nearest one.
        U, _, Vt = np.linalg.svd(np.array(rows["R"].split(), float).reshape(3, 3))
        T_lidar_imu[:3, :3] = U @ Vt
        T_lidar_imu[:3, 3] = np.array(rows["T"].split(), float)
        truth = read_trajectory(folder / f"{KITTI}.gt_velodyne.tum", "tum")
        found.append(Case(KITTI, folder / KITTI, np.linalg.inv(T_lidar_imu), truth, None))
    return [case for case in found if not only or case.name in only]


def race(events: Iterable[Event], makers: dict[str, Callable[[], Contestant]]) -> dict[str, Contestant]:
    """Every contestant over the same events, taking turns, another one first at every event."""
    contestants = {name: make() for name, make in makers.items()}
    order = list(contestants.values())
    for event in events:
        for contestant in order:
            contestant.push(event)
        order = order[1:] + order[:1]
    for contestant in order:
        contestant.finish()
    return contestants


def ate_cm(contestant: Contestant, case: Case) -> float:
    """ATE of the IMU, SE(3)-aligned, ground truth interpolated; infinite without a usable trajectory."""
    try:
        estimate = trajectory(contestant, case.name)
        return 100.0 * evaluate(estimate, case.truth, method="interpolate", deltas=()).ate.rmse
    except ValueError as problem:
        print(f"{case.name}: {problem}")
        return np.inf


def kitti_figures(contestant: Contestant, case: Case) -> tuple[float, float]:
    """Deviation of the path length [%], and median relative rotation error over a second [deg], of the Velodyne."""
    estimate = trajectory(contestant, case.name, case.T_imu_lidar)
    report = evaluate(estimate, case.truth, method="interpolate", deltas=[Delta(1.0, "s")], rpe_pairs="all")
    deviation = 100.0 * abs(estimate.path_length_m / KITTI_PATH_M - 1.0)
    return deviation, report.relative[0].rotation.median


def settings(T_imu_lidar: NDArray[np.float64], voxel: float | None) -> LioConfig:
    """Ours: the defaults, or a voxel size for filter and map, from which the filter does not depart."""
    extrinsic = tuple(map(tuple, T_imu_lidar.tolist()))
    if voxel is None:
        return LioConfig(T_imu_lidar=extrinsic)
    return LioConfig(T_imu_lidar=extrinsic, scan_voxel=voxel, map_cell=voxel, max_points=1_000_000)


def compare(case: Case, events: Sequence[Event], voxel: float | None, rounds: int) -> list[Metric]:
    """One recording at one voxel size; None is our defaults, without opponents."""
    label = f"recordings/{case.name}, " + ("defaults" if voxel is None else f"{voxel:g} m")
    makers: dict[str, Callable[[], Contestant]] = {"boxplus": lambda: Boxplus(settings(case.T_imu_lidar, voxel))}
    if voxel is not None:
        makers |= opponents(voxel, case.T_imu_lidar, starts_at_rest=case.name != KITTI)
    races = [race(events, makers) for _ in range(rounds)]
    first = races[0]
    medians = {name: float(np.median([1e3 * np.median(one[name].seconds) for one in races])) for name in makers}
    metrics = []
    if case.voxel_bars is not None:
        errors = {name: ate_cm(contestant, case) for name, contestant in first.items()}
        bar = case.voxel_bars[2 if voxel is None else 0 if voxel == 0.5 else 1]
        metrics.append(Metric(f"{label}: ATE", errors["boxplus"], "cm", bar=bar, tolerance=0.1))
    else:
        errors = {}
        deviation, rotation = kitti_figures(first["boxplus"], case)
        metrics.append(Metric(f"{label}: path length error", deviation, "%", bar=1.5, tolerance=0.5))
        rival = [kitti_figures(first[name], case)[1] for name in makers if name != "boxplus"]
        metrics.append(Metric(f"{label}: 1 s rotation error", rotation, "deg", bar=0.15, tolerance=0.1))
        for name, value in zip([name for name in makers if name != "boxplus"], rival, strict=True):
            metrics.append(Metric(f"{label}: rotation error vs {name}", rotation, "deg", "lower", 1.0, name, value, 0.1))
    lost = float(sum(status == "lost" for status in getattr(first["boxplus"], "status")))  # noqa: B009
    metrics.append(Metric(f"{label}: lost scans", lost, "scans", bar=0.0))
    for name in makers:
        if name == "boxplus":
            continue
        if name in errors:
            metrics.append(Metric(f"{label}: ATE vs {name}", errors["boxplus"], "cm", "lower", 1.0, name, errors[name], 0.1))
        metrics.append(Metric(f"{label}: scan time vs {name}", medians["boxplus"], "ms", "lower", 1.0, name, medians[name]))
    if voxel is None:
        metrics.append(Metric(f"{label}: scan time", medians["boxplus"], "ms", gated=False))
    return metrics


def real_time(case: Case) -> list[Metric]:
    """Everything `boxplus lio` does but the report: reading, odometry, map, trajectory and log on disk. The best of two."""
    walls, works = [], []
    for _ in range(2):
        with tempfile.TemporaryDirectory() as folder:
            wall, work = time.perf_counter(), time.process_time()
            config = RunConfig(odometry=settings(case.T_imu_lidar, None))
            with open_recording(case.path) as recording:
                summary = run_odometry(recording, Path(folder) / "run", config)
            walls.append(summary.duration_s / (time.perf_counter() - wall))
            works.append(summary.duration_s / (time.process_time() - work))
    return [
        Metric(f"recordings/{case.name}: end to end", max(walls), "x real time", "higher", REAL_TIME_BAR, gated=False),
        Metric(f"recordings/{case.name}: end to end, processor time", max(works), "x real time", "higher", gated=False),
    ]


def simulated(name: str) -> list[Metric]:
    """A simulated recording with our defaults."""
    simulation = simulate(name)
    ours = race(simulation, {"boxplus": lambda: Boxplus(settings(simulation.T_imu_lidar, None))})["boxplus"]
    truth = simulation.ground_truth(np.array(ours.time_ns))
    exact = Trajectory(np.array(ours.time_ns), truth.p_world_imu, quaternion.from_matrix(truth.R_world_imu))
    report = evaluate(trajectory(ours, name), exact, deltas=())
    return [
        Metric(
            f"recordings/simulated {name}, defaults: ATE", 100.0 * report.ate.rmse, "cm", bar=SIMULATED_BARS[name], tolerance=0.1
        ),
        Metric(f"recordings/simulated {name}, defaults: scan time", 1e3 * float(np.median(ours.seconds)), "ms", gated=False),
    ]


def measure(options: argparse.Namespace) -> list[Metric]:
    """Recording by recording."""
    folder = options.shared / "data" / "recordings"
    found = cases(folder, options.only)
    if not found:
        print(f"recordings: none in {folder}")
    if not opponents(0.5, np.eye(4), starts_at_rest=True):
        print("recordings: no opponents, neither rko-lio nor kiss-icp is installed (pip install -e '.[bench]')")
    metrics = []
    for case in found:
        with open_recording(case.path) as recording:
            events = list(recording)
        race(events[:200], {"boxplus": lambda case=case: Boxplus(settings(case.T_imu_lidar, None))})  # compiles
        for voxel in (0.5, 0.25, None):
            metrics += compare(case, events, voxel, options.rounds)
        metrics += real_time(case)
        print(f"{case.name} done", flush=True)
    for name in SIMULATED_BARS:
        if not options.only or name in options.only:
            metrics += simulated(name)
    return metrics


def _arguments(parser: argparse.ArgumentParser) -> None:
    default = Path(__file__).resolve().parents[1].parent / "shared"
    parser.add_argument("--shared", type=Path, default=default, help="folder with data/recordings")
    parser.add_argument("--rounds", type=int, default=1, help="of which the medians are taken")
    parser.add_argument("--only", nargs="*", default=[], help="names of recordings, or walk, drive")


if __name__ == "__main__":
    run_as_script(__doc__, measure, _arguments)
