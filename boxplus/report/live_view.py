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
from boxplus.systems.lidar_inertial_odometry.estimate import AXES, Estimate

_STATUS_RGB = {"ok": (47, 125, 91), "weak": (224, 159, 62), "lost": (193, 68, 60)}
_AXES_RGB = [(181, 68, 60), (58, 143, 77), (53, 104, 168)]
_MOST_POINTS = 20_000
_MAP_SCANS = 600
"""Scans that stay visible; older ones are replaced, so that the viewer's memory stays bounded."""
_SMALLEST_STEP_M = 0.02
_LOOPBACK = "127.0.0.1"
_LONGEST_WAIT_S = 20.0


class LiveView:
    """Opens the viewer and shows every estimate it is given.

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

    def show(self, estimate: Estimate) -> None:
        """Show pose, path, points and the axes' information of one scan."""
        rerun, state = self._rerun, estimate.state
        rerun.set_time("time", timestamp=1e-9 * estimate.time_ns)
        color = _STATUS_RGB[estimate.status]
        w, x, y, z = quaternion.from_matrix(state.R_world_imu[None])[0]
        pose = rerun.Transform3D(translation=state.p_world_imu, rotation=rerun.Quaternion(xyzw=(x, y, z, w)))
        rerun.log("world/imu", pose, rerun.Arrows3D(vectors=0.5 * np.eye(3), colors=_AXES_RGB))
        if not self._path or np.linalg.norm(state.p_world_imu - self._path[-1]) > _SMALLEST_STEP_M:
            self._path.append(state.p_world_imu.copy())
        rerun.log("world/path", rerun.LineStrips3D([np.array(self._path)], colors=[color]))
        if estimate.status != "lost":
            points = estimate.points_world()[:: max(1, len(estimate.p_lidar) // _MOST_POINTS)]
            rerun.log(f"world/map/{self._count % _MAP_SCANS}", rerun.Points3D(points, radii=0.02))
        for axis, share in zip(AXES, estimate.lidar_share, strict=True):
            rerun.log(f"lidar_share/{axis.replace(' ', '_')}", rerun.Scalars(float(share)))
        rerun.log("points_used", rerun.Scalars(float(estimate.points_used)))
        self._count += 1


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
