"""Whether depths lie on the pixels that they belong to: where surfaces end or bend, grey values change as well.

On a plane 1/z is affine in the pixels, so that its second differences find the edges of surfaces, steps and creases alike. At a
small octave of a keyframe, the mean strength of the grey values' gradient is taken over these edges, moved by every shift s up to
a tenth of the image:

    c(s) = Σ w(p) m(p + s) / Σ w(p) − mean of m,   w = d/(d + d₀),  d = |∇²(1/z)| / median(1/z),   m = |∇I| / (|∇I| + m₀)

Registered depths have the peak of c at 0, others where they should be moved to. It is believed when edges of surfaces are
clearly edges of the image there, much more so than at 0, keyframe after keyframe, and farther away than a sensor may put the
edges of its depths. Keyframes that see the same agree about where texture happens to lie along edges as well; but then c has many
such peaks, and the largest of them does not stand out from all other shifts. Surroundings without edges (a wall, sheets of metal
all alike) say nothing. The normalisation by d + d₀ and |∇I| + m₀ keeps a few strong edges from deciding alone.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from boxplus.sensors.images.image import Image

Matrix = NDArray[np.float64]
_WIDTH = 160  # of the octave, at least this and less than twice it
_REACH = 0.1  # of the width that depths may be shifted by
_BEND = 0.02  # d₀
_EDGE = 0.5  # of w from which on a pixel is an edge
_FEWEST_EDGES, _MOST_EDGES = 50, 400  # pixels of a keyframe
_FEWEST, _MOST = 5, 20  # keyframes for a contradiction, and that are looked at
_LEAST_SHIFT = 2  # pixels of the octave; sensors put the edges of their depths no closer than this
_LEAST_HEIGHT = 0.04  # of the peak, by the largest that c can be
_LEAST_DROP = 0.3  # of it to c at no shift, by the peak
_LEAST_RISE = 5.0  # standard deviations of that, over keyframes
_LEAST_LEAD = 4.5  # standard deviations of c over the shifts by which the peak stands out from them
_OF_PEAK = 4  # pixels of the octave around the peak that are of it


class RegistrationWatch:
    """What the keyframes so far say of where the depths lie."""

    def __init__(self) -> None:
        self._surfaces: list[Matrix] = []
        self._octave_px = 1

    def add(self, image: Image, depth: NDArray[np.float32]) -> None:
        """A keyframe: grey values and depths (H, W), 0 where there is none."""
        if len(self._surfaces) >= _MOST:
            return
        self._octave_px = 1
        while image.shape[1] >= 2 * _WIDTH:
            image, self._octave_px = image.half(), 2 * self._octave_px
        height, width = image.shape
        step = self._octave_px
        blocks = depth[: step * height, : step * width].reshape(height, step, width, step)
        nearest, mean = blocks.min(axis=(1, 3)), blocks.mean(axis=(1, 3), dtype=np.float32)
        rho = np.where(nearest > 0.0, 1.0 / np.where(nearest > 0.0, mean, 1.0), np.nan)
        surface = _surface(image.grey.astype(np.float64), rho)
        if surface is not None:
            self._surfaces.append(surface)

    @property
    def contradiction(self) -> str:
        """By how much depths are shifted, in a sentence; empty where they are not, or where nothing shows it."""
        if len(self._surfaces) < _FEWEST:
            return ""
        each = np.array(self._surfaces)
        mean, reach = each.mean(axis=0), each.shape[1] // 2
        row, column = (int(k) for k in np.unravel_index(int(mean.argmax()), mean.shape))
        u, v = column - reach, row - reach
        drops = each[:, row, column] - each[:, reach, reach]
        rise = float(drops.mean() / max(drops.std(ddof=1) / np.sqrt(len(each)), 1e-12))
        is_clear = mean[row, column] > _LEAST_HEIGHT and drops.mean() > _LEAST_DROP * mean[row, column] and rise > _LEAST_RISE
        is_border = max(abs(u), abs(v)) == reach  # the peak may lie beyond
        if not is_clear or is_border or max(abs(u), abs(v)) < _LEAST_SHIFT or _lead(mean, row, column) < _LEAST_LEAD:
            return ""
        return (
            "depths lie on other pixels than their grey values: edges of surfaces agree with edges of the image when depths are "
            f"moved by {u * self._octave_px:+d} pixels along u and {v * self._octave_px:+d} along v ({rise:.0f} standard "
            f"deviations better than as they are, over {len(each)} keyframes); register the depth to the images"
        )


def _lead(mean: Matrix, row: int, column: int) -> float:
    """By how many of its standard deviations over all other shifts c is larger at its peak than there."""
    rows, columns = np.ogrid[: mean.shape[0], : mean.shape[1]]
    others = mean[np.maximum(np.abs(rows - row), np.abs(columns - column)) > _OF_PEAK]
    return float((mean[row, column] - others.mean()) / max(others.std(), 1e-12))


def _surface(grey: Matrix, rho: Matrix) -> Matrix | None:
    """c(s) (2r + 1, 2r + 1) by rows v and columns u of s; None without enough edges."""
    reach = int(_REACH * grey.shape[1])
    bend = np.full(rho.shape, np.nan)
    across, down = rho[:, 2:] - 2.0 * rho[:, 1:-1] + rho[:, :-2], rho[2:] - 2.0 * rho[1:-1] + rho[:-2]
    bend[1:-1, 1:-1] = np.hypot(across[1:-1], down[:, 1:-1])
    known = np.isfinite(bend)
    inner = np.zeros_like(known)
    inner[reach + 1 : -reach - 1, reach + 1 : -reach - 1] = True
    if not (known & inner).any():
        return None
    bend = np.where(known, bend, 0.0) / float(np.median(rho[np.isfinite(rho)]))
    weight = bend / (bend + _BEND)
    v, u = np.nonzero(inner & (weight > _EDGE))
    if len(v) < _FEWEST_EDGES:
        return None
    stride = -(-len(v) // _MOST_EDGES)
    v, u = v[::stride], u[::stride]
    slope = np.zeros_like(grey)
    slope[1:-1, 1:-1] = 0.5 * np.hypot(grey[1:-1, 2:] - grey[1:-1, :-2], grey[2:, 1:-1] - grey[:-2, 1:-1])
    strength = slope / (slope + float(np.median(slope)) + 1e-3 * float(np.ptp(grey)) + 1e-30)
    shifts = np.arange(-reach, reach + 1)
    w = weight[v, u]
    around_edges = sliding_window_view(strength.astype(np.float32), (2 * reach + 1, 2 * reach + 1))[v - reach, u - reach]
    c = np.tensordot(w.astype(np.float32), around_edges, axes=1).astype(np.float64)
    total = np.pad(strength.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    height, width = (length - 2 * reach - 2 for length in grey.shape)
    first = shifts + reach + 1
    last = first + np.array([[height], [width]])
    around = total[np.ix_(last[0], last[1])] - total[np.ix_(first, last[1])] - total[np.ix_(last[0], first)]
    around += total[np.ix_(first, first)]
    surface: Matrix = c / w.sum() - around / (height * width)
    return surface
