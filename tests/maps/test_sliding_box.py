"""The box around the sensor: what it drops is exactly old minus new, and it never oscillates.

Derivation: docs/lidar_inertial_odometry.md, section 9.
"""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from boxplus.maps.sliding_box import GAMMA, SlidingBox

seeds = st.integers(0, 2**32 - 1)
sizes = st.tuples(st.floats(5.0, 200.0), st.floats(3.51, 12.0)).map(lambda s: (s[0] * s[1], s[0]))


def _inside(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return np.all((points >= low) & (points < high), axis=1)


def _bounds(box: SlidingBox) -> tuple[np.ndarray, np.ndarray]:
    bounds = box.bounds
    assert bounds is not None
    return bounds


@given(sizes, seeds, st.sampled_from([0.1, 1.0, 5.0]))
def test_it_drops_old_minus_new(size: tuple[float, float], seed: int, stride: float) -> None:
    side, detection = size
    random = np.random.default_rng(seed)
    box, p = SlidingBox(side, detection), 100.0 * random.normal(size=3)
    assert box.bounds is None
    assert box.follow(p) == []
    assert np.allclose(_bounds(box), (p - 0.5 * side, p + 0.5 * side))
    for _ in range(10):
        p = p + stride * detection * random.normal(size=3)
        old = _bounds(box)
        slabs = box.follow(p)
        new = _bounds(box)
        assert np.allclose(new[1] - new[0], side)
        points = np.concatenate([random.uniform(b[0] - 0.1 * side, b[1] + 0.1 * side, (200, 3)) for b in (old, new)])
        dropped = np.zeros(len(points), bool)
        for low, high in slabs:
            assert np.all(low < high)
            dropped |= _inside(points, low, high)
        # Points at a face may be on either side by rounding.
        clear = np.all([np.abs(points - face).min(axis=1) > 1e-6 * side for face in (*old, *new)], axis=0)
        assert np.array_equal(dropped[clear], (_inside(points, *old) & ~_inside(points, *new))[clear])


@given(sizes, seeds)
def test_it_does_not_oscillate(size: tuple[float, float], seed: int) -> None:
    side, detection = size
    random = np.random.default_rng(seed)
    box, p = SlidingBox(side, detection), np.zeros(3)
    box.follow(p)
    for _ in range(20):
        p = p + detection * random.normal(size=3)
        box.follow(p)
        settled = _bounds(box)
        assert box.follow(p) == []
        assert np.array_equal(_bounds(box), settled)


@given(sizes, seeds)
def test_after_a_step_all_that_the_sensor_sees_is_inside(size: tuple[float, float], seed: int) -> None:
    side, detection = size
    random = np.random.default_rng(seed)
    box, p = SlidingBox(side, detection), np.zeros(3)
    box.follow(p)
    for _ in range(20):
        p = p + detection * random.normal(size=3)
        box.follow(p)
        low, high = _bounds(box)
        assert np.all(p - low >= GAMMA * detection * (1.0 - 1e-9))
        assert np.all(high - p >= GAMMA * detection * (1.0 - 1e-9))


def test_a_sensor_that_stays_near_the_middle_moves_nothing() -> None:
    box = SlidingBox(1000.0, 100.0)
    box.follow(np.zeros(3))
    assert box.follow(np.array([349.0, -349.0, 0.0])) == []
    (slab,) = box.follow(np.array([351.0, 0.0, 0.0]))
    assert np.allclose(slab, ([-500.0, -500.0, -500.0], [-185.0, 500.0, 500.0]))  # 0.45 (1000 − 300) m of the far side
    assert np.allclose(_bounds(box), ([-185.0, -500.0, -500.0], [815.0, 500.0, 500.0]))
