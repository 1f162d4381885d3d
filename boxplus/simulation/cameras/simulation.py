"""A recording of cameras that is computed: images, depths and IMU samples of a scenario, with their exact ground truth."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from boxplus._settings import Settings
from boxplus.errors import InputError
from boxplus.sensors.images.camera_image import CameraImage
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.simulation.cameras.exposure import ExposureCourse
from boxplus.simulation.cameras.renderer import Renderer, Surfaces
from boxplus.simulation.cameras.scenarios import CameraScenario, Light, make_camera_scenario
from boxplus.simulation.cameras.sensor import ELECTRONS_PER_GREY, GREY_PER_LIGHT_SECOND, CameraRig
from boxplus.simulation.imu import ImuModel, SimulatedImu
from boxplus.simulation.motions.spline import Motion, span_of
from boxplus.simulation.worlds.world import Solid

Floats = NDArray[np.float64]
CameraEvent = CameraImage | ImuSamples

DEPTH = "depth"
"""Name of the stream of depth images."""

_NOISE_STREAM, _EXPOSURE_STREAM = 11, 12
_FIRST_IMAGE_NS = 63_300_000
"""The first image lies between two IMU samples, as do all others: sensors are not synchronised."""
_LAST_MARGIN_NS = 60_000_000
_THUMBNAIL_PX = 48
_BLUR_NEAR_M = 2.5
_STEPS_A_PIXEL = 1.5


class CameraSimulationConfig(Settings):
    """What a simulation was made from; together with the version of boxplus it determines every bit of a built-in scenario."""

    scenario: str = Field(description="name of the scenario")
    seed: int = Field(0, ge=0, description="of the noise, and of a built-in scenario's world and motion")
    duration_s: float = Field(gt=0, description="simulated time [s]")
    rig: CameraRig
    imu: ImuModel
    light: Light
    pixel_m: float = Field(gt=0, description="side of a pixel of the pictures on the surfaces [m]")
    contrast: float = Field(ge=0, description="of these pictures")


class CameraSimulation:
    """Images and IMU samples of a scenario. Nothing is stored: every image is computed when it is asked for.

    Attributes:
        config: the parameters.
        scenario: world, motion, light and sensors.
        names: of the streams of images, by index: `cam0`, `cam1` …, and `depth` where the rig has depths.
        start_ns, end_ns: span of the data [ns].
        image_count: images of each camera.
    """

    def __init__(self, scenario: CameraScenario, seed: int = 0, duration_s: float | None = None) -> None:
        trajectory = scenario.trajectory
        self.start_ns, self.end_ns, duration = span_of(trajectory, scenario.name, duration_s)
        self.scenario = scenario
        self.config = CameraSimulationConfig(
            scenario=scenario.name,
            seed=seed,
            duration_s=duration,
            rig=scenario.rig,
            imu=scenario.imu,
            light=scenario.light,
            pixel_m=scenario.pixel_m,
            contrast=scenario.contrast,
        )
        cameras = scenario.rig.cameras
        self.names = [f"cam{index}" for index in range(len(cameras))] + ([DEPTH] if scenario.rig.depth else [])
        self._period_ns = round(1e9 / scenario.rig.rate_hz)
        self.image_count = max((self.end_ns - self.start_ns - _FIRST_IMAGE_NS - _LAST_MARGIN_NS) // self._period_ns, 0)
        self.imu = SimulatedImu(scenario.imu, scenario.imu_trajectory or trajectory, seed, duration)

    def _random(self, stream: int, *index: int) -> np.random.Generator:
        return np.random.Generator(np.random.SFC64([self.config.seed, stream, *index]))

    @functools.cached_property
    def _surfaces(self) -> Surfaces:
        return Surfaces(self.scenario.world, self.config.seed, self.scenario.pixel_m, self.scenario.contrast)

    @functools.cached_property
    def _renderers(self) -> list[Renderer]:
        return [Renderer(camera.sensor, self._surfaces) for camera in self.scenario.rig.cameras]

    @functools.cached_property
    def _exposures(self) -> ExposureCourse:
        first = self.scenario.rig.cameras[0]
        small = first.sensor.scaled(_THUMBNAIL_PX / first.sensor.width).model_copy(update={"line_delay_s": 0.0})
        renderer = Renderer(small, self._surfaces)

        def brightness(since_s: Floats) -> Floats:
            time_ns = self.start_ns + np.rint(since_s * 1e9).astype(np.int64)
            means = []
            for time in time_ns:
                R, p = self._row_poses(0, np.array([time]), small.height, 0.0)
                means.append(renderer.radiance(R, p, [self._movers(int(time))]).mean())
            return np.array(means) * self.scenario.light.at(since_s)

        seconds = (self.end_ns - self.start_ns) * 1e-9
        return ExposureCourse(self.scenario.rig.exposure, brightness, seconds, self._random(_EXPOSURE_STREAM, 0))

    def stamp_ns(self, index: int) -> int:
        """The middle of the exposure of the middle row of the images `index` [ns].

        Raises:
            InputError: no such image.
        """
        if not 0 <= index < self.image_count:
            raise InputError(f"an image from 0 to {self.image_count - 1}", f"{index}", "see CameraSimulation.image_count")
        return self.start_ns + _FIRST_IMAGE_NS + index * self._period_ns

    def exposure(self, index: int) -> tuple[float, float]:
        """How long the shutter is open for images `index` [s], and the gain."""
        return self._exposures.at((self.stamp_ns(index) - self.start_ns) * 1e-9)

    def T_world_camera(self, camera: int, time_ns: ArrayLike) -> Floats:
        """(N, 4, 4) exact poses of a camera at `time_ns` (N,) int64 [ns]."""
        motion = self.ground_truth(time_ns)
        T = np.tile(np.eye(4), (len(motion.p_world_imu), 1, 1))
        T[:, :3, :3], T[:, :3, 3] = motion.R_world_imu, motion.p_world_imu
        poses: Floats = T @ self.scenario.rig.cameras[camera].mounting
        return poses

    def row_times_ns(self, camera: int, index: int) -> NDArray[np.int64]:
        """When the middle of the exposure of each row (H,) of an image is [ns]."""
        sensor = self.scenario.rig.cameras[camera].sensor
        return self.stamp_ns(index) + _row_delays_ns(sensor.height, sensor.line_delay_s)

    def _row_poses(self, camera: int, time_ns: NDArray[np.int64], height: int, line_delay_s: float) -> tuple[Floats, Floats]:
        """Poses (N, H, 3, 3), (N, H, 3) of all rows at N instants of their exposure."""
        delays = _row_delays_ns(height, line_delay_s) if line_delay_s else np.zeros(1, np.int64)
        times = np.clip(time_ns[:, None] + delays, self.start_ns, self.scenario.trajectory.end_ns)
        T = self.T_world_camera(camera, times.ravel()).reshape(*times.shape, 4, 4)
        shape = (len(time_ns), height)
        return np.broadcast_to(T[..., :3, :3], (*shape, 3, 3)), np.broadcast_to(T[..., :3, 3], (*shape, 3))

    def _movers(self, time_ns: int) -> Sequence[Solid]:
        if self.scenario.movers is None:
            return ()
        motion = self.ground_truth([time_ns])
        return self.scenario.movers((time_ns - self.start_ns) * 1e-9, motion.R_world_imu[0], motion.p_world_imu[0])

    def exact_image(self, camera: int, index: int) -> NDArray[np.float32]:
        """Grey values (H, W) before noise, rounding and clipping: what the noise of `image` is laid on.

        Raises:
            InputError: no such image.
        """
        sensor = self.scenario.rig.cameras[camera].sensor
        stamp_ns = self.stamp_ns(index)
        exposure_s, gain = self.exposure(index)
        instants = stamp_ns + self._instants_ns(stamp_ns, exposure_s, sensor.lens.intrinsics[0], sensor.blur_samples)
        R, p = self._row_poses(camera, instants, sensor.height, sensor.line_delay_s)
        radiance = self._renderers[camera].radiance(R, p, [self._movers(int(time)) for time in instants])
        light = float(self.scenario.light.at(np.array([(stamp_ns - self.start_ns) * 1e-9]))[0])
        grey = radiance * np.float32(GREY_PER_LIGHT_SECOND * exposure_s * gain * light)
        return grey * _vignette(sensor.width, sensor.height, sensor.vignetting)

    def _instants_ns(self, stamp_ns: int, exposure_s: float, focal_px: float, most: int) -> NDArray[np.int64]:
        """The instants an image is the mean of, about the middle of its exposure: as many as its motion blur asks for."""
        motion = self.ground_truth([stamp_ns])
        rate = np.linalg.norm(motion.omega_imu[0]) + np.linalg.norm(motion.v_world_imu[0]) / _BLUR_NEAR_M
        count = int(np.clip(np.ceil(_STEPS_A_PIXEL * rate * exposure_s * focal_px), 1, most))
        shares = (np.arange(count) + 0.5) / count - 0.5
        return np.rint(shares * exposure_s * 1e9).astype(np.int64)

    def image(self, camera: int, index: int) -> CameraImage:
        """Image `index` of a camera, (H, W) uint8.

        Raises:
            InputError: no such image.
        """
        sensor = self.scenario.rig.cameras[camera].sensor
        grey = self.exact_image(camera, index)
        exposure_s, gain = self.exposure(index)
        if sensor.noise:
            electrons = ELECTRONS_PER_GREY / gain
            sigma = sensor.noise * np.sqrt(np.maximum(grey, 0.0) / electrons + (sensor.read_noise / electrons) ** 2)
            noise = self._random(_NOISE_STREAM, camera, index).standard_normal(grey.shape, np.float32)
            grey = (grey + sigma * noise).astype(np.float32)
        pixels = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
        return CameraImage(camera, self.names[camera], self.stamp_ns(index), pixels, exposure_s)

    def depth(self, camera: int, index: int) -> Floats:
        """Exact depths (H, W) along the optical axis at the pixels' centres [m], infinite where there is nothing.

        Of a rolling shutter, every row is seen from its own pose.

        Raises:
            InputError: no such image.
        """
        sensor = self.scenario.rig.cameras[camera].sensor
        stamp_ns = self.stamp_ns(index)
        R, p = self._row_poses(camera, np.array([stamp_ns]), sensor.height, sensor.line_delay_s)
        return self._renderers[camera].depth(R[0], p[0], self._movers(stamp_ns))

    def depth_image(self, index: int) -> CameraImage:
        """Depths of the first camera as a stream delivers them, float32 [m], zero where there is nothing."""
        depth = self.depth(0, index)
        pixels = np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)
        return CameraImage(len(self.names) - 1, DEPTH, self.stamp_ns(index), pixels, None, 1.0)

    def events(self) -> Iterator[CameraEvent]:
        """Blocks of IMU samples and images in the order of time, as `CameraRecording` delivers them."""
        reached_ns = self.start_ns - 1
        for index in range(self.image_count):
            stamp_ns = self.stamp_ns(index)
            yield self.imu.samples(reached_ns, stamp_ns, index)
            for camera in range(len(self.scenario.rig.cameras)):
                yield self.image(camera, index)
            if self.scenario.rig.depth:
                yield self.depth_image(index)
            reached_ns = stamp_ns
        yield self.imu.samples(reached_ns, self.end_ns, self.image_count)

    def __iter__(self) -> Iterator[CameraEvent]:
        return self.events()

    def ground_truth(self, time_ns: ArrayLike) -> Motion:
        """Exact pose, velocity, acceleration and angular velocity of the body at `time_ns` (N,) int64 [ns]."""
        return self.scenario.trajectory.evaluate(time_ns)


def _row_delays_ns(height: int, line_delay_s: float) -> NDArray[np.int64]:
    """When each row is exposed after the middle one [ns]."""
    delays: NDArray[np.int64] = np.rint((np.arange(height) - 0.5 * (height - 1)) * line_delay_s * 1e9).astype(np.int64)
    return delays


@functools.lru_cache(maxsize=8)
def _vignette(width: int, height: int, missing: float) -> NDArray[np.float32]:
    v, u = np.mgrid[0:height, 0:width]
    middle = 0.5 * np.array([height - 1, width - 1])
    share = ((v - middle[0]) ** 2 + (u - middle[1]) ** 2) / (middle**2).sum()
    seen: NDArray[np.float32] = (1.0 - missing * share).astype(np.float32)
    return seen


def simulate_cameras(
    scenario: str | CameraScenario = "room",
    seed: int = 0,
    *,
    duration_s: float | None = None,
    rig: CameraRig | None = None,
) -> CameraSimulation:
    """Simulate a recording of cameras and IMU.

    Args:
        scenario: name of a built-in scenario (`CAMERA_SCENARIOS`, or one of the LiDAR), or one of your own.
        seed: of the noise, the pictures on the surfaces, and of a built-in scenario's world and motion.
        duration_s: only the first seconds; all of the motion when not given.
        rig: other cameras than the scenario's, for example of `make_rig`.

    Raises:
        InputError: no such scenario, a duration longer than the motion.

    Example:
        >>> from boxplus.simulation.cameras import make_rig, simulate_cameras
        >>> simulation = simulate_cameras("room", seed=3, rig=make_rig("mono", scale=0.25), duration_s=1.0)
        >>> simulation.image(0, 5).shape, simulation.depth(0, 5).shape
        ((120, 188), (120, 188))
    """
    from dataclasses import replace

    chosen = make_camera_scenario(scenario, seed) if isinstance(scenario, str) else scenario
    return CameraSimulation(chosen if rig is None else replace(chosen, rig=rig), seed, duration_s)
