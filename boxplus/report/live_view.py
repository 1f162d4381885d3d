"""A run shown in 3D while it goes on, in the viewer of rerun (extra `view`)."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections import deque
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.manifolds import quaternion
from boxplus.runs.slam.loop_search import Closure
from boxplus.systems.lidar_inertial_odometry.estimate import AXES, Estimate
from boxplus.systems.visual_inertial_odometry.estimate import VioEstimate

_STATUS_RGB = {"ok": (47, 125, 91), "weak": (224, 159, 62), "lost": (193, 68, 60)}
_AXES_RGB = [(181, 68, 60), (58, 143, 77), (53, 104, 168)]
_MOST_POINTS = 20_000
_MAP_SCANS = 600
"""Scans or keyframes that stay visible; older ones are replaced, so that the viewer's memory stays bounded."""
_SMALLEST_STEP_M = 0.02
_VAGUE_M = 0.5  # standard deviation of the distance beyond which a landmark is not kept
_SEEN_RGB = (53, 104, 168)
_LOOP_RGB = (209, 73, 91)
_LOOPBACK = "127.0.0.1"
_LONGEST_WAIT_S = 20.0


class _Viewer:
    """Opens the viewer, and shows pose and path of a body.

    The viewer listens on the loopback interface only: nobody on the network can look at the run or send to it.

    Args:
        title: name of the recording.
        spawn: open a viewer; False only prepares the recording stream (tests, or a viewer that is connected elsewhere).

    Raises:
        InputError: rerun-sdk is not installed, or its viewer does not open.
    """

    def __init__(self, title: str, *, spawn: bool = True) -> None:
        try:
            import rerun
        except ImportError as error:
            raise InputError(
                "rerun-sdk for the live view", "an installation without it", "install it: pip install 'boxplus[view]'"
            ) from error
        self._rerun = rerun
        rerun.init(f"boxplus {title}")
        if spawn:
            rerun.connect_grpc(f"rerun+http://{_LOOPBACK}:{_open_viewer()}/proxy")
        rerun.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._path: deque[NDArray[np.float64]] = deque(maxlen=20_000)
        self._count = 0

    def _show_pose(self, time_ns: int, status: str, R: NDArray[np.float64], p: NDArray[np.float64]) -> None:
        """The IMU at R_world_imu (3, 3), p_world_imu (3,), and where it has been."""
        rerun = self._rerun
        rerun.set_time("time", timestamp=1e-9 * time_ns)
        w, x, y, z = quaternion.from_matrix(R[None])[0]
        pose = rerun.Transform3D(translation=p, rotation=rerun.Quaternion(xyzw=(x, y, z, w)))
        rerun.log("world/imu", pose, rerun.Arrows3D(vectors=0.5 * np.eye(3), colors=_AXES_RGB))
        if not self._path or np.linalg.norm(p - self._path[-1]) > _SMALLEST_STEP_M:
            self._path.append(p.copy())
        rerun.log("world/path", rerun.LineStrips3D([np.array(self._path)], colors=[_STATUS_RGB[status]]))


class LiveView(_Viewer):
    """Opens the viewer, which listens on the loopback interface only, and shows every scan it is given.

    Args:
        title, spawn: see `_Viewer`; a title, and False to open no viewer.

    Raises:
        InputError: rerun-sdk is not installed, or its viewer does not open.
    """

    def show(self, estimate: Estimate) -> None:
        """Show pose, path, points and the axes' information of one scan."""
        rerun, state = self._rerun, estimate.state
        self._show_pose(estimate.time_ns, estimate.status, state.R_world_imu, state.p_world_imu)
        if estimate.status != "lost":
            points = estimate.points_world()[:: max(1, len(estimate.p_lidar) // _MOST_POINTS)]
            rerun.log(f"world/map/{self._count % _MAP_SCANS}", rerun.Points3D(points, radii=0.02))
        for axis, share in zip(AXES, estimate.lidar_share, strict=True):
            rerun.log(f"lidar_share/{axis.replace(' ', '_')}", rerun.Scalars(float(share)))
        rerun.log("points_used", rerun.Scalars(float(estimate.points_used)))
        self._count += 1

    def show_loops(self, closure: Closure) -> None:
        """Show the path with loops closed, beside that of the odometry, and every loop that is believed now."""
        rerun, p_map = self._rerun, np.array(closure.p_map)
        rerun.log("world/corrected", rerun.LineStrips3D([p_map], colors=[_SEEN_RGB]))
        rerun.log("world/loops", rerun.LineStrips3D(p_map[np.array(closure.loops)], radii=0.05, colors=[_LOOP_RGB]))


class LiveCameraView(_Viewer):
    """Opens the viewer, which listens on the loopback interface only, and shows every frame of cameras and IMU it is given.

    Args:
        title, spawn: see `_Viewer`; a title, and False to open no viewer.

    Raises:
        InputError: rerun-sdk is not installed, or its viewer does not open.
    """

    def show(self, estimate: VioEstimate) -> None:
        """Show pose, path, landmarks, how many were seen and how well the position is known; nothing before the start."""
        if estimate.status == "starting":
            return
        rerun, T = self._rerun, estimate.T_world_imu
        self._show_pose(estimate.time_ns, estimate.status, T[:3, :3], T[:3, 3])
        rerun.log("world/landmarks", rerun.Points3D(estimate.landmarks, radii=0.03, colors=[_SEEN_RGB]))
        lines = rerun.LineStrips3D(estimate.line_ends.reshape(-1, 2, 3), radii=0.01, colors=[_SEEN_RGB])
        rerun.log("world/lines", lines)
        if estimate.is_keyframe:
            known = estimate.landmarks[estimate.landmark_sigmas < _VAGUE_M]
            rerun.log(f"world/map/{self._count % _MAP_SCANS}", rerun.Points3D(known, radii=0.01))
            self._count += 1
        rerun.log("tracked", rerun.Scalars(float(estimate.tracked)))
        rerun.log("sigma_position_m", rerun.Scalars(float(np.sqrt(np.trace(estimate.covariance[3:6, 3:6])))))


def _open_viewer() -> int:
    """Start a viewer, which outlives this process; returns its port. Started by rerun itself it would listen to every network."""
    with socket.socket() as free:
        free.bind((_LOOPBACK, 0))
        port = int(free.getsockname()[1])
    viewer = subprocess.Popen(
        [sys.executable, "-m", "rerun", f"--bind={_LOOPBACK}", f"--port={port}", "--expect-data-soon"],
        env={**os.environ, "RERUN_APP_ONLY": "true"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    until = time.monotonic() + _LONGEST_WAIT_S
    while viewer.poll() is None and time.monotonic() < until:
        with suppress(OSError), socket.create_connection((_LOOPBACK, port), timeout=1.0):
            return port
        time.sleep(0.05)
    got = "none in 20 s" if viewer.poll() is None else f"a process that ended with code {viewer.returncode}"
    viewer.terminate()
    raise InputError("the viewer of rerun in a window", got, "run without the live view, or try 'python -m rerun' by itself")
