"""A bias that stays where it was known to be is not spoken of; one that leaves is."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.systems.lidar_inertial_odometry.watches.steady_bias import SteadyBias

WALK, RATE_HZ = 1e-4, 10


def followed(seed: int, sigma: float, off: float, seconds: float = 60.0) -> list[str]:
    """A bias that walks, followed by a Kalman filter that takes its first estimate, `off` from it, to be known to `sigma`."""
    rng = np.random.default_rng(seed)
    steady = SteadyBias(WALK)
    bias = 0.02 * rng.standard_normal(3)
    x, P, noise = bias + off + sigma * rng.standard_normal(3), np.full(3, sigma**2), 0.02
    told = []
    for k in range(int(seconds * RATE_HZ)):
        bias = bias + WALK * np.sqrt(1.0 / RATE_HZ) * rng.standard_normal(3)
        P = P + WALK**2 / RATE_HZ
        gain = P / (P + noise**2)
        x, P = x + gain * (bias + noise * rng.standard_normal(3) - x), (1.0 - gain) * P
        told += filter(None, [steady.update(k * 10**9 // RATE_HZ, x, P, np.zeros(3))])
    return told


@pytest.mark.parametrize("sigma", [0.0005, 0.005, 0.05])
def test_of_a_filter_that_knows_what_it_knows_nothing_is_said(sigma: float) -> None:
    assert not any(followed(seed, sigma, 0.0) for seed in range(30))


@pytest.mark.parametrize("seed", range(8))
def test_a_first_estimate_that_was_far_surer_than_right_is_told(seed: int) -> None:
    told = followed(seed, 0.002, 0.03)
    assert told and "the gyroscope's bias about " in told[0] and "standard deviations of what was known of it" in told[0]


def test_estimates_of_hours_ago_are_remembered_and_few() -> None:
    steady = SteadyBias(1e-6)
    known = np.full(3, 1e-8)
    for k in range(20_000):
        assert steady.update(k * 10**8, np.zeros(3), known, np.zeros(3)) is None
    assert len(steady._time_s) <= 64 and steady._time_s[0] == 0.0
    assert "about y has moved by 0.57 deg/s" in (
        steady.update(20_000 * 10**8, np.array([0.0, 0.01, 0.0]), known, np.zeros(3)) or ""
    )


def test_a_bias_that_moves_with_an_unknown_mounting_is_not_spoken_of_but_beyond_it() -> None:
    # As the platform moves on, the bias owes more to the mounting: its whole variance grows, where that of the rest falls.
    steady, told = SteadyBias(WALK), []
    for k in range(20):
        known, by_mounting = np.full(3, 0.004**2 / (1 + k)), np.full(3, (0.0005 * k) ** 2)
        told.append(steady.update(k * 10**8, np.full(3, 0.0006 * k), known, by_mounting))
    assert not any(told)
    assert steady.update(2 * 10**9, np.full(3, 0.1), known, by_mounting)


@pytest.mark.parametrize(("scale", "told"), [(0.004, False), (0.05, True)])
def test_what_a_gyroscopes_scale_makes_of_turns_is_no_bias_that_moved(scale: float, told: bool) -> None:
    """The platform turns at 1.5 rad/s, one way and then the other, and the estimate of the bias follows."""
    steady, said = SteadyBias(1e-6), []
    known = np.full(3, 1e-8)
    for k in range(100):
        follows = scale * 1.5 * np.tanh((k - 50) / 10.0) * np.array([0.0, 0.0, 1.0])
        said.append(steady.update(k * 10**8, follows, known, np.zeros(3), rate=1.5))
    assert any(said) == told
    at_rest = SteadyBias(1e-6)
    assert at_rest.update(0, np.zeros(3), known, np.zeros(3)) is None
    assert at_rest.update(10**9, np.full(3, 0.012), known, np.zeros(3))


def test_an_estimate_counts_with_what_the_mounting_left_open_then() -> None:
    """The bias moves by ten deviations of what is known, but the mounting, unknown at first and known later, explains it."""
    steady, known = SteadyBias(1e-6), np.full(3, 1e-6)
    assert steady.update(0, np.zeros(3), known, np.full(3, 0.01**2)) is None
    assert steady.update(10**9, np.full(3, 0.01), np.full(3, 1e-8), np.zeros(3)) is None
    certain = SteadyBias(1e-6)
    assert certain.update(0, np.zeros(3), known, np.zeros(3)) is None
    assert "has moved by 0.57 deg/s within 1.0 s" in (
        certain.update(10**9, np.full(3, 0.01), np.full(3, 1e-8), np.zeros(3)) or ""
    )
