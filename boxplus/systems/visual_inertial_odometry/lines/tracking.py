"""Lines followed through the images of a rig: found in the first camera, looked for across themselves where they should be next.

Where a line should be follows from the motion that the IMU measured and the depth of its ends known so far, in the next image and
in the other cameras. A line new to the rig is compared along epipolar lines at all depths of both its ends.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from boxplus.systems.visual_inertial_odometry.lines import edges
from boxplus.systems.visual_inertial_odometry.lines.disparity import ALIGNED, along_baseline, inverse_depths
from boxplus.systems.visual_inertial_odometry.lines.segments import new_segments, shortest_px
from boxplus.systems.visual_inertial_odometry.lines.tracks import LineTracks
from boxplus.systems.visual_inertial_odometry.rig import Rig

_AHEAD, _BESIDE = 8, 4  # px across a line that it is looked for, in the next image and in another camera
_BORDER = 8.0  # px
_LEAST = 8  # of the places along a line that have to lie on it
_SHORT = 0.6  # of the shortest new segment, below which a line is let go
_STEEP = 3.0  # grey values for a pixel, of an edge worth following
_NEAREST = 5.0  # 1/m
_SMOOTH = (5, 5), 1.0

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Grey = NDArray[np.uint8]


class LineFollower(Protocol):
    """What odometry asks of whatever follows lines; `LineTracker` says what the methods do."""

    seconds: float

    def track(
        self, images: Mapping[int, Grey], R_before_now: Floats, p_before_now: Floats, *, wants_new: bool = False
    ) -> LineTracks: ...

    def forget(self, ids: NDArray[np.int64]) -> None: ...

    def snapshot(self) -> dict[str, object]: ...

    def restore(self, snapshot: Mapping[str, Any]) -> None: ...


class LineTracker:
    """Follows lines through the images of a rig.

    Call `track` for the images of every instant.

    Args:
        cv2: the module.
        most: lines followed at most.

    Attributes:
        seconds: spent on the last instant.
    """

    def __init__(self, cv2: Any, rig: Rig, most: int) -> None:
        self._cv2, self._rig, self._most = cv2, rig, most
        self._detector = cv2.createLineSegmentDetector()
        self._greys: list[Grey | None] = [None] * len(rig.cameras)
        self._ids = np.zeros(0, np.int64)
        self._segments = np.zeros((0, len(rig.cameras), 4))
        self._rho = np.zeros((0, 2))  # of both ends in the first camera
        self._known = np.zeros(0, dtype=np.bool_)  # whose depth a second camera has shown
        self._sign = np.zeros(0)
        self._steepness = np.zeros(0)
        self._profiles = np.zeros((0, edges.PLACES, 2 * edges.REACH + 1))
        self._next_id = 0
        self._shortest = shortest_px(rig.cameras[0].width)
        self.seconds = 0.0
        T = [camera.T_imu_camera for camera in rig.cameras]
        self._R_imu_first, self._p_imu_first = T[0][:3, :3], T[0][:3, 3]
        self._others = [np.linalg.inv(t) @ T[0] for t in T[1:]]  # first camera to each other one

    def track(
        self, images: Mapping[int, Grey], R_before_now: Floats, p_before_now: Floats, *, wants_new: bool = False
    ) -> LineTracks:
        """Follow the lines into the images of the next instant.

        Args:
            images: (H, W) 8 bit, by camera; some may be missing.
            R_before_now, p_before_now: how the IMU moved since the instant before, in its frame there.
            wants_new: look for new ones as well.
        """
        begin = time.perf_counter()
        self._greys = [
            None if k not in images else self._cv2.GaussianBlur(images[k], *_SMOOTH) for k in range(len(self._rig.cameras))
        ]
        rejected: Counter[str] = Counter()
        grey = self._greys[0]
        if grey is None:
            rejected["no image of the first camera"] += len(self._ids)
            self._keep(np.zeros(len(self._ids), dtype=np.bool_))
        elif len(self._ids):
            self._follow(grey, R_before_now, p_before_now, rejected)
        if wants_new and grey is not None:
            self._detect(grey, images[0])
        self._search_others(at_all_depths=wants_new)
        self.seconds = time.perf_counter() - begin
        counts = {reason: count for reason, count in rejected.items() if count}
        return LineTracks(self._ids.copy(), self._segments.copy(), counts)

    def _detect(self, grey: Grey, raw: Grey) -> None:
        """New lines, where the first image shows some that are not followed."""
        room = self._most - len(self._ids)
        if room <= 0:
            return
        model = self._rig.cameras[0].model
        segments = new_segments(self._cv2, self._detector, raw, model, self._segments[:, 0], room)
        if not len(segments):
            return
        pixels = self._pixels(0, edges.places(segments), np.zeros((len(segments), edges.PLACES)), None)
        slope = (
            np.diff(edges.profiles(self._cv2, grey, pixels, edges.normals(pixels), np.array([-1.5, 1.5])), axis=2)[..., 0] / 3.0
        )
        mean = np.median(slope, axis=1)
        segments, sign, steepness, _ = self._measured(0, grey, pixels, np.sign(mean), np.abs(mean), least=12)
        good = np.isfinite(segments[:, 0]) & (steepness > _STEEP) & (self._length(segments) > self._shortest)
        segments, sign, steepness = segments[good], sign[good], steepness[good]
        count = len(segments)
        typical = float(np.median(self._rho[self._known])) if self._known.any() else 0.0
        fresh = np.arange(len(self._ids) + count) >= len(self._ids)
        every = np.full((count, len(self._rig.cameras), 4), np.nan)
        every[:, 0] = segments
        self._ids = np.append(self._ids, self._next_id + np.arange(count))
        self._next_id += count
        self._segments = np.concatenate([self._segments, every])
        self._rho = np.concatenate([self._rho, np.full((count, 2), typical)])
        self._known = np.append(self._known, np.zeros(count, dtype=np.bool_))
        self._sign, self._steepness = np.append(self._sign, sign), np.append(self._steepness, steepness)
        self._profiles = np.concatenate([self._profiles, np.zeros((count, *self._profiles.shape[1:]))])
        self._see(grey, fresh)

    def snapshot(self) -> dict[str, object]:
        """All that `track` depends on beside the rig; only to be read."""
        return {name: value for name, value in vars(self).items() if name not in ("_cv2", "_rig", "_detector")}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from a `snapshot`."""
        vars(self).update(snapshot)

    def forget(self, ids: NDArray[np.int64]) -> None:
        """Follow these lines no longer."""
        self._keep(~np.isin(self._ids, ids))

    def _follow(self, grey: Grey, R: Floats, p: Floats, rejected: Counter[str]) -> None:
        R_now_before = self._R_imu_first.T @ R.T @ self._R_imu_first
        t = self._R_imu_first.T @ (R.T @ (self._p_imu_first - p) - self._p_imu_first)
        rays, rho = edges.places(self._segments[:, 0]), _between(self._rho)
        pixels = self._pixels(0, rays, rho, (R_now_before, t))
        moved, alike = self._aligned(grey, pixels, _AHEAD)
        segments, _, steepness, _ = self._measured(0, grey, moved, self._sign, self._steepness, _LEAST)
        ends = self._segments[:, 0].reshape(-1, 2, 2)
        depth = (ends @ R_now_before[2, :2] + R_now_before[2, 2]) + self._rho * t[2]
        self._rho = np.clip(self._rho / np.maximum(depth, 0.2), 0.0, _NEAREST)
        self._segments[:, 0] = segments
        there = np.isfinite(segments[:, 0]) & (self._length(segments) > _SHORT * self._shortest)
        rejected["looks different"] += int((~alike).sum())
        rejected["not found again"] += int((alike & ~there).sum())
        self._steepness = np.where(there, 0.8 * self._steepness + 0.2 * steepness, self._steepness)
        self._keep(alike & there)
        self._see(grey, np.ones(len(self._ids), dtype=np.bool_))

    def _search_others(self, *, at_all_depths: bool) -> None:
        """Find the lines of the first image in the other cameras, those whose depth is not known if `at_all_depths`."""
        self._segments[:, 1:] = np.nan
        first = self._greys[0]
        for c, T in enumerate(self._others, start=1):
            grey = self._greys[c]
            if grey is None or first is None or not len(self._ids):
                continue
            R, t = T[:3, :3], T[:3, 3]
            if at_all_depths:
                unknown = np.flatnonzero(~self._known)
                self._rho[unknown], self._known[unknown] = inverse_depths(
                    self._cv2, first, grey, self._rig, c, T, self._segments[unknown, 0], self._rho[unknown]
                )
            tried = np.flatnonzero(self._known | along_baseline(self._segments[:, 0], R.T @ t))
            if not len(tried):
                continue
            pixels = self._pixels(c, edges.places(self._segments[tried, 0]), _between(self._rho[tried]), (R, t))
            moved, alike = self._aligned(grey, pixels, _BESIDE, tried)
            segments, _, _, _ = self._measured(c, grey, moved, self._sign[tried], self._steepness[tried], _LEAST)
            found = alike & np.isfinite(segments[:, 0]) & (self._length(segments) > _SHORT * self._shortest)
            tried, segments = tried[found], segments[found]
            self._segments[tried, c] = segments
            # The plane of the segment there, n · (R m + ρ t) = 0, gives ρ at the ends here, unless it holds the baseline.
            ends = np.concatenate([self._segments[tried, 0].reshape(-1, 2, 2), np.ones((len(tried), 2, 1))], axis=2)
            n = np.cross(_homogeneous(segments[:, :2]), _homogeneous(segments[:, 2:]))
            n /= np.linalg.norm(n, axis=1, keepdims=True)
            across = n @ t
            tells = np.abs(across) > ALIGNED * np.linalg.norm(t)
            rho = -np.einsum("nki,ni->nk", ends @ R.T, n) / np.where(tells, across, 1.0)[:, None]
            tells &= (rho > -0.02).all(axis=1) & (rho < _NEAREST).all(axis=1)
            self._rho[tried[tells]] = np.maximum(rho[tells], 0.0)
            self._known[tried[tells]] = True

    def _aligned(self, grey: Grey, pixels: Floats, reach: int, rows: NDArray[np.intp] | None = None) -> tuple[Floats, Flags]:
        """Places (n, PLACES, 2) moved across lines to where profiles are as they were, and whether they are alike there."""
        seen = self._profiles if rows is None else self._profiles[rows]
        across = edges.normals(pixels)
        offsets = np.arange(-edges.REACH - reach, edges.REACH + reach + 1).astype(np.float64)
        wide = edges.profiles(self._cv2, grey, pixels, across, offsets)
        usable = edges.inside(pixels, grey.shape, _BORDER)
        shift, alike = edges.shifted(seen, wide, usable)
        return pixels + shift[..., None] * across, alike & (usable.sum(axis=1) >= _LEAST)

    def _measured(
        self, camera: int, grey: Grey, expected: Floats, sign: Floats, steepness: Floats, least: int
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Segments (n, 4) of rays on the edges near places (n, PLACES, 2), NaN without; sign, steepness and misfit [px] (n,)."""
        edge, found, steep = edges.snapped(self._cv2, grey, expected, sign, steepness)
        segments, fits, rms = edges.fitted(self._rig.cameras[camera].model, edge, found, least)
        mean = (steep * fits).sum(axis=1) / np.maximum(fits.sum(axis=1), 1)
        return segments, sign, mean, rms

    def _see(self, grey: Grey, which: Flags) -> None:
        """Remember the profiles across lines `which` (n,) as the first image shows them."""
        if which.any():
            rays = edges.places(self._segments[which, 0])
            pixels = self._pixels(0, rays, np.zeros(rays.shape[:2]), None)
            offsets = np.arange(-edges.REACH, edges.REACH + 1).astype(np.float64)
            self._profiles[which] = edges.profiles(self._cv2, grey, pixels, edges.normals(pixels), offsets)

    def _pixels(self, camera: int, rays: Floats, rho: Floats, motion: tuple[Floats, Floats] | None) -> Floats:
        """Where rays (n, k, 2) of depths 1/ρ (n, k) are in an image after a motion (R, t) [px]; far outside where unseen."""
        points = _homogeneous(rays)
        if motion is not None:
            points = points @ motion[0].T + rho[..., None] * motion[1]
        pixels, seen = self._rig.cameras[camera].model.project(points.reshape(-1, 3))
        seen &= points.reshape(-1, 3)[:, 2] > 0.2
        return np.where(seen[:, None], pixels, -1e3).reshape(rays.shape)

    def _length(self, segments: Floats) -> Floats:
        """(n,) of segments of rays [px]; 0 where there is none."""
        model = self._rig.cameras[0].model
        length = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
        return np.asarray(np.sqrt(model.fx * model.fy) * np.nan_to_num(length))

    def _keep(self, kept: Flags) -> None:
        self._ids, self._segments = self._ids[kept], self._segments[kept]
        self._rho, self._known = self._rho[kept], self._known[kept]
        self._sign, self._steepness, self._profiles = self._sign[kept], self._steepness[kept], self._profiles[kept]


def _between(rho: Floats) -> Floats:
    """(n, PLACES) along segments with ρ (n, 2) at their ends: inverse depth is linear along a line in the plane of rays."""
    along = np.linspace(0.0, 1.0, edges.PLACES)
    return rho[:, :1] * (1.0 - along) + rho[:, 1:] * along


def _homogeneous(xy: Floats) -> Floats:
    return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
