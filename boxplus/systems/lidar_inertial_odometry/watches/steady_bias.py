"""Whether the gyroscope's bias stays where it was known to be.

What a filter knows of a constant shrinks: of the difference between two of its estimates b₀ and b₁ the covariance is P₀ − P₁, and
what the constant walks in between. A bias that moves by many times as much was never known so well. So it is where a start took
turns for a bias that the LiDAR alone did not see rightly, among trunks with few rings, say: the map of the first seconds is
tilted then, and later scans only fit what lies there, surer of themselves from scan to scan.

P is with the mounting known. Where it is not, the bias moves with what the mounting is taken for, and how it does changes with
the motion: by no more than what both estimates owe to the mounting, and that shrinks with nothing the filter learns of the bias.

A gyroscope whose scale or axes are off by a share shows that share of every turn beside its bias, and the estimate follows. No
filter here knows of it: what it comes to at the present rate is allowed for.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel

_APART_S = 0.5  # between estimates that are kept, at first
_MOST = 64  # of them; then every other one goes
_SIGMAS = 5.0  # 2.5 at most in 25 sound runs, simulated and real; 8 in one from rest, of 0.006 rad/s
_LEAST = 0.009  # rad/s: within a second it tilts the map by half a degree
_SCALE = 0.003  # of a turn that no bias explains: a factory leaves a few thousandths, and what is not calibrated a hundredth
_MEMORY_S = 1.0  # of the rate
_ROUGHLY = 0.1  # of a standard deviation, by which it is itself not known


class SteadyBias:
    """Follows the bias of one run.

    Args:
        walk: of the bias [rad/s²/√Hz].
    """

    def __init__(self, walk: float) -> None:
        self._walk, self._apart_s = walk, _APART_S
        self._time_s, self._kept = np.zeros(0), np.zeros((0, 3, 3))
        self._rate, self._rate_s = 0.0, -np.inf

    def update(
        self,
        time_ns: int,
        bias: NDArray[np.float64],
        variance: NDArray[np.float64],
        by_mounting: NDArray[np.float64],
        rate: float = 0.0,
    ) -> str | None:
        """Take the estimate after a scan in; a sentence where it has left an earlier one.

        Args:
            bias: (3,) [rad/s]; variance: (3,) of it with the mounting known; by_mounting: (3,) what an unknown one adds to it.
            rate: at which the platform turned within the scan [rad/s].
        """
        now = time_ns * 1e-9
        faded = math.exp(-max(now - self._rate_s, 0.0) / _MEMORY_S)
        self._rate, self._rate_s = faded * self._rate + (1.0 - faded) * rate, now
        by_mounting = by_mounting + (_SCALE * self._rate) ** 2
        row, axis, moved, sigmas = _moved_most(self._time_s, self._kept, now, bias, variance, by_mounting, self._walk)
        since = now - self._time_s[row] if len(self._time_s) else 0.0
        if not len(self._time_s) or now - self._time_s[-1] >= self._apart_s:
            self._keep(now, np.stack([bias, variance, by_mounting]))
        if sigmas < _SIGMAS:
            return None
        return (
            f"the gyroscope's bias about {'xyz'[axis]} has moved by {np.degrees(moved):.2f} deg/s within "
            f"{since:.1f} s, by {sigmas:.0f} standard deviations of what was known of it: the estimate was surer "
            "than right, at its start above all; poses may be off, and the map tilted, by far more than their covariance says"
        )

    def _keep(self, now: float, estimate: NDArray[np.float64]) -> None:
        if len(self._time_s) == _MOST:
            self._time_s, self._kept = self._time_s[::2], self._kept[::2]
            self._apart_s *= 2.0
        self._time_s, self._kept = np.append(self._time_s, now), np.concatenate([self._kept, estimate[None]])


@kernel
def _moved_most(
    time_s: NDArray[np.float64],
    kept: NDArray[np.float64],
    now: float,
    bias: NDArray[np.float64],
    variance: NDArray[np.float64],
    by_mounting: NDArray[np.float64],
    walk: float,
) -> tuple[int, int, float, float]:
    """Which of the estimates kept (n, 3, 3) the bias has left farthest, about which axis, by how much, and in deviations."""
    row, about, by, largest = 0, 0, 0.0, 0.0
    for k in range(len(time_s)):
        for axis in range(3):
            moved = abs(bias[axis] - kept[k, 0, axis])
            if moved <= _LEAST:
                continue
            learnt = max(kept[k, 1, axis] * (1.0 + _ROUGHLY**2) - variance[axis], 0.0)
            allowed = math.sqrt(learnt + walk**2 * (now - time_s[k]) + kept[k, 2, axis] + by_mounting[axis])
            sigmas = moved / max(allowed, 1e-12)
            if sigmas > largest:
                row, about, by, largest = k, axis, moved, sigmas
    return row, about, by, largest
