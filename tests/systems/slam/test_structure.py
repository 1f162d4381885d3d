"""What stands upright in two maps: counted where both see, whatever the ground has in common."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.manifolds import se3
from boxplus.maps.local_maps.config import LocalMapRegistrationConfig
from boxplus.maps.local_maps.registration import Surface
from boxplus.systems.slam.structure import standing_in_common

CONFIG = LocalMapRegistrationConfig()
HERE = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def ground(random: np.random.Generator, slope: float = 0.0, half: float = 20.0) -> np.ndarray:
    xy = random.uniform(-half, half, (6000, 2))
    return np.column_stack([xy, slope * xy[:, 0] - 1.8])


def wall(random: np.random.Generator, y: float, slope: float = 0.0) -> np.ndarray:
    x = random.uniform(-15.0, 15.0, 1500)
    return np.column_stack([x, np.full(1500, y), slope * x + random.uniform(-1.8, 2.0, 1500)])


def surface(*parts: np.ndarray) -> Surface:
    return Surface.of(np.concatenate(parts).astype(np.float32))


@pytest.mark.parametrize("slope", [0.0, 0.1])
def test_the_ground_does_not_count(slope: float) -> None:
    """One wall of two is in the other map; the ground, most of the points, in both."""
    random = np.random.default_rng(1)
    one = surface(ground(random, slope), wall(random, 5.0, slope), wall(random, -9.0, slope))
    two = surface(ground(random, slope), wall(random, 5.0, slope))
    shared, asked = standing_in_common(one, two, HERE, CONFIG)
    assert 0.4 < shared / asked < 0.6
    shared, asked = standing_in_common(one, one, HERE, CONFIG)
    assert shared == asked > 300


def test_a_pose_that_is_off_leaves_nothing_in_common() -> None:
    random = np.random.default_rng(2)
    one = surface(ground(random), wall(random, 5.0))
    T = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 2.0, 0.0]))
    shared, asked = standing_in_common(one, one, T, CONFIG)
    assert asked > 300 and shared == 0


def test_a_ceiling_and_bare_ground_do_not_stand() -> None:
    random = np.random.default_rng(3)
    floor = ground(random, half=10.0)
    room = surface(floor, floor + np.array([0.0, 0.0, 3.0]))
    shared, asked = standing_in_common(room, room, HERE, CONFIG)
    assert asked < 100 and shared == asked
    assert standing_in_common(surface(ground(random)), surface(ground(random)), HERE, CONFIG) == (0, 0)


def test_a_stray_point_far_away_costs_nothing() -> None:
    random = np.random.default_rng(4)
    parts = ground(random), wall(random, 5.0)
    stray = np.array([[1e6, -1e6, 0.0]])
    shared, asked = standing_in_common(surface(*parts, stray), surface(*parts, stray), HERE, CONFIG)
    assert shared == asked > 300
    apart = se3.exp(np.array([0.0, 0.0, 0.0, 500.0, 0.0, 0.0]))
    assert standing_in_common(surface(*parts), surface(*parts), apart, CONFIG) == (0, 0)


def test_a_direction_with_nothing_to_show_does_not_hide_the_other() -> None:
    """Bare ground over ground with two walls: the one has nothing that stands, the walls of the other are not there."""
    random = np.random.default_rng(5)
    bare, walls = surface(ground(random)), surface(ground(random), wall(random, 5.0), wall(random, -9.0))
    shared, asked = standing_in_common(bare, walls, HERE, CONFIG)
    assert shared == 0 and asked > 300
    assert standing_in_common(walls, bare, HERE, CONFIG) == (shared, asked)
