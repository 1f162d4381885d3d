"""One scan registered to a map: undistort, register, until the motion that is found is the one that was expected."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.degeneracy import PoseDirections
from boxplus.filtering.nav_state import P, R
from boxplus.filtering.plane_information import ONE_LINE
from boxplus.manifolds import so3
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.plane_measurement import REASONS, PlaneMeasurement
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.lidar.downsampling import VoxelFilter
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import Twist
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import (
    FEWEST_USED,
    GOOD_MISFIT_M,
    Turning,
    align,
    honest_information,
    middle_of,
    nodes_within,
    undistorted,
    with_held,
)

MOST_POINTS = 1500  # that a scan is registered with
MOST_MAP_POINTS = 5000  # that it leaves in the map
MOST_RAW = 12_000  # that it is undistorted and filtered from
_PASSES = 3  # undistort, register: the motion found undistorts better than the one expected
# The steps of a path have a floor of noise: a direction may count that says hardly more than noise.
_WEAK = 0.7
_INDEPENDENT_M = 0.5  # between points whose errors are independent
_SAME_MOTION = 2e-3  # rad and m between passes
_COARSE, _FEW = 3, 300  # every so many points are enough for a first pass, where so many stay
_ROUGHLY = 2e-3  # rad and m of the last step of a first pass, which a wrong motion has undistorted
_FASTEST = 35.0, 70.0  # rad/s, m/s: beyond it a registration has gone astray
_LEAST_SHARE = 0.1  # of the points lie on the map, or the scan is not registered; in an open field a fifth of them do at rest
_SAME_START = 0.005, 0.02  # rad and m between two expectations
_SAME_POSE = 0.002, 0.005  # rad and m between what first passes have come to
_POOR = 1.5  # times the usual misfit: worth another guess


@dataclass(frozen=True, slots=True)
class Standing:
    """What a scan is registered from.

    Attributes:
        tree: the map, axes of the path.
        x: (36,) packed, the pose of the scan before, axes of the path.
        rate, velocity: (3,) of the way to it, LiDAR frame [rad/s], and along the path's axes [m/s].
        usual: misfit of the scans so far [m]; 0 where there is none.
    """

    tree: IkdTree
    x: NDArray[np.float64]
    rate: NDArray[np.float64]
    velocity: NDArray[np.float64]
    usual: float


@dataclass(frozen=True, slots=True)
class ScanFit:
    """What has come of it.

    Attributes:
        x: (36,) packed, the pose of the scan, axes of the path.
        rate, velocity: (3,) of the way to it, as those of `Standing`.
        information: (6, 6) of the pose [θ, p], nothing along weak directions.
        weak: whether there are any.
        misfit: rms of the points about their planes [m].
        cost: the same squared, with what points cost that lie on none [m²].
        map_points: (m, 3) float32, what the scan brings to the map, LiDAR frame.
    """

    x: NDArray[np.float64]
    rate: NDArray[np.float64]
    velocity: NDArray[np.float64]
    information: NDArray[np.float64]
    weak: bool
    misfit: float
    cost: float
    map_points: NDArray[np.float32]


class ScanFitter:
    """Registers the scans of a track; its voxels adapt to them from scan to scan. Arguments as for `lidar_path`."""

    def __init__(self, config: RegistrationConfig, guesses: Sequence[Turning], *, undistort: bool, held: bool) -> None:
        self.config = config.model_copy(update={"weak_threshold": min(config.weak_threshold, _WEAK)})
        self._of_few = self.config.model_copy(update={"min_points": max(config.min_points, FEWEST_USED)})
        self.guesses = tuple(guesses)
        self._undistort, self._held = undistort and bool(guesses), held
        self._filter = VoxelFilter(max(config.scan_voxel, config.map_cell), MOST_POINTS)
        self._map_filter = VoxelFilter(config.map_cell, MOST_MAP_POINTS)

    def fork(self) -> ScanFitter:
        """Another one that goes on by itself."""
        other = copy.copy(self)
        other._filter, other._map_filter = copy.deepcopy(self._filter), copy.deepcopy(self._map_filter)
        return other

    def map_points(self, p_lidar: NDArray[np.float32]) -> NDArray[np.float32]:
        """(m, 3) what points (n, 3) of a scan bring to the map."""
        return self._map_filter(p_lidar)[1]

    def map_of(self, first: Scan, rate: NDArray[np.float64], velocity: NDArray[np.float64]) -> IkdTree:
        """The map that a first scan makes for a LiDAR that moves like this."""
        tree = IkdTree(cell_size=self.config.map_cell, rebuild="inplace")
        first_ns = middle_of(first)
        still = undistorted(first, self._nodes(first, first_ns, rate, velocity), first_ns)
        tree.insert(self.map_points(still).astype(np.float64), downsample=True)
        return tree

    def turning(self, middle_ns: int, step_s: float) -> list[NDArray[np.float64]]:
        """The turn rates (3,) [rad/s] of the guesses on the way to a scan."""
        rates = []
        for guess in self.guesses:
            R_guess = guess(np.array([middle_ns - round(step_s * 1e9), middle_ns]))
            rates.append(so3.log(R_guess[0].T @ R_guess[1]) / step_s)
        return rates

    def best(self, at: Standing, scan: Scan, middle_ns: int, step_s: float, expected: Twist | None) -> ScanFit | None:
        """The registration that fits best, from constant velocity, from the guesses and, if need be, from other speeds."""
        starts = [(rate, at.velocity) for rate in (at.rate, *(self.turning(middle_ns, step_s) or [at.rate]))]
        if expected is not None:
            rate, velocity = expected
            starts.append((rate, at.x[R : R + 9].reshape(3, 3) @ so3.exp(0.5 * step_s * rate) @ velocity))
            starts = starts[-1:] if self._held else starts
        # Where two expect about the same, one is enough.
        starts = [
            start
            for number, start in enumerate(starts)
            if not any(
                np.abs(start[0] - other[0]).max() * step_s < _SAME_START[0]
                and np.abs(start[1] - other[1]).max() * step_s < _SAME_START[1]
                for other in starts[:number]
            )
        ]
        needed = len(starts)
        if expected is None:  # who has an estimate needs no search
            starts += [(0.3 * at.rate, 0.3 * at.velocity), (at.rate, 2.0 * at.velocity)]
        best: ScanFit | None = None
        reached: list[NDArray[np.float64]] | None = None if expected is None or self._held else []
        for number, (rate, velocity) in enumerate(starts):
            if number >= needed and best is not None and best.misfit < max(_POOR * at.usual, GOOD_MISFIT_M):
                break
            found = self.fit(at.tree, at.x, scan, middle_ns, step_s, rate, velocity, reached)
            if found is not None and (best is None or found.cost < best.cost):
                best = found
        return best

    def fit(
        self,
        tree: IkdTree,
        x_before: NDArray[np.float64],
        scan: Scan,
        middle_ns: int,
        step_s: float,
        rate: NDArray[np.float64],
        velocity: NDArray[np.float64],
        reached: list[NDArray[np.float64]] | None = None,
    ) -> ScanFit | None:
        """The registration from one expected motion; None where it fails, or goes the way of one before.

        Args:
            tree, x_before: as in `Standing`.
            middle_ns: when the scan has its pose; step_s: the time since the pose before [s].
            rate, velocity: (3,) expected on the way here.
            reached: packed states (36,) that others have come to; those of this one are added. Given by who has an estimate, and
                begins close by: then fewer points and steps are enough for the first pass, and a start ends where another has
                been, as nothing but the state tells what follows. Without one, in poor surroundings, the last centimetre counts.
        """
        R_before, p_before = x_before[R : R + 9].reshape(3, 3), x_before[P : P + 3]
        x = x_before.copy()
        x[R : R + 9] = (R_before @ so3.exp(rate * step_s)).ravel()
        x[P : P + 3] = p_before + velocity * step_s
        directions: PoseDirections | None = None
        held = velocity / np.linalg.norm(velocity) if self._held and velocity.any() else None
        for number in range(_PASSES):
            # Within the scan the motion is what it was found to be on the way here.
            nodes = self._nodes(scan, middle_ns, rate, x[R : R + 9].reshape(3, 3).T @ velocity)
            still = undistorted(scan, nodes, middle_ns)
            points = self._filter(still)[0]
            roughly = number == 0 and reached is not None
            directions = self._roughly(tree, x, points) if roughly and len(points) >= _FEW * _COARSE else None
            if directions is None:
                measurement = self._measurement(tree, points)
                directions = align(x, measurement, self.config, held=held)
            if directions is None:
                return None
            if reached is not None:
                if roughly and any(_same_pose(x, other) for other in reached):
                    return None
                reached.append(x.copy())
            moved = so3.log(R_before.T @ x[R : R + 9].reshape(3, 3)) / step_s, (x[P : P + 3] - p_before) / step_s
            change = max(np.abs(moved[0] - rate).max(), np.abs(moved[1] - velocity).max()) * step_s
            rate, velocity = moved
            if change < _SAME_MOTION and not roughly:
                break
        information = measurement.at(x, rematch=reached is None or measurement.has_moved(x))
        # A point among map points of one scan line is not used, but it does lie on the map.
        on_line = measurement.rejected().get(REASONS[ONE_LINE], 0)
        share = (information.used + on_line) / max(len(points), 1)
        if (
            directions is None
            or information.used < FEWEST_USED
            or share < _LEAST_SHARE
            or max(np.abs(rate).max() / _FASTEST[0], np.abs(velocity).max() / _FASTEST[1]) > 1.0
        ):
            return None
        known = honest_information(information.A[:6, :6], directions, information.residual_rms)
        return ScanFit(
            x=x,
            rate=rate,
            velocity=velocity,
            information=known if held is None else with_held(known, held),
            weak=bool(directions.weak.any()),
            misfit=information.residual_rms,
            cost=information.residual_rms**2 * share + self.config.plane_threshold**2 * (1.0 - share),
            map_points=self.map_points(still),
        )

    def _measurement(self, tree: IkdTree, points: NDArray[np.float32]) -> PlaneMeasurement:
        # Points close together share what is wrong with their surface: finer voxels give more of them, not more information.
        share = min(1.0, self._filter.voxel_size / _INDEPENDENT_M) ** 2
        return PlaneMeasurement(points, tree, self.config, with_extrinsic=False, weight=share)

    def _roughly(self, tree: IkdTree, x: NDArray[np.float64], points: NDArray[np.float32]) -> PoseDirections | None:
        """The first pass with some of the points, x (36,) in place; None, and x stays, where too few of them lie on the map."""
        near = x.copy()
        directions = align(near, self._measurement(tree, points[::_COARSE].copy()), self._of_few, settled=_ROUGHLY)
        if directions is not None:
            x[:] = near
        return directions

    def _nodes(self, scan: Scan, at_ns: int, rate: NDArray[np.float64], velocity: NDArray[np.float64]) -> NDArray[np.float64]:
        return nodes_within(scan, at_ns, rate, velocity, self.guesses[0] if self._undistort else None)


def _same_pose(x: NDArray[np.float64], y: NDArray[np.float64]) -> bool:
    """Whether two packed states (36,) are so near that the same comes of both."""
    turned = so3.log(x[R : R + 9].reshape(3, 3).T @ y[R : R + 9].reshape(3, 3))
    return bool(np.abs(turned).max() < _SAME_POSE[0] and np.abs(x[P : P + 3] - y[P : P + 3]).max() < _SAME_POSE[1])
