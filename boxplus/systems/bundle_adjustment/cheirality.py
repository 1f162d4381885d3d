"""Whether points lie before the cameras that saw them, and what is done about those that do not.

A point behind a camera projects all the same, mirrored, and pulls cameras and points to where they cannot be. Before solving,
such points are triangulated anew from their observations, and cameras that look away from their points are set anew from these.
What then still lies behind a camera is left out and named.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus._words import counted, either
from boxplus.errors import InputError
from boxplus.formats.reconstructions.bal import BalProblem
from boxplus.formats.reconstructions.colmap_model import ColmapModel
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.manifolds import quaternion, so3
from boxplus.systems.bundle_adjustment.sightings import Sightings, names_text
from boxplus.systems.bundle_adjustment.triangulation import intersect_rays, pose_from_points

_LEAST_TRUSTED = 4  # points that others see before them, for a camera to be called turned around
_REACHES = (10.0, 100.0, 1000.0)  # of the distances between the observers, where a point with parallel rays is put
_USUAL = (50, 95)  # percentiles of the errors of sound observations: what is small, and the largest that is usual
_COARSE = 0.05  # of the focal length, where no observation is sound
_GROSS = 30.0  # times the small error: whatever put some points behind cameras put this one elsewhere
_BETTER = 2.0  # times that a point may fit worse before its cameras than it fitted behind them, unless it fits well
_HOPELESS = 0.5  # share of observations behind their cameras beyond which it is the convention that is wrong


@dataclass(frozen=True, slots=True)
class Cheirality:
    """Points behind cameras: at the start, what became of them, and at the end.

    Attributes:
        behind_start: observations whose point lies behind their camera in the input.
        triangulated: numbers of the points that were computed anew from their observations.
        dropped: numbers of the points that could not be, and were left out.
        turned: numbers of the cameras that look away from their points; of COLMAP's the images.
        turned_back: those of them that were set anew from the points.
        left_out: observations of dropped points, and of turned cameras that could not be set anew.
        behind: observations whose point lies behind their camera at the end, those left out not counted.
        behind_points: numbers of these points.
        count: observations in all.

    Example:
        >>> result = bp.adjust_bundle(bp.read_reconstruction("scene.txt.bz2"))
        >>> result.cheirality.behind_start, result.cheirality.behind  # observations behind their cameras
        (0, 0)
    """

    behind_start: int
    triangulated: NDArray[np.int64]
    dropped: NDArray[np.int64]
    turned: NDArray[np.int64]
    turned_back: NDArray[np.int64]
    left_out: int
    behind: int
    behind_points: NDArray[np.int64]
    count: int

    @property
    def bad_share(self) -> float:
        """Share of all observations that are behind their cameras at the end, or were left out for it."""
        return (self.behind + self.left_out) / self.count if self.count else 0.0

    def notes(self, reconstruction: Reconstruction) -> list[str]:
        """A sentence on each, with the names of points and cameras as the file has them."""
        points = getattr(reconstruction, "point_ids", None)
        cameras = getattr(reconstruction, "image_ids", None)
        what = "images" if isinstance(reconstruction, ColmapModel) else "cameras"
        said = []
        if self.behind_start:
            said.append(
                f"{self.behind_start} of {counted(self.count, 'observation')} "
                f"{either(self.behind_start, 'is of a point', 'are of points')} behind their cameras in the input"
            )
        if len(self.turned_back):
            said.append(
                f"{what} that look away from their points, turned around, and were set anew from these: "
                f"{names_text(self.turned_back, cameras)}"
            )
        lost = np.setdiff1d(self.turned, self.turned_back)
        if len(lost):
            said.append(
                f"{what} that look away from their points, turned around, and could not be set anew; all they saw is left out: "
                f"{names_text(lost, cameras)}"
            )
        if len(self.triangulated):
            anew = names_text(self.triangulated, points)
            said.append(
                f"{counted(len(self.triangulated), 'point')} behind cameras, or far off, "
                f"{either(len(self.triangulated), 'was', 'were')} triangulated anew: {anew}"
            )
        if len(self.dropped):
            said.append(
                f"{counted(len(self.dropped), 'point')} {either(len(self.dropped), 'lies', 'lie')} behind cameras and nowhere "
                f"before them {either(len(self.dropped), 'fits what was seen; it is', 'fit what was seen; they are')} left out: "
                f"{names_text(self.dropped, points)}"
            )
        if self.behind:
            said.append(
                f"{counted(self.behind, 'observation')} {either(self.behind, 'is of a point', 'are of points')} behind their "
                f"cameras at the end, of {either(len(self.behind_points), 'point', 'points')} "
                f"{names_text(self.behind_points, points)}"
            )
        return said


@dataclass(frozen=True, slots=True)
class SoundStart:
    """A start without points behind cameras, and the observations (k,) that go with it."""

    reconstruction: Reconstruction
    used: NDArray[np.bool_]
    cheirality: Cheirality


def make_sound(reconstruction: Reconstruction) -> SoundStart:
    """Repair a start in which points lie behind the cameras that saw them.

    Raises:
        InputError: more than half of the observations are of points behind their cameras, and nothing helps.
    """
    sightings = Sightings.of(reconstruction)
    before = sightings.depths() > 0.0
    none = np.zeros(0, dtype=np.int64)
    count = len(before)
    if before.all():
        return SoundStart(reconstruction, before, Cheirality(0, none, none, none, none, 0, 0, none, count))
    turned = _turned_cameras(sightings, before)
    trusted = ~np.isin(sightings.camera_of, turned)
    bad = np.unique(sightings.point_of[~before & trusted])
    points, repaired = _triangulate(sightings, bad, before, trusted)
    moved = np.setdiff1d(_gross(sightings, before & trusted), bad)
    if len(moved) > len(bad):
        moved = none  # a start that is rough for other reasons
    again, nearer = _triangulate(sightings, moved, before, trusted)
    points[moved[nearer]] = again[moved[nearer]]
    sightings = replace(sightings, points=points)
    turned_back = []
    for camera in turned:
        pose = _resect(sightings, int(camera), trusted & ~np.isin(sightings.point_of, bad[~repaired]))
        if pose is not None:
            sightings.R_camera_world[camera], sightings.t[camera] = pose
            turned_back.append(int(camera))
    back = np.array(turned_back, dtype=np.int64)
    used = ~np.isin(sightings.point_of, bad[~repaired]) & ~np.isin(sightings.camera_of, np.setdiff1d(turned, back))
    used &= sightings.depths() > 0.0
    if np.count_nonzero(~used) > _HOPELESS * count:
        raise InputError(
            "points before the cameras that saw them",
            f"{np.count_nonzero(~before)} of {count} observations of points behind their cameras, and no better ones where their "
            f"rays meet ({getattr(reconstruction, 'source', 'reconstruction')})",
            "check the convention of the poses: world to camera; the cameras of BAL look along −z, all others along +z",
        )
    anew = np.union1d(bad[repaired], moved[nearer])
    left_out = int(np.count_nonzero(~used))
    found = Cheirality(int(np.count_nonzero(~before)), anew, bad[~repaired], turned, back, left_out, 0, none, count)
    return SoundStart(_with_start(reconstruction, sightings, back), used, found)


def count_behind(start: SoundStart, reconstruction: Reconstruction) -> Cheirality:
    """What is known of the start, with the observations behind their cameras in an adjusted reconstruction."""
    sightings = Sightings.of(reconstruction)
    behind = start.used & ~(sightings.depths() > 0.0)
    return replace(
        start.cheirality,
        behind=int(np.count_nonzero(behind)),
        behind_points=np.unique(sightings.point_of[behind]).astype(np.int64),
    )


def _turned_cameras(sightings: Sightings, before: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Cameras behind which most of those points lie that most of the others have before them."""
    times = np.bincount(sightings.point_of, minlength=len(sightings.points))
    good = np.bincount(sightings.point_of, before, len(sightings.points))
    others = (times - 1)[sightings.point_of]
    trusted = (others > 0) & (2.0 * (good[sightings.point_of] - before) > others)
    m = len(sightings.t)
    seen = np.bincount(sightings.camera_of[trusted], minlength=m)
    behind = np.bincount(sightings.camera_of[trusted & ~before], minlength=m)
    return np.flatnonzero((seen >= _LEAST_TRUSTED) & (2 * behind > seen)).astype(np.int64)


def _triangulate(
    sightings: Sightings, bad: NDArray[np.int64], before: NDArray[np.bool_], trusted: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """All points with the bad ones from their rays, and which of the bad ones (b,) now lie before all cameras."""
    points = sightings.points.copy()
    rows = np.flatnonzero(trusted & np.isin(sightings.point_of, bad))
    rays, found = sightings.bearings(rows)
    rows, rays = rows[found], rays[found]
    of = np.searchsorted(bad, sightings.point_of[rows])
    camera = sightings.camera_of[rows]
    directions = np.einsum("nji,nj->ni", sightings.R_camera_world[camera], rays)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    centers = sightings.centers[camera]
    met = intersect_rays(centers, directions, of, len(bad))
    small, usual = _usual_errors(sightings, before & trusted)
    ahead = np.bincount(of, minlength=len(bad)) > 0
    repaired = np.zeros(len(bad), dtype=np.bool_)
    times = np.maximum(np.bincount(of, minlength=len(bad)), 1)[:, None]

    def root_mean_square(error: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.sqrt(np.bincount(of, np.nan_to_num(error, nan=np.inf) ** 2, len(bad)) / times[:, 0]))

    # A track of wrong matches, or of what moves with the camera, meets behind it as well as tracks meet before it.
    limit = np.maximum(_BETTER * root_mean_square(sightings.errors(rows, points[bad][of], mirrored=True)), small)
    # Rays that are parallel but for noise meet anywhere, also behind: such a point may be far away.
    middle, forward = (np.stack([np.bincount(of, x, len(bad)) for x in a.T], axis=1) / times for a in (centers, directions))
    apart = np.sqrt(np.bincount(of, ((centers - middle[of]) ** 2).sum(axis=1), len(bad)) / times[:, 0])
    typical = float(np.median(sightings.depths()[before & trusted])) if (before & trusted).any() else 1.0
    once = np.where(times == 1, middle + typical * forward, np.nan)
    for p in (met, once, *(middle + reach * apart[:, None] * forward for reach in _REACHES)):
        depth = np.einsum("ni,ni->n", sightings.R_camera_world[camera, 2], p[of]) + sightings.t[camera, 2]
        is_sound = ahead & np.isfinite(p).all(axis=1) & (np.bincount(of, ~(depth > 0.0), len(bad)) == 0)
        is_sound &= root_mean_square(sightings.errors(rows, p[of])) <= np.minimum(limit, usual)
        chosen = is_sound & ~repaired
        points[bad[chosen]] = p[chosen]
        repaired |= chosen
    return points, repaired


def _gross(sightings: Sightings, sound: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Points before their cameras that are seen nowhere near where they should be."""
    limit = _GROSS * _usual_errors(sightings, sound)[0]
    error = sightings.errors(np.arange(len(sound)), sightings.points[sightings.point_of])
    return np.unique(sightings.point_of[sound & ~(error <= limit)]).astype(np.int64)


def _usual_errors(sightings: Sightings, sound: NDArray[np.bool_]) -> tuple[float, float]:
    """Small and large reprojection errors of sound observations at the start [px]."""
    rows = np.flatnonzero(sound)
    rows = rows[:: max(1, len(rows) // 10_000)]
    error = sightings.errors(rows, sightings.points[sightings.point_of[rows]])
    error = error[np.isfinite(error)]
    if not len(error):
        coarse = _COARSE * sightings.focal_length
        return coarse, coarse
    small, usual = np.percentile(error, _USUAL)
    return float(small), float(usual)


def _resect(
    sightings: Sightings, camera: int, sound: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """A pose before whose camera the points lie that other cameras see, or None."""
    own = np.flatnonzero(sightings.camera_of == camera)
    elsewhere = np.bincount(sightings.point_of[sound & (sightings.camera_of != camera)], minlength=len(sightings.points))
    own = own[elsewhere[sightings.point_of[own]] >= 2]
    rays, found = sightings.bearings(own)
    p = sightings.points[sightings.point_of[own[found]]]
    pose = pose_from_points(p, rays[found])
    if pose is None or not ((p @ pose[0][2] + pose[1][2]) > 0.0).all():
        return None
    return pose


def _with_start(reconstruction: Reconstruction, sightings: Sightings, cameras: NDArray[np.int64]) -> Reconstruction:
    """The reconstruction with the points, and the poses of some cameras, that were found anew."""
    R, t = sightings.R_camera_world[cameras], sightings.t[cameras]
    if isinstance(reconstruction, BalProblem):
        poses = reconstruction.cameras.copy()
        back = np.array([1.0, -1.0, -1.0])
        poses[cameras, :6] = np.hstack([so3.log(R * back[:, None]), t * back])
        return replace(reconstruction, cameras=poses, points=sightings.points)
    T = reconstruction.T_camera_world.copy()
    T[cameras] = np.hstack([quaternion.from_matrix(R), t])
    return replace(reconstruction, T_camera_world=T, points=sightings.points)
