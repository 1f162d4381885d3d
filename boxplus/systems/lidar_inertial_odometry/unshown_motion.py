"""A start that was taken for rest although the surroundings did not show it along some axis.

In a smooth corridor neither LiDAR nor IMU tells rest from a constant speed. The filter goes on with zero, the likeliest; that
nobody knows it is kept beside the filter, as a constant that it does not estimate (a consider state: Schmidt, 1966). As long as
nothing faces the axis, no scan determines the position along it, whatever noise makes of the planes, and the standard deviation
of the position grows by that of the speed times the time. Once surfaces do face the axis the filter is told to find the speed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.degeneracy import with_weak_axis
from boxplus.filtering.iterated_update import Information, Measurement
from boxplus.filtering.nav_state import T_P, T_V
from boxplus.maps.ikd_tree import IkdTree
from boxplus.systems.lidar_inertial_agreement.surfaces import surfaces_across

_SPEED_M_S = 10.0  # standard deviation: what carries a LiDAR does 30 m/s at most
_SCANS_BETWEEN_LOOKS = 5
_ONE_AXIS = 0.9  # cosine
_AXIS_RAD = 0.005  # how well the planes of a scan show the axis that they leave open


class UnshownMotion:
    """Follows one start.

    Args:
        axes: (K, 3) unit axes in the world along which rest was not shown; none by default.
        time_ns: of the start.
    """

    def __init__(self, axes: NDArray[np.float64] | None = None, time_ns: int = 0) -> None:
        self._axes = np.zeros((0, 3)) if axes is None else axes.copy()
        self._since_ns = time_ns
        self._shown_ns = np.full(len(self._axes), -1, dtype=np.int64)
        self._scans = 0
        self._shown_by = np.zeros((3, 3))  # information about the position, summed

    @property
    def axes(self) -> NDArray[np.float64]:
        """(K, 3) along which the speed is still unknown."""
        return self._axes[self._shown_ns < 0]

    def restrict(self, measurement: Measurement) -> Measurement:
        """The measurement, silent about the position along these axes."""
        return _Silent(measurement, self) if len(self.axes) else measurement

    def refine(self, information: NDArray[np.float64]) -> None:
        """Take in what one scan knows of the position (3, 3): the axes are those it knows least of, better than any start."""
        self._shown_by += information
        _, vectors = np.linalg.eigh(self._shown_by)
        for number in np.flatnonzero(self._shown_ns < 0):
            along = vectors.T @ self._axes[number]
            best = int(np.argmax(np.abs(along)))
            if abs(along[best]) > _ONE_AXIS:
                self._axes[number] = np.sign(along[best]) * vectors[:, best]

    def look(self, p_world: NDArray[np.float64], cov: NDArray[np.float64], time_ns: int, map_cell: float) -> None:
        """Whether the points (N, 3) of a scan show the speed; then the filter's cov (24, 24) is widened, in place, to find it."""
        self._scans += 1
        if not len(self.axes) or self._scans % _SCANS_BETWEEN_LOOKS:
            return
        tree = IkdTree(cell_size=map_cell, rebuild="inplace")
        tree.insert(p_world, downsample=True)
        for number in np.flatnonzero(self._shown_ns < 0):
            axis = self._axes[number]
            if surfaces_across(tree, p_world, axis):
                self._shown_ns[number] = time_ns
                cov[T_V : T_V + 3, T_V : T_V + 3] += _SPEED_M_S**2 * np.outer(axis, axis)

    def widened(self, cov: NDArray[np.float64], time_ns: int) -> NDArray[np.float64]:
        """A covariance at `time_ns`, of the tangent (24, 24) or of the pose (6, 6), with what the filter does not know of."""
        if not len(self._axes):
            return cov
        wide = cov.copy()
        for axis, shown_ns in zip(self._axes, self._shown_ns, strict=True):
            moved = np.zeros(len(cov))
            until_ns = time_ns if shown_ns < 0 else min(int(shown_ns), time_ns)
            moved[T_P : T_P + 3] = (until_ns - self._since_ns) * 1e-9 * axis
            if shown_ns < 0 and len(cov) > T_V:
                moved[T_V : T_V + 3] = axis
            wide += _SPEED_M_S**2 * np.outer(moved, moved)
            aside = moved[T_P : T_P + 3] @ moved[T_P : T_P + 3] * (np.eye(3) - np.outer(axis, axis))
            wide[T_P : T_P + 3, T_P : T_P + 3] += (_SPEED_M_S * _AXIS_RAD) ** 2 * aside
        return wide


class _Silent:
    """A measurement with the direction of the pose that is closest to each axis called weak."""

    def __init__(self, measurement: Measurement, unshown: UnshownMotion) -> None:
        self._measurement, self._unshown = measurement, unshown

    def at(self, x: NDArray[np.float64], *, rematch: bool) -> Information:
        information = self._measurement.at(x, rematch=rematch)
        if rematch:
            self._unshown.refine(information.A[T_P : T_P + 3, T_P : T_P + 3])
        directions = information.directions
        for axis in self._unshown.axes:
            directions = with_weak_axis(directions, axis)
        return replace(information, directions=directions)

    def has_moved(self, x: NDArray[np.float64]) -> bool:
        return self._measurement.has_moved(x)
