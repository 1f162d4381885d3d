"""LiDAR odometry systems behind one interface: boxplus, RKO-LIO and KISS-ICP, fed the same events and timed alike.

Each takes IMU samples and scans, and notes for every scan the seconds it took and the pose of the IMU it found. Timed is
processor time of the whole process, since the machines that run benchmarks are shared: every system runs on one thread, so
that this is what it would need alone.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import quaternion
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from boxplus.systems.lidar_odometry.odometry import LidarOdometry

Event = Scan | ImuSamples
MAX_RANGE = 200.0


class Contestant(Protocol):
    """A system under test.

    Attributes:
        seconds: of every scan.
        time_ns: of every pose.
        T_world_imu: (4, 4) each.
    """

    seconds: list[float]
    time_ns: list[int]
    T_world_imu: list[NDArray[np.float64]]

    def push(self, event: Event) -> None:
        """Take what arrives next."""

    def finish(self) -> None:
        """There is no more."""


class Boxplus:
    """Ours; a scan's seconds are those of every call since the estimate before, IMU samples included."""

    def __init__(self, config: LioConfig, clock: Callable[[], float] = time.thread_time) -> None:
        self.odometry: LidarInertialOdometry | LidarOdometry = LidarInertialOdometry(config)
        self._clock = clock
        self.seconds: list[float] = []
        self.time_ns: list[int] = []
        self.T_world_imu: list[NDArray[np.float64]] = []
        self.status: list[str] = []
        self._pending = 0.0

    def push(self, event: Event) -> list[Estimate]:
        """Take what arrives next; returns the estimates."""
        began = self._clock()
        estimates = self.odometry.push_scan(event) if isinstance(event, Scan) else self.odometry.push_imu(event)
        self._pending += self._clock() - began
        return self._note(estimates)

    def finish(self) -> None:
        """There is no more."""
        self._note(self.odometry.flush())

    def _note(self, estimates: list[Estimate]) -> list[Estimate]:
        if len(estimates) == 1:  # the scans that waited for the start come in one go
            self.seconds.append(self._pending)
        if estimates:
            self._pending = 0.0
        for estimate in estimates:
            self.time_ns.append(estimate.time_ns)
            self.T_world_imu.append(estimate.T_world_imu)
            self.status.append(estimate.status)
        return estimates


class BoxplusAlone(Boxplus):
    """Ours without an IMU; what it finds is the pose of the LiDAR."""

    def __init__(self, T_imu_lidar: NDArray[np.float64], clock: Callable[[], float] = time.thread_time) -> None:
        super().__init__(LioConfig(), clock)
        self.odometry = LidarOdometry()
        self._T_lidar_imu = np.linalg.inv(T_imu_lidar)

    def _note(self, estimates: list[Estimate]) -> list[Estimate]:
        super()._note(estimates)
        for k in range(len(self.T_world_imu) - len(estimates), len(self.T_world_imu)):
            self.T_world_imu[k] = self.T_world_imu[k] @ self._T_lidar_imu
        return estimates


class RkoLio:
    """RKO-LIO (Malladi et al.), base frame the IMU's; only its registration is timed.

    Everything but voxel size and threads is its default, except the initialisation at rest, without which it takes the first
    attitude for level.
    """

    def __init__(self, voxel: float, T_imu_lidar: NDArray[np.float64], *, starts_at_rest: bool) -> None:
        from rko_lio.config import LIOConfig
        from rko_lio.lio import LIO

        settings = LIOConfig(
            voxel_size=voxel, max_num_threads=1, max_range=MAX_RANGE, min_range=0.5, initialization_phase=starts_at_rest
        )
        self._lio = LIO(settings)
        self._T_imu_lidar = T_imu_lidar
        self.seconds: list[float] = []
        self.time_ns: list[int] = []
        self.T_world_imu: list[NDArray[np.float64]] = []
        self._imu: list[ImuSamples] = []
        self._scans: list[Scan] = []

    def push(self, event: Event) -> None:
        """Take what arrives next; a scan is registered once an IMU sample lies after it, as its own sequencer does."""
        if isinstance(event, Scan):
            self._scans.append(event)
        else:
            self._imu.append(event)
        while self._scans and self._imu and int(self._imu[-1].time_ns[-1]) > self._scans[0].end_ns:
            self._register(self._scans.pop(0))

    def _register(self, scan: Scan) -> None:
        rest = []
        for samples in self._imu:
            before = samples.time_ns < scan.end_ns
            for time_ns, gyro, accel in zip(samples.time_ns[before], samples.gyro[before], samples.accel[before], strict=True):
                self._lio.add_imu_measurement(accel, gyro, int(time_ns))
            after = ~before
            if after.any():
                rest.append(ImuSamples(samples.time_ns[after], samples.gyro[after], samples.accel[after]))
        self._imu = rest
        points = scan.p_lidar.astype(np.float64)
        began = time.thread_time()
        try:
            self._lio.register_scan(points, scan.time_ns, self._T_imu_lidar, scan.start_ns, scan.end_ns)
        except Exception as problem:  # noqa: BLE001  its binding raises its own types
            print(f"RKO-LIO drops a scan: {problem}")
            return
        self.seconds.append(time.thread_time() - began)
        self.time_ns.append(scan.end_ns)
        self.T_world_imu.append(self._lio.pose())

    def finish(self) -> None:
        """There is no more."""


class KissIcp:
    """KISS-ICP (Vizzo et al.), LiDAR only, with the times of the points; poses are those of the scan's end."""

    def __init__(self, voxel: float, T_imu_lidar: NDArray[np.float64]) -> None:
        from kiss_icp.config import KISSConfig
        from kiss_icp.kiss_icp import KissICP

        config = KISSConfig()
        config.mapping.voxel_size = voxel
        config.registration.max_num_threads = 1
        config.data.max_range = MAX_RANGE
        self._odometry = KissICP(config)
        self._T_lidar_imu = np.linalg.inv(T_imu_lidar)
        self.seconds: list[float] = []
        self.time_ns: list[int] = []
        self.T_world_imu: list[NDArray[np.float64]] = []

    def push(self, event: Event) -> None:
        """Take what arrives next; IMU samples are of no use to it."""
        if not isinstance(event, Scan):
            return
        points, stamps = event.p_lidar.astype(np.float64), (event.time_ns - event.start_ns) * 1e-9
        began = time.thread_time()
        self._odometry.register_frame(points, stamps)
        self.seconds.append(time.thread_time() - began)
        self.time_ns.append(event.end_ns)
        self.T_world_imu.append(self._odometry.last_pose @ self._T_lidar_imu)

    def finish(self) -> None:
        """There is no more."""


def opponents(voxel: float, T_imu_lidar: NDArray[np.float64], *, starts_at_rest: bool) -> dict[str, Callable[[], Contestant]]:
    """The opponents that are installed, as name → maker."""
    makers: dict[str, Callable[[], Contestant]] = {}
    if importlib.util.find_spec("rko_lio"):
        makers["RKO-LIO"] = lambda: RkoLio(voxel, T_imu_lidar, starts_at_rest=starts_at_rest)
    if importlib.util.find_spec("kiss_icp"):
        makers["KISS-ICP"] = lambda: KissIcp(voxel, T_imu_lidar)
    return makers


def trajectory(contestant: Contestant, source: str, T_imu_body: NDArray[np.float64] | None = None) -> Trajectory:
    """The poses as a trajectory of the IMU, or of a body at `T_imu_body`."""
    poses = np.array(contestant.T_world_imu) @ (np.eye(4) if T_imu_body is None else T_imu_body)
    q_wxyz = quaternion.from_matrix(poses[:, :3, :3])
    return Trajectory(np.array(contestant.time_ns), poses[:, :3, 3], q_wxyz, source=source)
