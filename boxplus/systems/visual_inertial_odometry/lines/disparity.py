"""How far away a line is that a second camera may see: its surroundings compared along epipolar lines, at all depths of its ends.

Along a line inverse depth is linear in the plane of rays. So what is looked for are two numbers, the inverse depths of both ends,
and all pairs of them are tried: what the first camera shows about places along the line should be found at all of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus.systems.visual_inertial_odometry.lines import edges
from boxplus.systems.visual_inertial_odometry.rig import Rig

_STEPS = 64
_NEAREST = 1.6  # 1/m
_HALF = 5  # px of what is compared
ALIGNED = 0.25  # sine of the angle to the epipolar line, below which all depths look alike
_LIKE, _BETTER = 0.75, 0.05  # correlation in the mean, and by how much it is above that at other depths

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Grey = NDArray[np.uint8]


def inverse_depths(
    cv2: Any, first: Grey, second: Grey, rig: Rig, camera: int, T: Floats, segments: Floats, guess: Floats
) -> tuple[Floats, Flags]:
    """ρ (n, 2) at both ends of segments (n, 4) of the first camera, and whether one pair explains the second image best.

    Args:
        T: (4, 4) first camera to the second.
        guess: (n, 2) what is returned where none does.
    """
    count = len(segments)
    if not count:
        return guess, np.zeros(0, dtype=np.bool_)
    R, t = T[:3, :3], T[:3, 3]
    model, other = rig.cameras[0].model, rig.cameras[camera].model
    rays = edges.places(segments)
    m = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=2)
    rho = np.linspace(0.0, _NEAREST, _STEPS)
    turned = m @ R.T
    points = turned[:, :, None] + rho[:, None] * t  # (n, PLACES, steps, 3)
    there, seen = other.project(points.reshape(-1, 3))
    there = there.reshape(*points.shape[:3], 2)
    usable = seen.reshape(points.shape[:3]) & edges.inside(there, second.shape, 2.0 + _HALF)
    # What is compared lies along the epipolar line in both images; the same number of pixels, as for a surface that faces both.
    reach = np.arange(-_HALF, _HALF + 1)
    along = there[:, :, -1] - there[:, :, 0]
    along /= np.maximum(np.linalg.norm(along, axis=2, keepdims=True), 1e-9)
    here, _ = model.project(m.reshape(-1, 3))
    here = here.reshape(count, edges.PLACES, 2)
    epipole = R.T @ t
    ahead = m + 0.01 * epipole / np.linalg.norm(epipole)
    beside, _ = model.project(ahead.reshape(-1, 3))
    own = beside.reshape(here.shape) - here
    own /= np.maximum(np.linalg.norm(own, axis=2, keepdims=True), 1e-9)
    own *= np.where((own * along).sum(axis=2, keepdims=True) < 0.0, -1.0, 1.0)
    a = _grey_at(cv2, first, here[:, :, None] + reach[:, None] * own[:, :, None])
    b = _grey_at(cv2, second, there[:, :, :, None] + reach[:, None] * along[:, :, None, None])
    a -= a.mean(axis=-1, keepdims=True)
    b -= b.mean(axis=-1, keepdims=True)
    strong = np.linalg.norm(a, axis=-1)
    a /= np.maximum(strong, 2.0)[..., None]
    b /= np.maximum(np.linalg.norm(b, axis=-1), 2.0)[..., None]
    likeness = np.where(usable, np.einsum("npw,npsw->nps", a, b), 0.0)
    score = np.zeros((count, _STEPS, _STEPS))
    steps = np.arange(_STEPS)
    for k, part in enumerate(np.linspace(0.0, 1.0, edges.PLACES)):
        column = np.rint((1.0 - part) * steps[:, None] + part * steps).astype(np.int64)
        score += likeness[:, k, column]
    score /= np.maximum(usable.any(axis=2).sum(axis=1), 1)[:, None, None]
    flat = score.reshape(count, -1)
    best = np.argmax(flat, axis=1)
    i, j = np.unravel_index(best, (_STEPS, _STEPS))
    top = flat[np.arange(count), best]
    # Elsewhere: pairs of depths that are not those next to the best.
    far = (np.abs(steps[:, None] - i[:, None, None]) > 3) | (np.abs(steps - j[:, None, None]) > 3)
    second_best = np.where(far, score, -1.0).reshape(count, -1).max(axis=1)
    sure = (top > _LIKE) & (top - second_best > _BETTER) & ~along_baseline(segments, epipole)
    return np.where(sure[:, None], np.column_stack([rho[i], rho[j]]), guess), sure


def along_baseline(segments: Floats, baseline: Floats) -> Flags:
    """Which segments (n, 4) of rays lie so near to a plane with the baseline (3,) that they look alike at all depths."""
    ones = np.ones((len(segments), 1))
    normal = np.cross(np.hstack([segments[:, :2], ones]), np.hstack([segments[:, 2:], ones]))
    off = np.abs(normal @ baseline) / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    return np.asarray(off < ALIGNED * np.linalg.norm(baseline))


def _grey_at(cv2: Any, grey: Grey, at: Floats) -> Floats:
    """Grey values at pixels (..., k, 2), bilinear."""
    maps = at.astype(np.float32).reshape(-1, at.shape[-2], 2)
    rows = [
        cv2.remap(grey, part[..., 0], part[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for part in np.array_split(maps, max(1, -(-len(maps) // 30_000)))
    ]
    return np.concatenate(rows).astype(np.float64).reshape(at.shape[:-1])
