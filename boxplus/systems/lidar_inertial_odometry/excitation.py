"""Whether the motion makes the extrinsic observable."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.propagation import N_TIME, N_W


class RotationExcitation:
    """Decides from the recent turn rates whether the extrinsic can be estimated.

    The rotation between IMU and LiDAR shows only when the platform turns, and all of it only when it turns about two
    axes. The second largest singular value of the turn rates of the last seconds is the rate about the second axis.

    Args:
        min_rate: root mean square rate needed about the second axis [rad/s].
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
        """Whether two axes are turned about fast enough."""
        return bool(np.linalg.eigvalsh(self._moment)[1] > self._min_rate**2)
