"""Whether two sessions fit as well turned as wholes: a room that is the same from either end, and one that is not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.systems.sessions.config import SessionsConfig
from boxplus.systems.sessions.other_alignments import fits_otherwise, other_alignments
from boxplus.systems.sessions.places import Places
from boxplus.systems.sessions.session import Session

CONFIG = SessionsConfig()
CONFIG = CONFIG.model_copy(update={"slam": CONFIG.slam.model_copy(update={"appearance": "none"})})
HERE = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def wall(x: tuple[float, float], y: tuple[float, float]) -> NDArray[np.float64]:
    """Points every 0.25 m on an upright wall of 3 m between two corners."""
    count = int(np.hypot(x[1] - x[0], y[1] - y[0]) / 0.25) + 1
    line = np.column_stack([np.linspace(*x, count), np.linspace(*y, count)])
    z = np.arange(0.125, 3.0, 0.25)
    return np.column_stack([np.repeat(line, len(z), axis=0), np.tile(z, count)])


def room(half_width: tuple[float, float]) -> NDArray[np.float64]:
    """28 m along x about the origin, as wide as given at either end: floor, sides and ends."""
    low, high = half_width
    grid = np.stack(np.meshgrid(np.arange(-14.0, 14.1, 0.5), np.arange(-9.0, 9.1, 0.5), [0.0]), axis=-1).reshape(-1, 3)
    floor = grid[np.abs(grid[:, 1]) <= np.interp(grid[:, 0], [-14.0, 14.0], half_width)]
    sides = [wall((-14, 14), (s * low, s * high)) for s in (-1, 1)]
    return np.concatenate([floor, *sides, wall((-14, -14), (-low, low)), wall((14, 14), (-high, high))])


def session(name: str, points: NDArray[np.float64], seed: int, noise: float = 0.01) -> Places:
    """Walked along x, everything seen from everywhere, to 1 cm."""
    random, maps = np.random.default_rng(seed), []
    for k, x in enumerate(np.linspace(-8.0, 8.0, 5)):
        T = HERE + np.array([0.0, 0.0, 0.0, 0.0, x, 0.0, 1.2])
        seen = se3.act(se3.inverse(T), points + random.normal(0.0, noise, points.shape)).astype(np.float32)
        maps.append(LocalMap(k, k, k, k, T, 1e-6 * np.eye(6), 4.0 * k, seen, 1))
    return Places(Session.of(name, maps), CONFIG.slam)


def otherwise(points: NDArray[np.float64]) -> str | None:
    a, b = session("a", points, 1), session("b", points, 2)
    return fits_otherwise(a, b, HERE, other_alignments(a, b, HERE, CONFIG), CONFIG)


def test_a_room_that_is_the_same_from_either_end_fits_turned_by_half() -> None:
    told = otherwise(room((6.0, 6.0)))
    assert told is not None and "as wholes they fit as well turned by 180°" in told


def test_a_room_that_widens_does_not() -> None:
    assert otherwise(room((2.0, 9.0))) is None
