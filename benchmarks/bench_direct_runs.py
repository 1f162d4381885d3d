"""Whole runs of direct odometry: accuracy and time a frame on recordings with ground truth.

    python benchmarks/bench_direct_runs.py [--shared ../shared]

7-Scenes (60 RGB-D frames of 640×480, poses of KinectFusion): error of the motion over a second, and how far from the first pose
the last one is when the frames are run forth and back. `room_rgbd_tum` (rendered, 320×240): ATE by the length of the path, with
its depths; with the light changed by ±30 % every twenty frames, against unchanged; and without its depths, aligned by a
similarity. KITTI (36 frames): the translation's error over 5, 10 … 35 m by KITTI's measure, and the rotation's. Times are
processor time of one thread per frame, decoding excluded, means over a run after one that warms up; accuracies do not depend on
the load.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from metrics import Metric, run_as_script
from numpy.typing import NDArray
from PIL import Image as Picture

from boxplus import DirectOdometry, Pinhole
from boxplus.evaluation.alignment import align
from boxplus.formats.trajectory import read_trajectory
from boxplus.manifolds import so3
from boxplus.systems.direct_odometry import StereoPair
from boxplus.systems.direct_odometry.estimate import Estimate

HERE = Path(__file__).resolve().parent
FAIR, SECOND = Pinhole(585.0, 585.0, 320.0, 240.0), 30
KITTI, BASELINE_M = Pinhole(707.0912, 707.0912, 601.8873, 183.1104), 0.53715

Matrix = NDArray[np.float64]
Run = tuple[list[Estimate], float]


def grey_values(path: Path) -> NDArray[np.float32]:
    """An image."""
    return np.asarray(Picture.open(path).convert("L")).astype(np.float32)


def timed(pushes: Sequence[Callable[[], Estimate | None]]) -> Run:
    """Estimates, and mean milliseconds of processor time a frame."""
    began = time.thread_time()
    estimates = [push() for push in pushes]
    mean_ms = 1e3 * (time.thread_time() - began) / len(pushes)
    return [estimate for estimate in estimates if estimate is not None], mean_ms


def ate_percent(estimates: Sequence[Estimate], times_ns: NDArray[np.int64], truth: Matrix, kind: str) -> float:
    """Root mean square of the positions' errors after alignment, by the length of the path."""
    rows = np.searchsorted(times_ns, [estimate.time_ns for estimate in estimates])
    p, q = np.array([estimate.p_world_camera for estimate in estimates]), truth[rows]
    found = align(p, q, kind)  # type: ignore[arg-type]
    error = q - (found.scale * p @ found.R_world_estimate.T + found.p_world_estimate)
    return 100.0 * float(np.sqrt((error**2).sum(axis=1).mean()) / np.linalg.norm(np.diff(q, axis=0), axis=1).sum())


def seven_scenes(folder: Path) -> list[Metric]:
    """Time, motion over a second, forth and back."""
    frames, true = [], []
    for number in range(60):
        stem = str(folder / f"frame-{number:06d}")
        depth = np.asarray(Picture.open(stem + ".depth.png")).astype(np.float32) / 1000.0
        depth[depth > 10.0] = 0.0
        frames.append((grey_values(Path(stem + ".color.jpg")), depth))
        true.append(np.loadtxt(stem + ".pose.txt"))

    def run(order: Sequence[int]) -> Run:
        odometry = DirectOdometry(FAIR)
        return timed([lambda k=k, i=i: odometry.push_rgbd(k * 33_333_333, *frames[i]) for k, i in enumerate(order)])

    run(range(20))
    (estimates, ms), (there_and_back, _) = run(range(60)), run([*range(60), *range(58, -1, -1)])
    errors = []
    for k in range(60 - SECOND):
        one, two = estimates[k], estimates[k + SECOND]
        moved = one.R_world_camera.T @ (two.p_world_camera - one.p_world_camera)
        moved_true = true[k][:3, :3].T @ (true[k + SECOND][:3, 3] - true[k][:3, 3])
        errors.append(np.linalg.norm(moved - moved_true))
    last = there_and_back[-1]
    off_mm = 1e3 * float(np.linalg.norm(last.p_world_camera))
    turned = float(np.degrees(np.linalg.norm(so3.log(last.R_world_camera))))
    return [
        Metric("direct_runs/7scenes, a frame of 640x480, mean", ms, "ms", bar=15.0, gated=False),
        Metric("direct_runs/7scenes, error over 1 s", 100.0 * float(np.sqrt(np.mean(np.square(errors)))), "cm", bar=1.5),
        Metric("direct_runs/7scenes, forth and back", off_mm, "mm", bar=3.0, gated=False),
        Metric("direct_runs/7scenes, forth and back, turned", turned, "deg", bar=0.1, gated=False),
    ]


def room(folder: Path) -> list[Metric]:
    """With depths, in changing light, and without depths."""
    rows = [line.split() for line in (folder / "associations.txt").read_text().splitlines() if line.strip() and line[0] != "#"]
    times = np.array([round(float(row[0]) * 1e9) for row in rows])
    names = [(next(w for w in row if w.startswith("rgb/")), next(w for w in row if w.startswith("depth/"))) for row in rows]
    greys = [grey_values(folder / rgb) for rgb, _ in names]
    depths = [np.asarray(Picture.open(folder / depth)).astype(np.float32) / 5000.0 for _, depth in names]
    camera = Pinhole(*np.loadtxt(folder / "intrinsics.txt").ravel()[:4])
    poses = read_trajectory(folder / "groundtruth.txt")
    truth = np.stack([np.interp(times, poses.time_ns, poses.p[:, axis]) for axis in range(3)], axis=1)

    def run(light: Callable[[int], float], mono: bool = False) -> Run:
        odometry = DirectOdometry(camera)
        if mono:
            return timed([lambda k=k: odometry.push_mono(int(times[k]), greys[k]) for k in range(len(times))])
        return timed(
            [
                lambda k=k: odometry.push_rgbd(int(times[k]), np.clip(light(k) * greys[k], 0.0, 255.0), depths[k])
                for k in range(len(times))
            ]
        )

    (plain, ms), (alone, _) = run(lambda _: 0.75), run(lambda _: 1.0, mono=True)
    changing, _ = run(lambda k: 0.75 * (1.3 if (k // 20) % 2 else 0.7))
    steady_error, error = (ate_percent(found, times, truth, "se3") for found in (plain, changing))
    name = "direct_runs/room, "
    return [
        Metric(name + "a frame of 320x240, mean", ms, "ms", gated=False),
        Metric(name + "ATE by the path", steady_error, "%", bar=0.3, tolerance=0.5),
        Metric(name + "ATE in light of ±30 %", error, "%", bar=1.3, opponent="unchanged", opponent_value=steady_error),
        Metric(name + "one camera alone, ATE by the path", ate_percent(alone, times, truth, "sim3"), "%", tolerance=1.0),
    ]


def kitti(folder: Path) -> list[Metric]:
    """Stereo, by KITTI's measure over short distances."""
    left, right = ([grey_values(path) for path in sorted((folder / f"image_{side}").iterdir())] for side in "lr")
    T = np.tile(np.eye(4), (len(left), 1, 1))
    T[:, :3] = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)
    odometry = DirectOdometry(KITTI, stereo=StereoPair(KITTI, (1, 0, 0, 0, -BASELINE_M, 0, 0)))
    estimates, ms = timed([lambda k=k: odometry.push_stereo(k * 100_000_000, left[k], right[k]) for k in range(len(left))])
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1))])
    E = np.tile(np.eye(4), (len(estimates), 1, 1))
    E[:, :3, :3], E[:, :3, 3] = [e.R_world_camera for e in estimates], [e.p_world_camera for e in estimates]
    translation, rotation = [], []
    for length in range(5, 40, 5):
        for one in range(len(T)):
            two = int(np.searchsorted(way, way[one] + length))
            if two >= len(T):
                break
            error = np.linalg.inv(np.linalg.inv(T[one]) @ T[two]) @ np.linalg.inv(E[one]) @ E[two]
            translation.append(100.0 * np.linalg.norm(error[:3, 3]) / length)
            rotation.append(np.degrees(np.linalg.norm(so3.log(error[:3, :3]))) / length)
    return [
        Metric("direct_runs/kitti stereo, a frame of 1226x370, mean", ms, "ms", gated=False),
        Metric("direct_runs/kitti stereo, translation", float(np.mean(translation)), "%", bar=1.0, tolerance=0.1),
        Metric("direct_runs/kitti stereo, rotation", float(np.mean(rotation)), "deg/m", bar=0.02, tolerance=0.1),
    ]


def measure(options: argparse.Namespace) -> list[Metric]:
    """Of what recordings are there."""
    data, metrics = Path(options.shared) / "data", []
    for folder, job in (
        (data / "rgbd" / "7scenes_60", seven_scenes),
        (data / "cameras" / "room_rgbd_tum", room),
        (data / "cameras" / "kitti_stereo_36", kitti),
    ):
        if folder.is_dir():
            metrics += job(folder)
        else:
            print(f"{folder} is not there: left out", file=sys.stderr)
    return metrics


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--shared", default=str(HERE.parent.parent / "shared"))


if __name__ == "__main__":
    run_as_script(__doc__, measure, _arguments)
