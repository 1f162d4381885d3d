"""Zero velocity while a platform rests, and not a moment longer: against motions whose beginning is known."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.filtering.nav_state import T_V, TANGENT, NavState, P, V
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.lidar_inertial_odometry.mounting.unknown_mounting import mounting_known
from boxplus.systems.lidar_inertial_odometry.standstill import Standstill

RATE_HZ = 200.0
GRAVITY = np.array([0.0, 0.0, 9.81])


def _samples(begin_s: float, seconds: float, density: float, rng: np.random.Generator, accel: object = 0.0) -> ImuSamples:
    time = begin_s + np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    noise = rng.normal(size=(2, len(time), 3)) * np.sqrt(RATE_HZ) * density
    force = GRAVITY + np.asarray(accel) * np.array([0.0, 0.0, 1.0])
    return ImuSamples(np.round(time * 1e9).astype(np.int64), 0.1 * noise[0], force + noise[1])


def _leaves_after(acceleration: float, density: float, seed: int, seconds: float = 6.0) -> tuple[float, float]:
    """Time [s] and speed [m/s] at which a platform is said to move that sets off with `acceleration`, growing over a second."""
    rng = np.random.default_rng(seed)
    still = Standstill(_samples(0.0, 1.0, density, rng), np.zeros(3))
    speed = 0.0
    for k in range(round(seconds * 10)):
        now = acceleration * min(0.1 * k, 1.0)
        speed += 0.1 * now
        x, cov = NavState.identity().pack(), 1e-4 * np.eye(TANGENT)
        still.update(_samples(1.0 + 0.1 * k, 0.1, density, rng, now), 0.1, x, cov, None)
        if not still.active:
            return 0.1 * (k + 1), speed
    return np.inf, speed


@pytest.mark.parametrize(
    ("acceleration", "density"),  # gentler ones than these are within the noise, and end with the displacement
    [(0.02, 3e-4), (0.02, 2e-3), (0.05, 3e-4), (0.05, 2e-3), (0.05, 4e-3), (0.1, 4e-3), (-0.1, 4e-3), (0.4, 4e-3)],
)
@pytest.mark.parametrize("seed", range(4))
def test_a_platform_that_sets_off_slowly_is_noticed_before_it_is_fast(acceleration: float, density: float, seed: int) -> None:
    _, speed = _leaves_after(acceleration, density, seed)
    # What noise and walking biases sum up to within 1.6 s, seven times, the last scan's gain, and a little.
    noise = np.hypot(density * np.sqrt(1.6 + 1.6**2), 2e-3 * np.sqrt(1.6 + 2.5) * 1.6)
    assert abs(speed) < 0.015 + 7.0 * noise + 0.1 * abs(acceleration)


@pytest.mark.parametrize("density", [3e-4, 2e-3, 4e-3, 0.05])
@pytest.mark.parametrize("seed", range(6))
def test_noise_alone_does_not_end_it(density: float, seed: int) -> None:
    assert _leaves_after(0.0, density, seed, seconds=30.0)[0] == np.inf


@pytest.mark.parametrize("seed", range(4))
def test_a_bias_that_walks_does_not_end_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    still = Standstill(_samples(0.0, 1.0, 4e-3, rng), np.zeros(3))
    bias = np.cumsum(2e-3 * np.sqrt(0.1) * rng.normal(size=1200))  # a cheap IMU, two minutes
    for k, now in enumerate(bias):
        still.update(_samples(1.0 + 0.1 * k, 0.1, 4e-3, rng, now), 0.1, NavState.identity().pack(), np.eye(TANGENT), None)
    assert still.active


def test_a_displacement_ends_it_for_good() -> None:
    rng = np.random.default_rng(1)
    still = Standstill(_samples(0.0, 1.0, 2e-3, rng), np.zeros(3))
    for k, shift in enumerate((0.04, 0.06, 0.0)):
        x = NavState.identity().pack()
        x[P] = shift
        still.update(_samples(1.0 + 0.1 * k, 0.1, 2e-3, rng), 0.1, x, np.eye(TANGENT), None)
        assert still.active == (k == 0)


def test_while_it_rests_the_velocity_is_zero_and_known() -> None:
    rng = np.random.default_rng(2)
    still = Standstill(_samples(0.0, 1.0, 2e-3, rng), np.zeros(3))
    x, cov = NavState.identity().pack(), np.eye(TANGENT)
    cov[T_V : T_V + 3, 3:6] = cov[3:6, T_V : T_V + 3] = 0.5 * np.eye(3)
    x[V : V + 3], x[P : P + 3] = (0.1, -0.2, 0.0), (0.02, 0.0, 0.0)
    still.update(_samples(1.0, 0.1, 2e-3, rng), 0.1, x, cov, None)
    np.testing.assert_allclose(x[V : V + 3], 0.0, atol=1e-4)
    np.testing.assert_allclose(x[P : P + 3], [0.02 - 0.05, 0.1, 0.0], atol=1e-4)  # what goes with the velocity
    assert np.all(np.sqrt(np.diag(cov)[T_V : T_V + 3]) < 0.0101)
    assert np.all(np.linalg.eigvalsh(cov) > 0.0) and np.array_equal(cov, cov.T)


@pytest.mark.parametrize("rests", [True, False])
def test_it_says_what_it_has_left_of_the_errors(rests: bool) -> None:
    """P⁺ = (I − KH) P⁻ with the mounting known, and nothing of it where the platform moves."""
    rng = np.random.default_rng(2)
    still = Standstill(_samples(0.0, 1.0, 2e-3, rng), np.zeros(3))
    root, x = rng.normal(size=(TANGENT, TANGENT)), NavState.identity().pack()
    cov = 1e-4 * root @ root.T
    before, whole = cov.copy(), np.eye(TANGENT)
    left = still.update(_samples(1.0, 0.1, 2e-3, rng, 0.0 if rests else 5.0), 0.1, x, cov, whole)
    assert left is not None and (left == whole).all() == (not rests)
    np.testing.assert_allclose(left[:18, :18] @ mounting_known(before)[0][:18, :18], mounting_known(cov)[0][:18, :18], atol=1e-9)
    before[18:, :18] = before[:18, 18:] = 0.0
    for passed in (whole, 2.0 * whole[:18, :18], None):
        now = before.copy()
        again = still.update(_samples(1.1, 0.1, 2e-3, rng, 0.0 if rests else 5.0), 0.1, x, now, passed)
        if passed is None:
            assert again is None
        else:
            n = len(passed)
            kept = again @ before[:n, :n] / passed[0, 0]
            np.testing.assert_allclose(kept, now[:n, :n] if rests else before[:n, :n], atol=1e-9)
