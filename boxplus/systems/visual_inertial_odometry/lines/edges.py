"""Edges of an image to a part of a pixel, where a line is expected: across it, at places along it.

A line is looked for by its brightness across itself, at `PLACES` places between its ends. Where it is only roughly known, the
profile seen before is compared at all shifts of both ends; then the steepest edge of the sign seen before is found at every
place, to a part of a pixel, and a straight line is fitted to these in the plane of rays, where a lens bends nothing.

Source: Harris and Stennett, RAPID, BMVC 1990 (search across edges); Bouthemy, PAMI 1989 (moving edges).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.model import CameraModel

PLACES = 16
REACH = 5  # px across the line that a profile spans to either side
_SNAP, _STEP = 3.0, 1.0  # px: how far from where it is expected an edge is looked for, and how densely
_STEEPEST = 0.35  # of the steepness that the line had, which an edge has to have
_FITS = 0.7  # px from the line fitted, that a place may be to belong to it
_ROUNDS = 4
_LIKE = 0.7  # correlation of profiles

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Grey = NDArray[np.uint8]

_ALONG = np.linspace(0.0, 1.0, PLACES)


def places(segments: Floats) -> Floats:
    """(n, PLACES, 2) along segments (n, 4) of rays, the ends included."""
    return segments[:, None, :2] + _ALONG[:, None] * (segments[:, None, 2:] - segments[:, None, :2])


def normals(pixels: Floats) -> Floats:
    """(n, PLACES, 2) unit vectors across a line at its places (n, PLACES, 2) in the image [px]."""
    tangent = np.gradient(pixels, axis=1)
    length = np.maximum(np.linalg.norm(tangent, axis=2, keepdims=True), 1e-9)
    across: Floats = np.stack([-tangent[..., 1], tangent[..., 0]], axis=2) / length
    return across


def inside(pixels: Floats, shape: tuple[int, ...], border: float) -> Flags:
    """(...) whether pixels (..., 2) lie in an image (H, W), this far from its border."""
    size = np.array([shape[1], shape[0]])
    return np.asarray(((pixels >= border) & (pixels <= size - 1.0 - border)).all(axis=-1))


def profiles(cv2: Any, grey: Grey, middle: Floats, across: Floats, offsets: Floats) -> Floats:
    """(n, PLACES, k) grey values at offsets (k,) [px] across lines, bilinear."""
    at = (middle[:, :, None] + offsets[:, None] * across[:, :, None]).astype(np.float32).reshape(-1, len(offsets), 2)
    if not len(at):
        return np.zeros((len(middle), PLACES, len(offsets)))
    values = cv2.remap(grey, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, dtype=np.float64).reshape(len(middle), PLACES, len(offsets))


def shifted(seen: Floats, wide: Floats, usable: Flags) -> tuple[Floats, Flags]:
    """The shifts of both ends at which profiles across lines are most like those seen before.

    Args:
        seen: (n, PLACES, 2 REACH + 1) profiles seen before.
        wide: (n, PLACES, 2 (REACH + r) + 1) what there is now, from −REACH − r to REACH + r px across the line expected.
        usable: (n, PLACES) places that are in the image.

    Returns:
        (n, PLACES) shifts across the line [px], (n,) whether profiles are alike there.
    """
    width = seen.shape[2]
    count = wide.shape[2] - width + 1
    reach = count // 2
    windows = np.lib.stride_tricks.sliding_window_view(wide, width, axis=2)  # (n, PLACES, count, width)
    a = seen - seen.mean(axis=2, keepdims=True)
    a /= np.maximum(np.linalg.norm(a, axis=2, keepdims=True), 1e-9)
    mean = windows.mean(axis=3)
    norm = np.sqrt(np.maximum((windows**2).mean(axis=3) - mean**2, 0.0) * width)
    # a has the mean zero: that of the window drops out. A flat window is like nothing.
    likeness = np.einsum("npw,npcw->npc", a, windows) / np.maximum(norm, 2.0)
    likeness = np.where(usable[..., None], likeness, 0.0)
    shifts = np.arange(-reach, reach + 1)
    first, last = (grid.ravel() for grid in np.meshgrid(shifts, shifts, indexing="ij"))
    lines = first[:, None] * (1.0 - _ALONG) + last[:, None] * _ALONG  # (h, PLACES)
    columns = np.rint(lines).astype(np.int64) + reach
    score = likeness[:, np.arange(PLACES), columns].sum(axis=2) / np.maximum(usable.sum(axis=1), 1)[:, None]
    # Of shifts that are as good the smallest: what is predicted counts.
    best = np.argmax(score - 0.01 * np.abs(lines).mean(axis=1), axis=1)
    return lines[best], np.asarray(score[np.arange(len(seen)), best] > _LIKE)


def snapped(
    cv2: Any, grey: Grey, expected: Floats, sign: Floats, steepness: Floats, reach: float = _SNAP
) -> tuple[Floats, Flags, Floats]:
    """The steepest edge of a sign across lines, to a part of a pixel.

    Args:
        expected: (n, PLACES, 2) where the lines should be [px].
        sign, steepness: (n,) of the edge: whether it grows brighter across the line, and by how much for a pixel.

    Returns:
        (n, PLACES, 2) places on the edge [px]; (n, PLACES) whether there is one; (n, PLACES) its steepness.
    """
    across = normals(expected)
    half = round(reach / _STEP) + 1
    offsets = _STEP * np.arange(-half - 1.0, half + 2.0)
    values = profiles(cv2, grey, expected, across, offsets)
    slope = sign[:, None, None] * (values[..., 2:] - values[..., :-2]) / (2.0 * _STEP)
    inner = slope[..., 1:-1]
    peak = (inner >= slope[..., :-2]) & (inner > slope[..., 2:])
    steep = np.where(peak & (inner > _STEEPEST * steepness[:, None, None]), inner, 0.0)
    # The nearest of edges that are about as steep.
    nearness = 1.0 - 0.1 * np.abs(offsets[2:-2])
    at = np.argmax(steep * nearness, axis=2)
    rows = np.indices(at.shape)
    found = steep[(*rows, at)] > 0.0
    a, b, c = (slope[(*rows, at + k)] for k in range(3))
    curvature = a - 2.0 * b + c
    part = np.where(curvature < -1e-9, 0.5 * (a - c) / np.where(curvature < -1e-9, curvature, -1.0), 0.0)
    offset = offsets[at + 2] + _STEP * np.clip(part, -0.5, 0.5)
    edge = expected + offset[..., None] * across
    return edge, found & inside(expected, grey.shape, reach + 1.0), np.where(found, b, 0.0)


def fitted(model: CameraModel, edge: Floats, found: Flags, least: int) -> tuple[Floats, Flags, Floats]:
    """Straight lines through edges, in the plane of rays.

    Args:
        model: of the camera.
        edge: (n, PLACES, 2) [px]; found: (n, PLACES) which there are.
        least: of the places that have to fit.

    Returns:
        (n, 4) ends of the segments, as rays; (n, PLACES) which places fit; (n,) the root mean square of their distances [px].
        Where too few fit there is no line: NaN.
    """
    rays, seen = model.unproject(edge.reshape(-1, 2))
    xy = rays[:, :2].reshape(edge.shape)
    found = found & seen.reshape(found.shape)
    xy = np.where(found[..., None], xy, 0.0)
    weight = found.astype(np.float64)
    focal = _focal(model)
    for round_ in range(_ROUNDS):
        total = np.maximum(weight.sum(axis=1), 1e-9)
        middle = (weight[..., None] * xy).sum(axis=1) / total[:, None]
        away = xy - middle[:, None]
        C = np.einsum("np,npi,npj->nij", weight, away, away)
        direction = np.linalg.eigh(C)[1][:, :, 1]
        off = focal * np.abs(away[..., 0] * direction[:, None, 1] - away[..., 1] * direction[:, None, 0])
        # From a generous limit to the final one: the first lines are drawn aside by what does not belong to them.
        limit = _FITS * 2.0 ** (_ROUNDS - 2 - round_) if round_ < _ROUNDS - 2 else _FITS
        weight = (found & (off < limit)).astype(np.float64)
    fits = weight > 0.0
    along = np.einsum("npi,ni->np", away, direction)
    ahead = (weight * along * _ALONG).sum(axis=1)  # along has the mean zero
    low, high = np.where(fits, along, np.inf).min(axis=1), np.where(fits, along, -np.inf).max(axis=1)
    first, last = np.where(ahead >= 0.0, low, high), np.where(ahead >= 0.0, high, low)
    enough = (fits.sum(axis=1) >= least) & np.isfinite(low)
    with np.errstate(invalid="ignore"):
        ends = np.concatenate([middle + first[:, None] * direction, middle + last[:, None] * direction], axis=1)
    rms = np.sqrt((off**2 * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1.0))
    return np.where(enough[:, None], ends, np.nan), fits, rms


def _focal(model: CameraModel) -> float:
    return float(np.sqrt(model.fx * model.fy))
