"""Would the same surfaces fit as well somewhere else? Shifts at which the density images of two maps agree too.

Rows of columns, doors or parked cars fit at every multiple of their spacing. All shifts on the ground are compared at once: the
correlation of the two density images over shifts, by the convolution theorem, normalised by the lengths of both.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import se3

Floats = NDArray[np.float64]


def rival_shifts(
    query: NDArray[np.float32],
    place: NDArray[np.float32],
    T_place_query: Floats,
    *,
    cell: float,
    least: float,
    sigma: Floats,
    share: float,
    count: int,
) -> Floats:
    """(K, 2) shifts in the place's frame [m] at which the images agree nearly as well as where the query was laid, best first.

    Args:
        query, place: (N, 3) points, each in its own frame, z up.
        T_place_query: (7,) where the query was laid.
        cell: side of a pixel [m].
        least: shortest shift [m].
        sigma: (2, 2) covariance of where the query may be: shifts beyond three standard deviations are no rivals.
        share: of the agreement where it was laid.
        count: K at most.
    """
    reach = 3.0 * float(np.sqrt(max(np.linalg.eigvalsh(sigma)[-1], 0.0)))
    if reach < least:
        return np.zeros((0, 2))
    agreement, shift = _agreement(query, place, T_place_query, cell, reach)
    at_zero = agreement[0, 0]
    x, y = shift[..., 0], shift[..., 1]
    within = np.einsum("uva,ab,uvb->uv", shift, np.linalg.inv(sigma), shift) <= 9.0
    possible = within & (np.hypot(x, y) >= least) & (agreement >= share * at_zero)
    found: list[Floats] = []
    for k in np.argsort(-agreement, axis=None)[: np.count_nonzero(within)]:
        place_of = np.unravel_index(k, agreement.shape)
        if agreement[place_of] < share * at_zero or len(found) == count:
            break
        own = shift[place_of]
        if possible[place_of] and all(np.linalg.norm(own - other) >= least for other in found):
            found.append(own)
    return np.array(found).reshape(-1, 2)


def turned_rivals(
    query: NDArray[np.float32],
    place: NDArray[np.float32],
    T_place_query: Floats,
    *,
    cell: float,
    reach: float,
    share: float,
) -> list[Floats]:
    """Poses (7,) of the query turned by a quarter, half and three quarters of a turn at which the images agree nearly as well.

    Args:
        reach: of the shift beside the turn [m].
        share: of the agreement where it was laid.
    """
    here = float(_agreement(query, place, T_place_query, cell, cell)[0][0, 0])
    found: list[Floats] = []
    for turn in (0.5 * np.pi, np.pi, 1.5 * np.pi):
        T = se3.compose(T_place_query, np.array([np.cos(0.5 * turn), 0.0, 0.0, np.sin(0.5 * turn), 0.0, 0.0, 0.0]))
        agreement, shift = _agreement(query, place, T, cell, reach)
        near = (shift**2).sum(axis=-1) <= reach**2
        k = np.unravel_index(int(np.argmax(np.where(near, agreement, -np.inf))), agreement.shape)
        if agreement[k] >= share * here:
            T[4:6] += shift[k]
            found.append(T)
    return found


def best_shift(
    query: NDArray[np.float32], place: NDArray[np.float32], T_place_query: Floats, cell: float, reach: float
) -> Floats:
    """(2,) shift within `reach` [m], in the place's frame, at which the images agree best [m]."""
    agreement, shift = _agreement(query, place, T_place_query, cell, reach)
    near = (shift**2).sum(axis=-1) <= reach**2
    return np.asarray(shift[np.unravel_index(int(np.argmax(np.where(near, agreement, -np.inf))), agreement.shape)])


def _agreement(
    query: NDArray[np.float32], place: NDArray[np.float32], T_place_query: Floats, cell: float, reach: float
) -> tuple[Floats, Floats]:
    """Correlation (U, V) of the two density images over shifts (U, V, 2) of the query [m] up to `reach` at which they overlap."""
    moved = se3.act(T_place_query, query.astype(np.float64))[:, :2]
    there = place[:, :2].astype(np.float64)
    low = there.min(axis=0)
    if len(moved):  # beyond that they have nothing in common; an odometry without data for a minute allows for kilometres
        reach = min(reach, float(np.maximum(there.max(axis=0) - moved.min(axis=0), moved.max(axis=0) - low).max()))
    shape = np.ceil((there.max(axis=0) - low) / cell).astype(int) + 1
    inside = ((moved >= low - reach) & (moved <= low + shape * cell + reach)).all(axis=1)
    pad = int(np.ceil(reach / cell)) + 1
    size = shape + 2 * pad
    a, b = (_image(points, low - pad * cell, size, cell) for points in (there, moved[inside]))
    agreement = np.fft.irfft2(np.fft.rfft2(a) * np.conj(np.fft.rfft2(b)), s=a.shape)
    x, y = np.meshgrid(*(np.where((k := np.arange(n)) > n // 2, k - n, k) * cell for n in a.shape), indexing="ij")
    return agreement, np.stack([x, y], axis=-1)


def _image(xy: Floats, low: Floats, size: NDArray[np.int64], cell: float) -> Floats:
    """Cells by the root of their counts, less the mean: what stands up, not how often it was seen."""
    uv = np.floor((xy - low) / cell).astype(np.int64)
    uv = uv[((uv >= 0) & (uv < size)).all(axis=1)]
    counts = np.bincount(uv[:, 0] * size[1] + uv[:, 1], minlength=int(size[0] * size[1])).astype(np.float64)
    image = np.sqrt(np.minimum(counts, 20.0)).reshape(size[0], size[1])
    return np.asarray(np.maximum(image - 1.0, 0.0))
