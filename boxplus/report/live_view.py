"""Runs shown in 3D while they go on, and problems before and after their solution, in rerun (extra `view`)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion
from boxplus.report.viewer import WINDOW, Viewer
from boxplus.runs.slam.loop_search import Closure
from boxplus.systems.lidar_inertial_odometry.estimate import AXES, Estimate
from boxplus.systems.visual_inertial_odometry.estimate import VioEstimate

_STATUS_RGB = {"ok": (58, 163, 227), "weak": (221, 144, 0), "lost": (160, 48, 112)}  # STATUS and XYZ of the palette
_AXES_RGB = [(244, 67, 1), (45, 188, 174), (99, 70, 199)]
_MOST_POINTS = 20_000
_MAP_SCANS = 600
"""Scans or keyframes that stay visible; older ones are replaced, so that the viewer's memory stays bounded."""
_PIECE = 200  # poses of the path that are one line: only the last is sent again when it grows
_SMALLEST_STEP_M = 0.02
_VAGUE_M = 0.5  # standard deviation of the distance beyond which a landmark is not kept
_SEEN_RGB = (53, 104, 168)
_LOOP_RGB = (209, 73, 91)
_BEFORE_RGB = (150, 160, 170)


class _RunView(Viewer):
    """Shows pose and path of a body; arguments and errors as `Viewer`."""

    def __init__(self, title: str, where: str | None = WINDOW) -> None:
        super().__init__(title, where)
        self.log("world", self._rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._piece: list[NDArray[np.float64]] = []
        self._pieces, self._count = 0, 0

    def _show_pose(self, time_ns: int, status: str, R: NDArray[np.float64], p: NDArray[np.float64]) -> None:
        """The IMU at R_world_imu (3, 3), p_world_imu (3,), and where it has been."""
        rerun = self._rerun
        rerun.set_time("time", timestamp=1e-9 * time_ns)
        w, x, y, z = quaternion.from_matrix(R[None])[0]
        pose = rerun.Transform3D(translation=p, rotation=rerun.Quaternion(xyzw=(x, y, z, w)))
        self.log("world/imu", pose, rerun.Arrows3D(vectors=0.5 * np.eye(3), colors=_AXES_RGB))
        if not self._piece or np.linalg.norm(p - self._piece[-1]) > _SMALLEST_STEP_M:
            if len(self._piece) >= _PIECE:
                self._piece, self._pieces = [self._piece[-1]], self._pieces + 1
            self._piece.append(p.copy())
        line = rerun.LineStrips3D([np.array(self._piece)], colors=[_STATUS_RGB[status]])
        self.log(f"world/path/{self._pieces}", line)


class LiveView(_RunView):
    """Shows every scan it is given, and loops that close.

    Args:
        title: name of the recording.
        where: `window`, FILE.rrd or the address of a viewer on this machine; None shows nothing.

    Raises:
        InputError: see `Viewer`.
    """

    def show(self, estimate: Estimate) -> None:
        """Show pose, path, points and the axes' information of one scan."""
        if not self.look_after():
            return
        rerun, state = self._rerun, estimate.state
        self._show_pose(estimate.time_ns, estimate.status, state.R_world_imu, state.p_world_imu)
        if estimate.status != "lost":
            points = estimate.points_world()[:: max(1, len(estimate.p_lidar) // self.thinned(_MOST_POINTS))]
            self.log(f"world/map/{self._count % _MAP_SCANS}", rerun.Points3D(points.astype(np.float32), radii=0.02))
        for axis, share in zip(AXES, estimate.lidar_share, strict=True):
            self.log(f"lidar_share/{axis.replace(' ', '_')}", rerun.Scalars(float(share)))
        self.log("points_used", rerun.Scalars(float(estimate.points_used)))
        self._count += 1

    def show_loops(self, closure: Closure) -> None:
        """Show the path with loops closed, beside that of the odometry, and every loop that is believed now."""
        rerun, p_map = self._rerun, np.array(closure.p_map)
        self.log("world/corrected", rerun.LineStrips3D([p_map], colors=[_SEEN_RGB]))
        self.log("world/loops", rerun.LineStrips3D(p_map[np.array(closure.loops)], radii=0.05, colors=[_LOOP_RGB]))


class LiveCameraView(_RunView):
    """Shows every frame of cameras and IMU it is given; arguments and errors as `LiveView`."""

    def show(self, estimate: VioEstimate) -> None:
        """Show pose, path, landmarks, how many were seen and how well the position is known; nothing before the start."""
        if estimate.status == "starting" or not self.look_after():
            return
        rerun, T = self._rerun, estimate.T_world_imu
        self._show_pose(estimate.time_ns, estimate.status, T[:3, :3], T[:3, 3])
        self.log("world/landmarks", rerun.Points3D(estimate.landmarks, radii=0.03, colors=[_SEEN_RGB]))
        lines = rerun.LineStrips3D(estimate.line_ends.reshape(-1, 2, 3), radii=0.01, colors=[_SEEN_RGB])
        self.log("world/lines", lines)
        if estimate.is_keyframe:
            known = estimate.landmarks[estimate.landmark_sigmas < _VAGUE_M]
            self.log(f"world/map/{self._count % _MAP_SCANS}", rerun.Points3D(known, radii=0.01))
            self._count += 1
        self.log("tracked", rerun.Scalars(float(estimate.tracked)))
        self.log("sigma_position_m", rerun.Scalars(float(np.sqrt(np.trace(estimate.covariance[3:6, 3:6])))))


class ProblemView(Viewer):
    """Shows a problem before and after its solution, side by side in one world; arguments and errors as `LiveView`."""

    def show_graph(self, solved: bool, p: NDArray[np.float64], edges: NDArray[np.intp]) -> None:
        """Positions (N, 3) of the poses of a graph, and edges (E, 2) between them."""
        rerun, name, colour = self._rerun, "after" if solved else "before", _SEEN_RGB if solved else _BEFORE_RGB
        self.log(f"{name}/poses", rerun.Points3D(p, colors=[colour]), static=True)
        self.log(f"{name}/edges", rerun.LineStrips3D(p[edges], colors=[colour]), static=True)

    def show_scene(self, solved: bool, points: NDArray[np.float64], centers: NDArray[np.float64]) -> None:
        """Points (N, 3) of a reconstruction and centres (M, 3) of its cameras."""
        rerun, name, colour = self._rerun, "after" if solved else "before", _SEEN_RGB if solved else _BEFORE_RGB
        self.log(f"{name}/points", rerun.Points3D(points, colors=[colour]), static=True)
        self.log(f"{name}/cameras", rerun.Points3D(centers, colors=[_LOOP_RGB if solved else colour]), static=True)
