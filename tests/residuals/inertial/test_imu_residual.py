"""The IMU error: docs/residuals/imu_preintegration.md in NumPy, its Jacobians, and the scale of what is whitened."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import chi2

from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import InputError
from boxplus.manifolds import quaternion, so3
from boxplus.manifolds.body_pose import BodyPose
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.se3 import SE3
from boxplus.manifolds.sphere import S2
from boxplus.optimization.jacobian_check import check_jacobian
from boxplus.optimization.problem import Problem
from boxplus.residuals.camera.on_body import OnBody
from boxplus.residuals.camera.reprojection import Reprojection
from boxplus.residuals.inertial.imu import VELOCITY_BIAS, ImuPreintegration
from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.residuals.inertial.imu_preintegration import Preintegration
from boxplus.residuals.prior import Prior
from tests.residuals.inertial.imu_streams import random_stream

NOISE = ImuNoise(gyro=0.02, accel=0.1, gyro_walk=0.003, accel_walk=0.05)
GRAVITY = np.array([0.3, -0.2, -9.7])
CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


def preintegration(seed: int, count: int = 6) -> Preintegration:
    stream = random_stream(seed, 60)
    rng = np.random.default_rng(seed)
    begin = stream[0][0] + rng.integers(0, 300_000_000, count)
    return Preintegration.integrate(
        *stream,
        noise=NOISE,
        intervals_ns=np.stack([begin, begin + rng.integers(150_000_000, 400_000_000, count)], axis=1),
        bias_accel=rng.normal(size=(count, 3)) * 0.2,
        bias_gyro=rng.normal(size=(count, 3)) * 0.1,
    )


def random_states(seed: int, count: int = 6) -> list[NDArray[np.float64]]:
    """Poses anywhere, velocities and biases that have nothing to do with the samples: far from zero residual."""
    rng = np.random.default_rng(seed + 1)
    return [
        BodyPose.random(rng, count),
        VELOCITY_BIAS.random(rng, count) * np.repeat([2.0, 0.3, 0.1], 3),
        BodyPose.random(rng, count),
        VELOCITY_BIAS.random(rng, count) * np.repeat([2.0, 0.3, 0.1], 3),
    ]


@pytest.mark.parametrize("rotation", ["log", "vector"])
@given(seed=st.integers(0, 10_000))
@settings(max_examples=8)
def test_jacobians(rotation: str, seed: int) -> None:
    residual = ImuPreintegration(preintegration(seed), gravity=GRAVITY, rotation=rotation)  # type: ignore[arg-type]
    for manifolds in (residual.manifolds, (SE3, VELOCITY_BIAS, SE3, VELOCITY_BIAS)):
        report = check_jacobian(residual, *random_states(seed), manifolds=manifolds)
        assert report.passed and report.invalid == report.unsteady == 0 and report.largest_residual > 0.5, str(report)


@pytest.mark.parametrize(("gravity_direction", "time_offset"), [(True, False), (False, True), (True, True)])
@given(seed=st.integers(0, 10_000))
@settings(max_examples=6)
def test_jacobians_with_gravity_and_time_offset(gravity_direction: bool, time_offset: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    residual = ImuPreintegration(
        preintegration(seed), gravity=GRAVITY, gravity_direction=gravity_direction, time_offset=time_offset, time_offset_s=-0.01
    )
    more = [S2.random(rng, 6)] * gravity_direction + [rng.uniform(-0.05, 0.05, (6, 1))] * time_offset
    assert residual.roles[4:] == ("gravity_direction",) * gravity_direction + ("imu_time_offset",) * time_offset
    report = check_jacobian(residual, *random_states(seed), *more)
    assert report.passed and report.invalid == report.unsteady == 0 and report.largest_residual > 0.5, str(report)
    plain = ImuPreintegration(preintegration(seed), gravity=GRAVITY)
    at = [GRAVITY / np.linalg.norm(GRAVITY)] * gravity_direction + [np.array([-0.01])] * time_offset
    x = random_states(seed)
    np.testing.assert_allclose(residual.evaluate(*x, *at), plain.evaluate(*x), atol=1e-13)


def smooth_stream(step_ns: int) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    time_ns = np.arange(0, 1_000_000_001, step_ns, dtype=np.int64)
    s = time_ns * 1e-9
    gyro = np.stack([np.sin(3.0 * s), 0.8 * np.cos(2.0 * s), 0.5 * np.sin(4.0 * s + 1.0)], axis=1)
    return time_ns, gyro, np.stack([2.0 * np.sin(3.0 * s), np.cos(5.0 * s), 9.8 + np.sin(4.0 * s)], axis=1)


def test_intervals_that_move_in_time() -> None:
    """The derivative by time against shifted integration: right but for the midpoint rule's own error, of second order."""
    errors = []
    for step_ns in (8_000_000, 4_000_000):
        p = Preintegration.integrate(
            *smooth_stream(step_ns), noise=NOISE, intervals_ns=[[200_000_000, 500_000_000], [402_000_000, 801_000_000]],
            bias_accel=[0.1, -0.2, 0.3], bias_gyro=[0.02, 0.01, -0.03],
        )  # fmt: skip
        h = 16_000_000
        ahead, back = p.shifted(h), p.shifted(-h)
        further, before = p.shifted(2 * h), p.shifted(-2 * h)
        R = quaternion.to_matrix(p.gamma_wxyz)
        values = [
            np.hstack([q.alpha, so3.boxminus(quaternion.to_matrix(q.gamma_wxyz), R), q.beta])
            for q in (ahead, back, further, before)
        ]
        numeric = (8 * (values[0] - values[1]) - (values[2] - values[3])) / (12 * h * 1e-9)
        errors.append(np.abs(p.time_jacobian - numeric).max())
    assert errors[0] < 1e-3 and errors[1] < 0.3 * errors[0]
    assert np.abs(p.time_jacobian).max() > 1.0


def test_the_time_offset_of_a_flight_is_found() -> None:
    """Poses that are stamped 8 ms early, by the clock of the IMU: found to 20 µs, intervals cut anew on the way."""
    stream, t_d = smooth_stream(2_000_000), 0.008
    stamps = np.arange(100_000_000, 900_000_001, 100_000_000)
    at = np.column_stack([stamps[:-1], stamps[1:]])
    rng = np.random.default_rng(0)
    truth = Preintegration.integrate(*stream, noise=NOISE, intervals_ns=at + round(t_d * 1e9))
    pose, state = BodyPose.random(rng, 1), np.array([[1.0, -0.5, 0.2, *np.zeros(6)]])
    poses, states = [pose[0]], [state[0]]
    for k in range(len(at)):
        pose_j, state_j = truth[k].predict(poses[-1], states[-1], GRAVITY)
        poses.append(pose_j[0])
        states.append(state_j[0])
    imu = ImuPreintegration(
        Preintegration.integrate(*stream, noise=NOISE, intervals_ns=at),
        gravity=-GRAVITY,
        gravity_direction=True,
        time_offset=True,
    )
    problem = Problem()
    T, s = problem.add_variables(BodyPose, np.array(poses)), problem.add_variables(VELOCITY_BIAS, np.array(states))
    g, offset = problem.add_variables(S2, [0.0, 0.0, -1.0]), problem.add_variables(Euclidean(1), [0.0])
    problem.add_residuals(imu, T[:-1], s[:-1], T[1:], s[1:], g, offset)
    problem.fix(T)
    problem.add_residuals(Prior(VELOCITY_BIAS, np.array(states), sigma=np.repeat([100.0, 1e-6], [3, 6])), s)
    solution = problem.solve()
    assert imu.refresh(solution[s][:-1], solution[offset][0, 0]) == len(at)
    assert imu.time_offset_s == pytest.approx(t_d, abs=1e-3)
    solution = problem.solve()
    assert imu.refresh(solution[s][:-1], solution[offset][0, 0]) == 0
    assert solution[offset][0, 0] == pytest.approx(t_d, abs=2e-5)
    np.testing.assert_allclose(solution[g][0], GRAVITY / np.linalg.norm(GRAVITY), atol=1e-4)


def test_one_offset_is_not_counted_twice() -> None:
    problem = Problem()
    T, s = (
        problem.add_variables(BodyPose, BodyPose.random(np.random.default_rng(0), 2)),
        problem.add_variables(VELOCITY_BIAS, np.zeros((2, 9))),
    )
    p, offset = problem.add_variables(Euclidean(3), [0.0, 0.0, 5.0]), problem.add_variables(Euclidean(1), [0.0], name="offset")
    seen = OnBody(Reprojection(Pinhole(400.0, 400.0, 320.0, 240.0), [[1.0, 2.0]]), image_velocity=[[3.0, 4.0]])
    mounting = problem.add_variables(BodyPose, BodyPose.identity())
    problem.add_residuals(seen, T[[0]], mounting, p, offset)
    imu = ImuPreintegration(preintegration(1, 1), time_offset=True)
    with pytest.raises(
        InputError, match=r"imu_time_offset of ImuPreintegration, one by which the IMU is brought .* got 'offset'"
    ):
        problem.add_residuals(imu, T[[0]], s[[0]], T[[1]], s[[1]], offset)


@pytest.mark.parametrize("rotation", ["log", "vector"])
def test_residual_is_the_formula(rotation: str) -> None:
    p = preintegration(3)
    (pose_i, state_i, pose_j, state_j) = x = random_states(3)
    found = ImuPreintegration(p, gravity=GRAVITY, rotation=rotation).evaluate(*x)  # type: ignore[arg-type]
    alpha, gamma, beta = p.corrected(state_i[:, 3:6], state_i[:, 6:])
    Rt = quaternion.to_matrix(pose_i[:, :4]).swapaxes(1, 2)
    T = p.duration_s[:, None]
    up = -GRAVITY
    moved = pose_j[:, 4:] - pose_i[:, 4:] - state_i[:, :3] * T + 0.5 * up * T**2
    q = quaternion.multiply(pose_i[:, :4] * CONJUGATE, pose_j[:, :4])
    E = quaternion.multiply(gamma * CONJUGATE, q)
    E *= np.where(E[:, :1] < 0.0, -1.0, 1.0)
    turned = 2.0 * E[:, 1:] if rotation == "vector" else so3.log(quaternion.to_matrix(E))
    np.testing.assert_allclose(found[:, 0:3], np.einsum("nij,nj->ni", Rt, moved) - alpha, atol=1e-12)
    np.testing.assert_allclose(found[:, 3:6], turned, atol=1e-12)
    faster = state_j[:, :3] - state_i[:, :3] + up * T
    np.testing.assert_allclose(found[:, 6:9], np.einsum("nij,nj->ni", Rt, faster) - beta, atol=1e-12)
    np.testing.assert_allclose(found[:, 9:], state_j[:, 3:] - state_i[:, 3:], atol=1e-15)


@given(st.integers(0, 1000))
@settings(max_examples=10)
def test_predicted_states_have_no_error(seed: int) -> None:
    p = preintegration(seed)
    pose_i, state_i, _, _ = random_states(seed)
    pose_j, state_j = p.predict(pose_i, state_i, GRAVITY)
    for rotation in ("log", "vector"):
        residual = ImuPreintegration(p, gravity=GRAVITY, rotation=rotation)  # type: ignore[arg-type]
        assert np.abs(residual.evaluate(pose_i, state_i, pose_j, state_j)).max() < 1e-13
    # q and −q are the same rotation.
    pose_j[:, :4] *= -1.0
    assert np.abs(residual.evaluate(pose_i, state_i, pose_j, state_j)).max() < 1e-13


def test_two_exyz_is_log_for_small_errors_and_saturates() -> None:
    p = preintegration(5)
    pose_i, state_i, _, _ = random_states(5)
    pose_j, state_j = p.predict(pose_i, state_i)
    for angle, largest in ((1e-3, 1e-9), (2.0, 0.4)):
        delta = np.zeros(6)
        delta[0] = angle
        x = pose_i, state_i, BodyPose.boxplus(pose_j, delta), state_j
        log, vector = (ImuPreintegration(p, rotation=name).evaluate(*x)[:, 3] for name in ("log", "vector"))  # type: ignore[arg-type]
        np.testing.assert_allclose(log, angle, atol=1e-12)
        np.testing.assert_allclose(vector, 2.0 * np.sin(0.5 * angle), atol=1e-12)
        assert (np.abs(log - vector) < largest).all()


def test_whitened_residual_has_the_right_scale() -> None:
    """Simulated noise, shared between neighbouring steps as it is: squared whitened errors are χ² with 15 degrees of freedom."""
    intervals, steps, dt = 600, 100, 0.005
    rng = np.random.default_rng(0)
    count = intervals * steps + 1
    time_ns = np.arange(count, dtype=np.int64) * 5_000_000
    s = np.arange(count) * dt
    gyro = np.stack([np.sin(1.3 * s), 0.8 * np.cos(0.7 * s), 0.5 * np.sin(2.1 * s + 1.0)], axis=1)
    accel = np.stack([2.0 * np.sin(0.9 * s), np.cos(1.7 * s), 9.8 + np.sin(s)], axis=1)
    noise = ImuNoise(gyro=2e-3, accel=2e-2, gyro_walk=1e-3, accel_walk=1e-2)
    bias_gyro = np.cumsum(rng.normal(size=(count, 3)) * noise.gyro_walk * np.sqrt(dt), axis=0)
    bias_accel = np.cumsum(rng.normal(size=(count, 3)) * noise.accel_walk * np.sqrt(dt), axis=0)
    measured_gyro = gyro + bias_gyro + rng.normal(size=(count, 3)) * noise.gyro / np.sqrt(dt)
    measured_accel = accel + bias_accel + rng.normal(size=(count, 3)) * noise.accel / np.sqrt(dt)
    begin, end = np.arange(0, count - 1, steps), np.arange(steps, count, steps)
    times = np.stack([time_ns[begin], time_ns[end]], axis=1)
    truth = Preintegration.integrate(time_ns, gyro, accel, noise=noise, intervals_ns=times)
    pose_i, v_i = BodyPose.random(rng, intervals), rng.normal(size=(intervals, 3))
    pose_j, state_j = truth.predict(pose_i, np.hstack([v_i, np.zeros((intervals, 6))]))
    nees = {}
    for mode in ("merged", "independent"):
        measured = Preintegration.integrate(
            time_ns, measured_gyro, measured_accel, noise=noise, intervals_ns=times,
            bias_accel=bias_accel[begin], bias_gyro=bias_gyro[begin], mode=mode,  # type: ignore[arg-type]
        )  # fmt: skip
        residual = ImuPreintegration(measured)
        e = residual.evaluate(
            pose_i,
            np.hstack([v_i, bias_accel[begin], bias_gyro[begin]]),
            pose_j,
            np.hstack([state_j[:, :3], bias_accel[end], bias_gyro[end]]),
        )
        whitened = np.einsum("nij,nj->ni", residual.whitening.factors, e)
        nees[mode] = (whitened**2).sum() / intervals
    low, high = chi2.ppf([0.025, 0.975], 15 * intervals) / intervals
    assert low < nees["merged"] < high
    assert nees["independent"] > 1.4 * high  # variances of half the size in nine of fifteen rows


def test_refresh_integrates_anew_what_moved() -> None:
    p = preintegration(7)
    residual = ImuPreintegration(p)
    state = np.hstack([np.zeros((6, 3)), p.bias_accel, p.bias_gyro])
    assert residual.refresh(state) == 0 and residual.preintegration is p
    state[2, 3] += 0.2
    state[4, 8] -= 0.02
    assert residual.refresh(state) == 2
    expected = p.reintegrated(state[:, 3:6], state[:, 6:])
    assert np.array_equal(residual.preintegration.alpha, expected.alpha)
    assert np.array_equal(residual.whitening.factors, ImuPreintegration(expected).whitening.factors)
    x = random_states(7)
    assert np.array_equal(residual.evaluate(*x), ImuPreintegration(expected).evaluate(*x))


def test_refusals() -> None:
    stream = random_stream(9, 5)
    single = Preintegration.integrate(*stream, noise=NOISE, intervals_ns=(stream[0][1], stream[0][2]))
    with pytest.raises(InputError, match="at least two steps between IMU samples in every interval – got 1 in interval 0"):
        ImuPreintegration(single)
    p = preintegration(1)
    with pytest.raises(InputError, match="gravity as three finite numbers"):
        ImuPreintegration(p, gravity=9.81)
    with pytest.raises(InputError, match=r"velocity_bias_i of shape \(9,\) or \(6, 9\) – got shape \(5, 9\)"):
        ImuPreintegration(p).refresh(np.zeros((5, 9)))
    with pytest.raises(InputError, match="pose_i of shape"):
        p.predict(np.eye(4), np.zeros(9))
    with pytest.raises(InputError, match="gravity with a magnitude where its direction is a variable – got zero"):
        ImuPreintegration(p, gravity=(0.0, 0.0, 0.0), gravity_direction=True)
    with pytest.raises(InputError, match="time_offset_s finite"):
        ImuPreintegration(p, time_offset=True, time_offset_s=np.nan)
    with pytest.raises(InputError, match="no time_offset_s where it is no variable"):
        ImuPreintegration(p).refresh(np.zeros(9), 0.1)
    with pytest.raises(InputError, match='rotation "log" or "vector"'):
        ImuPreintegration(p, rotation="euler")  # type: ignore[arg-type]


def test_biases_and_velocities_of_a_flight_from_its_poses(shared_data: Path) -> None:
    """20 s of EuRoC: poses known to 5 mm and 0.1°, everything else from the IMU, biases from zero with one re-integration."""
    folder = shared_data / "imu"
    time_ns = np.loadtxt(folder / "V1_03_difficult.imu.csv", delimiter=",", usecols=0, dtype=np.int64)
    samples = np.loadtxt(folder / "V1_03_difficult.imu.csv", delimiter=",")[:, 1:]
    truth_ns = np.loadtxt(folder / "V1_03_difficult.gt.csv", delimiter=",", usecols=0, dtype=np.int64)
    chosen = np.arange(2000, 6000, 40)
    times, truth = truth_ns[chosen], np.loadtxt(folder / "V1_03_difficult.gt.csv", delimiter=",")[chosen, 1:]
    measured = BodyPose.check("truth", truth[:, [3, 4, 5, 6, 0, 1, 2]])
    imu = ImuPreintegration(
        Preintegration.integrate(
            time_ns,
            samples[:, :3],
            samples[:, 3:],
            noise=ImuNoise(gyro=1.7e-4, accel=2e-3, gyro_walk=1.9e-5, accel_walk=3e-3),
            intervals_ns=np.stack([times[:-1], times[1:]], axis=1),
        )
    )
    problem = Problem()
    poses = problem.add_variables(BodyPose, measured)
    states = problem.add_variables(VELOCITY_BIAS, np.zeros((len(times), 9)))
    problem.add_residuals(imu, poses[:-1], states[:-1], poses[1:], states[1:])
    problem.add_residuals(Prior(BodyPose, measured, sigma=np.repeat([2e-3, 5e-3], 3)), poses)
    first = problem.solve()
    assert imu.refresh(first[states][:-1]) > 0
    found = problem.solve()
    state = found[states]
    assert imu.refresh(state[:-1]) == 0
    assert np.linalg.norm(state[:, :3] - truth[:, 7:10], axis=1).mean() < 0.03
    assert np.abs(state[:, 6:] - truth[:, 10:13]).mean() < 1e-3
    assert np.abs(state[:, 3:6] - truth[:, 13:16]).mean() < 0.05
