"""Do the heights of the fixes go up and down with the odometry? Feet, depths and a receiver without heights do not.

Up to a constant, which no comparison shows, and a tilt of the odometry's world, which its verticals leave open, they do: in

    z_fix = a + b z + c x + d y,

b is 1. Where the way is level b is not known, and nothing is claimed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_SIGMAS = 4.0
_LEAST = 0.2  # of b from 1: less than that is no other unit
_FOOT = 0.3048
_KNOWN = {
    1.0 / _FOOT: "they are in feet",
    _FOOT: "they are in metres that somebody took for feet",
    0.0: "the receiver gives none",
    -1.0: "they are depths, and count downwards",
}


@dataclass(frozen=True, slots=True)
class Climb:
    """How far the fixes go up and down against the odometry, b, and its standard deviation."""

    ratio: float
    sigma: float

    @property
    def doubt(self) -> str | None:
        """What is wrong with the heights, a sentence; None where they go along with the odometry, or nothing tells."""
        if abs(self.ratio - 1.0) < max(_SIGMAS * self.sigma, _LEAST):
            return None
        near = [
            (abs(self.ratio - b), text) for b, text in _KNOWN.items() if abs(self.ratio - b) < max(_SIGMAS * self.sigma, 0.05)
        ]
        what = min(near)[1] if near else "they are in another unit, or of another place"
        return (
            f"heights of the fixes go {self.ratio:.2f} (± {self.sigma:.2f}) times as far up and down as the odometry: {what}; "
            "the map lies on the ground where they say, at no height that is to be trusted; correct the recording"
        )


def climb_of(p_level: Floats, up: Floats, drift: Floats, seconds: float, correlation: float) -> Climb | None:
    """The ratio of the heights; None where the way is level, or a plane.

    Args:
        p_level: (N, 3) antenna by the odometry, z up. up: (N,) by the fixes [m].
        drift: (N,) standard deviation of the odometry's height [m].
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
    return Climb(ratio, math.hypot(own, max(abs(ratio), 1.0) * float(np.median(drift))) / spread)
