"""An RGB-D frame of 640×480 pixels aligned to a keyframe: ours, and OpenCV's RGB-D odometry.

    python benchmarks/bench_direct.py [--shared ../shared] [--gap 4] [--rounds 3]

Every sixth of 60 recorded frames (7-Scenes) is a keyframe, to which the one `gap` later is aligned, without a start value. Ours
is timed from grey values to the pose, with the pyramid of the image and without what is prepared once a keyframe, which is
reported apart; so is the alignment of two images that are both new, by chosen pixels and by all. OpenCV's `Odometry` (RGB and
depth, fast) gets frames prepared beforehand, and the depth of the second frame too; timed is `compute`, and apart, with the
preparation of the second frame. One thread, processor time; the two take turns; each one's fastest round of a pair counts, and
medians over pairs are compared. Errors are against the poses given, which are those of KinectFusion. OpenCV is left out, with a
message, where it has no odometry.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from metrics import Metric, run_as_script
from numpy.typing import NDArray
from PIL import Image as Picture

from boxplus import Keyframe, Pinhole, align_rgbd, track
from boxplus.manifolds import quaternion, se3

HERE = Path(__file__).resolve().parent
CAMERA = Pinhole(585.0, 585.0, 320.0, 240.0)
BAR_MS, BAR_PAIR_MS = 15.0, 25.0

Frame = tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.float64]]


def frame(folder: Path, number: int) -> Frame:
    """Grey values, depth [m], pose in the world."""
    stem = str(folder / f"frame-{number:06d}")
    depth = np.asarray(Picture.open(stem + ".depth.png")).astype(np.float32) / 1000.0
    depth[depth > 10.0] = 0.0  # 65.535 m marks none
    T = np.loadtxt(stem + ".pose.txt")
    return np.asarray(Picture.open(stem + ".color.jpg").convert("L")), depth, np.r_[quaternion.from_matrix(T[:3, :3]), T[:3, 3]]


def opencv() -> Callable[[Frame, Frame], tuple[Callable[[], object], Callable[[], object]]] | None:
    """For a pair, how OpenCV computes the motion, and how it prepares the second frame; None without its odometry."""
    try:
        import cv2
    except ImportError:
        return None
    if not hasattr(cv2, "Odometry"):
        return None
    cv2.setNumThreads(1)
    settings = cv2.OdometrySettings()
    settings.setCameraMatrix(np.array([[CAMERA.fx, 0.0, CAMERA.cx], [0.0, CAMERA.fy, CAMERA.cy], [0.0, 0.0, 1.0]], np.float32))
    odometry = cv2.Odometry(cv2.ODOMETRY_TYPE_RGB_DEPTH, settings, cv2.ODOMETRY_ALGO_TYPE_FAST)

    def pair(one: Frame, two: Frame) -> tuple[Callable[[], object], Callable[[], object]]:
        def prepared(given: Frame) -> object:
            frame = cv2.OdometryFrame(given[1], cv2.cvtColor(given[0], cv2.COLOR_GRAY2BGR))
            odometry.prepareFrame(frame)
            return frame

        frames = prepared(one), prepared(two)
        return lambda: odometry.compute(*frames), lambda: prepared(two)

    return pair


def timed(work: Callable[[], object]) -> tuple[float, object]:
    """Milliseconds of processor time, and what came of it."""
    began = time.process_time()
    result = work()
    return 1e3 * (time.process_time() - began), result


def errors(T_21: NDArray[np.float64], one: Frame, two: Frame) -> tuple[float, float]:
    """Degrees and millimetres from the poses given."""
    T_true = se3.compose(se3.inverse(two[2]), one[2])
    turned = se3.log(se3.compose(T_21, se3.inverse(T_true)))[:3]
    return float(np.degrees(np.linalg.norm(turned))), 1e3 * float(np.linalg.norm(T_21[4:] - T_true[4:]))


def measure(options: argparse.Namespace) -> list[Metric]:
    """Medians over the pairs."""
    folder = Path(options.shared) / "data" / "rgbd" / "7scenes_60"
    if not folder.is_dir():
        print(f"{folder} is not there: direct is left out", file=sys.stderr)
        return []
    opponent = opencv()
    if opponent is None:
        print("cv2.Odometry is not installed: left out", file=sys.stderr)
    times: dict[str, list[float]] = {name: [] for name in ("track", "prepare", "pair", "all pixels", "cv", "cv prepare")}
    ours, theirs, all_pixels, doubted = [], [], [], 0
    for number in range(1, 60 - options.gap, 6):
        one, two = frame(folder, number), frame(folder, number + options.gap)
        keyframe = Keyframe.prepare(one[0], one[1], CAMERA)
        work: dict[str, Callable[[], object]] = {
            "track": lambda keyframe=keyframe, two=two: track(keyframe, two[0]),
            "prepare": lambda one=one: Keyframe.prepare(one[0], one[1], CAMERA),
            "pair": lambda one=one, two=two: align_rgbd(one[0], one[1], two[0], CAMERA),
            "all pixels": lambda one=one, two=two: align_rgbd(one[0], one[1], two[0], CAMERA, points=None),
        }
        if opponent is not None:
            work["cv"], work["cv prepare"] = opponent(one, two)
        for job in work.values():
            job()
        rounds = [{name: timed(job) for name, job in work.items()} for _ in range(options.rounds)]
        for name in work:
            times[name].append(min(taken[name][0] for taken in rounds))
        found, dense = rounds[0]["track"][1], rounds[0]["all pixels"][1]
        doubted += found.status != "converged"  # type: ignore[attr-defined]
        ours.append(errors(found.T_21, one, two))  # type: ignore[attr-defined]
        all_pixels.append(errors(dense.T_21, one, two))  # type: ignore[attr-defined]
        if opponent is not None:
            T = np.asarray(rounds[0]["cv"][1][1])  # type: ignore[index]
            theirs.append(errors(np.r_[quaternion.from_matrix(T[:3, :3]), T[:3, 3]], one, two))
    ms = {name: float(np.median(values)) if values else None for name, values in times.items()}
    name = "OpenCV" if opponent is not None else ""
    whole = None if ms["cv"] is None or ms["cv prepare"] is None else ms["cv"] + ms["cv prepare"]
    metrics = [
        Metric("direct/track", ms["track"] or np.nan, "ms", bar=BAR_MS, gated=False),
        Metric("direct/prepare a keyframe", ms["prepare"] or np.nan, "ms", gated=False),
        Metric("direct/a pair", ms["pair"] or np.nan, "ms", bar=BAR_PAIR_MS, gated=False),
        Metric("direct/all pixels", ms["all pixels"] or np.nan, "ms", gated=False),
        Metric("direct/doubted", float(doubted), "pairs", bar=0.0, tolerance=0.0),
    ]
    if opponent is not None:
        metrics.append(Metric("direct/track, theirs prepared", ms["track"] or np.nan, "ms", "lower", 1.0, name, ms["cv"], 0.5))
        metrics.append(Metric("direct/track, with preparation", ms["track"] or np.nan, "ms", "lower", 0.4, name, whole, 0.5))
    for k, unit in enumerate(("deg", "mm")):
        cv = float(np.median([e[k] for e in theirs])) if theirs else None
        value = float(np.median([e[k] for e in ours]))
        metrics.append(Metric(f"direct/error, {unit}", value, unit, opponent=name, opponent_value=cv, tolerance=0.2))
        metrics.append(
            Metric(f"direct/error of all pixels, {unit}", float(np.median([e[k] for e in all_pixels])), unit, tolerance=0.2)
        )
    return metrics


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--shared", default=str(HERE.parent.parent / "shared"))
    parser.add_argument("--gap", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=3)


if __name__ == "__main__":
    run_as_script(__doc__, measure, _arguments)
