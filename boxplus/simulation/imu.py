"""A model of an IMU: white noise, wandering biases, saturation."""

from __future__ import annotations

from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from boxplus._settings import Settings
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.simulation.motions.spline import Motion, Trajectory

GRAVITY = 9.81
"""Free fall in simulated worlds [m/s²], along −z."""

_IMU_STREAM, _BIAS_STREAM, _VIBRATION_STREAM = 2, 3, 4
_BIAS_STEP_S = 0.1
_PHASE_STEP_S = 0.02
_PHASE_STEP_RAD = 0.5
_HARMONICS = np.array([1.0, 2.0, 3.0])
_WEIGHTS = np.array([0.8, 0.5, 0.33166247903554])  # squares add up to one


class ImuModel(Settings):
    """Errors of an IMU; the default is the ADIS16448 as characterised for the EuRoC recordings.

    A sample reads a_m = R_world_imuᵀ (a − g) + b_a + n_a and ω_m = ω + b_w + n_w (docs/conventions.md), and is clipped at the
    limits of the sensor. White noise of density σ has standard deviation σ √rate a sample.
    """

    rate_hz: float = Field(200.0, gt=0, description="samples per second")
    gyro_noise_density: float = Field(1.7e-4, ge=0, description="[rad/s/√Hz]")
    accel_noise_density: float = Field(2.0e-3, ge=0, description="[m/s²/√Hz]")
    gyro_bias_walk: float = Field(1.9e-5, ge=0, description="[rad/s²/√Hz]")
    accel_bias_walk: float = Field(3.0e-3, ge=0, description="[m/s³/√Hz]")
    gyro_bias: tuple[float, float, float] = Field((-0.003, 0.012, 0.008), description="at the first instant [rad/s]")
    accel_bias: tuple[float, float, float] = Field((0.03, -0.04, 0.05), description="at the first instant [m/s²]")
    gyro_max: float = Field(35.0, gt=0, description="largest rate about an axis [rad/s]")
    accel_max: float = Field(176.0, gt=0, description="largest specific force along an axis [m/s²]")
    accel_vibration: float = Field(0.0, ge=0, description="standard deviation of motor vibration along an axis [m/s²]")
    gyro_vibration: float = Field(0.0, ge=0, description="the same about an axis [rad/s]")
    vibration_hz: float = Field(70.0, gt=0, description="turns of the motors per second; twice and three times as well")

    def noise_free(self) -> Self:
        """The same sensor without noise and biases."""
        zero = (0.0, 0.0, 0.0)
        return self.model_copy(
            update={
                "gyro_noise_density": 0.0,
                "accel_noise_density": 0.0,
                "gyro_bias_walk": 0.0,
                "accel_bias_walk": 0.0,
                "gyro_bias": zero,
                "accel_bias": zero,
                "accel_vibration": 0.0,
                "gyro_vibration": 0.0,
            }
        )


class BiasWalk:
    """Brownian motion of the six biases, drawn every 0.1 s and linear in between.

    Args:
        imu: initial biases and densities of the walk.
        duration_s: length [s].
        random: source of the steps.
    """

    def __init__(self, imu: ImuModel, duration_s: float, random: np.random.Generator) -> None:
        count = int(np.ceil(duration_s / _BIAS_STEP_S)) + 1
        density = np.repeat([imu.gyro_bias_walk, imu.accel_bias_walk], 3)
        steps = random.standard_normal((count, 6)) * density * np.sqrt(_BIAS_STEP_S)
        steps[0] = [*imu.gyro_bias, *imu.accel_bias]
        self._time = np.arange(count) * _BIAS_STEP_S
        self._values = np.cumsum(steps, axis=0)

    def at(self, offset_s: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Gyro [rad/s] and accelerometer [m/s²] biases (N, 3) at `offset_s` (N,) after the first instant [s]."""
        columns = [np.interp(np.asarray(offset_s, dtype=np.float64), self._time, column) for column in self._values.T]
        values = np.stack(columns, axis=-1)
        return values[..., :3], values[..., 3:]


class Vibration:
    """What motors add to the readings: a tone and its two harmonics on each axis, with wandering phases.

    At 70 Hz, 1 m/s² is 7 µm of motion; the pose does not follow it.

    Args:
        imu: strength and frequency.
        duration_s: length [s].
        random: source of the phases.
    """

    def __init__(self, imu: ImuModel, duration_s: float, random: np.random.Generator) -> None:
        count = int(np.ceil(duration_s / _PHASE_STEP_S)) + 1
        self._time = np.arange(count) * _PHASE_STEP_S
        self._wander = np.cumsum(random.standard_normal(count)) * _PHASE_STEP_RAD
        self._phase = random.uniform(0.0, 2.0 * np.pi, (3, 6))
        self._hz = imu.vibration_hz
        self._amplitude = np.sqrt(2.0) * np.repeat([imu.gyro_vibration, imu.accel_vibration], 3)

    def at(self, offset_s: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Parts of the gyro's [rad/s] and accelerometer's [m/s²] readings (N, 3) `offset_s` (N,) after the first instant [s]."""
        time = np.asarray(offset_s, dtype=np.float64)
        turned = 2.0 * np.pi * self._hz * time + np.interp(time, self._time, self._wander)
        tones = np.sin(turned[:, None, None] * _HARMONICS[:, None] + self._phase)
        values = self._amplitude * np.einsum("k,nkc->nc", _WEIGHTS, tones)
        return values[:, :3], values[:, 3:]


def measure(
    imu: ImuModel,
    motion: Motion,
    gyro_bias: NDArray[np.float64],
    accel_bias: NDArray[np.float64],
    random: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gyro [rad/s] and accelerometer [m/s²] readings (N, 3) of a motion at N instants, given the biases (N, 3) there."""
    specific_force_world = motion.a_world_imu + np.array([0.0, 0.0, GRAVITY])
    accel = np.einsum("nji,nj->ni", motion.R_world_imu, specific_force_world)
    noise = random.standard_normal((2, *accel.shape)) * np.sqrt(imu.rate_hz)
    gyro = motion.omega_imu + gyro_bias + imu.gyro_noise_density * noise[0]
    accel = accel + accel_bias + imu.accel_noise_density * noise[1]
    return np.clip(gyro, -imu.gyro_max, imu.gyro_max), np.clip(accel, -imu.accel_max, imu.accel_max)


class SimulatedImu:
    """An IMU on a moving body. The noise of every block of samples has a seed of its own, so any part can be computed alone.

    Args:
        imu: the sensor.
        trajectory: motion of the IMU.
        seed: of the noise.
        duration_s: from the beginning of the motion on [s].
    """

    def __init__(self, imu: ImuModel, trajectory: Trajectory, seed: int, duration_s: float) -> None:
        self._imu, self._trajectory, self._seed = imu, trajectory, seed
        self._period_ns = round(1e9 / imu.rate_hz)
        self._bias_walk = BiasWalk(imu, duration_s, self._random(_BIAS_STREAM, 0))
        self._vibration: Vibration | None = None
        if imu.accel_vibration or imu.gyro_vibration:
            self._vibration = Vibration(imu, duration_s, self._random(_VIBRATION_STREAM, 0))

    def _random(self, stream: int, index: int) -> np.random.Generator:
        return np.random.Generator(np.random.PCG64([self._seed, stream, index]))

    def samples(self, begin_ns: int, end_ns: int, block: int) -> ImuSamples:
        """The samples in (begin_ns, end_ns], with the noise of block `block`."""
        start_ns = self._trajectory.start_ns
        first = (begin_ns - start_ns) // self._period_ns + 1
        last = (end_ns - start_ns) // self._period_ns
        time_ns = start_ns + np.arange(first, last + 1, dtype=np.int64) * self._period_ns
        gyro_offset, accel_offset = self.biases(time_ns)
        if self._vibration is not None:
            gyro_shaken, accel_shaken = self._vibration.at((time_ns - start_ns) * 1e-9)
            gyro_offset, accel_offset = gyro_offset + gyro_shaken, accel_offset + accel_shaken
        motion = self._trajectory.evaluate(time_ns)
        gyro, accel = measure(self._imu, motion, gyro_offset, accel_offset, self._random(_IMU_STREAM, block))
        return ImuSamples.from_arrays(time_ns, gyro, accel)

    def biases(self, time_ns: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Exact gyro [rad/s] and accelerometer [m/s²] biases (N, 3) at `time_ns` (N,) int64 [ns]."""
        return self._bias_walk.at((np.atleast_1d(np.asarray(time_ns)) - self._trajectory.start_ns) * 1e-9)
