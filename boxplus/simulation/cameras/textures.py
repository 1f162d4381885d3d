"""Textures of surfaces: periodic pictures with their pyramids, read with a filter that follows the footprint of a pixel.

The pictures are dead leaves (Lee, Mumford and Huang, IJCV 2001): rectangles and discs that cover one another, of all sizes with
the density of r⁻³, which has the statistics of natural images and corners at every scale; walls of bricks; clouds of noise. Each
level of a pyramid is the one below it, low-passed with [1 3 3 1]/8 and halved, so that reading the level that fits the footprint
does not alias. Where a footprint is long, several readings along it keep what is across it sharp (Heckbert, 1989; McCormack et
al., SIGGRAPH 1999).
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel

Pictures = NDArray[np.float32]

SIDE = 1024
LEVELS = 11  # down to one pixel
KINDS = 5
_MOST_READINGS = 6
_ROUND_ENOUGH = 1.5  # ratio of the axes of a footprint that is taken for a disc


def level_offsets() -> NDArray[np.uint32]:
    """Where each level begins in the pyramid of one picture, (LEVELS + 1,)."""
    sizes = [(SIDE >> level) ** 2 for level in range(LEVELS)]
    return np.concatenate([[0], np.cumsum(sizes)]).astype(np.uint32)


OFFSETS = level_offsets()


@functools.lru_cache(maxsize=2)
def texture_pyramids(seed: int) -> Pictures:
    """The pyramids of a seed, one after the other, (KINDS · OFFSETS[LEVELS],) float32 in [0, 1]; read-only."""
    random = np.random.Generator(np.random.PCG64([seed, 300]))
    pictures = [
        _leaves(random, 9000, 3.0, 200.0),
        _leaves(random, 9000, 4.0, 140.0),
        _bricks(random),
        0.6 * _leaves(random, 4000, 8.0, 260.0) + 0.4 * _noise(random),
        0.45 * _leaves(random, 12000, 3.0, 60.0) + 0.55 * _bricks(random, 128, 128),
    ]
    pyramids = np.concatenate([_pyramid(picture) for picture in pictures])
    pyramids.setflags(write=False)
    return pyramids


def _leaves(random: np.random.Generator, count: int, smallest: float, largest: float) -> Pictures:
    # The inverse of the distribution function of a density of r⁻³ between both ends.
    u = random.uniform(size=count)
    radius = 1.0 / np.sqrt(1.0 / smallest**2 - u * (1.0 / smallest**2 - 1.0 / largest**2))
    leaves = np.column_stack(
        [
            random.uniform(0.0, SIDE, (count, 2)),
            radius,
            radius * random.uniform(0.3, 1.0, count),
            random.uniform(0.0, np.pi, count),
            random.uniform(size=count) < 0.25,
            random.uniform(0.02, 0.98, count),
        ]
    )
    # What is large lies below, or it would hide most of what is small.
    leaves = leaves[np.argsort(-radius * random.uniform(0.5, 1.0, count), kind="stable")]
    picture = np.full((SIDE, SIDE), 0.5, np.float32)
    _paint(leaves, picture)
    return picture


@kernel
def _paint(leaves: NDArray[np.float64], picture: Pictures) -> None:
    """Rectangles and discs: centre x y, half length and width, angle, whether it is a disc, value."""
    side = picture.shape[0]
    for k in range(leaves.shape[0]):
        x, y, a, b, angle, disc, value = leaves[k]
        c, s = math.cos(angle), math.sin(angle)
        reach = int(a + b) + 1
        for i in range(int(y) - reach, int(y) + reach + 1):
            for j in range(int(x) - reach, int(x) + reach + 1):
                dx, dy = j - x, i - y
                p, q = (c * dx + s * dy) / a, (c * dy - s * dx) / b
                inside = p * p + q * q <= 1.0 if disc > 0.5 else (abs(p) <= 1.0 and abs(q) <= 1.0)
                if inside:
                    picture[i % side, j % side] = value


def _bricks(random: np.random.Generator, width: int = 64, height: int = 32) -> Pictures:
    """Stones of their own shade, and joints between them."""
    rows, columns = SIDE // height, SIDE // width
    shade = random.uniform(0.25, 0.95, (rows, columns)).astype(np.float32)
    i, j = np.mgrid[0:SIDE, 0:SIDE]
    row = i // height
    j = (j + (row % 2) * (width // 2)) % SIDE
    picture = shade[row, j // width]
    picture = picture * (0.75 + 0.25 * random.uniform(size=(SIDE // 4, SIDE // 4)).repeat(4, 0).repeat(4, 1))
    joint = (i % height < 3) | (j % width < 3)
    return np.where(joint, np.float32(0.05), picture).astype(np.float32)


def _noise(random: np.random.Generator) -> Pictures:
    """Clouds: white noise with a spectrum of 1/f."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(SIDE), np.fft.rfftfreq(SIDE), indexing="ij"))
    spectrum = np.fft.rfft2(random.standard_normal((SIDE, SIDE))) / np.maximum(frequency, 2.0 / SIDE)
    noise = np.fft.irfft2(spectrum, s=(SIDE, SIDE))
    clouds: Pictures = np.clip(0.5 + 0.2 * (noise - noise.mean()) / noise.std(), 0.0, 1.0).astype(np.float32)
    return clouds


def _pyramid(picture: Pictures) -> Pictures:
    levels = [_smoothed(picture, (0.25, 0.5, 0.25), 1)]  # the stairs of painted edges
    for _ in range(1, LEVELS):
        levels.append(_smoothed(levels[-1], (0.125, 0.375, 0.375, 0.125), 1)[::2, ::2])
    return np.concatenate([level.ravel() for level in levels]).astype(np.float32)


def _smoothed(picture: Pictures, weights: tuple[float, ...], before: int) -> Pictures:
    """Convolved along both axes of the period; the first weight is that of the pixel `before` this one."""
    for axis in (0, 1):
        picture = sum(  # type: ignore[assignment]
            np.float32(weight) * np.roll(picture, before - k, axis) for k, weight in enumerate(weights)
        )
    return picture


@kernel(inline=True)
def _bilinear(pyramids: Pictures, begin: np.uint32, level: int, x: float, y: float) -> float:
    """One level at (x, y), in pixels of level 0, counted from the corner of the picture."""
    scale = 1.0 / (1 << level)
    u, v = x * scale - 0.5, y * scale - 0.5
    fu, fv = math.floor(u), math.floor(v)
    a, b = u - fu, v - fv
    side = SIDE >> level
    mask = side - 1
    j0, i0 = np.uint32(int(fu) & mask), np.uint32(int(fv) & mask)
    j1, i1 = np.uint32((int(fu) + 1) & mask), np.uint32((int(fv) + 1) & mask)
    above, below = begin + i0 * np.uint32(side), begin + i1 * np.uint32(side)
    top = (1.0 - a) * pyramids[above + j0] + a * pyramids[above + j1]
    bottom = (1.0 - a) * pyramids[below + j0] + a * pyramids[below + j1]
    value: float = (1.0 - b) * top + b * bottom
    return value


@kernel(borrow=True, fastmath=True, inline=True)
def read_round(pyramids: Pictures, offsets: NDArray[np.uint32], picture: np.uint32, width: float, x: float, y: float) -> float:
    """A picture at (x, y), in its pixels, seen through a round filter about `width` of its pixels wide."""
    begin = picture * offsets[LEVELS]
    if width <= 1.0:
        finest: float = _bilinear(pyramids, begin, 0, x, y)
        return finest
    lod = min(math.log2(width), LEVELS - 1.001)
    level = int(lod)
    fine = _bilinear(pyramids, begin + offsets[level], level, x, y)
    coarse = _bilinear(pyramids, begin + offsets[level + 1], level + 1, x, y)
    value: float = fine + (lod - level) * (coarse - fine)
    return value


@kernel(borrow=True, fastmath=True, inline=True)
def read_filtered(
    pyramids: Pictures, offsets: NDArray[np.uint32], picture: np.uint32,
    x: float, y: float, xu: float, yu: float, xv: float, yv: float,
) -> tuple[float, float]:  # fmt: skip
    """A picture at (x, y), in its pixels, where a pixel of the camera to the right and one down move by (xu, yu) and (xv, yv).

    Returns:
        The value, and the longer axis of the pixel's footprint.
    """
    # The footprint is the ellipse of A = J Jᵀ; its axes are the square roots of the eigenvalues.
    a, b, c = xu * xu + xv * xv, xu * yu + xv * yv, yu * yu + yv * yv
    mean, half = 0.5 * (a + c), 0.5 * (a - c)
    root = math.sqrt(half * half + b * b)
    longest, shortest = math.sqrt(mean + root), math.sqrt(max(mean - root, 0.0))
    readings = int(min(math.ceil(longest / max(_ROUND_ENOUGH * shortest, 1.0)), _MOST_READINGS))
    if readings <= 1:
        return read_round(pyramids, offsets, picture, longest, x, y), longest
    # Of the rows of A − λ₂ I, both along the longer axis, the longer one.
    ex, ey = (root + half, b) if half >= 0.0 else (b, root - half)
    scale = longest / (readings * math.sqrt(ex * ex + ey * ey))
    width = max(longest / readings, shortest)
    total = 0.0
    for k in range(readings):
        t = scale * (k - 0.5 * (readings - 1))
        total += read_round(pyramids, offsets, picture, width, x + t * ex, y + t * ey)
    return total / readings, longest
