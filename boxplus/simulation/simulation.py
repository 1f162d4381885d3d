"""A recording that is computed: sensor data of a scenario, with its exact ground truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from boxplus._arguments import require, shown
from boxplus._numbers import as_floats, is_finite
from boxplus._settings import Settings
from boxplus.errors import InputError
from boxplus.manifolds import so3
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation.imu import ImuModel, SimulatedImu
from boxplus.simulation.lidar import LidarModel
from boxplus.simulation.motions.spline import Motion, span_of
from boxplus.simulation.scenarios import Scenario, make_scenario
from boxplus.simulation.worlds.world import World

Event = Scan | ImuSamples

_LIDAR_STREAM = 1
_FIRST_SCAN_NS = 7_300_000
"""The first scan begins after the first IMU sample and at none of the others: sensors are not synchronised."""
_LAST_MARGIN_NS = 20_000_000


class SimulationConfig(Settings):
    """What a simulation was made from; together with the version of boxplus it determines every bit of it."""

    scenario: str = Field(description="name of the scenario")
    seed: int = Field(0, ge=0, description="of the noise, and of a built-in scenario's world and motion")
    duration_s: float = Field(gt=0, description="simulated time [s]")
    lidar: LidarModel
    imu: ImuModel
    T_imu_lidar: tuple[tuple[float, ...], ...] = Field(description="4 × 4, LiDAR coordinates to IMU coordinates")


class Simulation:
    """Scans and IMU samples of a scenario. Nothing is stored: every scan is computed when it is asked for.

    The noise of every scan and of every block of IMU samples has its own seed, so any part can be computed alone.

    Attributes:
        config: the parameters.
        scenario: world, motion and sensors.
        world: what there is to see.
        T_imu_lidar: (4, 4) float64, LiDAR coordinates to IMU coordinates.
        start_ns, end_ns: span of the data [ns].
        scan_count: number of scans.

    Example:
        >>> simulation = bp.simulate("spin", duration_s=1.0)
        >>> truth = simulation.ground_truth([simulation.start_ns])  # exact, at any instant
        >>> truth.p_world_imu.shape, truth.R_world_imu.shape
        ((1, 3), (1, 3, 3))
    """

    def __init__(self, scenario: Scenario, seed: int = 0, duration_s: float | None = None) -> None:
        trajectory = scenario.trajectory
        self.start_ns, self.end_ns, duration = span_of(trajectory, scenario.name, duration_s)
        T_imu_lidar = np.array(scenario.T_imu_lidar, dtype=np.float64)
        if T_imu_lidar.shape != (4, 4) or not so3.is_rotation(T_imu_lidar[:3, :3]):
            raise InputError("T_imu_lidar (4, 4) with a rotation", f"shape {T_imu_lidar.shape}", "give a rigid transform")
        self.scenario = scenario
        self.world: World = scenario.world
        self.T_imu_lidar: NDArray[np.float64] = T_imu_lidar
        self.config = SimulationConfig(
            scenario=scenario.name,
            seed=seed,
            duration_s=duration,
            lidar=scenario.lidar,
            imu=scenario.imu,
            T_imu_lidar=tuple(map(tuple, T_imu_lidar.tolist())),
        )
        self._scan_ns = round(1e9 / scenario.lidar.rate_hz)
        available = self.end_ns - self.start_ns - _FIRST_SCAN_NS - _LAST_MARGIN_NS
        self.scan_count = max(available // self._scan_ns, 0)
        self._imu = SimulatedImu(scenario.imu, trajectory, seed, duration)

    def _random(self, stream: int, index: int) -> np.random.Generator:
        return np.random.Generator(np.random.PCG64([self.config.seed, stream, index]))

    def scan_start_ns(self, index: int) -> int:
        """When scan `index` begins [ns]; its points lie after this instant and up to the start of the next scan."""
        return self.start_ns + _FIRST_SCAN_NS + index * self._scan_ns

    def scan(self, index: int) -> Scan:
        """Scan `index`: every ray cast from the exact pose at its own time, noise along the ray, misses left out.

        Raises:
            InputError: no such scan.
        """
        points, time_ns, reflectivity = self._cast(index, self.scenario.lidar.range_sigma_m)
        scan = Scan.from_arrays(points.astype(np.float32), time_ns, (255.0 * reflectivity).astype(np.float32))
        if len(scan):
            return scan
        begin_ns = self.scan_start_ns(index)  # of rays that all meet nothing
        return replace(scan, start_ns=begin_ns + 1, end_ns=begin_ns + self._scan_ns)

    def exact_points(self, index: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """The points of scan `index` without noise: (N, 3) float64 in the LiDAR frame [m], and their times (N,) [ns]."""
        points, time_ns, _ = self._cast(index, 0.0)
        return points, time_ns

    def _cast(self, index: int, sigma_m: float) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
        if not 0 <= index < self.scan_count:
            raise InputError(f"a scan from 0 to {self.scan_count - 1}", f"{index}", "see Simulation.scan_count")
        lidar = self.scenario.lidar
        offset_s, directions = lidar.rays(index)
        time_ns = self.scan_start_ns(index) + np.maximum(np.rint(offset_s * 1e9).astype(np.int64), 1)
        motion = self.scenario.trajectory.evaluate(time_ns)
        R_world_lidar = motion.R_world_imu @ self.T_imu_lidar[:3, :3]
        p_world_lidar = motion.R_world_imu @ self.T_imu_lidar[:3, 3] + motion.p_world_imu
        ranges, hits = self.world.cast(directions, R_world_lidar, p_world_lidar, lidar.max_range)
        # Noise is drawn for every ray, so that it does not depend on which rays hit something.
        measured = ranges + sigma_m * self._random(_LIDAR_STREAM, index).standard_normal(len(ranges))
        keep = np.flatnonzero(np.isfinite(ranges) & (measured >= lidar.min_range) & (measured <= lidar.max_range))
        points = directions[keep] * measured[keep, None]
        return points, time_ns[keep // (len(directions) // len(offset_s))], self.world.reflectivity(hits[keep])

    def imu_samples(self, begin_ns: int, end_ns: int, block: int) -> ImuSamples:
        """The samples in (begin_ns, end_ns], with the noise of block `block`."""
        return self._imu.samples(begin_ns, end_ns, block)

    def events(self) -> Iterator[Event]:
        """Blocks of IMU samples and scans in order of time, like `Recording.events`: a scan comes when it is complete."""
        reached_ns = self.start_ns - 1
        for index in range(self.scan_count):
            complete_ns = self.scan_start_ns(index + 1)
            yield self.imu_samples(reached_ns, complete_ns, index)
            yield self.scan(index)
            reached_ns = complete_ns
        yield self.imu_samples(reached_ns, self.end_ns, self.scan_count)

    def __iter__(self) -> Iterator[Event]:
        return self.events()

    def ground_truth(self, time_ns: ArrayLike) -> Motion:
        """Exact pose, velocity, acceleration and angular velocity of the IMU at `time_ns` (N,) int64 [ns]."""
        return self.scenario.trajectory.evaluate(time_ns)

    def biases(self, time_ns: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Exact gyro [rad/s] and accelerometer [m/s²] biases (N, 3) at `time_ns` (N,) int64 [ns]."""
        return self._imu.biases(time_ns)


def simulate(
    scenario: str | Scenario = "walk",
    seed: int = 0,
    *,
    duration_s: float | None = None,
    lidar: LidarModel | None = None,
    imu: ImuModel | None = None,
    T_imu_lidar: ArrayLike | None = None,
) -> Simulation:
    """Simulate a scenario.

    Args:
        scenario: name of a built-in scenario (`SCENARIOS`), or one of your own.
        seed: of the noise, and of a built-in scenario's world and motion.
        duration_s: only the first seconds; all of the motion when not given.
        lidar, imu: other sensors than the scenario's.
        T_imu_lidar: (4, 4) another mounting of the LiDAR.

    Raises:
        InputError: no such scenario, a duration longer than the motion, a transform that is none.

    Example:
        >>> simulation = bp.simulate("walk", seed=1, duration_s=1.0)  # iterates as a recording does
        >>> sum(isinstance(event, bp.Scan) for event in simulation), simulation.T_imu_lidar.shape
        (9, (4, 4))
    """
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise InputError("seed as an integer from 0", shown(seed), "leave it out for 0")
    chosen = make_scenario(scenario, seed) if isinstance(scenario, str) else scenario
    require(chosen, Scenario, "the name of a scenario, or a Scenario", "choose one of boxplus.simulation.SCENARIOS")
    if duration_s is not None and not is_finite(duration_s):
        raise InputError("duration_s as a number [s]", shown(duration_s), "leave it out for all of the motion")
    if lidar is not None:
        chosen = replace(chosen, lidar=lidar)
    if imu is not None:
        chosen = replace(chosen, imu=imu)
    if T_imu_lidar is not None:
        chosen = replace(chosen, T_imu_lidar=as_floats(T_imu_lidar, "T_imu_lidar"))
    return Simulation(chosen, seed, duration_s)
