"""A step in the errors of fixes from near: one that lasts, one that comes and goes, and none."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.systems.georeference.step import _shared, step_at, step_gains

SECONDS = np.arange(100.0)


def noise(seed: int, white: float = 0.5, slow: float = 0.5, seconds: NDArray[np.float64] = SECONDS) -> NDArray[np.float64]:
    """(N, 2) of a usual receiver [m]."""
    random = np.random.default_rng(seed)
    keep, state = np.exp(-(seconds[1] - seconds[0]) / 60.0), random.standard_normal(2)
    stays = []
    for _ in seconds:
        stays.append(state)
        state = keep * state + np.sqrt(1.0 - keep**2) * random.standard_normal(2)
    return slow * np.array(stays) + white * random.standard_normal((len(seconds), 2))


@pytest.mark.parametrize("seed", range(6))
def test_a_step_that_lasts_is_told_and_as_long_as_it_is(seed: int) -> None:
    step = step_at(SECONDS, noise(seed) + 3.0 * np.outer(SECONDS >= 40.0, [0.8, 0.6]), 40, 0.7)
    assert step.is_told and not step.is_burst and step.metres == pytest.approx(3.0, abs=1.2)


@pytest.mark.parametrize("duration", [5.0, 12.0, 20.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_burst_is_one_where_it_begins_and_where_it_ends(seed: int, duration: float) -> None:
    burst = np.abs(SECONDS - 39.75 - 0.5 * duration) < 0.5 * duration
    errors = noise(seed) + 3.0 * np.outer(burst, [0.8, 0.6])
    for at in (40, 40 + int(duration)):
        step = step_at(SECONDS, errors, at, 0.7)
        assert step.is_burst and not step.is_told


def test_noise_is_no_step_nor_is_a_map_that_bends() -> None:
    bend = np.outer(0.04 * SECONDS, [1.0, -1.0])
    told = [step_at(SECONDS, noise(seed) + bend, at, 0.7).is_told for seed in range(20) for at in (35, 50, 65)]
    assert not any(told)


def test_near_to_the_begin_there_is_as_much_as_there_is() -> None:
    errors = noise(1) + 4.0 * np.outer(SECONDS >= 8.0, [1.0, 0.0])
    assert step_at(SECONDS, errors, 8, 0.7).metres == pytest.approx(4.0, abs=1.5)


@pytest.mark.parametrize("seed", range(4))
def test_a_step_is_told_beside_a_burst_that_hides_it(seed: int) -> None:
    """A datum that jumps while multipath lasts: once the burst was all there was of it."""
    jump = 5.0 * np.outer(SECONDS >= 40.0, [0.8, 0.6])
    for begin in (32.0, 40.0):
        burst = 12.0 * np.outer((begin <= SECONDS) & (begin + 8.0 > SECONDS), [-0.6, 0.8])
        both, alone = (step_at(SECONDS, noise(seed) + errors, 40, 0.7) for errors in (jump + burst, burst))
        assert both.is_beside and not both.is_burst and both.metres_beside == pytest.approx(5.0, abs=2.0)
        assert alone.is_burst and not alone.is_beside


BURSTS = {
    "one after the other": [(6.0, (-7.0, 4.0)), (6.0, (-6.0, -2.0))],
    "longer": [(8.0, (-8.0, 1.0)), (7.0, (-6.0, -2.0))],
    "long": [(10.0, (6.0, 8.0)), (12.0, (-5.0, 6.0))],
    "with a pause": [(5.0, (8.0, 0.0)), (2.0, (0.0, 0.0)), (8.0, (0.0, 8.0))],
    "one as long as any": [(25.0, (12.0, 0.0))],
}


@pytest.mark.parametrize("rate", [1.0, 5.0])
@pytest.mark.parametrize("bursts", BURSTS.values(), ids=BURSTS)
def test_bursts_in_a_row_are_no_step(bursts: list[tuple[float, tuple[float, float]]], rate: float) -> None:
    """Beside the first of them the second once was a datum that jumps, as only one was taken off."""
    seconds = np.arange(0.0, 140.0, 1.0 / rate)
    for seed in range(3):
        errors, begin = noise(seed, seconds=seconds), 50.13 + 0.31 * seed
        edges = [begin]
        for duration, metres in bursts:
            errors[(seconds >= begin) & (seconds < begin + duration)] += metres
            begin += duration
            edges.append(begin)
        for at in np.searchsorted(seconds, edges).tolist():
            step = step_at(seconds, errors, at, 0.7)
            assert not step.is_beside, (seed, at)
        assert step.is_burst and not step.is_told


def test_what_an_odometry_drifts_at_random_is_no_step_and_a_jump_is_one() -> None:
    random = np.random.default_rng(1)
    sigma, told, jumps, sure = 0.02, 0, 0, 0
    for _ in range(40):
        walked = np.cumsum(np.full(len(SECONDS), 0.03**2))
        drift = np.cumsum(0.03 * random.standard_normal((len(SECONDS), 2)), axis=0)
        errors = drift + 0.01 * random.standard_normal((len(SECONDS), 2))
        told += step_at(SECONDS, errors, 50, sigma, walked).is_told
        jumps += step_at(SECONDS, errors + np.outer(SECONDS >= 50.0, [0.4, 0.0]), 50, sigma, walked).is_told
        sure += step_at(SECONDS, errors + np.outer(SECONDS >= 50.0, [0.5, 0.0]), 50, sigma, walked).is_sure
        burst = np.outer((SECONDS >= 50.0) & (SECONDS < 65.0), [1.0, 0.0])
        assert not step_at(SECONDS, errors + burst, 50, sigma, walked).is_sure
    assert told == 0 and jumps >= 36 and sure >= 36


def test_in_a_gap_of_a_minute_there_is_no_step() -> None:
    """Fixes 10 s apart and a gap of 90 s: no fix lies within reach of the middle of it, which was an IndexError."""
    seconds = np.concatenate([np.arange(0.0, 150.0, 10.0), np.arange(230.0, 400.0, 10.0)])
    step = step_at(seconds, np.outer(seconds > 200.0, [5.0, 0.0]), 15, 0.02)
    assert step.gain == 0.0 and not step.is_told and not step.is_sure


def lost(begin: float, end: float, stated: float, off: float, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Errors (100, 2) of RTK and what it states (100,) [m], which loses its fixed solution from second to second."""
    inside = (begin <= SECONDS) & (end > SECONDS)
    white = np.where(inside, 0.1 * stated, 0.01)[:, None] * np.random.default_rng(seed).standard_normal((100, 2))
    return white + off * np.outer(inside, [0.6, -0.8]), np.where(inside, stated, 0.02)


@pytest.mark.parametrize("end", [45.0, 55.0, 90.0])
@pytest.mark.parametrize("seed", range(4))
def test_a_stretch_of_fixes_counts_as_one_that_is_as_far_off_as_they_state(seed: int, end: float) -> None:
    """Each of them counted for itself, so that sound RTK was said to jump where it lost its fixed solution, and said so."""
    errors, sigma = lost(35.0, end, 0.4, 0.6, seed)
    for at in (35, int(end)):
        assert not step_at(SECONDS, errors, at, sigma).is_seen
        assert step_at(SECONDS, errors, at, 0.02).is_seen  # of fixes that state centimetres it is a jump, or a burst
    far, _ = lost(35.0, end, 0.4, 4.0, seed)
    assert step_at(SECONDS, far, 35, sigma).is_seen  # ten times what they state is more than they say


@pytest.mark.parametrize("seed", range(4))
def test_a_jump_between_fixes_of_centimetres_shows_through_others(seed: int) -> None:
    """Beside a stretch that states half a metre, and with its begin within one."""
    jump = 0.4 * np.outer(SECONDS >= 50.0, [0.8, 0.6])
    beside, sigma = lost(58.0, 70.0, 0.5, 0.5, seed)
    assert step_at(SECONDS, beside + jump, 50, sigma).is_sure
    within, sigma = lost(47.0, 54.0, 0.5, 0.5, seed)
    assert step_at(SECONDS, within + jump, 54, sigma).is_told


def test_what_fixes_share_is_the_least_from_one_to_the_other() -> None:
    sigma = np.random.default_rng(3).choice([0.02, 0.3, 0.5], 30)
    expected = [[(sigma[min(i, j) : max(i, j) + 1] ** 2).min() for j in range(30)] for i in range(30)]
    np.testing.assert_array_equal(_shared(sigma), expected)
    assert np.linalg.eigvalsh(_shared(sigma))[0] > -1e-12


def test_every_fix_is_asked_for_a_step_as_one_alone_is() -> None:
    """About the middle of five seconds, in a recording with a gap of two minutes, in which there is none."""
    seconds = np.concatenate([SECONDS, SECONDS + 220.0])
    random, sigma, walked = np.random.default_rng(4), np.full(200, 0.02), np.cumsum(np.full(200, 0.03**2))
    errors = 0.02 * random.standard_normal((200, 2)) + 0.3 * np.outer(seconds >= 47.0, [0.6, 0.8])
    gains = step_gains(seconds, errors, sigma, walked)
    assert gains.shape == (200,) and gains[0] == 0.0 and gains[100] == 0.0 and int(np.argmax(gains)) == 47
    for at in (47, 52, 147):
        assert gains[at] == pytest.approx(step_at(seconds, errors, at, sigma, walked).gain, rel=0.1, abs=0.5)
