"""The quick look at planar residuals against the general one."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.optimization.incremental.contributions import check_planar_poses, check_relative_poses, turned_factors
from boxplus.optimization.losses import SQUARED


@pytest.mark.parametrize("spread", [0.02, 3.0])
def test_the_planar_look_sees_what_the_general_one_sees(spread: float) -> None:
    rng = np.random.default_rng(7)
    poses, count = 40, 300
    T = np.column_stack([rng.uniform(-np.pi, np.pi, poses), rng.normal(scale=20.0, size=(poses, 2))])
    index = rng.integers(0, poses, (count, 2)).astype(np.uint32)
    Z = np.column_stack([rng.uniform(-np.pi, np.pi, count), rng.normal(scale=spread, size=(count, 2))])
    W, r, J_i, J_j = (rng.normal(size=(count, 3, *more)) for more in ((3,), (), (3,), (3,)))
    numbers = np.arange(poses) - 2  # the first two are fixed
    numbers[:2] = -1
    start, delta = 3 * np.arange(poses), rng.normal(scale=spread, size=3 * poses)
    rows = rng.permutation(count)[:200]
    turned = np.zeros_like(W)
    turned_factors(0, count, Z, W, turned)
    general, planar = np.zeros(len(rows), np.bool_), np.zeros(len(rows), np.bool_)
    tolerance = 15.0 * (1.0 + spread)
    check_relative_poses(
        rows, False, True, T, T, index, Z, W, SQUARED, 1.0, numbers, numbers, start, delta, tolerance, r, J_i, J_j, general
    )
    check_planar_poses(rows, T, T, index, Z, turned, numbers, numbers, start, delta, tolerance, r, J_i, J_j, planar)
    assert (planar == general).all()
    assert 20 < general.sum() < 180


def test_the_planar_look_takes_nan_for_off() -> None:
    T, index, one = np.array([[0.0, 0.0, 0.0], [0.0, np.nan, 0.0]]), np.array([[0, 1]], np.uint32), np.eye(3)[None]
    is_off = np.zeros(1, np.bool_)
    none = np.zeros((1, 3))
    check_planar_poses(
        np.array([0]),
        T,
        T,
        index,
        none,
        one,
        np.arange(2),
        np.arange(2),
        3 * np.arange(2),
        np.zeros(6),
        1e9,
        none,
        one,
        one,
        is_off,
    )
    assert is_off.all()
