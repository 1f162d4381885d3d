"""When a run knows too little of a pose, by its own covariance, for the pose to be of use."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_PARTS = slice(0, 3), slice(3, 6)  # of the covariance of a pose: rotation, position
_VAGUE_M, _VAGUE_SHARE = 0.05, 0.02  # of the way: a position less certain than both is of little use
_UNKNOWN_M, _UNKNOWN_SHARE = 1.0, 0.2  # of no use


def largest_sigmas(P: NDArray[np.float64]) -> tuple[float, float]:
    """Standard deviations along the axes that a pose's covariance (6, 6) knows least: rotation [rad], position [m]."""
    turn, shift = (float(np.sqrt(max(np.linalg.eigvalsh(P[part, part])[-1], 0.0))) for part in _PARTS)
    return turn, shift


def is_vague(sigma_m: float, way_m: float) -> bool:
    """Whether a position of that standard deviation is of little use, after a way of that length."""
    return sigma_m > max(_VAGUE_M, _VAGUE_SHARE * way_m)


def is_unknown(sigma_m: float, way_m: float) -> bool:
    """Whether a position of that standard deviation is of no use, and with it the run."""
    return sigma_m > max(_UNKNOWN_M, _UNKNOWN_SHARE * way_m)


def length_text(metres: float) -> str:
    """In cm below a metre."""
    return f"{metres * 100:.0f} cm" if metres < 1.0 else f"{metres:.1f} m"
