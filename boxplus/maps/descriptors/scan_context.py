"""A place as heights around it, ring by ring: recognised under any heading, without OpenCV, from within a few metres.

The ground about the frame's origin is cut into rings and sectors; each cell has the height of its highest point. A turn shifts
the columns; two places are as far apart as their columns' directions differ, at the best shift,

    d = min_s (1/n) Σ_j (1 − cos(c_j, c'_{j+s})),        n columns that either place has points in,

and the means of the rings, which no turn changes, find the few places that are compared.

Source: Kim and Kim, Scan Context: Egocentric Spatial Descriptor for Place Recognition within 3D Point Cloud Map, IROS 2018.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_numbers
from boxplus.errors import InputError

Floats = NDArray[np.float64]

RINGS, SECTORS = 20, 60
_GROUND = 0.05  # quantile of the heights that is taken for the ground
_COMPARED = 10  # places with the nearest ring keys


@dataclass(frozen=True, slots=True, eq=False)
class ScanContext:
    """The heights (RINGS, SECTORS) around a place [m]; 0 where there is no point."""

    heights: Floats

    @property
    def ring_key(self) -> Floats:
        """(RINGS,) mean height of each ring."""
        return np.asarray(self.heights.mean(axis=1))

    def distance(self, other: ScanContext) -> tuple[float, float]:
        """How different two places are, 0 to 1, and the yaw [rad] of T_other_self that shows it best."""
        a, b = (_unit_columns(context.heights) for context in (self, other))
        cosines = a.T @ b
        seen = np.logical_or.outer(a.any(axis=0), b.any(axis=0))
        j = np.arange(SECTORS)
        means = np.array([_mean(1.0 - cosines[j, (j + s) % SECTORS], seen[j, (j + s) % SECTORS]) for s in range(SECTORS)])
        best = int(np.argmin(means))
        return float(means[best]), 2.0 * np.pi * (best if best <= SECTORS // 2 else best - SECTORS) / SECTORS


def scan_context(points: ArrayLike, max_range: float) -> ScanContext:
    """Of points (N, 3) in a frame whose z is up [m], out to `max_range` [m].

    Raises:
        InputError: another shape, coordinates that are not finite, a range that is not positive.

    Example:
        >>> import numpy as np
        >>> pole = np.array([[0.0, 10.0, h] for h in (0.0, 1.0, 2.0)])
        >>> wall = np.array([[15.0, y, h] for y in (-2.0, 0.0, 2.0) for h in (0.0, 3.0)])
        >>> context = scan_context(np.concatenate([pole, wall]), 40.0)
        >>> round(context.distance(context)[0], 6)
        0.0
    """
    xyz = as_numbers(points, "points").astype(np.float64)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or not np.isfinite(xyz).all() or not max_range > 0.0:
        raise InputError(
            "finite points (N, 3) and a positive range", f"shape {xyz.shape}, {max_range} m", "give the points of a local map [m]"
        )
    heights = np.zeros((RINGS, SECTORS))
    distance = np.hypot(xyz[:, 0], xyz[:, 1])
    near = xyz[distance < max_range]
    if len(near):
        ring = (distance[distance < max_range] * (RINGS / max_range)).astype(np.int64)
        turn = np.arctan2(near[:, 1], near[:, 0]) / (2.0 * np.pi) % 1.0
        sector = np.minimum((turn * SECTORS).astype(np.int64), SECTORS - 1)
        above = near[:, 2] - np.quantile(near[:, 2], _GROUND)
        np.maximum.at(heights, (ring, sector), above)
    return ScanContext(heights)


class ScanContextIndex:
    """Scan contexts of places, numbered 0, 1, … as they are added."""

    def __init__(self) -> None:
        self._places: list[ScanContext] = []
        self._keys = np.zeros((64, RINGS))

    def add(self, place: ScanContext) -> None:
        """Add the next place."""
        if len(self._places) == len(self._keys):
            self._keys = np.concatenate([self._keys, np.zeros_like(self._keys)])
        self._keys[len(self._places)] = place.ring_key
        self._places.append(place)

    def candidates(self, query: ScanContext, *, before: int | None = None, count: int = 3) -> list[tuple[int, float, float]]:
        """Places that look most like the query, the nearest first: number, distance, and yaw [rad] of T_place_query.

        Args:
            before: only places of smaller numbers.
        """
        last = len(self._places) if before is None else max(min(before, len(self._places)), 0)
        apart = ((self._keys[:last] - query.ring_key) ** 2).sum(axis=1)
        near = np.argsort(apart, kind="stable")[:_COMPARED].tolist()
        found = [(place, *query.distance(self._places[place])) for place in near]
        return sorted(found, key=lambda candidate: candidate[1])[:count]


def _unit_columns(heights: Floats) -> Floats:
    norm = np.linalg.norm(heights, axis=0)
    return np.asarray(heights / np.where(norm > 0.0, norm, 1.0))


def _mean(values: Floats, counted: NDArray[np.bool_]) -> float:
    return float(values[counted].mean()) if counted.any() else 1.0
