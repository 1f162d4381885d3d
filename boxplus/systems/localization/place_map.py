"""What localisation asks of a map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.maps.local_maps.local_map import LocalMap


class PlaceMap(Protocol):
    """A map with places; `SavedMap` is one."""

    @property
    def local_maps(self) -> Sequence[LocalMap]:
        """Places, each with what can be seen from it; T_odo_map is its pose in the map's frame, z up."""

    @property
    def voxel(self) -> float:
        """Distance between neighbouring points [m]."""

    def points_near(self, centre: ArrayLike, radius: float) -> NDArray[np.float32]:
        """(N, 3) points within a radius [m] of a position (3,), map frame."""
