"""Depths of points that no sensor measured, from the motion of the camera: a Gaussian and uniform filter of inverse depths.

A pixel of a new keyframe is looked for along its epipolar line in keyframes before it, one after the other. What is found, x ± τ,
is the inverse depth ρ with probability π, else anything in the range that was searched:

    p(x | ρ, π) = π N(x; ρ, τ²) + (1 − π) U(x),    q(ρ, π | μ, σ, a, b) = N(ρ; μ, σ²) Beta(π; a, b)

The first view gives μ and σ; every other one updates all four by the moments of the posterior, which is no q, but is replaced by
the one that has its first two moments of ρ and of π. A view in which the pixel should be seen and is not found counts as an
outlier, b ← b + 1. A depth is believed when σ is a small share of it and the mean a/(a + b) of π is high enough.

Points that keyframes of the window have already are carried over: they need no motion, and hold depths through turns.

Source: Vogiatzis and Hernández, Video-based, real-time multi-view stereo, IVC 2011, eqs. 4 and 17 to 27; the search as in Engel,
Sturm and Cremers, Semi-dense visual odometry for a monocular camera, ICCV 2013.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.pinhole import Pinhole
from boxplus.manifolds import quaternion, se3
from boxplus.sensors.images.image import Image
from boxplus.systems.direct_odometry.depth.epipolar_kernel import DIFFERENT, FOUND
from boxplus.systems.direct_odometry.depth.epipolar_search import View, choose_candidates, search
from boxplus.systems.direct_odometry.depth.sensed_depth import SensedDepth
from boxplus.systems.direct_odometry.window_system import WindowKeyframe

Matrix = NDArray[np.float64]
Flags = NDArray[np.bool_]

_CANDIDATES, _ASKED = 6000, 4  # pixels whose depth is looked for, and keyframes that are asked
_FIRST = 1.0  # a and b before anything was seen
_BELIEVED = 0.6  # mean of π from which on a depth is, where several views were asked
_KNOWN = 0.1  # σ by ρ up to which it is
_CARRIED = 0.05  # standard deviation of a depth that is carried over, by the depth: its pixel is rounded
_CELLS = 12  # across the image, each with a range of depths of its own
_WIDER = 1.5  # factor of the range that points around show
_MOST_WIDER = 3.0  # of that of the whole image, where there are none


@dataclass(slots=True, eq=False)
class DepthFilter:
    """State of n pixels.

    Attributes:
        mu, sigma: (n,) of the inverse depths [1/m]; infinite σ where none was found yet.
        a, b: (n,) of the share of inliers; span: (n,) range that is searched [1/m].
    """

    mu: Matrix
    sigma: Matrix
    a: Matrix
    b: Matrix
    span: Matrix

    @classmethod
    def over(cls, near: Matrix, far: Matrix) -> DepthFilter:
        """Nothing is known of inverse depths but that they lie between `far` and `near` (n,)."""
        n = len(near)
        return cls(0.5 * (near + far), np.full(n, np.inf), np.full(n, _FIRST), np.full(n, _FIRST), near - far)

    def update(self, x: Matrix, tau: Matrix, seen: Flags, missed: Flags) -> None:
        """What one view says.

        Args:
            x, tau: (n,) inverse depth and its standard deviation, where `seen` (n,).
            missed: (n,) where the pixel should be in view and is not.
        """
        first = seen & np.isinf(self.sigma)
        again = np.flatnonzero(seen & ~first)
        self.b[missed & np.isfinite(self.sigma)] += 1.0
        m, s2, a, b = self.mu[again], self.sigma[again] ** 2, self.a[again], self.b[again]
        t2 = tau[again] ** 2
        both = 1.0 / (1.0 / s2 + 1.0 / t2)
        mean = both * (m / s2 + x[again] / t2)
        inlier = a / (a + b) * np.exp(-0.5 * (x[again] - m) ** 2 / (s2 + t2)) / np.sqrt(2.0 * np.pi * (s2 + t2))
        outlier = b / (a + b) / np.maximum(self.span[again], 1e-300)
        share = inlier / np.maximum(inlier + outlier, 1e-300)
        n = a + b
        f = share * (a + 1.0) / (n + 1.0) + (1.0 - share) * a / (n + 1.0)
        e = (share * (a + 1.0) * (a + 2.0) + (1.0 - share) * a * (a + 1.0)) / ((n + 1.0) * (n + 2.0))
        mu = share * mean + (1.0 - share) * m
        variance = share * (both + mean**2) + (1.0 - share) * (s2 + m**2) - mu**2
        self.mu[again], self.sigma[again] = mu, np.sqrt(np.maximum(variance, 1e-300))
        self.a[again] = (e - f) / (f - e / f)
        self.b[again] = self.a[again] * (1.0 - f) / f
        self.mu[first], self.sigma[first] = x[first], tau[first]

    def believed(self, views: int) -> Flags:
        """(n,) of which the depth is known, after so many views."""
        least = _BELIEVED if views > 1 else 0.0
        return np.asarray((self.mu > 0.0) & (self.sigma < _KNOWN * self.mu) & (self.a > least * (self.a + self.b)))


def depth_of_two(image: Image, other: Image, camera: Pinhole, T_other_image: Matrix, within: tuple[float, float]) -> SensedDepth:
    """Depths of an image by one other of the same camera, of inverse depths `within` a range [1/m]."""
    gain = _spread(image.grey) / max(_spread(other.grey), 1e-30)
    view = View(Image(np.float32(gain) * other.grey), camera, T_other_image)
    return _depth(image, camera, [view], np.zeros((0, 3)), within, None)


def _spread(grey: NDArray[np.float32]) -> float:
    some = grey[::4, ::4]
    return float(np.median(np.abs(some - np.median(some))))


def depth_from(
    keyframes: Sequence[WindowKeyframe],
    image: Image,
    camera: Pinhole,
    T_world_camera: Matrix,
    log_gain: float,
    wanted: Flags | None = None,
) -> SensedDepth:
    """Depths of an image, by how the camera moved since the last keyframes, and by what these know already.

    Args:
        keyframes: the newest last; T_world_camera: (7,) of the image, log_gain: of its brightness.
        wanted: (H, W) where depths are wanted; all by default.
    """
    views = [
        View(
            Image(np.float32(np.exp(log_gain - k.log_gain)) * k.grey),
            camera,
            se3.compose(se3.inverse(k.T_world_camera), T_world_camera),
        )
        for k in keyframes[: -_ASKED - 1 : -1]
    ]
    points = np.concatenate([keyframe.points() for keyframe in keyframes]).astype(np.float64)
    points = (points - T_world_camera[4:]) @ quaternion.to_matrix(T_world_camera[:4])
    return _depth(image, camera, views, points, None, wanted)


def _depth(
    image: Image,
    camera: Pinhole,
    views: Sequence[View],
    points: Matrix,
    within: tuple[float, float] | None,
    wanted: Flags | None,
) -> SensedDepth:
    """The same, with points (m, 3) of known depth in the camera [m]; without any, inverse depths are searched `within`."""
    height, width = image.shape
    z, sigma = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    pixels, seen = camera.project(points) if len(points) else (np.zeros((0, 2)), np.zeros(0, dtype=np.bool_))
    seen = seen & (points[:, 2] > 0.0) & (pixels >= 0.5).all(axis=1) & (pixels < (width - 1.5, height - 1.5)).all(axis=1)
    places, depths = np.rint(pixels[seen]).astype(np.int64), points[seen, 2]
    farthest_first = np.argsort(-depths)
    u, v = places[farthest_first].T
    z[v, u], sigma[v, u] = depths[farthest_first], _CARRIED * depths[farthest_first]
    centres = choose_candidates(image, _CANDIDATES)
    if wanted is not None:
        z[~wanted] = 0.0
        centres = centres[wanted[centres[:, 1], centres[:, 0]]]
    if len(centres) and len(views) and (within is not None or len(depths)):
        near, far = _ranges(centres, places, 1.0 / depths, width, within)
        state = DepthFilter.over(near, far)
        for view in views:
            known = np.isfinite(state.sigma)
            margin = np.where(known, 3.0 * state.sigma, 0.0)
            found = search(
                image, camera, centres, view, np.where(known, np.minimum(state.mu + margin, near), near),
                np.where(known, np.maximum(state.mu - margin, far), far),
            )  # fmt: skip
            state.update(found.rho, found.sigma, found.state == FOUND, found.state == DIFFERENT)
        good = state.believed(len(views))
        u, v = centres[good].T
        z[v, u], sigma[v, u] = 1.0 / state.mu[good], state.sigma[good] / state.mu[good] ** 2
    return SensedDepth(z, sigma, is_measured=np.zeros(z.shape, dtype=np.bool_))


def _ranges(
    centres: NDArray[np.int64], pixels: NDArray[np.int64], rho: Matrix, width: int, within: tuple[float, float] | None
) -> tuple[Matrix, Matrix]:
    """Inverse depths to search between (n,): those of points in the same cell of the image and in those around it."""
    if within is not None:
        return np.full(len(centres), within[1]), np.full(len(centres), within[0])
    least, most = np.quantile(rho, [0.02, 0.98])
    cell = max(width // _CELLS, 1)
    rows, columns = (int(k) + 3 for k in centres[:, ::-1].max(axis=0) // cell)
    rows, columns = max(rows, int(pixels[:, 1].max()) // cell + 3), max(columns, int(pixels[:, 0].max()) // cell + 3)
    low, high = np.full((rows, columns), np.inf), np.zeros((rows, columns))
    i, j = pixels[:, 1] // cell + 1, pixels[:, 0] // cell + 1
    for di in (-1, 0, 1):
        for dj in (-1, 0, 1):
            np.minimum.at(low, (i + di, j + dj), rho)
            np.maximum.at(high, (i + di, j + dj), rho)
    i, j = centres[:, 1] // cell + 1, centres[:, 0] // cell + 1
    is_known = high[i, j] > 0.0
    near = np.where(is_known, _WIDER * high[i, j], _MOST_WIDER * most)
    far = np.where(is_known, low[i, j] / _WIDER, least / _MOST_WIDER)
    return near, far
