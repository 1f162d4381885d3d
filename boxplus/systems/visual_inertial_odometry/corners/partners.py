"""What share of the corners another camera finds where the calibration puts them: next to none where cameras are swapped.

Only corners count that the other camera sees at whatever distance they are, within the reach of the optical flow that looks for
them. Cameras that share too little of their view, or stand too far apart for that, tell nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

LEAST_SHARE = 0.15
FLAT = 5.0
"""Grey values: standard deviation of an image that shows nothing."""
FEWEST = 15
"""Corners that tell a share."""
NEAREST = 0.5
"""1/m: corners are expected from there to infinity."""

_EXCHANGED = 0.4  # share; where cameras are swapped rooms, aisles, stairs and halls show 0.55 and more (seeds 7 and 9)


@dataclass(frozen=True, slots=True)
class Partners:
    """What shares of the first camera's corners the others find at one instant, of those that they should.

    Attributes:
        share: as calibrated, 0 to 1.
        exchanged: with the images of the first camera and of another one exchanged; None where `share` is not small, or where
            too few corners would then be expected.
    """

    share: float
    exchanged: float | None = None


def swapped(partners: Iterable[Partners | None]) -> str | None:
    """What says that cameras are swapped: few corners are found as calibrated, and many with images exchanged; None else."""
    told = [found for found in partners if found is not None]
    exchanged = [found.exchanged for found in told if found.exchanged is not None]
    if not exchanged:
        return None
    share, other = float(np.mean([found.share for found in told])), float(np.mean(exchanged))
    if share >= LEAST_SHARE or other < _EXCHANGED:
        return None
    return f"{few_are_found(share)}; with the images of both exchanged {100 * other:.0f} % are found, as where they are swapped"


def few_are_found(share: float) -> str:
    """The sentence about a share that is too small."""
    return (
        f"{100 * share:.0f} % of the corners are found in a second camera, where it should see them: check which camera is "
        "which, and T_imu_camera"
    )
