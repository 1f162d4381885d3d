"""A frame of visual-inertial odometry against the OpenCV calls inside it; and memory over a long simulated walk through a room.

    OPENBLAS_NUM_THREADS=1 python benchmarks/bench_vio.py [--shared ../shared] [--only mh05_stereo] [--minutes 0]

The recordings have two cameras of 752×480 pixels at 20 Hz. Timed is everything between the arrival of an event and the estimate,
the reading of the recording apart, by processor time of the one thread that does it all (BLAS and OpenCV too; that of the process
comes in ticks of 4 ms on some machines); the opponent is the processor time of the calls of OpenCV in it: corners are found and
followed there. Compilation is over before the first frame counts. The error is
that of the position after alignment by yaw and translation.

With `--minutes` a walk of that length is simulated, images of 226×144 pixels at 10 Hz, and run as `boxplus vio` runs it, with
everything on disk: what counts is the slope of a straight line through the medians of the resident memory of each minute.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from metrics import Metric, run_as_script
from numpy.typing import NDArray

from boxplus import CameraImage, open_camera_recording, read_trajectory
from boxplus.evaluation.evaluation import evaluate
from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import quaternion
from boxplus.recordings.cameras.options import CameraRecordingOptions
from boxplus.runs.run_loop import Progress
from boxplus.runs.visual_inertial.config import VioRunConfig
from boxplus.runs.visual_inertial.rig_of_recording import rig_of_recording
from boxplus.runs.visual_inertial.visual_run import run_visual_odometry
from boxplus.simulation.cameras import as_camera_recording, make_rig, simulate_cameras
from boxplus.simulation.cameras.scenarios import ROOM_HIGH, ROOM_LOW, make_camera_scenario
from boxplus.simulation.motions import manoeuvres
from boxplus.systems.visual_inertial_odometry import VioConfig, VioEstimate, VisualInertialOdometry

HERE = Path(__file__).resolve().parent
RECORDINGS = {  # recording, ground truth, calibration where it is a file of its own
    "mh01": ("euroc_mh01_stereo_imu_11s", "euroc_mh01_stereo_imu_11s/groundtruth.tum", None),
    "v103_stereo": ("v103_stereo.bag", "v103_stereo.gt.tum", "v103_stereo.calib.yaml"),
    "mh05_stereo": ("mh05_stereo", "mh05_stereo/gt.tum", None),
    "mh05_low_texture": ("mh05_stereo_low_texture", "mh05_stereo_low_texture/gt.tum", None),
}
TIMED = ("mh01", "v103_stereo", "mh05_stereo")
FRAME_BAR, TAIL_BAR = 2.2, 2.0
WARM = 5  # frames after the start that do not count
SETTLED_MIN = 5.0
RATE_HZ = 10.0
_STATM = Path("/proc/self/statm")


class TimedCalls:
    """The module cv2, with the processor time spent in its functions."""

    def __init__(self, module: Any) -> None:
        self._module, self.seconds = module, 0.0

    def __getattr__(self, name: str) -> Any:
        function = getattr(self._module, name)

        def timed(*arguments: Any, **options: Any) -> Any:
            began = time.thread_time()
            try:
                return function(*arguments, **options)
            finally:
                self.seconds += time.thread_time() - began

        return timed


@dataclass(frozen=True, slots=True)
class Files:
    """Recording, ground truth, and calibration where it is a file of its own."""

    recording: Path
    truth: Path
    calibration: Path | None = None


def files_of(name: str, shared: Path) -> Files | None:
    """Where a recording lies; None, with a message, where it is not."""
    folder = shared / "data" / "cameras"
    recording, truth, calibration = RECORDINGS[name]
    if (folder / recording).exists():
        return Files(folder / recording, folder / truth, None if calibration is None else folder / calibration)
    print(f"vio: {recording} is not in {folder}, left out", file=sys.stderr)
    return None


def frames(files: Files, config: VioConfig) -> tuple[list[VioEstimate], NDArray[np.float64]]:
    """Every estimate, and (n, 2) milliseconds of the frame and of the calls of OpenCV in it."""
    import cv2

    cv2.setNumThreads(1)
    estimates, spent = [], []
    with open_camera_recording(files.recording, CameraRecordingOptions(calibration=files.calibration)) as recording:
        vio = VisualInertialOdometry(config, rig_of_recording(recording.info, config))
        calls = vio._tracker._cv2 = TimedCalls(cv2)  # type: ignore[attr-defined]
        passed = 0.0
        for event in recording:
            began = time.thread_time()
            ready = vio.push_image(event) if isinstance(event, CameraImage) else vio.push_imu(event)
            passed += time.thread_time() - began
            for estimate in ready:
                estimates.append(estimate)
                spent.append((1e3 * passed, 1e3 * calls.seconds))
                passed, calls.seconds = 0.0, 0.0
    return estimates, np.array(spent)


def with_pose(estimates: list[VioEstimate]) -> list[VioEstimate]:
    """Those from the start on."""
    return [estimate for estimate in estimates if estimate.status != "starting"]


def trajectory_of(known: list[VioEstimate]) -> Trajectory:
    """Of estimates after the start."""
    T = np.array([e.T_world_imu for e in known])
    return Trajectory(np.array([e.time_ns for e in known]), T[:, :3, 3], quaternion.from_matrix(T[:, :3, :3]))


def position_error(known: list[VioEstimate], files: Files) -> float:
    """Root mean square after alignment by yaw and translation [cm] of estimates after the start."""
    truth = read_trajectory(files.truth)
    return 100.0 * evaluate(trajectory_of(known), truth, alignment="yaw", method="interpolate").ate.rmse


def metrics_of(name: str, shared: Path) -> list[Metric]:
    """Time and accuracy on one recording."""
    files = files_of(name, shared)
    if files is None:
        return []
    frames(files, VioConfig())  # compiles, and warms up
    estimates, spent = frames(files, VioConfig())
    is_known = np.array([e.status != "starting" for e in estimates])
    total, opencv = spent[is_known][WARM:].T
    median = float(np.median(total))
    return [
        Metric(f"vio/{name}: frame", median, "ms", "lower", FRAME_BAR, "OpenCV in it", float(np.median(opencv)), 0.2),
        Metric(f"vio/{name}: 99th percentile over median", float(np.quantile(total, 0.99)) / median, "ratio", bar=TAIL_BAR),
        Metric(f"vio/{name}: position error", position_error(with_pose(estimates), files), "cm", tolerance=0.2),
    ]


def memory_metrics(minutes: float) -> list[Metric]:
    """Resident memory over a simulated walk."""
    if not _STATM.exists():
        print("vio: memory left out, needs /proc/self/statm", file=sys.stderr)
        return []
    motion = manoeuvres.handheld(60.0 * minutes, ROOM_LOW, ROOM_HIGH, speed=1.1, rate=0.9, seed=0)
    room = replace(make_camera_scenario("room", 0, make_rig("stereo", scale=0.3, rate_hz=RATE_HZ)), trajectory=motion)
    simulation = simulate_cameras(room)
    samples: list[tuple[int, float]] = []

    def note(progress: Progress) -> None:
        if progress.count and (not samples or progress.count > samples[-1][0]):
            samples.append((progress.count, int(_STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6))
            if progress.count % round(60 * RATE_HZ) == 0:
                print(f"{progress.count / RATE_HZ / 60:3.0f} min  {samples[-1][1]:7.1f} MB", file=sys.stderr, flush=True)

    config = VioRunConfig(odometry=VioConfig(cell_size=12, features=100))
    with tempfile.TemporaryDirectory() as folder:
        summary = run_visual_odometry(as_camera_recording(simulation), Path(folder) / "run", config, progress=note)
    count, memory = np.array(samples).T
    minute = np.floor(count / RATE_HZ / 60.0)
    full = [m for m in np.unique(minute) if m >= min(SETTLED_MIN, minutes // 3)]
    medians = [float(np.median(memory[minute == m])) for m in full]
    slope = float(np.polyfit(full, medians, 1)[0]) if len(full) > 1 else float("nan")
    return [
        Metric("vio/memory, slope", slope, "MB/min", bar=1.0, gated=False),
        Metric("vio/memory, resident", medians[-1], "MB", gated=False),
        Metric("vio/memory, frames", float(summary.frames), "frames", "higher", gated=False),
        Metric("vio/memory, lost frames", float(summary.status.get("lost", 0)), "frames", gated=False),
    ]


def measure(options: argparse.Namespace) -> list[Metric]:
    """What the options ask for."""
    metrics = [
        metric for name in (TIMED if options.only is None else options.only) for metric in metrics_of(name, options.shared)
    ]
    return metrics + (memory_metrics(options.minutes) if options.minutes else [])


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--shared", type=Path, default=HERE.parent.parent / "shared")
    parser.add_argument("--only", nargs="*", choices=TIMED, help="recordings; all of them if left out")
    parser.add_argument("--minutes", type=float, default=0.0, help="of the simulated walk; none if left out")


if __name__ == "__main__":
    run_as_script(__doc__, measure, _arguments)
