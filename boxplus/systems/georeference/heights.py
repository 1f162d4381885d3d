"""Do the heights of the fixes go up and down with the odometry? Feet, depths and a receiver without heights do not.

Up to a constant, which no comparison shows, and a tilt of the odometry's world, which its verticals leave open, they do: in

    z_fix = a + b z + c x + d y,

b is 1. Where the way is level b is not known, and nothing is claimed.

How well b is known is told by what the ratio leaves, which counts as few errors as stay for long within a recording: on a short
way over low hills that is not enough for feet of a usual receiver. But in another unit its noise grows as the hills do. Read in
the right one, the heights then scatter as the receiver states, and as its places do; as they are, several times as much.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_SIGMAS = 4.0
_LEAST = 0.2  # of b from 1: less than that is no other unit
_SIGMAS_STATED = 2.0  # where the noise that is stated bears out a unit, and
_AS_STATED, _BEYOND = 1.5, 3.0  # times that noise, what the heights scatter by in that unit at most, and as they are at least
_FOOT = 0.3048
_FEWEST = 5  # fixes on either side of a jump
_EXPLAINED = 0.8  # of what heights are off by, for a jump to be what it is
_UNITS = (1.0 / _FOOT, _FOOT)
_KNOWN = {
    1.0 / _FOOT: "they are in feet",
    _FOOT: "they are in metres that somebody took for feet",
    0.0: "the receiver gives none",
    -1.0: "they are depths, and count downwards",
}


@dataclass(frozen=True, slots=True)
class Climb:
    """How far the fixes go up and down against the odometry.

    Attributes:
        ratio: b; sigma: its standard deviation.
        unit: the b of a unit in which the heights scatter as the receiver states, and far less than as they are; None: of none.
    """

    ratio: float
    sigma: float
    unit: float | None = None

    @property
    def doubt(self) -> str | None:
        """What is wrong with the heights, a sentence; None where they go along with the odometry, or nothing tells."""
        sigmas = _SIGMAS if self.unit is None else _SIGMAS_STATED
        if abs(self.ratio - 1.0) < max(sigmas * self.sigma, _LEAST):
            return None
        near = [
            (abs(self.ratio - b), text) for b, text in _KNOWN.items() if abs(self.ratio - b) < max(_SIGMAS * self.sigma, 0.05)
        ]
        what = min(near)[1] if near else "they are in another unit, or of another place"
        return (
            f"heights of the fixes go {self.ratio:.2f} (± {self.sigma:.2f}) times as far up and down as the odometry: {what}; "
            "the map lies on the ground where they say, at no height that is to be trusted; correct the recording"
        )


def climb_of(p_level: Floats, up: Floats, drift: Floats, noise: float, seconds: float, correlation: float) -> Climb | None:
    """The ratio of the heights; None where the way is level, or a plane.

    Args:
        p_level: (N, 3) antenna by the odometry, z up. up: (N,) by the fixes [m].
        drift: (N,) standard deviation of the odometry's height [m].
        noise: standard deviation of a height that the receiver states, times what its places scatter beyond their own [m].
        seconds: of the recording; correlation: time for which errors of fixes stay [s].
    """
    plane = np.column_stack([np.ones(len(up)), p_level[:, :2] - p_level[:, :2].mean(axis=0)])
    climbed, rest = (v - plane @ np.linalg.lstsq(plane, v, rcond=None)[0] for v in (p_level[:, 2], up))
    energy = float(climbed @ climbed)
    spread = math.sqrt(energy / len(up))
    if spread <= _SIGMAS * float(np.median(drift)) or spread <= 1e-6:
        return None
    ratio = float(climbed @ rest) / energy
    # What a plane and one ratio leave, as many times as errors of fixes are anew; and the odometry's height is not exact.
    own = float(np.std(rest - ratio * climbed)) / math.sqrt(max(seconds / max(correlation, 1e-9), 1.0))
    sigma = math.hypot(own, max(abs(ratio), 1.0) * float(np.median(drift))) / spread
    stated = math.hypot(noise, float(np.median(drift)))
    as_given = float(np.std(rest - climbed))
    unit = next(
        (
            b
            for b in _UNITS
            if as_given >= _BEYOND * stated
            and float(np.std(rest / b - climbed)) <= _AS_STATED * stated
            and abs(ratio - b) <= _SIGMAS_STATED * sigma
        ),
        None,
    )
    return Climb(ratio, sigma, unit)


def height_jump(off: Floats) -> tuple[int, float] | None:
    """The row from which heights that are off (N,) [m] are so by another level, and by how much it is higher [m].

    None where one jump does not explain most of it: noise, and levels that come and go.
    """
    n = len(off)
    if n < 2 * _FEWEST:
        return None
    off = off - off[0]  # of one level exactly nothing is left, and no rounding
    after = np.arange(_FEWEST, n - _FEWEST + 1)
    before = np.cumsum(off)[after - 1]
    step = (off.sum() - before) / (n - after) - before / after
    explained = step**2 * after * (n - after) / n
    best = int(np.argmax(explained))
    if explained[best] < _EXPLAINED * float(((off - off.mean()) ** 2).sum()) or not step[best]:
        return None
    return int(after[best]), float(step[best])
