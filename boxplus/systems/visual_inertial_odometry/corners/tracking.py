"""Corners followed through the images of a rig: optical flow from where gyroscope and depth say, checked there and back.

Corners are found in the first camera, in cells of its image that hold none, and followed from image to image there. The other
cameras are searched in every instant, from where the depth known so far puts the corner, so that a corner's place in them never
drifts away from that in the first. What is believed has come back to where it began, and lies on its epipolar line.

Source: Lucas and Kanade 1981; Bouguet, Pyramidal implementation, 2001; Shi and Tomasi 1994; all three in OpenCV.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from boxplus._extras import require
from boxplus._jit import kernel
from boxplus.manifolds import so3
from boxplus.sensors.images.eight_bits import EightBits
from boxplus.systems.visual_inertial_odometry.config import VioConfig
from boxplus.systems.visual_inertial_odometry.corners.carried import CARRIED, CarriedCorners
from boxplus.systems.visual_inertial_odometry.corners.centres import centred
from boxplus.systems.visual_inertial_odometry.corners.partners import FEWEST, FLAT, LEAST_SHARE, NEAREST, Partners
from boxplus.systems.visual_inertial_odometry.corners.shutter import BodyMotion, at_once
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks
from boxplus.systems.visual_inertial_odometry.corners.triangulation import epipolar_distances, inverse_depths
from boxplus.systems.visual_inertial_odometry.rig import Rig

_WINDOW = (21, 21)
_LEVELS = 3
_REACH = 5.0  # px in the smallest image of the pyramid: flow finds 86 to 99 % of rendered corners that moved by as much
_STOP = (3, 30, 0.01)
_QUALITY = 0.01  # of a corner against the best one of the image (Shi and Tomasi)
_TEXTURED = 0.5  # share of the corners asked for; where fewer are found, noise decides where the centre of one is
_BORDER = 8  # px within which no corner is kept
_LEAST_SPREAD = 4.0  # grey values; an image with a smaller standard deviation shows nothing
_FAR = 1e-3  # 1/m
_GIVEN = ("_cv2", "_config", "_rig")
_GUESSED = 4  # cv2.OPTFLOW_USE_INITIAL_FLOW

Floats = NDArray[np.float64]
Grey = NDArray[np.uint8]


class Tracker(Protocol):
    """What odometry asks of whatever follows corners; `FeatureTracker` says what the methods do."""

    opencv_s: float

    def track(
        self,
        time_ns: int,
        images: Mapping[int, NDArray[Any]],
        R_before_now: Floats,
        p_before_now: Floats | None = None,
        rate: Floats | None = None,
    ) -> Tracks: ...

    def detect(self, tracks: Tracks) -> Tracks: ...

    def forget(self, ids: NDArray[np.int64]) -> None: ...

    def snapshot(self) -> dict[str, object]: ...

    def restore(self, snapshot: Mapping[str, Any]) -> None: ...


class FeatureTracker:
    """Follows corners through the images of a rig.

    Call `track` for the images of every instant, then `detect` where new corners are wanted.

    Args:
        rig: the first camera is the one in which corners are found and followed.

    Raises:
        InputError: OpenCV is not installed.

    Attributes:
        opencv_s: seconds spent in OpenCV for the last instant.
    """

    def __init__(self, config: VioConfig, rig: Rig) -> None:
        self._cv2, self._config, self._rig = require("cv2", "which follows corners"), config, rig
        self._to_8_bits = EightBits()
        self._images: list[Grey | None] = [None] * len(rig.cameras)
        self._before: Grey | None = None
        self._ids = np.zeros(0, np.int64)
        self._pixels = np.zeros((0, len(rig.cameras), 2))
        self._rays = np.zeros((0, len(rig.cameras), 3))
        self._old_pixels, self._old_rays = self._pixels, self._rays  # in the image before, NaN for corners it did not show
        self._motion: BodyMotion | None = None
        self._time_ns: int | None = None
        self._rho = np.zeros(0)
        self._next_id = 0
        self._carried = CarriedCorners(rig.cameras[0].model.fx)
        self.opencv_s = 0.0
        T = [camera.T_imu_camera for camera in rig.cameras]
        self._R_imu_first = T[0][:3, :3]
        self._p_imu_first = T[0][:3, 3]
        self._reach = [_reach(camera.width, camera.height) for camera in rig.cameras]
        self._others = [np.linalg.inv(t) @ T[0] for t in T[1:]]  # first camera to each other one

    def track(
        self,
        time_ns: int,
        images: Mapping[int, NDArray[Any]],
        R_before_now: Floats,
        p_before_now: Floats | None = None,
        rate: Floats | None = None,
    ) -> Tracks:
        """Follow the corners into the images of the next instant.

        Args:
            images: grey images (H, W) by the number of their camera; without that of the first camera all corners are lost.
            R_before_now: (3, 3) attitude of the IMU now in its frame at the instant before.
            p_before_now: (3,) its position there [m], where known.
            rate: (3,) its angular velocity now [rad/s], where known; for rolling shutters.
        """
        self.opencv_s = 0.0
        p = np.zeros(3) if p_before_now is None else p_before_now
        if self._time_ns is not None:
            self._motion = BodyMotion(1e-9 * (time_ns - self._time_ns), R_before_now, p, rate)
        self._time_ns, self._old_pixels, self._old_rays = time_ns, self._pixels.copy(), self._rays.copy()
        greys = self._in_8_bits(images)
        rejected: Counter[str] = Counter()
        motion = float("nan")
        before, now = self._images[0], greys[0]
        if len(self._ids) and (now is None or before is None):
            rejected["no image of the first camera"] += len(self._ids)
            self._keep(np.zeros(len(self._ids), dtype=np.bool_))
        elif len(self._ids) and now is not None and before is not None:
            old = self._pixels[:, 0].copy()
            guess, rho = self._predicted(R_before_now, p)
            there, kept = self._flow(before, now, old, guess, rejected)
            inside = self._inside(there, 0)
            rejected["left the image"] += int((kept & ~inside).sum())
            kept &= inside
            angle = float(np.linalg.norm(so3.log(R_before_now)))
            carried = self._carried.find(self._ids, old, self._by_turn(R_before_now), there, kept, angle)
            rejected[CARRIED] += int(carried.sum())
            kept &= ~carried
            self._rho = rho
            self._pixels[:, 0] = there
            motion = float(np.median(np.linalg.norm(there[kept] - old[kept], axis=1))) if kept.any() else motion
            rays, found = self._rig.cameras[0].model.unproject(there)
            kept &= found
            self._rays[:, 0] = rays
            self._keep(kept)
        self._images, self._before = greys, now
        self._search_others(np.ones(len(self._ids), dtype=np.bool_), rejected)
        return self._tracks(time_ns, np.zeros(len(self._ids), dtype=np.bool_), rejected, motion)

    def detect(self, tracks: Tracks) -> Tracks:
        """The tracks of this instant with new corners, where cells of the first image hold none."""
        grey = self._images[0]
        room = self._config.features - len(self._ids)
        if grey is None or room <= 0 or float(tracks.contrast[0]) < _LEAST_SPREAD:
            return tracks
        begin = time.perf_counter()
        cell = self._config.cell_size
        corners = self._cv2.goodFeaturesToTrack(grey, room, _QUALITY, 0.6 * cell, mask=self._empty(grey.shape, cell))
        pixels = None if corners is None else corners.reshape(-1, 2).astype(np.float64)
        if pixels is not None and len(self._ids) + len(pixels) >= _TEXTURED * self._config.features:
            pixels = centred(self._cv2, grey, pixels, cell)
        self.opencv_s += time.perf_counter() - begin
        if pixels is None:
            return tracks
        rays, found = self._rig.cameras[0].model.unproject(pixels)
        found &= self._inside(pixels, 0)
        pixels, rays = pixels[found], rays[found]
        count, cameras = len(pixels), len(self._rig.cameras)
        fresh = np.arange(len(self._ids) + count) >= len(self._ids)
        self._ids = np.append(self._ids, self._next_id + np.arange(count))
        self._next_id += count
        self._pixels = np.concatenate([self._pixels, np.full((count, cameras, 2), np.nan)])
        self._rays = np.concatenate([self._rays, np.full((count, cameras, 3), np.nan)])
        self._old_pixels = np.concatenate([self._old_pixels, np.full((count, cameras, 2), np.nan)])
        self._old_rays = np.concatenate([self._old_rays, np.full((count, cameras, 3), np.nan)])
        self._pixels[fresh, 0], self._rays[fresh, 0] = pixels, rays
        typical = float(np.median(self._rho[self._rho > _FAR])) if (self._rho > _FAR).any() else 0.0
        self._rho = np.append(self._rho, np.full(count, typical))
        rejected = Counter(tracks.rejected)
        self._search_others(fresh, rejected)
        return self._tracks(tracks.time_ns, fresh, rejected, tracks.motion_px)

    def forget(self, ids: NDArray[np.int64]) -> None:
        """Follow these corners no longer: they move on their own, or were never corners."""
        if len(ids):
            self._keep(~np.isin(self._ids, ids))

    def snapshot(self) -> dict[str, object]:
        """All that `track` depends on beside config and rig; only to be read."""
        return {name: value for name, value in vars(self).items() if name not in _GIVEN}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from a `snapshot`."""
        vars(self).update(snapshot)

    def _tracks(self, time_ns: int, fresh: NDArray[np.bool_], rejected: Counter[str], motion_px: float) -> Tracks:
        brightness, contrast = np.full((2, len(self._images)), np.nan)
        for k, image in enumerate(self._images):
            if image is not None:
                brightness[k], contrast[k] = _mean_and_deviation(np.ascontiguousarray(image[::8, ::8]))
        counts = {reason: count for reason, count in rejected.items() if count}
        pixels, rays = self._pixels.copy(), self._rays.copy()
        for c, camera in enumerate(self._rig.cameras):
            if camera.line_delay_s and self._motion is not None:
                seen = self._pixels[:, c], self._rays[:, c], self._old_pixels[:, c], self._old_rays[:, c]
                pixels[:, c], rays[:, c] = at_once(camera, *seen, self._rho, self._motion)
        partners = self._partners() if (contrast > FLAT).all() else None
        return Tracks(time_ns, self._ids.copy(), pixels, rays, fresh, counts, motion_px, brightness, contrast, partners)

    def _in_8_bits(self, images: Mapping[int, NDArray[Any]]) -> list[Grey | None]:
        """The image of each camera; where one shows that the range is larger, those of the instant before follow."""
        full = self._to_8_bits.full
        greys = [None if images.get(c) is None else self._to_8_bits(images[c]) for c in range(len(self._rig.cameras))]
        if 0.0 < full < self._to_8_bits.full:
            share = full / self._to_8_bits.full
            self._images = [None if image is None else np.rint(image * share).astype(np.uint8) for image in self._images]
        return greys

    def _keep(self, kept: NDArray[np.bool_]) -> None:
        self._ids, self._rho = self._ids[kept], self._rho[kept]
        self._pixels, self._rays = self._pixels[kept], self._rays[kept]
        self._old_pixels, self._old_rays = self._old_pixels[kept], self._old_rays[kept]

    def _predicted(self, R: Floats, p: Floats) -> tuple[Floats, Floats]:
        """Where the corners should be in the first image now (n, 2), and their inverse depths there (n,)."""
        R_now_before = self._R_imu_first.T @ R.T @ self._R_imu_first
        t = self._R_imu_first.T @ (R.T @ (self._p_imu_first - p) - self._p_imu_first)
        points = self._rays[:, 0] @ R_now_before.T + self._rho[:, None] * t
        pixels, seen = self._rig.cameras[0].model.project(points)
        ahead = seen & (points[:, 2] > 0.2)
        rho = np.where(ahead, self._rho / np.where(ahead, points[:, 2], 1.0), 0.0)
        return np.where(ahead[:, None], pixels, self._pixels[:, 0]), rho

    def _by_turn(self, R_before_now: Floats) -> Floats:
        """Where the rotation of the IMU alone puts the corners in the first image (n, 2), NaN outside of it."""
        R_now_before = self._R_imu_first.T @ R_before_now.T @ self._R_imu_first
        pixels, seen = self._rig.cameras[0].model.project(self._rays[:, 0] @ R_now_before.T)
        return np.where(seen[:, None], pixels, np.nan)

    def _flow(
        self, first: Grey, second: Grey, old: Floats, guess: Floats, rejected: Counter[str]
    ) -> tuple[Floats, NDArray[np.bool_]]:
        """Where `old` (n, 2) of the first image is in the second, and whether it was found there and comes back."""
        begin = time.perf_counter()
        start = old.astype(np.float32)
        options = {"winSize": _WINDOW, "maxLevel": _LEVELS, "criteria": _STOP, "flags": _GUESSED}
        there, found, _ = self._cv2.calcOpticalFlowPyrLK(first, second, start, guess.astype(np.float32), **options)
        back, returned, _ = self._cv2.calcOpticalFlowPyrLK(second, first, there, start.copy(), **options)
        self.opencv_s += time.perf_counter() - begin
        ok = (found.ravel() == 1) & (returned.ravel() == 1)
        close = np.linalg.norm((back - start).reshape(-1, 2), axis=1) < self._config.there_and_back
        rejected["not found again"] += int((~ok).sum())
        rejected["did not come back to where it began"] += int((ok & ~close).sum())
        return there.reshape(-1, 2).astype(np.float64), ok & close

    def _search_others(self, which: NDArray[np.bool_], rejected: Counter[str]) -> None:
        """Find the corners `which` (n,) of the first image in the other cameras."""
        rows = np.flatnonzero(which)
        first = self._images[0]
        self._pixels[rows, 1:], self._rays[rows, 1:] = np.nan, np.nan
        for c, T in enumerate(self._others, start=1):
            image = self._images[c]
            if image is None or first is None or not len(rows):
                continue
            there, rays, rho, kept = self._search(
                (first, image), c, T, self._pixels[rows, 0], self._rays[rows, 0], self._rho[rows], rejected
            )
            self._pixels[rows[kept], c], self._rays[rows[kept], c] = there[kept], rays[kept]
            self._rho[rows[kept]] = np.maximum(rho[kept], 0.0)

    def _search(
        self,
        images: tuple[Grey, Grey],
        camera: int,
        T: Floats,
        pixels: Floats,
        m: Floats,
        rho: Floats,
        rejected: Counter[str],
    ) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
        """Where corners of one image are in another, of which `camera` says the model.

        Args:
            images: the one and the other.
            T: (4, 4) camera of the one to that of the other.
            pixels: (n, 2) in the one; m: (n, 3) their rays; rho: (n,) inverse depths to begin from [1/m].

        Returns:
            (n, 2) pixels there, (n, 3) rays, (n,) inverse depths, (n,) whether to believe them.
        """
        model = self._rig.cameras[camera].model
        there, rays, depths = np.full((len(m), 2), np.nan), np.full((len(m), 3), np.nan), np.zeros(len(m))
        believed = np.zeros(len(m), dtype=np.bool_)
        guess, seen = model.project(m @ T[:3, :3].T + rho[:, None] * T[:3, 3])
        tried = np.flatnonzero(seen & self._inside(guess, camera))
        if not len(tried):
            return there, rays, depths, believed
        there[tried], kept = self._flow(*images, pixels[tried], guess[tried], Counter())
        rays[tried], found = model.unproject(there[tried])
        kept &= found & self._inside(there[tried], camera)
        turned = m[tried] @ T[:3, :3].T
        on_line = model.fx * epipolar_distances(turned, T[:3, 3], rays[tried]) < self._config.epipolar
        depths[tried], information = inverse_depths(turned, T[:3, 3], rays[tried])
        before = depths[tried] > -2.0 * self._config.pixel_sigma / model.fx / np.sqrt(information)
        rejected["off its epipolar line"] += int((kept & ~on_line).sum())
        rejected["behind the camera by its disparity"] += int((kept & on_line & ~before).sum())
        believed[tried] = kept & on_line & before
        return there, rays, depths, believed

    def _partners(self) -> Partners | None:
        """What shares the other cameras find; None where too few are expected to tell one."""
        expected = np.zeros(len(self._ids), dtype=np.bool_)
        for c, T in enumerate(self._others, start=1):
            expected |= self._is_expected(c, T, self._rays[:, 0])
        count = int(expected.sum())
        if count < FEWEST:
            return None
        found = np.isfinite(self._pixels[expected, 1:, 0]).any(axis=1)
        share = float(found.mean())
        return Partners(share, self._share_exchanged() if share < LEAST_SHARE else None)

    def _share_exchanged(self) -> float | None:
        """The share found if the image of the first camera came from another one, and its image from the first."""
        best: float | None = None
        for c, T in enumerate(self._others, start=1):
            first, image = self._images[0], self._images[c]
            if first is None or image is None or first.shape != image.shape:
                continue
            back: Floats = np.linalg.inv(T).astype(np.float64, copy=False)
            rays, known = self._rig.cameras[c].model.unproject(self._pixels[:, 0])
            rows = np.flatnonzero(known)
            rows = rows[self._is_expected(0, back, rays[rows])]
            if len(rows) < FEWEST:
                continue
            *_, found = self._search((first, image), 0, back, self._pixels[rows, 0], rays[rows], np.zeros(len(rows)), Counter())
            best = max(best or 0.0, float(found.mean()))
        return best

    def _is_expected(self, camera: int, T: Floats, m: Floats) -> NDArray[np.bool_]:
        """Which rays (n, 3) a camera sees at all distances from the nearest, and so that flow finds them (n,)."""
        model = self._rig.cameras[camera].model
        turned = m @ T[:3, :3].T
        far, at_infinity = model.project(turned)
        near, is_seen = model.project(turned + NEAREST * T[:3, 3])
        close = np.linalg.norm(near - far, axis=1) < self._reach[camera]
        return np.asarray(at_infinity & is_seen & close & self._inside(far, camera) & self._inside(near, camera))

    def _inside(self, pixels: Floats, camera: int) -> NDArray[np.bool_]:
        of = self._rig.cameras[camera]
        u, v = pixels[:, 0], pixels[:, 1]
        inside = (u >= _BORDER) & (u <= of.width - 1 - _BORDER) & (v >= _BORDER) & (v <= of.height - 1 - _BORDER)
        return np.asarray(inside)

    def _empty(self, shape: tuple[int, ...], cell: int) -> Grey:
        """(H, W) 255 in cells without a corner and around them no nearer to one than half a cell, else 0."""
        mask = np.full(shape, 255, np.uint8)
        mask[:_BORDER], mask[-_BORDER:], mask[:, :_BORDER], mask[:, -_BORDER:] = 0, 0, 0, 0
        for pixels in (self._pixels[:, 0], self._carried.places):
            _clear(np.rint(pixels).astype(np.int64), cell // 2, mask)
        return mask


def _reach(width: int, height: int) -> float:
    """How far from where it begins optical flow finds a corner [px]; images are halved while they hold more than one window."""
    levels = int(np.log2(max(min(width, height) / _WINDOW[0], 1.0)))
    return float(_REACH * 2.0 ** min(levels, _LEVELS))


@kernel
def _mean_and_deviation(grey: Grey) -> tuple[float, float]:
    """Mean and standard deviation of grey values (H, W)."""
    total, squares, count = np.int64(0), np.int64(0), grey.size
    for row in range(grey.shape[0]):
        for column in range(grey.shape[1]):
            value = np.int64(grey[row, column])
            total += value
            squares += value * value
    return total / count, math.sqrt(float(count * squares - total * total)) / count


@kernel
def _clear(corners: NDArray[np.int64], half: int, mask: Grey) -> None:
    """Zero about every corner (n, 2), `half` pixels wide to all sides."""
    for k in range(len(corners)):
        for v in range(max(corners[k, 1] - half, 0), min(corners[k, 1] + half + 1, mask.shape[0])):
            for u in range(max(corners[k, 0] - half, 0), min(corners[k, 0] + half + 1, mask.shape[1])):
                mask[v, u] = 0
