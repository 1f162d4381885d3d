"""All that an odometry on a map depends on, to go on from later."""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.ikd_tree import IkdTree
from boxplus.sensors.lidar.downsampling import VoxelFilter

_OF_ITS_OWN = ("config", "map", "_voxel_filter")  # settings, and what is kept by its content


class Snapshots:
    """An odometry with a map and a voxel filter; of the rest of its attributes each can be written as it is."""

    map: IkdTree
    _voxel_filter: VoxelFilter

    def snapshot(self) -> dict[str, object]:
        """Everything the next estimates depend on, but for the settings: to be written at once, as it goes on changing."""
        state = {name: value for name, value in vars(self).items() if name not in _OF_ITS_OWN}
        return state | {"map": (self.map.points(), self.map.origin), "scan_voxel": self._voxel_filter.voxel_size}

    def restore(self, state: dict[str, object]) -> None:
        """Go on where `snapshot` was taken, in an odometry of the same settings that has not begun."""
        for name, value in state.items():
            if name not in ("map", "scan_voxel"):
                setattr(self, name, value)
        points, origin = cast(tuple[NDArray[np.float64], NDArray[np.float64]], state["map"])
        self.map.build(points, origin=origin if len(points) else None)
        self._voxel_filter.voxel_size = cast(float, state["scan_voxel"])
