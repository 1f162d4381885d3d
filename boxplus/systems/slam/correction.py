"""From the odometry's world to the map: the correction T_map_odo, which changes where loops were closed.

The odometry itself never jumps. A pose between two local maps is placed from either, each with its own correction, and the two
answers are blended along the way, A Exp(s Log(A⁻¹ B)): the correction of a far-away world origin, with its long lever, never
appears.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError
from boxplus.manifolds import se3
from boxplus.manifolds.se3 import SE3

Floats = NDArray[np.float64]


def _unknown() -> Floats:
    return np.zeros((0, 6, 6))


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """Poses of n local maps before and after.

    Attributes:
        time_ns: (n,) int64, ascending.
        T_odo: (n, 7) along the odometry; T_map: (n, 7) after closing loops.
        covariance: (n, 6, 6) of each T_map against the first, on its right [w, v] [rad, m].
        cross_covariance: (n, 6, 6) of each with the one before it: rows belong to that one. Zero for the first.
        step_covariance: (n, 6, 6) of the odometry from the one before, at least what was assumed. Zero for the first.
            All three are empty where nobody knows.
    """

    time_ns: NDArray[np.int64]
    T_odo: Floats
    T_map: Floats
    covariance: Floats = field(default_factory=_unknown)
    cross_covariance: Floats = field(default_factory=_unknown)
    step_covariance: Floats = field(default_factory=_unknown)

    @property
    def T_map_odo(self) -> Floats:
        """(7,) that of the newest local map: what a live consumer multiplies the odometry by."""
        return se3.compose(self.T_map[-1], se3.inverse(self.T_odo[-1]))

    def apply(self, time_ns: ArrayLike, T_odo_body: ArrayLike) -> Floats:
        """Poses (m, 7) of a body in the map, for those along the odometry (m, 7) at times (m,) [ns].

        Before the first and after the last local map the nearest one's correction holds.

        Raises:
            InputError: poses whose quaternions are not of unit length.
        """
        t, T = np.asarray(time_ns, dtype=np.int64), SE3.check("T_odo_body", T_odo_body)
        before, after, along = self._between(t)
        share = np.clip(along, 0.0, 1.0)
        A, B = (se3.compose(self.T_map[k], se3.compose(se3.inverse(self.T_odo[k]), T)) for k in (before, after))
        return se3.compose(A, se3.exp(share[:, None] * se3.log(se3.compose(se3.inverse(A), B))))

    def covariances(self, time_ns: ArrayLike, T_map_body: ArrayLike) -> Floats:
        """(m, 6, 6) of corrected poses (m, 7) at times (m,) [ns] against the first local map, on their right [w, v] [rad, m].

        Between two maps the odometry's errors are a random walk whose ends are known as well as the maps are: the errors of the
        ends are interpolated, and a share s(1 − s) of what the odometry adds between them comes on top (a Brownian bridge).
        Beyond the first and the last map it grows with time as between the two maps there. Derivation: docs/slam.md.

        Raises:
            InputError: poses whose quaternions are not of unit length; a correction without covariances.
        """
        if len(self.covariance) != len(self.time_ns):
            raise InputError("a correction with covariances", "one without", "take that of Slam")
        t, T = np.asarray(time_ns, dtype=np.int64), SE3.check("T_map_body", T_map_body)
        before, after, along = self._between(t)
        share = np.clip(along, 0.0, 1.0)[:, None, None]
        A, B = (se3.adjoint(se3.compose(se3.inverse(T), self.T_map[k])) for k in (before, after))
        At, Bt = np.swapaxes(A, 1, 2), np.swapaxes(B, 1, 2)
        both = A @ self.cross_covariance[after] @ Bt
        ends = (1.0 - share) ** 2 * (A @ self.covariance[before] @ At) + share**2 * (B @ self.covariance[after] @ Bt)
        ends += share * (1.0 - share) * (both + np.swapaxes(both, 1, 2))
        beyond = np.abs(along[:, None, None] - share)
        total = ends + (share * (1.0 - share) + beyond) * (B @ self.step_covariance[after] @ Bt)
        return np.asarray(0.5 * (total + np.swapaxes(total, 1, 2)))

    def _between(self, t: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
        """The maps before and after times (m,), and the share of the time between them; below 0 and above 1 beyond the ends."""
        after = np.clip(np.searchsorted(self.time_ns, t, side="right"), 1, max(len(self.time_ns) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(self.time_ns) - 1)
        span = np.maximum((self.time_ns[after] - self.time_ns[before]).astype(np.float64), 1.0)
        return before, after, (t - self.time_ns[before]) / span if len(self.time_ns) > 1 else np.zeros(len(t))
