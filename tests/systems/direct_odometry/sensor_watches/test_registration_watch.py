"""Depths that lie on other pixels than their grey values are contradicted, with the shift; registered ones are not."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.sensors.images.image import Image
from boxplus.systems.direct_odometry.sensor_watches.registration_watch import RegistrationWatch

SHAPE = (240, 320)


def boxes(rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Grey values and depths of boxes in front of a wall, all of them painted with stains of their own."""
    grey, depth = np.full(SHAPE, 100.0), np.full(SHAPE, 4.0)
    for _ in range(25):
        height, width = rng.integers(25, 80, 2)
        top, left = rng.integers(0, SHAPE[0] - height), rng.integers(0, SHAPE[1] - width)
        grey[top : top + height, left : left + width] = rng.uniform(20.0, 230.0)
        depth[top : top + height, left : left + width] = rng.uniform(1.0, 3.5)
    for _ in range(60):
        top, left = rng.integers(0, SHAPE[0] - 15), rng.integers(0, SHAPE[1] - 15)
        grey[top : top + rng.integers(4, 15), left : left + rng.integers(4, 15)] += rng.uniform(-60.0, 60.0)
    grey += rng.normal(0.0, 2.0, SHAPE)
    return grey.astype(np.float32), (depth * (1.0 + rng.normal(0.0, 0.002, SHAPE))).astype(np.float32)


def contradiction(seed: int, u: int, v: int, keyframes: int = 8) -> str:
    """Of depths that were moved by (u, v) pixels."""
    rng, watch = np.random.default_rng(seed), RegistrationWatch()
    for _ in range(keyframes):
        grey, depth = boxes(rng)
        watch.add(Image(grey), np.roll(depth, (v, u), axis=(0, 1)))
    return watch.contradiction


@pytest.mark.parametrize("seed", range(4))
def test_registered_depths_are_not_contradicted(seed: int) -> None:
    assert contradiction(seed, 0, 0) == ""
    assert contradiction(seed, 1, -1) == ""  # no closer than a sensor may put its edges


@pytest.mark.parametrize("seed", [0, 1, 5, 28])
def test_texture_that_happens_to_lie_along_edges_says_nothing(seed: int) -> None:
    """Surfaces end where grey values do not change, and every keyframe sees the same: chance is not told by its scatter."""
    rng, watch = np.random.default_rng(seed), RegistrationWatch()
    (grey, _), (_, depth) = boxes(rng), boxes(rng)
    for _ in range(8):
        noise = rng.normal(0.0, 2.0, (2, *SHAPE))
        watch.add(Image((grey + noise[0]).astype(np.float32)), (depth * (1.0 + 0.001 * noise[1])).astype(np.float32))
    assert watch.contradiction == ""


@pytest.mark.parametrize(("u", "v"), [(16, 0), (-8, 0), (0, 12), (-10, 6)])
def test_a_shift_is_named(u: int, v: int) -> None:
    assert f"moved by {-u:+d} pixels along u and {-v:+d} along v" in contradiction(7, u, v)


def test_few_keyframes_decide_nothing() -> None:
    assert contradiction(1, 16, 0, keyframes=4) == ""


def test_without_edges_nothing_is_said() -> None:
    rng, watch = np.random.default_rng(2), RegistrationWatch()
    grey = (100.0 + 40.0 * np.sin(0.3 * np.arange(SHAPE[1]))) * np.ones((SHAPE[0], 1))
    wall = (2.0 + 0.001 * np.arange(SHAPE[1])) * np.ones((SHAPE[0], 1))
    for _ in range(8):
        watch.add(Image(grey.astype(np.float32)), (wall * (1.0 + rng.normal(0.0, 1e-4, SHAPE))).astype(np.float32))
    watch.add(Image(grey.astype(np.float32)), np.zeros(SHAPE, np.float32))  # no depth at all
    assert watch.contradiction == ""
