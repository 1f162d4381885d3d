"""The way by the cameras against that of the IMU alone."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from boxplus.manifolds import quaternion, so3
from boxplus.residuals.inertial.imu_preintegration import Preintegration
from boxplus.systems.visual_inertial_odometry import Rig, VioConfig
from boxplus.systems.visual_inertial_odometry.inertial_watch import InertialWatch, _as_one
from tests.systems.visual_inertial_odometry.simulated_rays import (
    IMAGE_EVERY,
    NOISE,
    PIXEL_SIGMA,
    Flight,
    SimulatedTracker,
    rig,
    run,
)

SIGMAS = np.repeat([5e-4, 0.005, 0.005, 2e-4, 5e-3], 3)  # θ, p, v, b_ω, b_a, as after some seconds


def watched(seed: int, scale: float, silent: int = -1, duration_s: float = 12.0) -> InertialWatch:
    """Estimates that err as their covariance says, but for lengths; the frame `silent` comes after a silence."""
    flight, watch, rng = Flight(seed, duration_s), InertialWatch(9.81), np.random.default_rng([seed, 5])
    for number, k in enumerate(range(300, len(flight.time_ns) - IMAGE_EVERY, IMAGE_EVERY)):
        ends = flight.time_ns[[k - IMAGE_EVERY, k]]
        step = Preintegration.integrate(flight.time_ns, flight.gyro, flight.accel, noise=NOISE, intervals_ns=[ends])
        off = rng.normal(size=15) * SIGMAS
        turn = quaternion.from_matrix(flight.R[k] @ so3.exp(off[:3]))
        pose = np.concatenate([turn, scale * flight.p[k] + off[3:6]])
        biases = flight.bias_accel[k] + off[12:], flight.bias_gyro[k] + off[9:12]
        state = np.concatenate([scale * flight.v[k] + off[6:9], *biases])
        watch.add(pose, state, np.diag(SIGMAS**2), None if number == silent else step)
    return watch


def test_estimates_as_good_as_they_say_are_believed() -> None:
    ratios = [watched(seed, 1.0).ratio for seed in range(6)]
    assert 0.3 < np.mean(ratios) < 1.5 and max(ratios) < 3.0
    assert all(watched(seed, 1.0).contradiction is None for seed in range(3))


@pytest.mark.parametrize("scale", [0.8, 1.25])
def test_lengths_that_are_not_the_accelerometers_are_named(scale: float) -> None:
    said = [watched(seed, scale).contradiction for seed in range(3)]
    assert all(sentence is not None and "baseline" in sentence and "scale" in sentence for sentence in said)


def test_a_few_per_cent_of_length_are_measured_and_named() -> None:
    """Three segments alone do not tell them from chance: `ratio` stays below its bound."""
    found = [watched(seed, 1.04, duration_s=30.0) for seed in range(4)]
    for watch in found:
        share, sigma = watch.length
        assert abs(share - 0.04) < 4.0 * sigma and sigma < 0.01
    assert sum("longer" in (watch.contradiction or "") for watch in found) >= 3
    sound = [watched(seed, 1.0, duration_s=30.0) for seed in range(4)]
    assert all(watch.contradiction is None and abs(watch.length[0]) < 3.0 * watch.length[1] for watch in sound)


@pytest.mark.slow
@pytest.mark.parametrize(("shaking", "bias"), [(0.05, 0.0), (0.05, 0.006), (0.2, 0.0)])
def test_standing_still_for_minutes_says_nothing_of_lengths(shaking: float, bias: float) -> None:
    """What the IMU errs by is all of what it measures there; shaking [m/s²] a sample, as of an engine that idles."""
    rng, watch, seconds = np.random.default_rng(4), InertialWatch(9.81), 120
    time_ns = np.arange(200 * seconds + 1) * 5_000_000
    gyro = 0.002 * rng.normal(size=(len(time_ns), 3))
    accel = np.array([bias, 0.0, 9.81]) + shaking * rng.normal(size=(len(time_ns), 3))
    covariance = np.diag(np.repeat([5e-4, 0.005, 0.002, 2e-4, 5e-3], 3) ** 2)
    for first in range(0, len(time_ns) - 20, 20):
        ends = time_ns[[first, first + 20]]
        step = Preintegration.integrate(time_ns, gyro, accel, noise=NOISE, intervals_ns=[ends])
        watch.add(np.array([1.0, *np.zeros(6)]), np.zeros(9), covariance, step)
        assert watch.contradiction is None


def test_a_first_segment_that_knows_little_hides_nothing_of_what_follows() -> None:
    """As one of a start in motion, whose biases are open: whatever comes after it, it comes apart by less than it may."""
    flight, rng = Flight(2, 12.0), np.random.default_rng(6)
    whole, later = InertialWatch(9.81), InertialWatch(9.81)
    begin_ns = flight.time_ns[300]
    for k in range(300, len(flight.time_ns) - IMAGE_EVERY, IMAGE_EVERY):
        since_s = 1e-9 * float(flight.time_ns[k] - begin_ns)
        ends = flight.time_ns[[k - IMAGE_EVERY, k]]
        step = Preintegration.integrate(flight.time_ns, flight.gyro, flight.accel, noise=NOISE, intervals_ns=[ends])
        off = rng.normal(size=15) * SIGMAS
        turn = quaternion.from_matrix(flight.R[k] @ so3.exp(off[:3]))
        pose = np.concatenate([turn, 1.25 * flight.p[k] + off[3:6]])
        state = np.concatenate([1.25 * flight.v[k] + off[6:9], flight.bias_accel[k] + off[12:], flight.bias_gyro[k] + off[9:12]])
        P = np.diag((SIGMAS if since_s > 0.0 else 100.0 * SIGMAS) ** 2)
        whole.add(pose, state, P, step)
        if since_s >= 2.5:
            later.add(pose, state, P, step)
        if since_s > 8.0:
            break
    assert later.ratio > 3.0
    assert whole.ratio == pytest.approx(later.ratio, rel=1e-9)


def test_little_time_and_silence_say_nothing() -> None:
    watch = InertialWatch(9.81)
    assert watch.ratio == 0.0 and watch.contradiction is None and np.isnan(watch.length[0]) and np.isinf(watch.length[1])
    sound, silent = watched(1, 1.25), watched(1, 1.25, silent=120)
    assert silent.ratio > 0.0 and silent.ratio != sound.ratio


def test_the_steps_of_a_segment_are_integrated_as_one() -> None:
    flight = Flight(2, 3.0)
    ends = flight.time_ns[100:400:IMAGE_EVERY]
    samples = flight.time_ns, flight.gyro, flight.accel
    biases = {"bias_accel": flight.bias_accel[100], "bias_gyro": flight.bias_gyro[100]}
    steps = [Preintegration.integrate(*samples, noise=NOISE, intervals_ns=[pair], **biases)[[0]] for pair in pairwise(ends)]
    whole = Preintegration.integrate(*samples, noise=NOISE, intervals_ns=[ends[[0, -1]]], **biases)
    joined = _as_one(steps)
    for name in ("alpha", "beta", "gamma_wxyz", "covariance"):
        assert np.array_equal(getattr(joined, name), getattr(whole, name))


def stretched(its: Rig, scale: float) -> Rig:
    """The rig with another distance between its cameras."""
    mountings = [camera.T_imu_camera.copy() for camera in its.cameras]
    mountings[1][:3, 3] = mountings[0][:3, 3] + scale * (mountings[1][:3, 3] - mountings[0][:3, 3])
    return Rig.of([c.model for c in its.cameras], mountings, [(c.width, c.height) for c in its.cameras], its.noise)


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "is_named"), [(1.0, False), (1.25, True), (0.8, True)])
def test_a_wrong_baseline_is_contradicted(scale: float, is_named: bool) -> None:
    flight, true = Flight(3, 10.0), rig()
    vio, _ = run(flight, stretched(true, scale), VioConfig(pixel_sigma=PIXEL_SIGMA), SimulatedTracker(flight, true))
    assert (vio.contradiction is not None) == is_named
