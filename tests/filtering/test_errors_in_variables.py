"""What a scan says of the pose once the noise of its normals is off it: whole shifts, honest variances, no more than is seen.

Derivation: docs/lidar_inertial_odometry.md, section 8.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.filtering.degeneracy import PoseDirections, pose_directions, strong_covariance, strong_step, with_weak_axis
from boxplus.filtering.errors_in_variables import without_noise
from boxplus.filtering.iterated_update import Information, iterated_update
from boxplus.filtering.nav_state import TANGENT, NavState, P
from boxplus.filtering.update_step import map_step
from tests.filtering.noisy_planes import LEVER_ARM, TILT, information, noise, tilted, tube, unit_vector
from tests.filtering.random_states import random_covariance

THRESHOLD = 2.5
KNOWN, MANY = np.zeros((6, 6)), 10**12  # a pose that is known, and points of which N is exact
seeds = st.integers(0, 2**32 - 1)


def _taken(
    A: np.ndarray, b: np.ndarray, directions: PoseDirections, cov_prior: np.ndarray = KNOWN, used: int = MANY
) -> tuple[np.ndarray, np.ndarray]:
    """What is taken in of planes that were found at this pose."""
    left = without_noise(A, b, directions, cov_prior=cov_prior, used=used, since_match=np.zeros(6))
    assert left is not None
    return left


def test_no_information_is_weak_everywhere() -> None:
    directions = pose_directions(np.zeros((6, 6)), np.zeros((6, 6)), LEVER_ARM, THRESHOLD)
    assert directions.weak.all()
    A, b = _taken(np.eye(12), np.ones(12), directions)
    assert not A[:6].any()
    assert not b[:6].any()
    assert not strong_step(np.eye(12), np.ones(12), directions).any()


def test_a_covariance_that_is_none_makes_no_update() -> None:
    directions = pose_directions(4.0 * np.eye(6), np.eye(6), 1.0, 0.0)
    for axis in np.eye(3)[:2]:
        directions = with_weak_axis(directions, axis)
    impossible = np.diag([1.0, 1.0, 1.0, 3.0, -1.0, 1.0])
    assert without_noise(np.eye(12), np.ones(12), directions, cov_prior=impossible, used=100, since_match=np.zeros(6)) is None


@given(seeds)
def test_a_threshold_below_one_makes_no_use_of_what_noise_alone_gives(seed: int) -> None:
    random = np.random.default_rng(seed)
    S, N = random_covariance(random, 6), 3.0 * random_covariance(random, 6)
    directions = pose_directions(S, N, 1.0, 0.2)
    A, b = np.eye(12), random.normal(size=12)
    A[:6, :6] = S
    left, _ = _taken(A, b, directions)
    covariance = strong_covariance(left, replace(directions, weak=~directions.measured))
    assert np.isfinite(covariance).all()
    assert np.linalg.matrix_rank(covariance, tol=1e-9 * max(np.abs(covariance).max(), 1.0)) <= np.count_nonzero(
        directions.ratios > 1.0
    )


@given(seeds)
def test_normals_without_noise_keep_all_they_say(seed: int) -> None:
    random = np.random.default_rng(seed)
    A, b = random_covariance(random, 12), random.normal(size=12)
    directions = replace(pose_directions(A[:6, :6], np.eye(6), 1.0, 0.0), ratios=np.full(6, np.inf))
    left, pulled = _taken(A, b, directions)
    np.testing.assert_allclose(left, A, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(pulled, b, rtol=1e-6, atol=1e-9)
    assert np.allclose(strong_step(A, b, directions), -np.linalg.solve(A[:6, :6], b[:6]), rtol=1e-6)


@given(seeds)
def test_what_noise_has_made_is_left_out_direction_by_direction(seed: int) -> None:
    random = np.random.default_rng(seed)
    A, b = random_covariance(random, 12), random.normal(size=12)
    N = random_covariance(random, 6)
    directions = pose_directions(A[:6, :6], N, 3.0, 0.0)
    directions = pose_directions(A[:6, :6], N, 3.0, float(directions.ratios[2:4].mean()))
    left, pulled = _taken(A, b, directions)
    V, ratios = directions.basis, directions.ratios
    share = np.where(directions.weak | (ratios < 1.0), 0.0, 1.0 - 1.0 / ratios)
    assert np.allclose(V.T @ left[:6, :6] @ V, np.diag(share**2 * ratios), atol=1e-6 * ratios.max())
    assert np.allclose(V.T @ pulled[:6], share * (V.T @ b[:6]), atol=1e-7 * np.abs(V.T @ b[:6]).max())


@given(seeds)
def test_the_step_is_the_one_of_errors_in_variables(seed: int) -> None:
    random = np.random.default_rng(seed)
    true, N, b = np.eye(6), np.eye(6), np.zeros(12)
    for M in (true, N):
        h = random.normal(size=(30, 6))
        M += h.T @ h
    b[:6] = random.normal(size=6)
    A = np.zeros((12, 12))
    A[:6, :6] = true + N
    directions = replace(pose_directions(A[:6, :6], N, 1.0, 0.0), weak=np.zeros(6, dtype=bool))
    left, pulled = _taken(A, b, directions)
    # N is widened by what no normal is better than, a milliradian.
    np.testing.assert_allclose(left[:6, :6], true @ np.linalg.solve(A[:6, :6], true), rtol=1e-3, atol=1e-3 * true.max())
    np.testing.assert_allclose(np.linalg.solve(left[:6, :6], pulled[:6]), np.linalg.solve(true, b[:6]), rtol=1e-3, atol=1e-4)


def test_a_shift_along_a_tube_with_a_few_bars_across_is_measured_whole() -> None:
    """Noise of the walls' normals does not see the shift: it must neither hold the estimate back nor make it surer than it is."""
    random, shift, axis = np.random.default_rng(5), 0.05, np.array([1.0, 0.0, 0.0])
    plain, steps, variances, ratios = [], [], [], []
    for seed in range(300):
        _, normals, p_imu = tube(seed, axis, 400)
        normals[:6] = axis
        x = NavState.identity()
        noisy = tilted(random, normals, 0.1)
        z = -normals @ (shift * axis) + 0.01 * random.normal(size=len(normals))
        A, b = information(x, noisy, p_imu, z)
        directions = pose_directions(A[:6, :6], noise(x, noisy, p_imu, 0.1), LEVER_ARM, 1.3)
        if directions.weak.any():
            continue
        left, pulled = _taken(A, b, directions)
        covariance = np.linalg.inv(left[:6, :6])
        plain.append(strong_step(A, b, directions)[3])
        steps.append(-(covariance @ pulled[:6])[3])
        variances.append(covariance[3, 3])
        ratios.append(directions.ratios[0])
    assert len(ratios) > 250
    assert 2.0 < np.median(ratios) < 4.0
    assert np.mean(plain) < 0.75 * shift
    assert np.mean(steps) == pytest.approx(shift, rel=0.1)
    assert np.std(steps) == pytest.approx(np.sqrt(np.mean(variances)), rel=0.3)


@settings(max_examples=30)
@given(seeds)
def test_the_update_leaves_the_axis_of_a_noisy_tube_alone(seed: int) -> None:
    random = np.random.default_rng(seed)
    axis = unit_vector(seed)
    x, normals, p_imu = tube(seed, axis)
    noisy = tilted(random, normals)  # noise in the normals looks like a measurement along the axis
    A, b = information(x, noisy, p_imu, 0.05 + 0.02 * random.normal(size=len(normals)))
    directions = pose_directions(A[:6, :6], noise(x, noisy, p_imu), LEVER_ARM, THRESHOLD)
    assert directions.weak.sum() == 1
    prior = np.diag(np.linspace(0.5, 2.0, TANGENT) ** 2)  # independent: what is not measured stays exactly
    # The directions are conjugate in N: where the prior is N⁻¹, they are independent in it as well.
    V = directions.basis
    prior[:6, :6] = V @ V.T
    delta, cov = np.zeros(TANGENT), np.zeros((TANGENT, TANGENT))
    packed = x.pack()
    assert map_step(packed, packed, prior, *_taken(A, b, directions), delta, cov)
    along = np.linalg.solve(V, delta[:6])  # in units of the prior
    weak, strong = directions.weak, ~directions.weak
    assert np.allclose(along[weak], 0, atol=1e-6)
    variances = np.linalg.solve(V, np.linalg.solve(V, cov[:6, :6]).T)
    assert np.allclose(variances[np.ix_(weak, weak)], 1.0)
    # In the strong directions it is the update by what they measure, and nothing else.
    share = 1.0 - 1.0 / directions.ratios[strong]
    expected = -share * (V.T @ b[:6])[strong] / (1.0 + share**2 * directions.ratios[strong])
    assert np.abs(expected).max() > 1e-3
    assert np.allclose(along[strong], expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


@given(seeds)
def test_an_axis_can_be_called_weak_whatever_its_ratio(seed: int) -> None:
    random = np.random.default_rng(seed)
    axis = random.normal(size=3)
    axis /= np.linalg.norm(axis)
    x, normals, p_imu = tube(seed, axis)
    noisy = tilted(random, normals, 3.0 * TILT)
    S = information(x, noisy, p_imu, np.zeros(len(noisy)))[0][:6, :6]
    directions = pose_directions(S, noise(x, noisy, p_imu), LEVER_ARM, THRESHOLD)
    forced = with_weak_axis(directions, axis)
    closest = int(np.argmax(np.abs(axis @ directions.vectors[3:])))
    assert forced.weak[closest] and abs(axis @ forced.vectors[3:, closest]) > 0.8
    np.testing.assert_array_equal(np.delete(forced.weak, closest), np.delete(directions.weak, closest))
    A = np.zeros((12, 12))
    A[:6, :6] = S
    along = np.r_[forced.basis[:, closest], np.zeros(6)]
    kept, _ = _taken(A, np.zeros(12), forced)
    assert along @ kept @ along < 1e-9 * (along @ A @ along)


@dataclass
class HeldPlanes:
    """Planes found where the state was then: (S − N) times the way to the truth, and the noise stays with the sensor."""

    true: np.ndarray
    noise: np.ndarray
    p_world_imu: np.ndarray
    found_at: np.ndarray = field(default_factory=lambda: np.zeros(3))
    steps: list[np.ndarray] = field(default_factory=list)

    def at(self, x: np.ndarray, *, rematch: bool) -> Information:
        p = x[P : P + 3]
        self.steps.append(p.copy())
        if rematch:
            self.found_at = p.copy()
        A, b, N = np.zeros((12, 12)), np.zeros(12), 1e5 * np.eye(6)
        A[:3, :3] = 1e8 * np.eye(3)
        N[3:, 3:] = self.noise
        A[3:6, 3:6] = self.true + self.noise
        b[3:6] = self.true @ (self.found_at - self.p_world_imu) + A[3:6, 3:6] @ (p - self.found_at)
        return Information(A, b, np.zeros(12), pose_directions(A[:6, :6], N, 1.0, 1.3), MANY, 0.0)

    def has_moved(self, x: np.ndarray) -> bool:
        del x
        return False


@pytest.mark.parametrize("ratio", [1.4, 1.7, 2.0, 3.0, 30.0])
def test_planes_that_are_held_lead_to_the_truth_without_swinging(ratio: float) -> None:
    random = np.random.default_rng(int(10 * ratio))
    turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
    noise_of = 1e4 * turn @ np.diag([1.0, 2.0, 3.0]) @ turn.T
    measurement = HeldPlanes((ratio - 1.0) * noise_of, noise_of, 0.03 * random.normal(size=3))
    prior = NavState.identity()
    cov = 1e4 * np.eye(TANGENT)  # says nothing
    posterior = iterated_update(prior.pack(), cov, measurement, max_iterations=6)
    assert posterior.converged and posterior.steps == 2  # the second one finds nothing left to do
    # N is widened by what no normal is better than, a milliradian.
    np.testing.assert_allclose(posterior.x[P : P + 3], measurement.p_world_imu, atol=2e-5)
    np.testing.assert_allclose(measurement.steps[1], measurement.p_world_imu, atol=2e-5)


@given(seeds, st.floats(0.01, 3.0), st.integers(100, 5000))
def test_what_is_read_is_as_unsure_as_the_noise_that_was_taken_off(seed: int, sigma: float, used: int) -> None:
    """Against the information of the same reading with the variance q added to it, the mounting's columns included."""
    random = np.random.default_rng(seed)
    whole = random_covariance(random, 12)
    b = random.normal(size=12)
    directions = pose_directions(whole[:6, :6], random_covariance(random, 6), 3.0, 0.0)
    directions = replace(directions, ratios=2.0 + directions.ratios)  # none is weak
    cov_prior = sigma**2 * random_covariance(random, 6)
    left, pulled = _taken(whole, b, directions, cov_prior, used)
    V, ratios = directions.basis, directions.ratios
    D = np.eye(12)
    D[:6, :6] = V @ np.diag(1.0 - 1.0 / ratios) @ np.linalg.inv(V)
    reading, pull = D.T @ whole @ D, D.T @ b
    inverse = np.linalg.inv(V)
    q = 20.0 / used * (inverse @ cov_prior @ inverse.T).diagonal() / (ratios - 1.0) ** 2
    added = np.zeros((12, 12))
    added[:6, :6] = V @ np.diag(q) @ V.T
    covariance = np.linalg.inv(reading)
    expected = np.linalg.inv(covariance + added)
    scale = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
    np.testing.assert_allclose(left / scale, expected / scale, atol=1e-5)
    np.testing.assert_allclose(left @ (covariance @ pull), pulled, rtol=1e-4, atol=1e-4 * np.abs(pulled).max())


def test_a_filter_that_knows_its_place_loses_nothing() -> None:
    x, normals, p_imu = tube(4, np.array([1.0, 0.0, 0.0]), 2000)
    normals[:40] = np.array([1.0, 0.0, 0.0])
    A, b = information(x, normals, p_imu, 0.01 * np.random.default_rng(4).normal(size=len(normals)))
    directions = pose_directions(A[:6, :6], noise(x, normals, p_imu), LEVER_ARM, 1.3)
    assert not directions.weak.any()
    known = _taken(A, b, directions)[0]
    kept = _taken(A, b, directions, np.diag([1e-6] * 3 + [1e-4] * 3), 2000)[0]
    np.testing.assert_allclose(kept, known, atol=0.02 * known.max())


def test_walls_without_features_do_not_hold_a_sensor_whose_rotation_is_known() -> None:
    """Scan after scan along a tube, the rotation known by a gyroscope: what chance says must not add up to a place."""
    axis = np.array([1.0, 0.0, 0.0])
    held, errors = [], []
    for trial in range(20):
        random = np.random.default_rng([trial, 1])
        cov, place = np.diag([1e-6] * 3 + [0.3**2] * 3), np.zeros(6)
        place[3] = 0.3 * random.normal()
        for scan in range(30):
            _, normals, p_imu = tube(1000 * trial + scan, axis, 60)
            each = np.repeat(np.arange(60), 10)
            noisy = tilted(random, normals, 0.1)[each]
            x = NavState.identity()
            true = np.hstack([np.cross(p_imu[each], normals[each]), normals[each]])
            A, b = information(x, noisy, p_imu[each], true @ place + 0.01 * random.normal(size=600))
            directions = pose_directions(A[:6, :6], noise(x, noisy, p_imu[each], 0.1), LEVER_ARM, 1.8)
            A, b = _taken(A, b, directions, cov, 600)
            posterior = np.linalg.inv(np.linalg.inv(cov) + A[:6, :6])
            place, cov = place - posterior @ b[:6], posterior.copy()
            cov[:3, :3] += 1e-6 * np.eye(3)
            cov[4:6, 4:6] += 1e-2 * np.eye(2)
        held.append(np.sqrt(cov[3, 3]))
        errors.append(place[3])
    assert np.median(held) > 0.2
    assert np.sqrt(np.mean((np.array(errors) / held) ** 2)) < 1.6


@given(seeds, st.floats(0.01, 2.0))
def test_a_direction_called_weak_for_another_reason_learns_only_what_the_prior_ties_to_others(seed: int, sigma: float) -> None:
    """Its ratio may be larger than that of measured ones: the cone stays one around it."""
    random = np.random.default_rng(seed)
    A, N = random_covariance(random, 12), random_covariance(random, 6)
    A[:6, 6:], A[6:, :6] = 0.0, 0.0
    directions = pose_directions(A[:6, :6], N, 3.0, 0.0)
    directions = replace(directions, ratios=2.0 + directions.ratios, weak=np.arange(6) == 3)
    free = _taken(A, np.zeros(12), directions, sigma**2 * directions.basis @ directions.basis.T, 500)[0]
    along = directions.basis[:, 3]
    assert abs(along @ free[:6, :6] @ along) < 1e-6 * (along @ A[:6, :6] @ along)  # the prior ties it to nothing
    tied = _taken(A, np.zeros(12), directions, sigma**2 * random_covariance(random, 6), 500)[0]
    assert np.isfinite(tied).all()
    assert np.linalg.eigvalsh(tied[:6, :6])[0] > -1e-6 * np.abs(tied).max()
