"""Inverse depths take what those around them say, keep the edges of surfaces, and drop what stands alone."""

from __future__ import annotations

import numpy as np

from boxplus.systems.direct_odometry.depth.agreement import agreed

SHAPE, CELL = (60, 80), 4


def cells(seed: int) -> np.ndarray:
    """A pixel in every cell."""
    v, u = np.mgrid[: SHAPE[0] // CELL, : SHAPE[1] // CELL]
    corners = CELL * np.stack([u.ravel(), v.ravel()], axis=1)
    return corners + np.random.default_rng(seed).integers(0, CELL, size=corners.shape)


def test_noise_falls_and_is_said() -> None:
    pixels, rng = cells(0), np.random.default_rng(1)
    true = 0.1 + 0.0002 * pixels[:, 0]  # a wall seen a little aslant
    mean, deviation = agreed(pixels, true + rng.normal(0.0, 0.02, len(true)), np.full(len(true), 0.02), SHAPE, CELL)
    kept = np.isfinite(deviation)
    assert kept.mean() > 0.95
    assert np.std((mean - true)[kept]) < 0.4 * 0.02
    assert 0.3 < np.std((mean - true)[kept] / deviation[kept]) < 1.2


def test_an_edge_stays_and_what_stands_alone_goes() -> None:
    pixels, rng = cells(2), np.random.default_rng(3)
    true = np.where(pixels[:, 0] < 40, 0.2, 0.5)
    rho = true + rng.normal(0.0, 0.01, len(true))
    alone = np.arange(len(true)) % 37 == 5
    rho[alone] += 0.9
    mean, deviation = agreed(pixels, rho, np.full(len(true), 0.01), SHAPE, CELL)
    assert np.isinf(deviation[alone]).all()
    kept = np.isfinite(deviation)
    assert kept[~alone].mean() > 0.9 and np.abs((mean - true)[kept]).max() < 0.04


def test_few_say_nothing() -> None:
    mean, deviation = agreed(np.array([[5, 5], [9, 5]]), np.array([0.2, 0.2]), np.array([0.01, 0.01]), SHAPE, CELL)
    assert np.isinf(deviation).all() and not mean.any()
    assert not len(agreed(np.zeros((0, 2), np.int64), np.zeros(0), np.zeros(0), SHAPE, CELL)[0])
