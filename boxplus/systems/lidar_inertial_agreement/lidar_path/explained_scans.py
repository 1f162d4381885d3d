"""Does a path of the LiDAR explain the scans it was found from, as well as the motion that an estimator expected?

Rings or columns of points far apart fit their own pattern: a registration may stay with it while the platform moves on,
with small residuals, scan after scan. Seconds apart it shows. Under the right motion surfaces of the first scans are where the
last scans see them; under a wrong one points lie beside them, or where nothing was. A path that explains its scans clearly worse
than another motion does has gone astray, and cannot contradict that motion. The other way round, an estimator whose motion
explains them clearly worse, and which is somewhere else by the end, has gone astray: no sample of the IMU has caused that path.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.lidar.downsampling import VoxelFilter
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.finding import Finding
from boxplus.systems.lidar_inertial_agreement.lidar_path.changes.common_motion import explains_changes
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath, Poses, Twist
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import Turning, middle_of
from boxplus.systems.lidar_inertial_agreement.lidar_path.surfaces import surface_distances

_WORSE = 1.3  # times the mean squared distance; sound comparisons reach 1.2, paths that ride with a pattern 1.6 to 6
# An estimate is called astray where it ends this far from a path that the scene shows in all but a few scans, and so much more of
# the points lie off the surfaces, in shares of what a point far off counts. Before single walls, paths of a narrow view drift by
# a metre of six, at which up to 0.08 more lie off; under estimates that run away 0.18 and more do.
_ASTRAY_RAD, _ASTRAY_M, _ASTRAY_SHARE, _FEW_WEAK, _MORE_OFF = 0.2, 0.5, 0.25, 0.1, 0.13
# Under a path at rest nothing comes newly into view: where so much lies off it all the same, it is the path that stays with a
# pattern. On a highway rings held one while the platform braked from 17 to 9 m/s: 0.34 lay off; at true rest 0.01 to 0.22.
_AT_REST, _OFF_AT_REST = 0.1, 0.25  # of the other way, and of what a point far off counts
_TURNS_ALIKE_RAD = 0.02
_FEWEST_SCANS = 9
_FIRST, _LAST = 6, 4  # scans of the first and of the last third
_MOST_MAP_POINTS, _POINTS, _VOXEL_M = 5000, 1500, 0.4
_RAYS, _BESIDE_RAD = 2000, np.deg2rad(5.0)  # of a scan that say where it looked, and how far beside them it did as well
_COMPARED = 0.3
_FEWEST_JUDGED = 60  # points on surfaces: with less of them nothing is explained


@dataclass(frozen=True, slots=True)
class Explained:
    """Which of two motions explains the scans.

    Attributes:
        by_path: whether every long segment of the path explains its scans about as well as the expected motion.
        astray: that the expected motion explains them clearly worse, and leads elsewhere; None where it does not.
        turns_alike: whether both turn alike all the way, so that attitudes may be taken from the path, though nothing else.
    """

    by_path: bool
    astray: Finding | None
    turns_alike: bool


def explained_scans(path: LidarPath, scans: Sequence[Scan], expected: Sequence[Twist], config: RegistrationConfig) -> Explained:
    """Lay the scans upon one another as a path says, and as an estimator does.

    Args:
        path: of `scans`.
        scans: consecutive sweeps.
        expected: of every scan, how an estimator believes that the LiDAR moved since the scan before.
        config: sizes of map cells, and how far a point may lie from its plane.
    """
    time_ns, R, p = _reckoned(scans, expected)
    by_path, astray, turns_alike = True, None, True
    for segment in np.unique(path.segment):
        part = path.part(path.segment == segment)
        chosen = scans_of(part.time_ns, scans)
        numbers = np.searchsorted(time_ns, [scan.end_ns for scan in chosen])
        other = time_ns[numbers], R[numbers], p[numbers]
        if len(chosen) < _FEWEST_SCANS or one_motion(part.poses, other):
            continue
        turns_alike = turns_alike and _apart(part.poses, other)[0] < _TURNS_ALIKE_RAD
        laid, laid_other = _laid(chosen, part.poses, config), _laid(chosen, other, config)
        by_path = by_path and laid.misfit <= _WORSE * laid_other.misfit
        more_off = (laid_other.misfit - laid.misfit) / config.plane_threshold**2
        elsewhere = not one_motion(part.poses, other, _ASTRAY_RAD, _ASTRAY_M + _ASTRAY_SHARE * _way(part.poses))
        rests = _way(part.poses) < _AT_REST * _way(other)
        holds = not (rests and laid.misfit > _OFF_AT_REST * config.plane_threshold**2)
        if astray is None and elsewhere and holds and float(part.weak.mean()) < _FEW_WEAK and more_off > _MORE_OFF:
            if not (laid_other.misfit_in_view - laid.misfit_in_view) / config.plane_threshold**2 > _MORE_OFF:
                continue
            twists = [expected[number] for number in numbers]
            # Where all but a few things go along with the LiDAR, as on a highway, it is the path that has gone astray.
            if not explains_changes(chosen, turning_through(other[0], other[1], np.array([rate for rate, _ in twists])), twists):
                astray = _astray(part.poses, other, more_off)
    return Explained(by_path, astray, turns_alike)


def expected_path(path: LidarPath, scans: Sequence[Scan], expected: Sequence[Twist]) -> LidarPath:
    """The last segment of a path, with its poses where an estimator believes that the LiDAR was.

    Args:
        path, scans, expected: as for `explained_scans`.
    """
    if not len(path):
        return path
    part = path.part(path.segment == path.segment[-1])
    time_ns, R, p = _reckoned(scans, expected)
    numbers = np.searchsorted(time_ns, [scan.end_ns for scan in scans_of(part.time_ns, scans)])
    back = ((time_ns[numbers] - part.time_ns) * 1e-9)[:, None]
    rate, velocity = (np.array([expected[number][which] for number in numbers]) for which in (0, 1))
    moved = p[numbers] - back * np.einsum("kij,kj->ki", R[numbers], velocity)
    return replace(part, R_path_lidar=R[numbers] @ so3.exp(-back * rate), p_path_lidar=moved)


def _astray(own: Poses, other: Poses, more_off: float) -> Finding:
    seconds = float(own[0][-1] - own[0][0]) * 1e-9
    apart_rad, apart = _apart(own, other)
    way, way_other = (float(np.linalg.norm(p[-1] - p[0])) for _, _, p in (own, other))
    return Finding(
        "astray",
        f"over {seconds:.1f} s the scans, laid upon one another without the IMU, show that the LiDAR moved by {way:.1f} m; the "
        f"estimate moved by {way_other:.1f} m and ends {apart:.1f} m and {np.degrees(apart_rad):.0f} deg from there, and "
        f"{more_off:.0%} more of the points lie off one another's surfaces under it: it has gone astray. The IMU is not that of "
        "this LiDAR, or a unit, a sign, T_imu_lidar or a clock is wrong (see 'boxplus inspect')",
    )


def scans_of(time_ns: NDArray[np.int64], scans: Sequence[Scan]) -> list[Scan]:
    """The scans whose middles are at `time_ns` (K,)."""
    middles = {middle_of(scan): scan for scan in scans}
    return [middles[time] for time in time_ns.tolist()]


def other_explains_better(scans: Sequence[Scan], own: Poses, other: Poses, config: RegistrationConfig) -> bool:
    """Whether other poses (K,) of the same scans explain them clearly better."""
    if len(scans) < _FEWEST_SCANS:
        return False
    return _laid(scans, own, config).misfit > _WORSE * _laid(scans, other, config).misfit


def _reckoned(scans: Sequence[Scan], expected: Sequence[Twist]) -> Poses:
    """Poses at the ends of the scans, from the twists between them."""
    R, p = [np.eye(3)], [np.zeros(3)]
    for k in range(1, len(scans)):
        seconds = (scans[k].end_ns - scans[k - 1].end_ns) * 1e-9
        rate, velocity = expected[k]
        R.append(R[-1] @ so3.exp(seconds * rate))
        p.append(p[-1] + seconds * (R[-1] @ velocity))
    return np.array([scan.end_ns for scan in scans]), np.array(R), np.array(p)


def turning_through(ends: NDArray[np.int64], R: NDArray[np.float64], rates: NDArray[np.float64]) -> Turning:
    """How a LiDAR turned through attitudes R (K, 3, 3) at `ends` (K,), at the rates (K, 3) of the steps that they end."""

    def at(time_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        k = np.clip(np.searchsorted(ends, time_ns), 0, len(ends) - 1)
        turned: NDArray[np.float64] = R[k] @ so3.exp(((time_ns - ends[k]) * 1e-9)[:, None] * rates[k])
        return turned

    return at


def one_motion(own: Poses, other: Poses, angle_rad: float = 0.01, distance_m: float = 0.05) -> bool:
    """Whether two motions end alike: then neither has gone astray on its own."""
    angle, distance = _apart(own, other)
    return angle < angle_rad and distance < distance_m


def _apart(own: Poses, other: Poses) -> tuple[float, float]:
    """Angle [rad] and distance [m] between the last poses of two motions, seen from their first ones."""
    (_, R, p), (_, R_other, p_other) = own, other
    turned, turned_other = R[0].T @ R[-1], R_other[0].T @ R_other[-1]
    moved, moved_other = R[0].T @ (p[-1] - p[0]), R_other[0].T @ (p_other[-1] - p_other[0])
    return float(np.linalg.norm(so3.log(turned.T @ turned_other))), float(np.linalg.norm(moved - moved_other))


def _way(motion: Poses) -> float:
    return float(np.linalg.norm(np.diff(motion[2], axis=0), axis=1).sum())


@dataclass(frozen=True, slots=True)
class _Laid:
    """The last scans laid upon the first ones.

    Attributes:
        squared: distances of points from surfaces of the first scans [m²], the sum; judged: how many points have one.
        off: (F, 3) points that lie off everything; total: how many points were laid.
        views: where from (3,) the first scans were taken, and some of their points (M, 3).
        most: what a point that is off counts [m²].
    """

    squared: float
    judged: int
    off: NDArray[np.float64]
    total: int
    views: list[tuple[NDArray[np.float64], NDArray[np.float32]]]
    most: float

    @property
    def misfit(self) -> float:
        """Mean squared distance of points from surfaces [m²]; what is off counts in full."""
        return self._mean(len(self.off))

    @property
    def misfit_in_view(self) -> float:
        """The same where what is off counts only in directions in which one of the first scans has looked.

        A narrow view that turns away sees what none of them could, and a path that stays behind seems to explain it better. NaN
        where less than a part of the points lie in such directions.
        """
        seen = int(self._is_in_view().sum())
        return self._mean(seen) if self.total - len(self.off) + seen > _COMPARED * self.total else np.nan

    def _mean(self, off: int) -> float:
        if not self.judged > _FEWEST_JUDGED:
            return self.most
        return (self.squared + self.most * off) / (self.judged + off)

    def _is_in_view(self) -> NDArray[np.bool_]:
        seen = np.zeros(len(self.off), dtype=np.bool_)
        for origin, points in self.views:
            rays = IkdTree(_directions(points - origin))
            seen |= np.isfinite(rays.nearest(_directions(self.off - origin), 1, max_distance=_BESIDE_RAD).distances[:, 0])
        return seen


def _laid(scans: Sequence[Scan], poses: Poses, config: RegistrationConfig) -> _Laid:
    """Lay the last third of some scans upon the first, by poses (K,) of them."""
    third = len(scans) // 3
    tree = IkdTree(cell_size=config.map_cell, rebuild="inplace")
    thin = VoxelFilter(config.map_cell, _MOST_MAP_POINTS)
    views = []
    for k in np.unique(np.linspace(0, third - 1, _FIRST).astype(int)):
        placed = _placed(scans[k], poses, k)
        views.append((poses[2][k], placed[:: max(len(placed) // _RAYS, 1)]))
        tree.insert(thin(placed)[1].astype(np.float64), downsample=True)
    squared, judged, total, off = 0.0, 0, 0, []
    most = config.plane_threshold**2
    for k in np.unique(np.linspace(len(scans) - third, len(scans) - 1, _LAST).astype(int)):
        points = VoxelFilter(_VOXEL_M, _POINTS)(_placed(scans[k], poses, k))[0].astype(np.float64)
        near, surface, distance, _ = surface_distances(tree, points)
        squared += float(np.minimum(distance[surface] ** 2, most).sum())
        judged, total = judged + int(surface.sum()), total + len(points)
        off.append(points[~near])
    return _Laid(squared, judged, np.concatenate(off), total, views, most)


def _directions(offsets: NDArray[np.float64]) -> NDArray[np.float64]:
    directions: NDArray[np.float64] = offsets / np.maximum(np.linalg.norm(offsets, axis=1), 1e-9)[:, None]
    return directions


def _placed(scan: Scan, poses: Poses, k: int) -> NDArray[np.float32]:
    """Points (N, 3) of scan k in the frame of the poses, undistorted with the motion from the pose before to the one after."""
    time_ns, R, p = poses
    before, after = max(k - 1, 0), min(k + 1, len(time_ns) - 1)
    seconds = (time_ns[after] - time_ns[before]) * 1e-9
    rate, velocity = so3.log(R[before].T @ R[after]) / seconds, (p[after] - p[before]) / seconds
    since = ((scan.time_ns - time_ns[k]) * 1e-9)[:, None]
    turned = np.einsum("nij,nj->ni", R[k] @ so3.exp(since * rate), scan.p_lidar.astype(np.float64))
    placed: NDArray[np.float64] = turned + p[k] + since * velocity
    return placed.astype(np.float32)
