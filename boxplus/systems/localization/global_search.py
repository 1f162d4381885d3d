"""Where in the map may a query be? Every place is compared from above at every turn and shift, by the convolution theorem.

Exhaustive on purpose: features propose places that look alike, but to believe one it has to be known that no other place looks
as much alike, and what was never compared cannot be ruled out. Gravity leaves x, y and yaw; the image of a place has a one where
something stands. With the query's image q turned by a yaw and the place's image p, widened by a cell and less its mean,
Σ q(x) p(x + t) over all shifts t is one product of their Fourier transforms (docs/localization.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.systems.localization.standing import standing

Floats = NDArray[np.float64]

_SIDE, _CONTENT = 128, 40  # cells of an image, and from its middle to the rim of what it holds
_REACH = _SIDE // 2 - _CONTENT  # cells that a query may be shifted without wrapping around
_YAWS = 72
_CELLS = (0.5, 1.0)  # m, within buildings and outdoors
_WIDE = 18.0  # m, of the median distance of what stands, from which the larger one is taken
_PEAKS = 4  # of each place
_APART, _TURNED, _ABOVE = 1.5, np.deg2rad(15.0), 1.5  # m, rad, m: poses nearer to each other than this are one
_AS_ALIKE = 0.5  # of the best agreement; what agrees less is no candidate
_NEAR = 12.0  # m, within which the lowest points tell the ground


@dataclass(frozen=True, slots=True, eq=False)
class Guess:
    """A pose at which a query may lie in the map.

    Attributes:
        place: number of the local map it was found over.
        T_map_query: (7,).
        agreement: share of the query's cells that stand on cells that stand, less what chance gives.
    """

    place: int
    T_map_query: Floats
    agreement: float


class PlaceImages:
    """The images of all places of a map, ready to be compared.

    Args:
        places: local maps, T_odo_map being their pose in the map.
    """

    def __init__(self, places: Sequence[LocalMap]) -> None:
        from scipy.fft import rfft2

        what_stands = [place.points[standing(place.points)][:, :2] for place in places]
        distances = np.concatenate([np.linalg.norm(xy, axis=1) for xy in what_stands] or [np.zeros(0)])
        self.cell = _CELLS[int(len(distances) > 0 and np.median(distances) > _WIDE)]
        self._T_map = [place.T_odo_map for place in places]
        self._ground = [_ground(place.points) for place in places]
        self._transforms = [np.conj(rfft2(_widened(_image(xy, self.cell)))) for xy in what_stands]

    def guesses(self, query: NDArray[np.float32], count: int) -> list[Guess]:
        """The poses at which a query (N, 3), frame level, agrees best with the map; best first."""
        from scipy.fft import irfft2, rfft2

        xy = query[standing(query)][:, :2]
        if not len(xy):
            return []
        yaws = 2.0 * np.pi * np.arange(_YAWS) / _YAWS
        turned = np.stack([_image(xy @ _turn(yaw).T, self.cell) for yaw in yaws])
        weight = float(turned.sum()) / _YAWS
        transforms = rfft2(turned)
        ground = _ground(query)
        shift = _shifts() * self.cell
        within = np.hypot(shift[..., 0], shift[..., 1]) <= _REACH * self.cell
        found: list[Guess] = []
        for number, transform in enumerate(self._transforms):
            # conj(P) Q is the correlation over shifts of the place; the query's are the opposite.
            agreement = irfft2(np.conj(transform * transforms), s=(_SIDE, _SIDE)) / weight
            best_yaw = agreement.argmax(axis=0)
            best = np.where(within, agreement.max(axis=0), -np.inf)
            for u, v in _peaks(best, self.cell):
                yaw = yaws[best_yaw[u, v]]
                T = np.array([np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw), *shift[u, v], self._ground[number] - ground])
                found.append(Guess(number, se3.compose(self._T_map[number], T), float(best[u, v])))
        return _distinct(found, count)


def same_pose(A: Floats, B: Floats, apart: float = _APART, turned: float = _TURNED, above: float = _ABOVE) -> bool:
    """Whether two poses (7,) are nearer to each other than these distances."""
    xi = se3.log(se3.compose(se3.inverse(A), B))
    d = np.abs(A[4:] - B[4:])
    return bool(np.hypot(d[0], d[1]) < apart and d[2] < above and np.linalg.norm(xi[:3]) < turned)


def _distinct(guesses: list[Guess], count: int) -> list[Guess]:
    kept: list[Guess] = []
    for guess in sorted(guesses, key=lambda guess: -guess.agreement):
        if len(kept) == count or (kept and guess.agreement < _AS_ALIKE * kept[0].agreement):
            break
        if not any(same_pose(guess.T_map_query, other.T_map_query) for other in kept):
            kept.append(guess)
    return kept


def _image(xy: NDArray[np.float32], cell: float) -> NDArray[np.float32]:
    """(side, side) one where something stands, the frame's origin in the middle of cell (side / 2, side / 2)."""
    uv = np.floor(xy / np.float32(cell) + np.float32(0.5)).astype(np.int64)
    uv = uv[np.einsum("na,na->n", uv, uv) <= _CONTENT**2] + _SIDE // 2
    image = np.zeros((_SIDE, _SIDE), np.float32)
    image[uv[:, 0], uv[:, 1]] = 1.0
    return image


def _widened(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Each one made a block of 3 × 3, beyond the middle with less weight; and no mean within what an image may hold."""
    wide = image.copy()
    for du in (-1, 0, 1):
        for dv in (-1, 0, 1):
            wide = np.maximum(wide, np.float32(1.0 if du == dv == 0 else 0.6) * np.roll(image, (du, dv), (0, 1)))
    u, v = np.meshgrid(*[np.arange(_SIDE) - _SIDE // 2] * 2, indexing="ij")
    held = np.hypot(u, v) <= _CONTENT
    wide[held] -= wide[held].mean()
    return wide


def _peaks(best: Floats, cell: float) -> list[tuple[int, int]]:
    """Where the agreement of a place is largest, no two within 1.5 m."""
    left, found = best.copy(), []
    reach = int(np.ceil(_APART / cell))
    for _ in range(_PEAKS):
        u, v = (int(k) for k in np.unravel_index(int(left.argmax()), left.shape))
        if not left[u, v] > 0.0:
            break
        found.append((u, v))
        rows, columns = (np.arange(k - reach, k + reach + 1) % _SIDE for k in (u, v))
        left[np.ix_(rows, columns)] = -np.inf
    return found


def _shifts() -> Floats:
    """(side, side, 2) shift in cells that each entry of a circular correlation stands for."""
    k = np.arange(_SIDE)
    signed = np.where(k >= _SIDE // 2, k - _SIDE, k).astype(np.float64)
    return np.stack(np.meshgrid(signed, signed, indexing="ij"), axis=-1)


def _turn(yaw: float) -> NDArray[np.float32]:
    return np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]], dtype=np.float32)


def _ground(points: NDArray[np.float32]) -> float:
    """Height of the lowest twentieth of the points nearby [m]."""
    near = points[np.hypot(points[:, 0], points[:, 1]) < _NEAR, 2]
    return float(np.quantile(near, 0.05)) if len(near) else 0.0
