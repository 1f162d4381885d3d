"""How fine a map has to be where a scan sees little of a place: small rooms, stairs, a wall before a narrow view.

Five points of the map make a plane, and reach over two cells: with steps of 0.3 by 0.2 m in cells of 0.25 m they lie on the
slope of the stairs, or on tread and wall. Such planes fit as if by chance, move along with the sensor and hold it back. In a
large place they are few among many; in a small one they are most of what tells the height. There cells are halved, where the
scans fill them: finer cells that stay empty would only make five neighbours those of one scan line. (Box-counting dimension:
Falconer, Fractal Geometry, 1990, section 3.1.)

Source: docs/lidar_inertial_odometry.md, section 9.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.lidar.downsampling import VoxelFilter

# How the number of occupied cells grows as they get smaller (the box-counting dimension): 0 is single points, 2 surfaces that are
# seen all over, and more than 2 are surfaces closer together than the cells. Cells that a scan meets, and at most so many, are
# halved where it has more than this dimension; a wood, whose points lie far apart, has 0.8 to 1.
_SURFACES, _FEW_CELLS = 1.2, 1000
_CLUTTER, _SOME_CELLS = 2.1, 2000
_LEAST_CELL = 4.0  # range_sigma: of points closer together noise makes planes


def map_cell_for(points: NDArray[np.float32], voxel: float, config: RegistrationConfig) -> float:
    """Side of the map's cells [m] for what a scan sees: `config.map_cell`, or a half or a quarter of it.

    Args:
        points: (n, 3) float32, the scan, thinned to one point a voxel, any frame.
        voxel: side of these voxels [m].
        config: `map_cell` and `range_sigma`.
    """
    cell = config.map_cell
    while voxel < cell and 0.5 * cell >= _LEAST_CELL * config.range_sigma:
        # So many voxels fill more than so few cells, whatever is seen.
        if not 0 < len(points) < _SOME_CELLS * (cell / voxel) ** 2:
            break
        cells = len(VoxelFilter(cell)(points)[0])
        dimension = math.log(len(points) / cells) / math.log(cell / voxel)
        if not ((cells < _FEW_CELLS and dimension > _SURFACES) or (cells < _SOME_CELLS and dimension > _CLUTTER)):
            break
        cell *= 0.5
    return cell
