"""Does something large move by itself in the view of a camera?

What stands still in the world moves in the images by one essential matrix E (yᵀ E x = 0 for directions x, y of a corner in two
images). What moves by itself has another one, and is a part of the view with an edge. Both matrices are estimated in turn with
the part that belongs to each, beginning with what lies far from the epipolar lines of the first: a corner goes with the matrix
that it and its neighbours fit better, so that a few corners that were followed wrongly make no part. Rolling shutters bend the
view smoothly, and one matrix leaves little that another one explains. So do calibrations that are wrong, but not where depth goes
with the place in the image, a near wall beside what is far: what is said names them as well. A camera that stands still is not
looked at, nor what passes after its first moving images.

Source: the alternation is that of Lloyd, IEEE Transactions on Information Theory 1982, with motions in the place of means.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from boxplus._extras import require
from boxplus.cameras import CameraModel
from boxplus.recordings.cameras.info import CameraStream
from boxplus.recordings.info import Evidence
from boxplus.runs.inspection.cameras.carried import Followed

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

_FEWEST, _FEWEST_OF_PART = 50, 15  # corners of a pair of images, and of a part
_NEAR_PX, _FAR_PX = 1.0, 3.0  # from an epipolar line: of a corner that fits, and of one that does not
_NEIGHBOURS, _ROUNDS = 8, 4
_SURE, _MOST_TRIES = 0.99, 300
_OWN = 0.75  # share of a part that fits its own motion
_LEAST_SHARE = 0.15  # of the corners
_STILL_PX = 0.5  # a part that stands still in the image is carried along, and does not move by itself
_FEWEST_PAIRS, _LONGEST_GAP, _MOST_OF = 5, 5, 0.5  # of a stretch: pairs with two parts, steps between them, and their share
_SAME_PLACE = 0.5  # agreement of the parts from pair to pair: 1 the same, 0 chance
_ROWS, _COLUMNS = 8, 12  # at which parts are compared


class _Parts(NamedTuple):
    """A view of which two parts move unlike.

    Attributes:
        pixels: (N, 2) of the corners.
        apart: (N,) which of them are of the smaller part.
    """

    pixels: Floats
    apart: Mask


def check_motions(camera: CameraStream, pairs: Sequence[Followed], origin_ns: int) -> list[Evidence]:
    """A finding where a part of the view moves by itself, in several pairs of images and at about the same place.

    Args:
        camera: whose corners they are.
        pairs: corners of two images each, in order of time.
        origin_ns: from which times are counted in what is said [ns].
    """
    if camera.model is None:
        return []
    model = camera.model
    found = _longest([(pair, _parts(model, pair)) for pair in pairs])
    if len(found) < _FEWEST_PAIRS:
        return []
    maps = np.array([_spread(parts, camera) for _, parts in found])
    # Which of two halves is the smaller one may change from pair to pair.
    agreement = np.abs((maps[1:] * maps[:-1]).mean(axis=1))
    if float(np.median(agreement)) < _SAME_PLACE:
        return []
    share = float(np.median((maps > 0.0).mean(axis=1)))
    share = min(share, 1.0 - share)
    begin_s, end_s = ((time_ns - origin_ns) * 1e-9 for time_ns in (found[0][0].begin_ns, found[-1][0].end_ns))
    text = (
        f"between {begin_s:.1f} and {end_s:.1f} s something that moves by itself fills {share:.0%} of the view (or all but "
        f"that): in {len(found)} pairs of images the corners of two parts each agree on a motion, and not on the same one. Leave "
        "these seconds out or give an IMU; where nothing passed by, the calibration of the camera is wrong"
    )
    return [Evidence(f"{camera.name}_motions", "two", "warning", text)]


def _longest(pairs: Sequence[tuple[Followed, _Parts | None]]) -> list[tuple[Followed, _Parts]]:
    """Of the stretches of pairs most of which have two parts, at most a few in a row having one, that with the most."""
    stretches: list[list[int]] = []
    for k in (k for k, (_, parts) in enumerate(pairs) if parts is not None):
        if stretches and k - stretches[-1][-1] <= _LONGEST_GAP:
            stretches[-1].append(k)
        else:
            stretches.append([k])
    most = [stretch for stretch in stretches if len(stretch) > _MOST_OF * (stretch[-1] - stretch[0] + 1)]
    longest = max(most, key=len, default=[])
    return [(pair, parts) for pair, parts in (pairs[k] for k in longest) if parts is not None]


def _parts(model: CameraModel, pair: Followed) -> _Parts | None:
    """The parts of a view that move unlike; None where one motion explains it, or nothing does."""
    rays_1, known_1 = model.unproject(pair.before)
    rays_2, known_2 = model.unproject(pair.after)
    known = known_1 & known_2
    if known.sum() < _FEWEST:
        return None
    x, y, pixels = rays_1[known, :2], rays_2[known, :2], pair.before[known]
    off = _off_px(x, y, np.ones(len(x), bool), model.fx)
    if off is None:
        return None
    apart, off_first, off_second = off > _FAR_PX, off, off
    neighbours = cKDTree(pixels).query(pixels, k=_NEIGHBOURS + 1)[1]  # each corner is its own first one
    for _ in range(_ROUNDS):
        first, second = (_off_px(x, y, part, model.fx) for part in (~apart, apart))
        if first is None or second is None:
            return None
        off_first, off_second = first, second
        gain = np.minimum(off_first, _FAR_PX) ** 2 - np.minimum(off_second, _FAR_PX) ** 2
        apart = gain[neighbours].mean(axis=1) > 0.0
        if min(apart.sum(), (~apart).sum()) < max(_FEWEST_OF_PART, _LEAST_SHARE * len(apart)):
            return None
    if apart.mean() > 0.5:
        apart, off_first, off_second = ~apart, off_second, off_first
    fit = min(float((off_first[~apart] < _NEAR_PX).mean()), float((off_second[apart] < _NEAR_PX).mean()))
    moved = np.linalg.norm(pair.after - pair.before, axis=1)[known]
    is_carried = min(float(np.median(moved[part])) for part in (apart, ~apart)) < _STILL_PX
    if fit < _OWN or is_carried or float(np.median(off_first[apart])) < _FAR_PX:
        return None
    return _Parts(pixels, apart)


def _off_px(x: Floats, y: Floats, part: Mask, fx: float) -> Floats | None:
    """How far all corners (N, 2) lie from the epipolar lines of a part, to first order; None where it has no essential matrix."""
    if part.sum() < _NEIGHBOURS:
        return None
    cv2 = require("cv2", "which finds the essential matrix")
    first, second = np.ascontiguousarray(x[part]), np.ascontiguousarray(y[part])
    E, _ = cv2.findEssentialMat(
        first, second, np.eye(3), method=cv2.RANSAC, prob=_SURE, threshold=_NEAR_PX / fx, maxIters=_MOST_TRIES
    )
    if E is None or E.shape != (3, 3):
        return None
    ones = np.ones((len(x), 1))
    X, Y = np.hstack([x, ones]), np.hstack([y, ones])
    lines_2, lines_1 = X @ E.T, Y @ E
    slopes = np.sqrt((lines_1[:, :2] ** 2).sum(axis=1) + (lines_2[:, :2] ** 2).sum(axis=1))
    off: Floats = fx * np.sqrt(2.0) * np.abs(np.einsum("ni,ni->n", Y, lines_2)) / np.maximum(slopes, 1e-12)
    return off


def _spread(parts: _Parts, camera: CameraStream) -> Floats:
    """(cells,) of the view, by the corner next to each: +1 in the smaller part, −1 in the other one."""
    u = (np.arange(_COLUMNS) + 0.5) * camera.width / _COLUMNS
    v = (np.arange(_ROWS) + 0.5) * camera.height / _ROWS
    cells = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    spread: Floats = np.where(parts.apart[cKDTree(parts.pixels).query(cells)[1]], 1.0, -1.0)
    return spread
