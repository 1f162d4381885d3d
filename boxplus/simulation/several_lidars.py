"""Other LiDARs on the body of a simulation: the same world and motion, seen with another sensor from another place."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation.faults import Fault
from boxplus.simulation.lidar import LidarModel
from boxplus.simulation.simulation import Simulation

_NOISE_STEP = 7919
"""Between the seeds of the noise of two LiDARs."""


@dataclass(frozen=True, slots=True)
class MountedLidar:
    """Another LiDAR on board.

    Attributes:
        lidar: its model.
        T_imu_lidar: (4, 4) its coordinates to those of the IMU, in truth.
        topic: of its clouds; its frame is called like it, without slashes.
        fault: what goes wrong with its scans, and with its mounting as declared.
    """

    lidar: LidarModel
    T_imu_lidar: NDArray[np.float64]
    topic: str = "/lidar_2/points"
    fault: Fault | None = None

    @property
    def frame(self) -> str:
        """Name of its frame."""
        return self.topic.strip("/").replace("/", "_")

    @property
    def T_declared(self) -> NDArray[np.float64] | None:
        """(4, 4) T_imu_lidar as the recording declares it."""
        return self.T_imu_lidar if self.fault is None else self.fault.declared_extrinsic(self.T_imu_lidar)


@dataclass(frozen=True, slots=True)
class Measured:
    """An event of one of several LiDARs, 0 the first one, or of the IMU.

    Attributes:
        at_ns: when it was measured, whatever its stamps say: its end [ns].
        lidar: number of the LiDAR; 0 for samples of the IMU too.
        event: as a fault has left it.
        sample_ns: (N,) when each sample of the block of the IMU was measured.
    """

    at_ns: int
    lidar: int
    event: Scan | ImuSamples
    sample_ns: NDArray[np.int64] | None = None

    def sample_times(self) -> NDArray[np.int64]:
        """When each of the samples was measured; by their stamps where some of the block are missing."""
        samples = cast(ImuSamples, self.event)
        return self.sample_ns if self.sample_ns is not None and len(self.sample_ns) == len(samples) else samples.time_ns


def simulation_of(simulation: Simulation, mounted: MountedLidar, number: int) -> Simulation:
    """What the other LiDAR measures, with noise of its own."""
    scenario = replace(simulation.scenario, lidar=mounted.lidar, T_imu_lidar=np.asarray(mounted.T_imu_lidar, np.float64))
    config = simulation.config
    return Simulation(scenario, config.seed + _NOISE_STEP * number, config.duration_s)


def other_events(simulation: Simulation, others: tuple[MountedLidar, ...]) -> list[Iterator[Measured]]:
    """The scans of each of the other LiDARs."""
    return [_events(simulation_of(simulation, mounted, k), mounted.fault, k) for k, mounted in enumerate(others, 1)]


def _events(simulation: Simulation, fault: Fault | None, lidar: int) -> Iterator[Measured]:
    at_ns = [simulation.start_ns]

    def scans() -> Iterator[Scan]:
        for index in range(simulation.scan_count):
            scan = simulation.scan(index)
            at_ns[0] = scan.end_ns if len(scan) else simulation.scan_start_ns(index + 1)
            yield scan

    for event in scans() if fault is None else fault.events(scans()):
        yield Measured(at_ns[0], lidar, event)
