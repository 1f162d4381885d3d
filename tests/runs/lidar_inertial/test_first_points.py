"""A recording is known again by its first points, and not taken for another one's."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.runs.lidar_inertial.first_points import first_points_of


def _points(seed: int) -> np.ndarray:
    random = np.random.default_rng(seed)
    rays = random.normal(size=(4000, 3))
    return (random.uniform(0.3, 60.0, (4000, 1)) * rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize(("least", "most", "alike"), [(0.0, 100.0, 7), (1.5, 100.0, 5), (0.0, 20.0, 5), (3.0, 12.0, 1)])
def test_a_least_and_a_largest_range_change_the_shells_that_they_cut(least: float, most: float, alike: int) -> None:
    points = _points(1)
    distance = np.linalg.norm(points, axis=1)
    own, cut = first_points_of(points), first_points_of(points[(distance >= least) & (distance <= most)])
    assert sum(a == b for a, b in zip(own, cut, strict=True) if a is not None and b is not None) == alike


def test_other_points_and_few_are_not_alike() -> None:
    assert not set(first_points_of(_points(1))) & set(first_points_of(_points(2)))
    assert set(first_points_of(_points(1)[:3])) == set(first_points_of(np.zeros((0, 3), np.float32))) == {None}
