"""Pictures on surfaces: periodic, in range, and read through a filter that does not alias."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.simulation.cameras.textures import KINDS, LEVELS, OFFSETS, SIDE, read_filtered, texture_pyramids

PYRAMIDS = texture_pyramids(0)


def level(picture: int, k: int) -> np.ndarray:
    begin = picture * int(OFFSETS[LEVELS]) + int(OFFSETS[k])
    side = SIDE >> k
    return PYRAMIDS[begin : begin + side * side].reshape(side, side)


def read(picture: int, x: float, y: float, footprint: tuple[float, float, float, float]) -> float:
    return float(read_filtered(PYRAMIDS, OFFSETS, np.uint32(picture), x, y, *footprint)[0])


@pytest.mark.parametrize("picture", range(KINDS))
def test_every_picture_has_contrast_at_every_scale_and_keeps_its_mean(picture: int) -> None:
    finest = level(picture, 0)
    assert finest.min() >= 0.0 and finest.max() <= 1.0
    assert finest.std() > 0.08 and level(picture, 3).std() > 0.04
    for k in range(1, LEVELS):
        assert abs(level(picture, k).mean() - finest.mean()) < 1e-3


@pytest.mark.parametrize("picture", range(KINDS))
def test_reading_is_the_mean_under_the_footprint(picture: int) -> None:
    """Against the sum over a Gaussian of the footprint's size, pixel by pixel; the picture itself is far rougher than that."""
    random = np.random.default_rng(picture)
    finest = level(picture, 0).astype(np.float64)
    errors = []
    for _ in range(40):
        x, y = random.uniform(0, SIDE, 2)
        size = random.uniform(3.0, 12.0)
        footprint = (size, 0.0, 0.0, size)
        reach = np.arange(-40, 41)
        i, j = int(y) + reach, int(x) + reach
        weight = np.exp(-0.5 * (((i + 0.5 - y) / (0.6 * size)) ** 2)[:, None] - 0.5 * (((j + 0.5 - x) / (0.6 * size)) ** 2)[None])
        mean = float((weight * finest[np.ix_(i % SIDE, j % SIDE)]).sum() / weight.sum())
        errors.append(read(picture, x, y, footprint) - mean)
    assert np.std(errors) < 0.35 * finest.std() and abs(np.mean(errors)) < 0.03


def test_pictures_go_on_beyond_their_borders_and_do_not_jump() -> None:
    random = np.random.default_rng(5)
    for x, y in random.uniform(-2 * SIDE, 2 * SIDE, (50, 2)):
        for footprint in ((0.5, 0.0, 0.0, 0.5), (6.0, 1.0, 0.2, 1.5)):
            here = read(0, x, y, footprint)
            assert here == pytest.approx(read(0, x + SIDE, y - SIDE, footprint), abs=1e-6)
            assert abs(read(0, x + 1e-4, y, footprint) - here) < 1e-3


def test_a_long_footprint_stays_sharp_across() -> None:
    """Stripes across the long axis vanish, stripes along it stay."""
    stripes = np.tile((np.arange(SIDE) // 8 % 2).astype(np.float32), (SIDE, 1))
    from boxplus.simulation.cameras.textures import _pyramid

    pyramid = _pyramid(stripes)
    xs = np.arange(100.0, 132.0, 1.0)
    offsets = OFFSETS
    along_x = [read_filtered(pyramid, offsets, np.uint32(0), x, 50.0, 30.0, 0.0, 0.0, 2.0)[0] for x in xs]
    along_y = [read_filtered(pyramid, offsets, np.uint32(0), x, 50.0, 2.0, 0.0, 0.0, 11.0)[0] for x in xs]
    assert np.std(along_x) < 0.1 and np.std(along_y) > 0.3
