"""Corners of a density image with binary descriptors (ORB), and which of two maps match.

Source: Rublee, Rabaud, Konolige and Bradski, ORB: an efficient alternative to SIFT or SURF, ICCV 2011, through OpenCV. One scale:
a density image is metric.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._arguments import as_settings
from boxplus._extras import require
from boxplus._jit import kernel
from boxplus.maps.descriptors.config import DescriptorConfig
from boxplus.maps.descriptors.density_image import density_image

WORDS = 4
"""Words of 64 bits in a descriptor."""

_PATCH = 31  # pixels that a descriptor looks at; what lies nearer to the border has none
_M1, _M2, _M4 = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333), np.uint64(0x0F0F0F0F0F0F0F0F)
_H01 = np.uint64(0x0101010101010101)
_1, _2, _4, _56 = np.uint64(1), np.uint64(2), np.uint64(4), np.uint64(56)


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """What a place is recognised by.

    Attributes:
        xy: (N, 2) in the map's frame [m].
        bits: (N, 4) uint64, descriptors of 256 bits.
    """

    xy: NDArray[np.float64]
    bits: NDArray[np.uint64]


def describe(points: ArrayLike, config: DescriptorConfig | None = None) -> Features:
    """The features of a local map, but for those that look like another one of the same map.

    Args:
        points: (N, 3) in a frame whose z is up [m].

    Raises:
        InputError: OpenCV, the extra `vision`, is not installed; what `density_image` refuses.
    """
    config = as_settings(DescriptorConfig, config)
    cv2 = require("cv2", "which describes density images")
    image = density_image(points, config.cell)
    # A margin of empty ground: corners at the rim of what was seen are described too.
    pixels = np.pad(image.pixels, _PATCH + 1)
    orb = cv2.ORB_create(
        nfeatures=config.features,
        scaleFactor=1.0,
        nlevels=1,
        edgeThreshold=_PATCH,
        patchSize=_PATCH,
        fastThreshold=config.corner_threshold,
    )
    corners, bits = orb.detectAndCompute(pixels, None)
    if not corners:
        return Features(np.zeros((0, 2)), np.zeros((0, WORDS), np.uint64))
    uv = np.array([corner.pt for corner in corners], dtype=np.float64) - (_PATCH + 1)
    words = np.ascontiguousarray(bits).view(np.uint64)
    alone = np.ones(len(words), dtype=np.bool_)
    _mark_alone(words, config.own_distance, alone)
    return Features(image.to_map(uv)[alone], np.ascontiguousarray(words[alone]))


def match_features(query: Features, place: Features, max_distance: int) -> NDArray[np.int64]:
    """(M, 2) rows of query and place that are each other's nearest, and differ in `max_distance` bits at most."""
    nearest = np.empty(len(query.bits), dtype=np.int64)
    back = np.empty(len(place.bits), dtype=np.int64)
    _match(query.bits, place.bits, max_distance, nearest, back)
    rows = np.flatnonzero(nearest >= 0)
    return np.column_stack([rows, nearest[rows]])


@kernel(inline=True)
def _ones(x: np.uint64) -> np.uint64:
    x = x - ((x >> _1) & _M1)
    x = (x & _M2) + ((x >> _2) & _M2)
    x = (x + (x >> _4)) & _M4
    return np.uint64((x * _H01) >> _56)


@kernel(inline=True)
def hamming(a: NDArray[np.uint64], i: int, b: NDArray[np.uint64], j: int) -> np.uint64:
    """Bits in which descriptor a[i] differs from b[j]."""
    return np.uint64(_ones(a[i, 0] ^ b[j, 0]) + _ones(a[i, 1] ^ b[j, 1]) + _ones(a[i, 2] ^ b[j, 2]) + _ones(a[i, 3] ^ b[j, 3]))


@kernel
def _mark_alone(bits: NDArray[np.uint64], own_distance: int, alone: NDArray[np.bool_]) -> None:
    limit = np.uint64(own_distance)
    for i in range(np.uint64(len(bits))):
        for j in range(i + np.uint64(1), np.uint64(len(bits))):
            if hamming(bits, i, bits, j) <= limit:
                alone[i] = False
                alone[j] = False


@kernel
def _match(
    a: NDArray[np.uint64], b: NDArray[np.uint64], max_distance: int, nearest: NDArray[np.int64], back: NDArray[np.int64]
) -> None:
    """Nearest of b for every a, −1 where it is too far or has a nearer one of a; the earlier of equals."""
    best_back = np.full(len(b), np.uint64(257))
    back[:] = -1
    for i in range(np.uint64(len(a))):
        best, found = np.uint64(257), np.int64(-1)
        for j in range(np.uint64(len(b))):
            distance = hamming(a, i, b, j)
            if distance < best:
                best, found = distance, np.int64(j)
            if distance < best_back[j]:
                best_back[j], back[j] = distance, np.int64(i)
        nearest[i] = found if best <= np.uint64(max_distance) else -1
    for i in range(np.uint64(len(a))):
        if nearest[i] >= 0 and back[nearest[i]] != np.int64(i):
            nearest[i] = -1
