"""A start that was taken for rest although the surroundings did not show it along some axis.

In a smooth corridor neither LiDAR nor IMU tells rest from a constant speed. The filter goes on with zero, the likeliest; that
nobody knows it is kept beside the filter, as a constant that it does not estimate (a consider state: Schmidt, 1966). As long as
nothing faces the axis, scans are called weak along it, and the standard deviation of the position grows by that of the speed
times the time. Once surfaces do face the axis they show the speed: either they fit a platform that started at rest, or the
innovations contradict it (`consistency`). Where such surfaces seemed to show rest at the start already, while much of what the
LiDAR saw changed, they are believed only after a way.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.degeneracy import PoseDirections, with_weak_axis
from boxplus.filtering.iterated_update import Posterior
from boxplus.filtering.nav_state import T_P, T_V
from boxplus.maps.ikd_tree import IkdTree
from boxplus.systems.lidar_inertial_agreement.lidar_path.surfaces import SeenSurfaces

_SPEED_M_S = 10.0  # standard deviation: what carries a LiDAR does 30 m/s at most
_SCANS_BETWEEN_LOOKS = 5
_ONE_AXIS = 0.9  # cosine
_TOLD_AFTER_S = 3.0  # of a speed that nothing shows; a hand that turns or steps aside mostly shows it sooner, and rested
_DRIVEN_M = 10.0  # along the axis: a registration that rides along with what it sees shows no way at all
_AXIS_RAD = 0.005  # how well the planes of a scan show the axis that they leave open


class UnshownMotion:
    """Follows one start.

    Args:
        axes: (K, 3) unit axes in the world along which rest was not shown; none by default.
        time_ns: of the start.
        p_world: (3,) where it began [m].
        doubted: whether something spoke against rest: surfaces seemed to show it, and show nothing until they have shown that the
            platform drives.
    """

    def __init__(
        self,
        axes: NDArray[np.float64] | None = None,
        time_ns: int = 0,
        p_world: NDArray[np.float64] | None = None,
        doubted: bool = False,
        text: str = "",
    ) -> None:
        self._axes = np.zeros((0, 3)) if axes is None else axes.copy()
        self._since_ns = time_ns
        self._scans = 0
        self._p_start = np.zeros(3) if p_world is None else p_world.copy()
        self._least_way_m = _DRIVEN_M if doubted else 0.0
        self._shown_by = np.zeros((3, 3))  # information about the position, summed
        self._text, self._told_s = text, 0.0 if doubted else _TOLD_AFTER_S

    @property
    def axes(self) -> NDArray[np.float64]:
        """(K, 3) along which the speed is still unknown."""
        return self._axes

    def words(self, time_ns: int) -> list[str]:
        """The sentence, once: at the start where something spoke against rest, else where nothing has shown it for three seconds.

        Meanwhile scans are weak and the covariance says how little is known; what has turned out to be rest needs no more words.
        """
        if not self._text or not len(self._axes) or time_ns < self._since_ns + round(self._told_s * 1e9):
            return []
        told, self._text = self._text, ""
        return [told]

    def mark(self, posterior: Posterior) -> Posterior:
        """The same posterior, the directions closest to these axes called weak, whatever the scan says of them."""
        if not len(self._axes) or not posterior.valid:
            return posterior
        self._refine(posterior.last.A[T_P : T_P + 3, T_P : T_P + 3])
        directions = posterior.last.directions
        for axis in self._axes:
            directions = with_weak_axis(directions, axis)
        return replace(posterior, last=replace(posterior.last, directions=directions))

    def _refine(self, information: NDArray[np.float64]) -> None:
        """Take in what one scan knows of the position (3, 3): the axes are those it knows least of, better than any start."""
        self._shown_by += information
        _, vectors = np.linalg.eigh(self._shown_by)
        for number in range(len(self._axes)):
            along = vectors.T @ self._axes[number]
            best = int(np.argmax(np.abs(along)))
            if abs(along[best]) > _ONE_AXIS:
                self._axes[number] = np.sign(along[best]) * vectors[:, best]

    def look(
        self, p_world: NDArray[np.float64], p_world_imu: NDArray[np.float64], map_cell: float, directions: PoseDirections | None
    ) -> None:
        """Whether a scan, its points (N, 3) and what it said of the pose, shows the speed; every few scans, as it takes a map."""
        self._scans += 1
        if not len(self._axes) or self._scans % _SCANS_BETWEEN_LOOKS or directions is None:
            return
        shown = np.abs(self._axes @ (p_world_imu - self._p_start)) >= self._least_way_m
        if not shown.any():
            return
        tree = IkdTree(cell_size=map_cell, rebuild="inplace")
        tree.insert(p_world, downsample=True)
        seen = SeenSurfaces(tree, p_world)
        shown[shown] = [seen.face_for_rings(p_world_imu, axis, directions.ratio_along(axis)) for axis in self._axes[shown]]
        self._axes = self._axes[~shown]

    def widened(self, cov: NDArray[np.float64], time_ns: int) -> NDArray[np.float64]:
        """A covariance at `time_ns`, of the tangent (24, 24) or of the pose (6, 6), with what the filter does not know of."""
        wide = cov.copy()
        for axis in self._axes:
            moved = np.zeros(len(cov))
            moved[T_P : T_P + 3] = (time_ns - self._since_ns) * 1e-9 * axis
            if len(cov) > T_V:
                moved[T_V : T_V + 3] = axis
            wide += _SPEED_M_S**2 * np.outer(moved, moved)
            aside = moved[T_P : T_P + 3] @ moved[T_P : T_P + 3] * (np.eye(3) - np.outer(axis, axis))
            wide[T_P : T_P + 3, T_P : T_P + 3] += (_SPEED_M_S * _AXIS_RAD) ** 2 * aside
        return wide
