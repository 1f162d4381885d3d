"""`boxplus warmup`: compile the kernels of the main jobs before they are needed.

Parts of the work are processes of their own, as many at a time as there are processors: compiling holds the interpreter. They
share the cache folder, so that each finds there what another one has compiled.
"""

from __future__ import annotations

import os
import subprocess
import sys

_MOST_PROCESSES = 4  # of half a gigabyte each


def warmup() -> None:
    """Compile everything now, so that the first run does not have to. Takes a minute, once."""
    import time
    from concurrent.futures import ThreadPoolExecutor, as_completed

    from boxplus._kernel_cache import cache_root
    from boxplus.cli.terminal.console import make_console
    from boxplus.errors import BoxplusError

    console = make_console()
    began = time.perf_counter()
    compiled: set[str] = set()
    with console.status("compiling kernels …") as status, ThreadPoolExecutor(min(os.cpu_count() or 1, _MOST_PROCESSES)) as pool:
        running = [pool.submit(_compile_apart, part) for part in _PARTS]
        for done, part in enumerate(as_completed(running), 1):
            names, failure = part.result()
            if failure:
                pool.shutdown(cancel_futures=True)
                raise BoxplusError(f"kernels cannot be compiled: {failure}")
            compiled |= names
            status.update(f"compiling kernels … {done} of {len(running)} parts, {len(compiled)} kernels")
    what = f"{len(compiled)} kernels compiled" if compiled else "nothing to compile, all kernels were ready"
    console.print(f"{what} in {time.perf_counter() - began:.1f} s, kept in {cache_root()}", soft_wrap=True)


def _compile_apart(part: str) -> tuple[set[str], str]:
    """Which kernels a process of its own had to compile for this part, and why it failed."""
    done = subprocess.run(
        [sys.executable, "-m", "boxplus.cli.warmup", part], capture_output=True, text=True, encoding="utf-8", check=False
    )
    if done.returncode:
        return set(), f"{part}: {(done.stderr.strip().splitlines() or [f'exit code {done.returncode}'])[-1]}"
    return set(done.stdout.split()), ""


def _compile_here(part: str) -> None:
    """Do this part, and write the names of the kernels that had to be compiled to the standard output."""
    import gc

    from boxplus._jit import on_compilation

    gc.set_threshold(100_000, 50, 50)  # a compiler keeps most of what it makes: a tenth of the time went into looking for garbage
    compiled: list[str] = []
    with on_compilation(compiled.append):
        _PARTS[part]()
    sys.stdout.write("\n".join(compiled))


def _run_odometry() -> None:
    import tempfile
    from pathlib import Path

    from boxplus.runs.lidar_inertial.config import load_run_config
    from boxplus.runs.lidar_inertial.odometry_run import run_odometry
    from boxplus.simulation import SpinningLidar, simulate
    from boxplus.simulation.live_recording import as_recording

    # A car in a map box so small that it slides: every kernel of a run is called.
    odometry = {"threads": 1, "box_side": 40.0, "detection_range": 5.0, "extrinsic_estimation": "on"}
    recording = as_recording(simulate("moving_start", duration_s=2.5, lidar=SpinningLidar(azimuth_steps=500)))
    with tempfile.TemporaryDirectory() as folder:
        run_odometry(recording, Path(folder) / "run", load_run_config(overrides={"odometry": odometry}))


def _close_loops() -> None:

    import numpy as np

    from boxplus._extras import has
    from boxplus.maps.local_maps.builder import LocalMapBuilder
    from boxplus.maps.local_maps.config import LocalMapConfig
    from boxplus.simulation.drifting_drive import DriftConfig, simulate_drifting_drive
    from boxplus.simulation.worlds.worlds import city
    from boxplus.systems.slam.config import SlamConfig
    from boxplus.systems.slam.slam import Slam

    route = [[20.0, 0.0], [40.0, 0.0], [40.0, 40.0], [0.0, 40.0], [0.0, 0.0], [40.0, 0.0]]
    config = DriftConfig(channels=16, azimuth_steps=200)
    drive = simulate_drifting_drive(city(1, 1, pitch=40.0, street=14.0), route, config)
    slam = Slam(SlamConfig(appearance="density" if has("cv2") else "scan_context"))
    builder, zero = LocalMapBuilder(LocalMapConfig(voxel=0.5)), np.zeros((6, 6))
    for time_ns, T_odo_body, scan in zip(drive.time_ns.tolist(), drive.T_odo_body, drive.scans, strict=True):
        for local_map in builder.push(time_ns, T_odo_body, zero, scan):
            slam.add(local_map)


def _optimize_pose_graphs() -> None:
    import numpy as np

    from boxplus.formats.graphs.pose_graph import PoseGraph
    from boxplus.manifolds import se2, se3
    from boxplus.manifolds.se2 import SE2
    from boxplus.manifolds.se3 import SE3
    from boxplus.optimization.losses import Huber
    from boxplus.systems.pose_graph.pose_graph import optimize_pose_graph
    from boxplus.systems.pose_graph.problem import pose_graph_problem

    count = 60  # more than the dense solver takes
    i = np.arange(count)
    edges = np.concatenate([np.stack([i, (i + 1) % count], 1), np.stack([i, (i + 7) % count], 1)])
    for manifold, group in ((SE2, se2), (SE3, se3)):
        poses = manifold.random(np.random.default_rng(0), count)
        measured = group.compose(group.inverse(poses[edges[:, 0]]), poses[edges[:, 1]])
        measured = manifold.boxplus(measured, np.full((len(edges), manifold.dof), 0.01))
        information = np.tile(np.eye(manifold.dof), (len(edges), 1, 1))
        none = np.zeros(0, dtype=np.int64)
        graph = PoseGraph(2 if manifold is SE2 else 3, i, None, edges, measured, information, none)
        optimize_pose_graph(graph)
        problem, variables = pose_graph_problem(graph, loss=Huber(1.0))
        problem.solve().covariance(variables[[1]])


def _adjust_bundle() -> None:
    import numpy as np

    from boxplus.formats.reconstructions.bal import BalProblem
    from boxplus.formats.reconstructions.gbp import GbpProblem
    from boxplus.manifolds import se3
    from boxplus.systems.bundle_adjustment.bundle_adjustment import adjust_bundle

    rng = np.random.default_rng(0)
    cameras = np.hstack([0.05 * rng.standard_normal((20, 6)), np.tile([500.0, 0.0, 0.0], (20, 1))])
    points = rng.uniform([-1.0, -1.0, -6.0], [1.0, 1.0, -4.0], (100, 3))
    camera_of, point_of = (index.reshape(-1) for index in np.indices((20, 100)))
    pixels = -500.0 * points[point_of, :2] / points[point_of, 2:]
    adjust_bundle(BalProblem(cameras, points, camera_of, point_of, pixels))
    poses = se3.exp(cameras[:, :6])
    adjust_bundle(GbpProblem(np.array([500.0, 500.0, 0.0, 0.0]), poses, -points, camera_of, point_of, -pixels))


def _follow_camera() -> None:
    import numpy as np

    from boxplus.cameras.pinhole import Pinhole
    from boxplus.systems.direct_odometry import DirectOdometry, DirectOdometryConfig, StereoPair

    camera = Pinhole(150.0, 150.0, 79.5, 59.5)
    v, u = np.mgrid[:120, :160]
    # A wall 2 m ahead that moves by three pixels a frame, seen twice with a baseline of as much.
    greys = [100.0 + 40.0 * np.sin(0.25 * (u + 3.0 * k)) * np.cos(0.2 * v + 0.05 * (u + 3.0 * k)) for k in range(5)]
    config = DirectOdometryConfig(window=2, keyframe_flow=0.005)
    by_depth = DirectOdometry(camera, config)
    by_stereo = DirectOdometry(camera, config, stereo=StereoPair(camera, (1.0, 0.0, 0.0, 0.0, -0.04, 0.0, 0.0)))
    for k, grey in enumerate(greys[:4]):
        by_depth.push_rgbd(k, grey, np.full(grey.shape, 2.0))
        by_stereo.push_stereo(k, grey, greys[k + 1])


def _follow_camera_and_imu() -> None:
    import tempfile
    from pathlib import Path

    from boxplus._extras import has
    from boxplus.runs.visual_inertial.config import VioRunConfig
    from boxplus.runs.visual_inertial.visual_run import run_visual_odometry
    from boxplus.simulation.cameras import as_camera_recording, make_rig, simulate_cameras

    if not has("cv2"):  # then there is no run either
        return
    # A start at rest and one in motion, and a window from which keyframes leave.
    config = VioRunConfig.model_validate({"odometry": {"cell_size": 12, "features": 100}})
    for scenario in ("room", "room_moving"):
        simulation = simulate_cameras(scenario, 1, duration_s=2.5, rig=make_rig("stereo", None, 0.3, 12.0))
        with tempfile.TemporaryDirectory() as folder:
            run_visual_odometry(as_camera_recording(simulation), Path(folder) / "run", config)


def _calibrate_cameras() -> None:
    """A small rig and its IMU before a target, with every lens."""
    import numpy as np

    from boxplus.manifolds import se3
    from boxplus.residuals.inertial.imu_noise import ImuNoise
    from boxplus.simulation.cameras.target_session import simulate_target_session
    from boxplus.systems.camera_calibration.calibration import calibrate_cameras
    from boxplus.systems.camera_calibration.config import CameraCalibrationConfig
    from boxplus.systems.camera_calibration.lens import lens
    from boxplus.systems.camera_calibration.target import AprilGrid

    target = AprilGrid(rows=3, columns=3, tag_size=0.1, spacing=0.3)
    camera = lens("pinhole-radtan", np.array([458.0, 457.0, 372.0, 246.0, -0.283, 0.074, 0.0, 0.0]))
    mounting = se3.exp(np.zeros((1, 6)))
    seen = simulate_target_session([camera], mounting, (752, 480), target, frames=24, rate_hz=5.0)
    noise = ImuNoise(1.7e-4, 2e-3, 1.9e-5, 3e-3)
    calibrate_cameras(seen.corners, target, CameraCalibrationConfig(max_views=8), imu=seen.imu, noise=noise)


# The longest first.
_PARTS = {
    "LiDAR-inertial odometry": _run_odometry,
    "visual-inertial odometry": _follow_camera_and_imu,
    "loop closure": _close_loops,
    "calibration of cameras": _calibrate_cameras,
    "bundle adjustment": _adjust_bundle,
    "pose graphs": _optimize_pose_graphs,
    "direct odometry": _follow_camera,
}

if __name__ == "__main__":
    _compile_here(sys.argv[1])
