"""How a LiDAR turned, against a gyroscope."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.lidar_inertial_agreement import rotation
from boxplus.systems.lidar_inertial_agreement.agreement import apart, contradicted_within
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.rotation import RotationFit, compare_rotations, turned_towards

STEP_S = 0.1


def compared(
    rate: np.ndarray,
    noise: np.ndarray,
    R_imu_lidar: np.ndarray,
    random: np.random.Generator,
    R_expected: np.ndarray | None = None,
    registered: np.ndarray | None = None,
) -> RotationFit:
    """Of a LiDAR that turns at `rate` (K, 3) and is registered with `noise` (K, 3), against an exact gyroscope.

    Registrations show the rate `registered` (K, 3) where that is another one.
    """
    K = len(rate)
    R = [np.eye(3)]
    for turn in so3.exp(((rate if registered is None else registered) + noise * random.normal(size=(K, 3))) * STEP_S):
        R.append(R[-1] @ turn)
    zeros = np.zeros(K + 1)
    time_ns = (np.arange(K + 1) * STEP_S * 1e9).astype(np.int64)
    information = np.tile(1e6 * np.eye(6), (K + 1, 1, 1))
    path = LidarPath(time_ns, np.array(R), np.zeros((K + 1, 3)), information, zeros.astype(int), zeros > 1.0, zeros, zeros, 0)
    imu_ns = np.arange(-100_000_000, time_ns[-1] + 100_000_000, 5_000_000)
    interval = np.clip((imu_ns - 1) // round(STEP_S * 1e9), 0, K - 1)  # a sample holds until the next
    gyro = rate[interval] @ R_imu_lidar.T
    fit = compare_rotations(path, ImuSamples(imu_ns, gyro, np.zeros_like(gyro)), R_expected)
    assert fit is not None
    return fit


@pytest.mark.parametrize("seed", range(8))
def test_what_turns_about_one_axis_leaves_the_mounting_about_it_as_expected(seed: int) -> None:
    """A turn that slows down, with registrations' noise a quarter of it: about that axis noise fits any mounting."""
    random = np.random.default_rng(seed)
    K, R_imu_lidar = 78, so3.exp(random.normal(size=3))
    t = np.linspace(-1.0, 1.0, K)[:, None]
    rate = np.deg2rad(4.0 * t + t**2) * np.array([0.07, 0.0, 1.0])
    noise = np.deg2rad([[0.6, 0.45, 0.55]])
    sound = compared(rate, noise, R_imu_lidar, random, R_imu_lidar)
    assert np.count_nonzero(sound.rotation_std[0] > 0.35) == 1
    assert contradicted_within(sound, R_imu_lidar) is None
    assert np.degrees(np.linalg.norm(so3.log(sound.R_imu_lidar @ R_imu_lidar.T))) < 5.0
    # Any turn about that axis is as good, one across it is not.
    turned = so3.exp(random.uniform(-2.5, 2.5) * sound.main_axis) @ R_imu_lidar
    assert contradicted_within(sound, turned) is None
    across = np.cross(sound.main_axis, random.normal(size=3))
    tilted = so3.exp(np.radians(40.0) * across / np.linalg.norm(across)) @ turned
    assert contradicted_within(sound, tilted) is not None
    np.testing.assert_allclose(np.degrees(apart(sound, tilted)[0]), 40.0, atol=8.0)


def yawing(
    seed: int, R_expected: np.ndarray, outliers_deg: float = 0.0, constant_deg_s: tuple[float, float] = (0.0, 0.0)
) -> RotationFit:
    """Of a platform that turns to and fro about one axis, beside a constant rate, and two scans that are laid down wrongly."""
    random = np.random.default_rng(seed)
    K = 78
    rate = np.deg2rad(np.array([[*constant_deg_s, 0.0]]) + 10.0 * np.sin(np.arange(K) / 9.0)[:, None] * [0.0, 0.0, 1.0])
    noise = np.deg2rad(np.tile([0.6, 0.45, 0.55], (K, 1)))
    wrong = random.choice(K, 2, replace=False)
    if outliers_deg:
        noise[wrong] = 0.0
    measured = rate.copy()
    measured[wrong] += np.deg2rad(outliers_deg / STEP_S) * np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    return compared(rate, noise, np.eye(3), random, R_expected, measured)


@pytest.mark.parametrize("outliers_deg", [0.0, 5.0, 12.0])
@pytest.mark.parametrize("seed", range(5))
def test_scans_that_are_laid_down_wrongly_hide_no_mounting(seed: int, outliers_deg: float) -> None:
    """One of 8 deg turned the axis of all turns, about which any mounting was as good."""
    wrong = so3.exp(np.array([np.radians(40.0), 0.0, 0.0]))
    fit = yawing(seed, wrong, outliers_deg)
    assert contradicted_within(fit, wrong) is not None
    np.testing.assert_allclose(np.degrees(apart(fit, wrong)[0]), 40.0, atol=4.0)
    assert contradicted_within(yawing(seed, np.eye(3), outliers_deg), np.eye(3)) is None


@pytest.mark.parametrize("seed", range(5))
def test_a_bias_goes_with_the_mounting_that_is_taken(seed: int) -> None:
    """The gyroscope has none: what it shows beside the LiDAR's constant rate would be the mounting's, turned by noise."""
    fit = yawing(seed, np.eye(3), constant_deg_s=(20.0, -12.0))
    assert fit.open_axis is not None
    np.testing.assert_allclose(np.degrees(np.linalg.norm(so3.log(fit.R_imu_lidar))), 0.0, atol=1.5)
    np.testing.assert_allclose(np.degrees(fit.bias), 0.0, atol=0.5)


def test_only_one_open_axis_and_only_that_of_the_turns_is_taken_as_given() -> None:
    fit = yawing(0, np.eye(3))
    x, _, z = np.eye(3)
    R = so3.exp(np.array([0.1, 0.0, 1.2]))
    covariance = fit.covariance.copy()
    for variances, main_axis, turned in (
        ([1e-4, 1e-4, 1.0], z, True),
        ([1e-4, 1e-4, 1.0], so3.exp(0.3 * x) @ z, True),
        ([1e-4, 1e-4, 1.0], x, False),
        ([1e-4, 1.0, 1.0], z, False),
        ([1.0, 1.0, 1.0], z, False),
        ([1e-4, 1e-4, 1e-4], z, False),
    ):
        covariance[:3, :3] = np.diag(variances)
        seen = replace(fit, R_imu_lidar=R, covariance=covariance, main_axis=main_axis)
        assert (seen.open_axis is not None) is turned
        assert np.allclose(seen.closest_to(np.eye(3)), R) is not turned


def taking_off(seed: int) -> tuple[RotationFit, np.ndarray]:
    """Two seconds of rest, then rolls, with pitch known ten times worse than at rest; and the true mounting."""
    random = np.random.default_rng(seed)
    K, R_imu_lidar = 40, so3.exp(random.normal(size=3))
    moves = np.clip(np.arange(K) - 23, 0, None)
    rate = np.deg2rad(20.0 * np.sin(0.45 * moves)[:, None] * [1.0, -0.35, 0.0] + moves[:, None] * [0.0, 0.0, 0.5])
    noise = np.deg2rad(np.where(moves[:, None] > 0, [1.0, 4.0, 0.2], [0.3, 0.4, 0.1]))
    return compared(rate, noise, R_imu_lidar, random, R_imu_lidar), R_imu_lidar


@pytest.mark.parametrize("mended", [True, False])
def test_what_is_off_only_in_motion_is_known_no_better_than_in_motion(mended: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """An eight-ring LiDAR on a drone that took off: a sound mounting was 12 deg off, known to 2.4 by the noise of its rest."""
    if not mended:  # all intervals alike
        monkeypatch.setattr(rotation, "_typical", lambda off, _: float(np.median(off)))
        monkeypatch.setattr(rotation, "_variance_turning", lambda _: 0.0)
    deviations, contradicted = [], []
    for seed in range(40):
        fit, R_imu_lidar = taking_off(seed)
        off = so3.log(fit.closest_to(R_imu_lidar) @ R_imu_lidar.T)
        deviations.append(np.sqrt(off @ np.linalg.solve(fit.covariance[:3, :3], off)))
        contradicted.append(contradicted_within(fit, R_imu_lidar) is not None)
    if mended:
        assert 0.8 < np.median(deviations) < 2.2  # of three degrees of freedom: 1.5
        assert np.mean(contradicted) < 0.06
    else:
        assert np.mean(contradicted) > 0.3


@pytest.mark.parametrize(("count", "fast_deg_s", "shown"), [(1, 50.0, 0.0), (3, 100.0, 0.5), (8, 100.0, 0.5)])
@pytest.mark.parametrize("seed", range(4))
def test_a_few_fast_turns_that_registrations_show_roughly_hide_nothing(
    seed: int, count: int, fast_deg_s: float, shown: float
) -> None:
    """A bump, or a gyroscope's glitch: counted by their squares, these would be all that counts, and nothing else be known."""
    random = np.random.default_rng(seed)
    K, R_imu_lidar = 78, so3.exp(random.normal(size=3))
    rate = np.deg2rad(10.0 * np.sin(np.arange(K)[:, None] * random.uniform(0.2, 0.6, 3) + random.uniform(0.0, 6.0, 3)))
    registered, fast = rate.copy(), random.choice(K, count, replace=False)
    turns = np.deg2rad(fast_deg_s) * so3.exp(random.normal(size=(count, 3)))[:, 0]
    rate[fast] += turns
    registered[fast] += shown * turns + 0.2 * np.deg2rad(fast_deg_s) * random.normal(size=(count, 3))
    axis = random.normal(size=3)
    wrong = so3.exp(np.radians(20.0) * axis / np.linalg.norm(axis)) @ R_imu_lidar
    for given, contradicted in ((R_imu_lidar, False), (wrong, True)):
        fit = compared(rate, np.deg2rad(np.full((K, 3), 0.3)), R_imu_lidar, random, given, registered)
        assert (contradicted_within(fit, given) is not None) is contradicted


@pytest.mark.parametrize("seed", range(8))
def test_turned_towards_another_rotation_as_close_as_an_axis_allows(seed: int) -> None:
    random = np.random.default_rng(seed)
    R, R_other = so3.exp(random.normal(size=(2, 3)))
    axis = random.normal(size=3)
    axis /= np.linalg.norm(axis)

    def angle(rotation: np.ndarray) -> float:
        return float(np.linalg.norm(so3.log(rotation @ R_other.T)))

    closest = turned_towards(R, R_other, axis)
    np.testing.assert_allclose(np.cross(axis, so3.log(closest @ R.T)), 0.0, atol=1e-9)  # about the axis alone
    tried = [angle(so3.exp(turn * axis) @ R) for turn in np.linspace(-np.pi, np.pi, 721)]
    assert angle(closest) <= min(tried) + 1e-9


@pytest.mark.parametrize("seed", range(6))
def test_a_few_fast_turns_are_no_outliers(seed: int) -> None:
    """A platform that turns to and fro and swerves now and then: registration knows less of swerves; they show the mounting."""
    random = np.random.default_rng(seed)
    K, R_imu_lidar = 120, so3.exp(random.normal(size=3))
    rate = 0.25 * np.sin(np.arange(K) / 9.0)[:, None] * np.array([0.0, 0.0, 1.0])
    swerves = random.choice(K, 8, replace=False)
    rate[swerves] += [[0.4, 0.03, 0.1]]
    noise = np.full(K, 5e-4)
    noise[swerves] = 0.01
    fit = compared(rate, noise[:, None], R_imu_lidar, random)
    assert np.degrees(np.linalg.norm(so3.log(fit.R_imu_lidar @ R_imu_lidar.T))) < 3.0
    assert fit.explained > 0.97
    assert fit.explained > fit.mirrored - 1e-3


@pytest.mark.parametrize("seed", range(12))
def test_a_turn_about_one_axis_that_just_begins_is_no_flipped_sign(seed: int) -> None:
    """Scale, bias and offset are hardly told apart: steps along them must not lead to where little is explained."""
    random = np.random.default_rng(seed)
    begun = np.clip(np.linspace(0.0, 1.0, 46)[:, None] - 0.7, 0.0, None) / 0.3
    rate = 0.2 * begun * np.array([0.05, 1.0, 0.0]) + 5e-4 * random.normal(size=(46, 3))
    fit = compared(rate, np.full((46, 1), 0.015), so3.exp(random.normal(size=3)), random)
    assert fit.explained > 0.75
    assert fit.explained > fit.mirrored - 0.02
    assert abs(fit.scale - 1.0) < 0.5


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("std", "known"), [(0.005, "well"), (0.02, "coarsely"), (0.2, "not")])
def test_attitudes_known_coarsely_are_compared_over_longer_intervals(seed: int, sign: float, std: float, known: str) -> None:
    random = np.random.default_rng(seed)
    K, step_s, R_imu_lidar = 80, 0.05, so3.exp(random.normal(size=3))
    t = np.arange(K)[:, None] * step_s
    rate = np.deg2rad([25.0, 18.0, 12.0]) * np.sin(2.0 * np.pi * random.uniform(0.2, 0.6, 3) * t + random.uniform(0.0, 6.0, 3))
    R = [np.eye(3)]
    for turn in so3.exp(rate * step_s):
        R.append(R[-1] @ turn)
    # A registration to a map: the errors of attitudes do not add up.
    R_path = np.array(R) @ so3.exp(0.3 * min(std, 0.02) * random.normal(size=(K + 1, 3)))
    zeros = np.zeros(K + 1)
    time_ns = (np.arange(K + 1) * step_s * 1e9).astype(np.int64)
    information = np.tile(np.eye(6) / std**2, (K + 1, 1, 1))
    path = LidarPath(time_ns, R_path, np.zeros((K + 1, 3)), information, zeros.astype(int), zeros > 1.0, zeros, zeros, 0)
    imu_ns = np.arange(-100_000_000, time_ns[-1] + 100_000_000, 5_000_000)
    interval = np.clip((imu_ns - 1) // round(step_s * 1e9), 0, K - 1)
    gyro = sign * rate[interval] @ R_imu_lidar.T
    fit = compare_rotations(path, ImuSamples(imu_ns, gyro, np.zeros_like(gyro)))
    assert (fit is None) == (known == "not")
    if fit is None:
        return
    assert fit.coarse == (known == "coarsely") and fit.covered > 0.9
    assert (fit.explained if sign > 0.0 else fit.mirrored) > 0.95
    if sign > 0.0:
        off = fit.covariance[:3, :3]
        error = so3.log(fit.R_imu_lidar @ R_imu_lidar.T)
        assert error @ np.linalg.solve(off, error) < 16.3  # three components, one in a thousand


@pytest.mark.parametrize("rate_hz", [5.0, 7.5, 10.0, 12.5, 20.0])
@pytest.mark.parametrize(("known", "compared"), [(1.0, True), (0.7, True), (0.4, False)])
def test_of_attitudes_known_coarsely_over_half_of_the_path_is_asked_for(rate_hz: float, known: float, compared: bool) -> None:
    """Whatever the rate of the scans, of which a whole number fits into an interval and a whole number into its half."""
    random = np.random.default_rng(7)
    K, step_s = round(16.0 * rate_hz), 1.0 / rate_hz
    std = np.where(np.arange(K + 1) < known * K, 0.02, 1.0)
    zeros = np.zeros(K + 1)
    time_ns = (np.arange(K + 1) * step_s * 1e9).astype(np.int64)
    rate = np.deg2rad([25.0, 18.0, 12.0]) * np.sin(np.arange(K)[:, None] * step_s * [1.5, 2.0, 2.5] + random.uniform(0.0, 6.0, 3))
    R = [np.eye(3)]
    for turn in so3.exp(rate * step_s):
        R.append(R[-1] @ turn)
    information = np.eye(6) / std[:, None, None] ** 2
    path = LidarPath(time_ns, np.array(R), np.zeros((K + 1, 3)), information, zeros.astype(int), zeros > 1.0, zeros, zeros, 0)
    imu_ns = np.arange(-100_000_000, time_ns[-1] + 100_000_000, 5_000_000)
    gyro = rate[np.clip(np.searchsorted(time_ns, imu_ns) - 1, 0, K - 1)]
    fit = compare_rotations(path, ImuSamples(imu_ns, gyro, np.zeros_like(gyro)))
    assert (fit is not None) == compared
    if fit is not None:
        assert fit.coarse
        assert known - 0.1 < fit.covered <= min(known + 0.02, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("count", [40, 120])
@pytest.mark.parametrize("second", [0.0, 0.005, 0.02, 0.2])
def test_the_mounting_is_as_far_off_as_it_says(count: int, second: float) -> None:
    """Turning about one axis, and about a second one less than registration knows, or more: noise is no turning."""
    known, off = [], []
    for seed in range(12):
        random = np.random.default_rng(seed)
        R_imu_lidar = so3.exp(random.normal(size=3))
        phase = np.arange(count)[:, None] * STEP_S * random.uniform(0.8, 1.5, 3) + random.uniform(0.0, 6.0, 3)
        rate = np.array([0.0, second, 0.25]) * np.sin(phase)
        fit = compared(rate, np.array([0.016, 0.016, 0.004]), R_imu_lidar, random)
        std, axes = fit.rotation_std
        off.append(np.abs(axes.T @ so3.log(fit.R_imu_lidar @ R_imu_lidar.T)) / std)
        known.append(std)
    assert np.max(off) < 5.0
    largest = np.degrees(np.array(known).max(axis=1))
    assert (largest > 40.0).all() if second < 0.01 else True
    assert np.median(largest) < 2.0 if second > 0.1 else True


@pytest.mark.slow
@pytest.mark.parametrize("amplitude_deg_s", [2.0, 5.0])
@pytest.mark.parametrize("density", [0.0, 4e-4])
def test_the_noise_of_a_gyroscope_brings_no_clocks_together(density: float, amplitude_deg_s: float) -> None:
    """Rates that noise changes from sample to sample look as if an offset were well known, and zero."""
    K, step_s, late_s, off = 80, 0.05, 0.035, []
    for seed in range(12):
        random = np.random.default_rng(seed)
        R_imu_lidar, phase, hz = so3.exp(random.normal(size=3)), random.uniform(0.0, 6.0, 3), random.uniform(0.1, 0.4, 3)

        def rate(time_s: np.ndarray, hz: np.ndarray = hz, phase: np.ndarray = phase) -> np.ndarray:
            swing: np.ndarray = np.deg2rad(amplitude_deg_s) * np.sin(2.0 * np.pi * hz * time_s[:, None] + phase)
            return swing

        R = [np.eye(3)]
        for turn in so3.exp(rate(np.arange(0.0025, K * step_s, 0.005)) * 0.005):
            R.append(R[-1] @ turn)
        R_path = np.array(R)[::10] @ so3.exp(2e-4 * random.normal(size=(K + 1, 3)))
        zeros = np.zeros(K + 1)
        time_ns = (np.arange(K + 1) * step_s * 1e9).astype(np.int64)
        information = np.tile(1e6 * np.eye(6), (K + 1, 1, 1))
        path = LidarPath(time_ns, R_path, np.zeros((K + 1, 3)), information, zeros.astype(int), zeros > 1.0, zeros, zeros, 0)
        imu_s = np.arange(-0.7, K * step_s + 0.7, 0.005)
        gyro = rate(imu_s) @ R_imu_lidar.T + density / np.sqrt(0.005) * random.normal(size=(len(imu_s), 3))
        samples = ImuSamples(np.round((imu_s + late_s) * 1e9).astype(np.int64), gyro, np.zeros_like(gyro))
        fit = compare_rotations(path, samples, R_imu_lidar)
        assert fit is not None
        off.append((fit.offset_s - late_s) / fit.offset_std_s)
    assert np.max(np.abs(off)) < 4.0
    assert np.sqrt(np.mean(np.square(off))) < 1.5
