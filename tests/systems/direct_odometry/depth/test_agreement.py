"""Inverse depths take what those around them say, keep the edges of surfaces, and drop what stands alone."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.systems.direct_odometry.depth.agreement import agreed

SHAPE, CELL = (60, 80), 4


def cells(seed: int) -> np.ndarray:
    """A pixel in every cell."""
    v, u = np.mgrid[: SHAPE[0] // CELL, : SHAPE[1] // CELL]
    corners = CELL * np.stack([u.ravel(), v.ravel()], axis=1)
    return corners + np.random.default_rng(seed).integers(0, CELL, size=corners.shape)


def reference(pixels: np.ndarray, rho: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The formulas of the module, pixel by pixel."""
    mean, deviation, cell = np.zeros(len(rho)), np.full(len(rho), np.inf), pixels // CELL
    for i in range(len(rho)):
        around = np.flatnonzero(np.abs(cell - cell[i]).max(axis=1) <= 2)
        s2 = sigma[around] ** 2 + (0.01 * rho[i]) ** 2 * ((pixels[around] - pixels[i]) ** 2).sum(axis=1)
        alike = (rho[around] - rho[i]) ** 2 < 4.0 * (sigma[i] ** 2 + s2)
        j, w, n = around[alike], 1.0 / s2[alike], np.count_nonzero(alike)
        if n - 1 >= max(3.0, 0.4 * (len(around) - 1)):
            mean[i] = (w * rho[j]).sum() / w.sum()
            scatter = (w * (rho[j] - mean[i]) ** 2).sum() / (n - 1)
            deviation[i] = np.sqrt(max(scatter, 1.0) * min(n, 3) / w.sum())
    return mean, deviation


@pytest.mark.parametrize("seed", range(3))
def test_the_kernel_is_its_formulas(seed: int) -> None:
    """With cells that are empty, depths that stand alone, and neighbours that scatter more and less than they say."""
    rng = np.random.default_rng([seed, 7])
    pixels = cells(seed)[rng.uniform(size=(SHAPE[0] // CELL) * (SHAPE[1] // CELL)) < 0.7]
    rho = 0.2 + 0.001 * pixels[:, 0] + rng.normal(0.0, 0.02, len(pixels)) + 0.3 * (rng.uniform(size=len(pixels)) < 0.1)
    sigma = np.where(pixels[:, 1] < SHAPE[0] // 2, 0.013, 0.04) * rng.uniform(0.8, 1.2, len(pixels))
    expected, found = reference(pixels, rho, sigma), agreed(pixels, rho, sigma, SHAPE, CELL)
    assert 0.5 < np.isfinite(expected[1]).mean() < 1.0
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-12)
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-12)


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
