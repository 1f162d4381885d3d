"""The IMU: integration gives the motion back, noise has the declared density, biases wander, limits hold."""

from __future__ import annotations

import numpy as np

from boxplus.manifolds import so3
from boxplus.simulation import ImuModel, Simulation
from boxplus.simulation.imu import GRAVITY, BiasWalk
from boxplus.simulation.motions import trajectories
from boxplus.simulation.scenarios import Scenario
from boxplus.simulation.worlds.worlds import room


def imu_only(trajectory: trajectories.SplineTrajectory, imu: ImuModel, seed: int = 0) -> Simulation:
    return Simulation(Scenario("test", room(), trajectory, imu=imu), seed)


def test_integrating_the_noise_free_imu_reproduces_the_motion() -> None:
    simulation = imu_only(trajectories.fast(6.0), ImuModel(rate_hz=1000.0).noise_free())
    begin, end = simulation.start_ns + 3_000_000_000, simulation.start_ns + 4_500_000_000
    samples = simulation.imu_samples(begin - 1, end, 0)
    truth = simulation.ground_truth(samples.time_ns)
    R, p, v = truth.R_world_imu[0], truth.p_world_imu[0], truth.v_world_imu[0]
    dt = 1e-3
    turns = so3.exp(0.5 * (samples.gyro[1:] + samples.gyro[:-1]) * dt)
    gravity = np.array([0.0, 0.0, -GRAVITY])
    for i, turn in enumerate(turns):
        next_R = R @ turn
        a = 0.5 * (R @ samples.accel[i] + next_R @ samples.accel[i + 1]) + gravity
        p, v, R = p + v * dt + 0.5 * a * dt * dt, v + a * dt, next_R
    assert np.linalg.norm(truth.v_world_imu[-1]) > 3.0
    np.testing.assert_allclose(p, truth.p_world_imu[-1], atol=1e-4)
    np.testing.assert_allclose(v, truth.v_world_imu[-1], atol=1e-4)
    assert np.linalg.norm(so3.boxminus(R, truth.R_world_imu[-1])) < 1e-5


def test_at_rest_it_reads_gravity_upwards() -> None:
    simulation = imu_only(trajectories.at_rest(1.0), ImuModel().noise_free())
    samples = simulation.imu_samples(simulation.start_ns - 1, simulation.end_ns, 0)
    assert len(samples) == 201
    np.testing.assert_allclose(samples.accel, [[0.0, 0.0, GRAVITY]] * 201, atol=1e-12)
    np.testing.assert_allclose(samples.gyro, 0.0, atol=1e-12)


def test_white_noise_has_the_declared_density() -> None:
    imu = ImuModel(gyro_bias_walk=0.0, accel_bias_walk=0.0)
    simulation = imu_only(trajectories.at_rest(100.0), imu)
    samples = simulation.imu_samples(simulation.start_ns, simulation.end_ns, 0)
    for values, density in ((samples.gyro, imu.gyro_noise_density), (samples.accel, imu.accel_noise_density)):
        assert np.abs(values.std(axis=0) / (density * np.sqrt(imu.rate_hz)) - 1.0).max() < 0.03
        # Allan deviation of white noise at τ is density / √τ.
        for tau in (0.1, 1.0):
            averages = values.reshape(-1, round(tau * imu.rate_hz), 3).mean(axis=1)
            allan = np.sqrt(0.5 * (np.diff(averages, axis=0) ** 2).mean())
            assert abs(allan / (density / np.sqrt(tau)) - 1.0) < 0.2


def test_biases_start_as_declared_and_walk_with_the_declared_density() -> None:
    imu = ImuModel()
    walk = BiasWalk(imu, 2000.0, np.random.default_rng(0))
    gyro, accel = walk.at(np.arange(0.0, 2000.0, 2.0))
    np.testing.assert_array_equal(gyro[0], imu.gyro_bias)
    np.testing.assert_array_equal(accel[0], imu.accel_bias)
    for values, density in ((gyro, imu.gyro_bias_walk), (accel, imu.accel_bias_walk)):
        assert abs(np.diff(values, axis=0).std() / (density * np.sqrt(2.0)) - 1.0) < 0.05


def test_measured_is_true_plus_bias_plus_noise() -> None:
    imu = ImuModel(gyro_noise_density=0.0, accel_noise_density=0.0)
    noisy = imu_only(trajectories.fast(5.0), imu)
    clean = imu_only(trajectories.fast(5.0), imu.noise_free())
    span = noisy.start_ns, noisy.start_ns + 4_000_000_000, 0
    a, b = noisy.imu_samples(*span), clean.imu_samples(*span)
    gyro_bias, accel_bias = noisy.biases(a.time_ns)
    np.testing.assert_allclose(a.gyro - b.gyro, gyro_bias, atol=1e-12)
    np.testing.assert_allclose(a.accel - b.accel, accel_bias, atol=1e-12)


def test_saturation() -> None:
    simulation = imu_only(trajectories.flips(1), ImuModel(gyro_max=10.0, accel_max=9.0))
    samples = simulation.imu_samples(simulation.start_ns, simulation.end_ns, 0)
    assert np.abs(samples.gyro).max() == 10.0
    assert np.abs(samples.accel).max() == 9.0


def test_motors_shake_the_readings_but_not_the_pose() -> None:
    quiet = ImuModel(rate_hz=400.0).noise_free()
    shaken = quiet.model_copy(update={"accel_vibration": 1.0, "gyro_vibration": 0.02})
    simulation = imu_only(trajectories.at_rest(20.0), shaken)
    samples = simulation.imu_samples(simulation.start_ns, simulation.end_ns, 0)
    np.testing.assert_allclose(samples.accel.std(axis=0), 1.0, rtol=0.05)
    np.testing.assert_allclose(samples.gyro.std(axis=0), 0.02, rtol=0.05)
    np.testing.assert_allclose(samples.accel.mean(axis=0), [0.0, 0.0, GRAVITY], atol=0.05)
    part = simulation.imu_samples(simulation.start_ns + 10_000_000_000, simulation.end_ns, 7)
    np.testing.assert_allclose(part.accel, samples.accel[-len(part) :], atol=1e-12)
    assert shaken.noise_free() == quiet
