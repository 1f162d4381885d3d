"""Whether the motion shows something of the extrinsic."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.propagation import N_TIME, N_W


class RotationExcitation:
    """Decides from the recent turn rates whether a scan is asked about the extrinsic.

    Rotation and lever arm show only when the platform turns. How much of them shows, about one axis or two, the covariance of the
    state says (`unknown_mounting`); held while it turns, a wrong one would be taken for biases and motion.

    Args:
        min_rate: root mean square rate needed about some axis [rad/s].
        memory_s: time over which older rates fade to 1/e [s].
    """

    def __init__(self, min_rate: float = 0.15, memory_s: float = 3.0) -> None:
        self._min_rate = min_rate
        self._memory_s = memory_s
        self._moment = np.zeros((3, 3))

    def add(self, nodes: NDArray[np.float64]) -> None:
        """Take the nodes (n, 22) of one scan in (see `filtering.propagation`)."""
        w = nodes[:, N_W : N_W + 3]
        duration = max(float(nodes[-1, N_TIME]), 1e-3)
        keep = float(np.exp(-duration / self._memory_s))
        self._moment = keep * self._moment + (1.0 - keep) * (w.T @ w) / len(w)

    @property
    def sufficient(self) -> bool:
        """Whether the platform turns fast enough."""
        return bool(np.linalg.eigvalsh(self._moment)[2] > self._min_rate**2)
