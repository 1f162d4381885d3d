"""A bare cloud in which nothing is found, read as what it may be instead: in feet, mirrored, with another axis up.

Each is one more map, in which the newest query is looked for. Only a place that is believed at once counts: the sentence is then
the cause, and what to do. Derivation: docs/localization.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.runs.saved_map.places import over_ground
from boxplus.runs.saved_map.saved_map import SavedMap
from boxplus.runs.saved_map.tiled_points import TiledPoints
from boxplus.systems.localization.localizer import Localizer

_FOOT_M = 0.3048
_MOST_POINTS = 20_000_000  # that are copied for it
_READINGS: tuple[tuple[str, str, NDArray[np.float64]], ...] = (
    ("in feet", "multiply its points by 0.3048", _FOOT_M * np.eye(3)),
    ("mirrored", "give one of its axes the other sign", np.diag([1.0, -1.0, 1.0])),
    ("with y up", "turn it so that z is up", np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])),
    ("with y down", "turn it so that z is up", np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])),
)


def other_reading(saved: SavedMap, localizer: Localizer, config: LocalMapConfig) -> str | None:
    """How a map would have to be read for what was seen last to be in it; a sentence, None where no reading is believed.

    Args:
        saved: a map without a trajectory; one with has been made by boxplus, and is as it says.
        localizer: which found nothing in it.
        config: that the map was opened with.
    """
    if saved.trajectories or localizer.last_query is None:
        return None
    points = saved.all_points(_MOST_POINTS)
    if points is None:
        return None
    for name, advice, change in _READINGS:
        other = _as_map(saved, (points @ change.T.astype(np.float32)).astype(np.float32), config)
        found = Localizer(other, localizer.config).believes(localizer.last_query) if other.local_maps else None
        if found is not None:
            return f"read {name}, the map has what was seen ({100.0 * found.fit:.0f} % of what stands): {advice}"
    return None


def _as_map(saved: SavedMap, points: NDArray[np.float32], config: LocalMapConfig) -> SavedMap:
    tiled = TiledPoints.of(points, saved.voxel)
    places = over_ground(tiled, tiled.near, config)[0] if tiled.tiles else []
    return SavedMap(saved.path, saved.kind, places, [], saved.voxel, [], tiled)
