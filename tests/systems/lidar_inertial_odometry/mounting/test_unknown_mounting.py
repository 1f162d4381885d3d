"""A mounting that is off turns and shifts the path as its Jacobian says, and the covariance covers it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.filtering.degeneracy import PoseDirections
from boxplus.filtering.iterated_update import Information, iterated_update
from boxplus.filtering.nav_state import PL, RL, TANGENT, G, NavState, P, R
from boxplus.filtering.pose_covariance.map_datum import SHARED_ERRORS
from boxplus.manifolds import so3
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import ImuModel, Scenario, Simulation, SpinningLidar, mounting
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.worlds import worlds
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.mounted_update import less_sure
from boxplus.systems.lidar_inertial_odometry.mounting.unknown_mounting import (
    MOUNTING,
    HeldMounting,
    UnknownMounting,
    first_sensitivity,
    mounting_jacobian,
    mounting_known,
    moved_sensitivity,
    with_mounting,
)
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry


def transform(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation
    return T


def state(T_world_imu: np.ndarray, T_imu_lidar: np.ndarray) -> np.ndarray:
    made = NavState.identity(T_imu_lidar)
    x = made.pack()
    x[:9], x[9:12] = T_world_imu[:3, :3].ravel(), T_world_imu[:3, 3]
    return x


def drawn(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    T_world_first, T_world_imu, T_imu_lidar = (
        transform(so3.exp(random.normal(size=3)), scale * random.normal(size=3)) for scale in (3.0, 10.0, 0.3)
    )
    return T_world_first, T_world_imu, T_imu_lidar


@given(st.integers(0, 10_000))
def test_the_jacobian_is_that_of_the_path(seed: int) -> None:
    T_world_first, T_world_imu, T_imu_lidar = drawn(seed)
    A = np.linalg.inv(T_world_first) @ T_world_imu
    L = np.linalg.inv(T_imu_lidar) @ A @ T_imu_lidar

    def pose(delta: np.ndarray) -> np.ndarray:
        T = transform(T_imu_lidar[:3, :3] @ so3.exp(delta[:3]), T_imu_lidar[:3, 3] + delta[3:])
        moved = T_world_first @ T @ L @ np.linalg.inv(T)
        turned = so3.log(T_world_imu[:3, :3].T @ moved[:3, :3])
        return np.concatenate([turned, moved[:3, 3] - T_world_imu[:3, 3]])

    step = 1e-5
    numeric = np.stack([(pose(step * e) - pose(-step * e)) / (2.0 * step) for e in np.eye(6)], axis=1)
    analytic = mounting_jacobian(state(T_world_first, T_imu_lidar), state(T_world_imu, T_imu_lidar))
    assert np.allclose(analytic, numeric, atol=1e-6 * max(1.0, float(np.abs(numeric).max())))


def test_a_mounting_that_is_given_widens_nothing() -> None:
    T_world_first, T_world_imu, T_imu_lidar = drawn(0)
    known = UnknownMounting(state(T_world_first, T_imu_lidar), LioConfig())
    assert np.array_equal(known.widened(np.eye(6), state(T_world_imu, T_imu_lidar)), np.eye(6))


@pytest.mark.parametrize("distance", [1.0, 10.0])
def test_half_a_degree_turns_a_straight_path_by_half_a_degree(distance: float) -> None:
    config = LioConfig(extrinsic_estimation="gated", extrinsic_rotation_sigma_deg=0.5, extrinsic_translation_sigma=0.02)
    first, last = state(np.eye(4), np.eye(4)), state(transform(np.eye(3), np.array([distance, 0.0, 0.0])), np.eye(4))
    sigma = np.sqrt(np.diag(UnknownMounting(first, config).widened(np.zeros((6, 6)), last)))
    assert np.allclose(sigma, [0.0, 0.0, 0.0, 0.0, np.deg2rad(0.5) * distance, np.deg2rad(0.5) * distance])


def test_a_path_that_began_elsewhere_is_off_by_as_much_all_along() -> None:
    T_world_first, T_world_imu, T_imu_lidar = drawn(1)
    config = LioConfig(extrinsic_estimation="on", extrinsic_rotation_sigma_deg=1e-6, extrinsic_translation_sigma=1e-6)
    follows = UnknownMounting(state(T_world_first, T_imu_lidar), config)
    refined = T_imu_lidar.copy()
    refined[:3, 3] += [0.1, -0.2, 0.05]
    off = T_world_first[:3, :3] @ [0.1, -0.2, 0.05]
    wide = follows.widened(np.zeros((6, 6)), state(T_world_imu, refined))
    assert np.allclose(wide[3:, 3:], np.outer(off, off), atol=1e-9)
    assert np.allclose(wide[:3, :3], 0.0, atol=1e-9)


def _random_covariance(random: np.random.Generator) -> np.ndarray:
    root = 0.1 * random.normal(size=(TANGENT, TANGENT))
    return root @ root.T + 1e-3 * np.eye(TANGENT)


@given(st.integers(0, 10_000))
def test_a_covariance_is_taken_apart_and_put_together(seed: int) -> None:
    cov = _random_covariance(np.random.default_rng(seed))
    known, B = mounting_known(cov)
    assert np.allclose(with_mounting(known, B), cov)
    assert np.allclose(np.linalg.inv(known[:18, :18]), np.linalg.inv(cov)[:18, :18])  # the conditional covariance


@given(st.integers(0, 10_000))
def test_the_first_state_moves_with_the_mounting_so_that_the_lidar_stays(seed: int) -> None:
    T_world_first, _, T_imu_lidar = drawn(seed)
    x = state(T_world_first, T_imu_lidar)
    x[G : G + 3] = [0.3, -0.2, -9.8]
    for column, step in enumerate(1e-6 * np.eye(6)):
        moved = x.copy()
        change = 1e-6 * first_sensitivity(x)[:, column]
        moved[R : R + 9] = (x[R : R + 9].reshape(3, 3) @ so3.exp(change[:3])).ravel()
        moved[P : P + 3] += change[3:6]
        moved[G : G + 3] += change[15:18]
        moved[RL : RL + 9] = (x[RL : RL + 9].reshape(3, 3) @ so3.exp(step[:3])).ravel()
        moved[PL : PL + 3] += step[3:]
        before, after = NavState.unpack(x), NavState.unpack(moved)
        assert np.allclose(after.R_world_imu @ after.R_imu_lidar, before.R_world_imu @ before.R_imu_lidar, atol=1e-10)
        origin = np.zeros((1, 3), dtype=np.float32)
        assert np.allclose(after.to_world(origin), before.to_world(origin), atol=1e-10)
        assert np.allclose(after.R_world_imu.T @ after.gravity_world, before.R_world_imu.T @ before.gravity_world, atol=1e-9)


class _Linear:
    """A measurement H [θ, p, θ_L, p_L] of unit information, linear about a state; every direction of the pose is determined."""

    def __init__(self, x: np.ndarray, H: np.ndarray, z: np.ndarray) -> None:
        self._x, self._H, self._z = x, H, z

    def at(self, x: np.ndarray, *, rematch: bool) -> Information:
        del rematch
        moved = np.concatenate([
            so3.log(self._x[R : R + 9].reshape(3, 3).T @ x[R : R + 9].reshape(3, 3)),
            x[P : P + 3] - self._x[P : P + 3],
            so3.log(self._x[RL : RL + 9].reshape(3, 3).T @ x[RL : RL + 9].reshape(3, 3)),
            x[PL : PL + 3] - self._x[PL : PL + 3],
        ])  # fmt: skip
        directions = PoseDirections(np.full(6, np.inf), np.eye(6), 1.0, np.zeros(6, dtype=bool), np.eye(6))
        return Information(self._H.T @ self._H, self._H.T @ (self._z + self._H @ moved), np.zeros(12), directions, 100, 0.0)

    def has_moved(self, x: np.ndarray) -> bool:
        del x
        return False


@given(st.integers(0, 10_000))
def test_a_scan_not_asked_about_the_mounting_moves_the_state_as_for_any_mounting(seed: int) -> None:
    random = np.random.default_rng(seed)
    T_world_first, _, T_imu_lidar = drawn(seed)
    x, (known, B) = state(T_world_first, T_imu_lidar), mounting_known(_random_covariance(random))
    H, z = random.normal(size=(30, 12)), 1e-5 * random.normal(size=30)
    posteriors = []
    step = 1e-5 * random.normal(size=6)
    for change in (np.zeros(6), step):  # with the mounting as it is, and were it another one
        prior = x.copy()
        rest = B @ change
        prior[R : R + 9] = (x[R : R + 9].reshape(3, 3) @ so3.exp(rest[:3])).ravel()
        prior[P : P + 15] = x[P : P + 15] + rest[3:18]
        prior[RL : RL + 9] = (x[RL : RL + 9].reshape(3, 3) @ so3.exp(change[:3])).ravel()
        prior[PL : PL + 3] += change[3:]
        held = HeldMounting(_Linear(x, H, z))
        posterior = iterated_update(prior, known, held)
        assert np.array_equal(posterior.x[RL:], prior[RL:])
        posteriors.append(posterior)
    after = moved_sensitivity(B, known, posteriors[0].cov, held.last)
    shift = posteriors[1].x[P : P + 15] - posteriors[0].x[P : P + 15]
    assert np.allclose(shift, (after @ step)[3:], atol=1e-3 * np.abs(shift).max() + 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_lever_arm_that_nobody_knows_is_found_or_its_covariance_says_so(seed: int) -> None:
    random = np.random.default_rng(seed)
    T_imu_lidar = mounting(*random.uniform(-8.0, 8.0, 2), random.uniform(-180.0, 180.0), tuple(random.uniform(-0.3, 0.3, 3)))
    walk = manoeuvres.handheld(8.0, (-2.0, -1.5, 1.1), (2.0, 1.5, 2.2), 0.8, 1.2, 1.5, seed)
    lidar = SpinningLidar(channels=16, azimuth_steps=450)
    scenario = Scenario("room", worlds.room((10.0, 8.0, 3.5), seed), walk, lidar, ImuModel(), T_imu_lidar)
    simulation = Simulation(scenario, seed, 8.0)
    guess = T_imu_lidar.copy()
    guess[:3, 3] = 0.0
    config = LioConfig(
        T_imu_lidar=guess.tolist(),
        extrinsic_rotation_sigma_deg=0.3,
        extrinsic_translation_sigma=0.3,
        extrinsic_estimation="gated",
    )
    odometry = LidarInertialOdometry(config)
    estimates = []
    for event in simulation.events():
        estimates += odometry.push_scan(event) if isinstance(event, Scan) else odometry.push_imu(event)
    last = estimates[-1]
    off = last.state.p_imu_lidar - T_imu_lidar[:3, 3]
    covariance = last.covariance[21:, 21:]
    assert np.sqrt(np.diag(covariance)).max() < 0.02, "the motion shows it"
    assert off @ np.linalg.solve(covariance, off) < 16.3, "99.9 % of three degrees of freedom"


@given(st.integers(0, 10_000))
def test_what_a_scan_says_of_the_mounting_counts_less_than_as_much_as_its_points_promise(seed: int) -> None:
    random = np.random.default_rng(seed)
    before = _random_covariance(random)[MOUNTING, MOUNTING]
    H = random.normal(size=(4, 6))
    after = np.linalg.inv(np.linalg.inv(before) + H.T @ H)
    kept = less_sure(before, after)
    scale = np.sqrt(np.outer(before.diagonal(), before.diagonal()))
    for larger, smaller in ((before, kept), (kept, after)):
        assert np.linalg.eigvalsh((larger - smaller) / scale)[0] > -1e-9
    gained = [np.linalg.inv(cov) - np.linalg.inv(before) for cov in (kept, after)]
    np.testing.assert_allclose(SHARED_ERRORS * gained[0], gained[1], rtol=1e-5, atol=1e-6 * np.abs(gained[1]).max())
