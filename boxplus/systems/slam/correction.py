"""From the odometry's world to the map: the correction T_map_odo, which changes where loops were closed.

The odometry itself never jumps. A pose between two local maps is placed from either, each with its own correction, and the two
answers are blended along the way, A Exp(s Log(A⁻¹ B)): the correction of a far-away world origin, with its long lever, never
appears.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.manifolds import se3
from boxplus.manifolds.se3 import SE3

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """Poses of n local maps before and after.

    Attributes:
        time_ns: (n,) int64, ascending.
        T_odo: (n, 7) along the odometry; T_map: (n, 7) after closing loops.
    """

    time_ns: NDArray[np.int64]
    T_odo: Floats
    T_map: Floats

    @property
    def T_map_odo(self) -> Floats:
        """(7,) that of the newest local map: what a live consumer multiplies the odometry by."""
        return se3.compose(self.T_map[-1], se3.inverse(self.T_odo[-1]))

    def placed(self, T_enu_map: ArrayLike) -> Correction:
        """The same with the map laid onto the Earth: results of `apply` are in ENU then."""
        return Correction(self.time_ns, self.T_odo, se3.compose(T_enu_map, self.T_map))

    def apply(self, time_ns: ArrayLike, T_odo_body: ArrayLike) -> Floats:
        """Poses (m, 7) of a body in the map, for those along the odometry (m, 7) at times (m,) [ns].

        Before the first and after the last local map the nearest one's correction holds.

        Raises:
            InputError: poses whose quaternions are not of unit length.
        """
        t, T = np.asarray(time_ns, dtype=np.int64), SE3.check("T_odo_body", T_odo_body)
        after = np.clip(np.searchsorted(self.time_ns, t, side="right"), 1, max(len(self.time_ns) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(self.time_ns) - 1)
        span = np.maximum((self.time_ns[after] - self.time_ns[before]).astype(np.float64), 1.0)
        share = np.clip((t - self.time_ns[before]) / span, 0.0, 1.0)
        A, B = (se3.compose(self.T_map[k], se3.compose(se3.inverse(self.T_odo[k]), T)) for k in (before, after))
        return se3.compose(A, se3.exp(share[:, None] * se3.log(se3.compose(se3.inverse(A), B))))
