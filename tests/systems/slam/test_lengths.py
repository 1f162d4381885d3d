"""The lengths of a map against those of a scan in it: a hall that is too long, and surfaces that cannot tell."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.manifolds import se3
from boxplus.maps.local_maps.config import LocalMapRegistrationConfig
from boxplus.maps.local_maps.registration import Surface
from boxplus.simulation.worlds.worlds import city, hall
from boxplus.systems.slam.lengths import compare_lengths
from tests.maps.local_maps.test_registration import pose, seen

CONFIG = LocalMapRegistrationConfig()


@pytest.mark.parametrize("ratio", [1.0, 1.01, 0.985])
def test_the_ratio_of_lengths_is_found(ratio: float) -> None:
    for seed, world, x in ((0, hall(seed=0), 3.0), (1, city(2, 2, seed=1), 60.0)):
        random = np.random.default_rng(seed)
        a, b = pose(random, x, 3.0), pose(random, x + 1.0, 2.0)
        T = se3.compose(se3.inverse(a), b)
        T[4:] *= ratio
        target = Surface.of((ratio * seen(world, a, random).points).astype(np.float32))
        found = compare_lengths(seen(world, b, random, 4000).points, target, T, CONFIG, distance=0.6)
        assert found is not None and abs(found.log_ratio - np.log(ratio)) < 0.003
        assert 0.0002 < found.sigma < 0.02  # of one scan, whose ranges may have an offset too


def test_a_wall_on_one_side_tells_nothing_of_lengths() -> None:
    """What is longer is as well farther."""
    random = np.random.default_rng(3)
    wall = random.uniform([5.0, -8.0, 0.0], [5.0, 8.0, 4.0], (6000, 3)) + random.normal(0.0, 0.01, (6000, 3))
    here = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    found = compare_lengths(
        wall[::6].astype(np.float32), Surface.of((1.01 * wall).astype(np.float32)), here, CONFIG, distance=0.6
    )
    assert found is None or found.sigma > 0.05
    few = compare_lengths(wall[:20].astype(np.float32), Surface.of(wall.astype(np.float32)), here, CONFIG, distance=0.6)
    assert few is None


def test_what_is_far_from_one_says_nothing() -> None:
    """Steps of a fit that no surface holds once went to a factor of 150, ± 56 of its logarithm."""
    random = np.random.default_rng(5)
    wall = random.uniform([1.0, -1.0, -1.0], [1.2, 1.0, 1.0], (4000, 3)).astype(np.float32)
    here = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    for factor in (0.5, 0.8, 1.2, 1.5):
        found = compare_lengths(np.float32(factor) * wall[::5], Surface.of(wall), here, CONFIG, distance=0.6)
        assert found is None or (abs(found.log_ratio) < 0.1 and found.sigma < 0.1)
