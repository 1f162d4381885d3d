"""When do two pairs of local maps that look alike say the same of where one stretch of way is in another?"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.manifolds import se3
from boxplus.systems.slam.loop import Floats

_BASIN_ROTATION, _BASIN_POSITION, _BASIN_DRIFT = 0.2, 4.0, 0.03  # rad, m, m/m: by which two likenesses of one alignment differ


def is_one_alignment(first: Floats, second: Floats, T: Floats, way_m: ArrayLike) -> NDArray[np.bool_]:
    """Whether two alignments put a local map at T at about the same place, so much way from where they were found.

    All of shape (7,), or (n, 7) with ways (n,).
    """
    xi = se3.log(se3.compose(se3.inverse(se3.compose(first, T)), se3.compose(second, T)))
    turn, metres = (np.linalg.norm(part, axis=-1) for part in (xi[..., :3], xi[..., 3:]))
    return np.asarray((turn <= _BASIN_ROTATION) & (metres <= _BASIN_POSITION + _BASIN_DRIFT * np.asarray(way_m)))
