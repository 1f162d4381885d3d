"""What an ikd-tree says of points that it was given or asked for."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class InsertReport(NamedTuple):
    """What became of the points given to `insert` or `build`."""

    inserted: int  #: points stored (with downsampling: winners of their cells)
    superseded: int  #: points not stored because their cell has one
    not_finite: int  #: rejected: a coordinate is NaN or infinite
    too_far: int  #: rejected: farther than 100 km from the origin on an axis
    stored: NDArray[np.bool_]  #: (N,) which of the points given were stored


class Neighbors(NamedTuple):
    """The nearest neighbours of M queries."""

    distances: NDArray[np.float64]  #: (M, k) ascending [m]; inf where there are fewer than k
    points: NDArray[np.float64]  #: (M, k, 3) [m]; nan where there are fewer than k
    counts: NDArray[np.int64]  #: (M,) how many were found
