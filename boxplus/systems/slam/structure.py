"""How much of what stands upright in two local maps stands at the same place.

Ground is level everywhere: half of the points of any street lie on any other one, and the fronts of two streets of one width do
as well. What tells them apart is the rest: corners, doorways, poles, trees, cars. What is not above the lowest points around, or
lies on a level plane, is left out, and so is what stands where the other map sees little.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter

from boxplus.manifolds import se3
from boxplus.maps.local_maps.config import LocalMapRegistrationConfig
from boxplus.maps.local_maps.registration import Surface, plane_normals

Floats = NDArray[np.float64]

_POINTS = 6000  # of a map, looked at
_CELL, _STANDING = 2.0, 0.5  # m: what is so much higher than the lowest point in a cell and those around it is not the ground
_LEVEL = 0.8  # |z| of the normal of a plane that is level; maps are aligned with gravity
_SEEN = 0.75  # of a map's points lie within the distance from its middle that counts as seen


def standing_in_common(own: Surface, there: Surface, T_there_own: Floats, config: LocalMapRegistrationConfig) -> tuple[int, int]:
    """Points of two maps that do not lie on level planes, where the other map sees: of how many there is one near, and how many.

    Of the two directions it is the one with less in common that has any such points; (0, 0) where neither has.

    Args:
        T_there_own: (7,) the maps laid over each other.
    """
    both = [_one_way(own, there, T_there_own, config), _one_way(there, own, se3.inverse(T_there_own), config)]
    return min((found for found in both if found[1]), key=lambda found: (found[0] / found[1], -found[1]), default=(0, 0))


def upright_points(surface: Surface, config: LocalMapRegistrationConfig) -> NDArray[np.float32]:
    """(N, 3) points of a map that stand, in its frame, of about 6,000 that are looked at."""
    return _that_stand(_some_of(surface), surface, config)


def upright_where_seen(
    own: Surface, there: Surface, T_there_own: Floats, config: LocalMapRegistrationConfig
) -> NDArray[np.float32]:
    """(N, 3) points of a map that stand, in its frame, where the other one sees."""
    points = _some_of(own)
    q = se3.act(T_there_own, points.astype(np.float64)).reshape(-1, 3)
    return _that_stand(points[np.linalg.norm(q[:, :2], axis=1) <= _sight(there)], own, config)


def _some_of(surface: Surface) -> NDArray[np.float32]:
    return surface.points[:: max(len(surface.points) // _POINTS, 1)]


def _that_stand(points: NDArray[np.float32], surface: Surface, config: LocalMapRegistrationConfig) -> NDArray[np.float32]:
    """Those of the points (N, 3) of a map that are above the ground and lie on no level plane of it."""
    if not len(points):
        return points
    is_level = np.abs(plane_normals(points, surface, config)[:, 2]) > _LEVEL
    return np.asarray(points[_above_ground(points) & ~is_level])


def _one_way(own: Surface, there: Surface, T_there_own: Floats, config: LocalMapRegistrationConfig) -> tuple[int, int]:
    q = se3.act(T_there_own, upright_where_seen(own, there, T_there_own, config).astype(np.float64)).reshape(-1, 3)
    near = there.tree.nearest(q, 1, max_distance=config.near).counts > 0
    return int(near.sum()), len(near)


def _sight(surface: Surface) -> float:
    """The distance within which a map has most of its points [m]."""
    return float(np.quantile(np.linalg.norm(surface.points[:, :2].astype(np.float64), axis=1), _SEEN))


def _above_ground(points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which points are higher than the lowest one near by."""
    cell = np.floor(points[:, :2].astype(np.float64) / _CELL).astype(np.int64)
    cell -= cell.min(axis=0) - 1
    lowest = np.full(cell.max(axis=0) + 2, np.inf)
    np.minimum.at(lowest, (cell[:, 0], cell[:, 1]), points[:, 2])
    around = minimum_filter(lowest, 3, mode="constant", cval=np.inf)
    return np.asarray(points[:, 2] > around[cell[:, 0], cell[:, 1]] + _STANDING)
