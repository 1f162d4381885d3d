"""What share of the corners another camera finds where the calibration puts them: next to none where cameras are swapped."""

from __future__ import annotations

import numpy as np

from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks

LEAST_SHARE = 0.15
FLAT = 5.0
"""Grey values: standard deviation of an image that shows nothing."""

_FEWEST = 15  # corners that tell a share


def share_found(tracks: Tracks) -> float | None:
    """Of the corners of the first camera; None where few are followed, a camera shows nothing, or there is one alone."""
    if tracks.pixels.shape[1] < 2 or len(tracks) < _FEWEST or not (tracks.contrast > FLAT).all():
        return None
    return float(np.isfinite(tracks.pixels[:, 1:, 0]).any(axis=1).mean())


def few_are_found(share: float) -> str:
    """The sentence about a share that is too small."""
    return (
        f"{100 * share:.0f} % of the corners are found in a second camera, where it should see them: check which camera is "
        "which, and T_imu_camera"
    )
