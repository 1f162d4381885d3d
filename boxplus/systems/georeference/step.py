"""A step in the errors of fixes, looked at from near: does it last, and is it one, or does multipath begin or end there?

Half a minute on either side the errors on the ground are a level, a slope (the map bends slowly) and noise: white, and such as
stays for τ, with the covariance

    K = σ_w² I + σ_s² exp(−|t − t'| / τ).

Generalised least squares says by how much a step there lowers the cost, and by how much a burst does, of any duration, that
begins or ends there. Either explains what the other does in part: of a datum that jumps, a burst explains little more than the
step; of multipath, a third more and beyond. A datum that jumps while multipath lasts is both: the burst explains most, and beside
it the step is still there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

Floats = NDArray[np.float64]

_REACH = 30.0  # s, on either side
_LONGEST = 25.0  # s, of a burst: of a longer one hardly anything is seen beyond it
_STAYS = 30.0  # s, of the noise that stays
_LEAST = 20.0  # by which a step lowers the cost where there is one; two numbers, looked for all over a recording
_BURST = 1.3  # times as much by a burst: then it is one


@dataclass(frozen=True, slots=True)
class Step:
    """What a step in errors is.

    Attributes:
        gain: by which it lowers the cost. burst_gain: by which the best burst does that begins or ends there. beside: by which
            the step does where that burst has been taken off.
        metres: length of the step. metres_beside: and beside that burst.
    """

    gain: float
    burst_gain: float
    beside: float
    metres: float
    metres_beside: float

    @property
    def is_burst(self) -> bool:
        """Whether it comes and goes."""
        return self.burst_gain > _BURST * self.gain and self.beside < _LEAST

    @property
    def is_beside(self) -> bool:
        """Whether it is there beside a burst, which explains most of it."""
        return self.burst_gain > _BURST * self.gain and self.beside >= _LEAST

    @property
    def is_told(self) -> bool:
        """Whether noise makes no such step, nor a burst."""
        return self.gain >= _LEAST and not self.is_burst


def step_at(seconds: Floats, errors: Floats, at: int, sigma: float) -> Step:
    """The step between fix `at` and the one before it.

    Args:
        seconds: (N,) of the fixes. errors: (N, 2) on the ground [m].
        sigma: standard deviation of a fix that is believed [m], all of which may stay.
    """
    middle = 0.5 * (seconds[at - 1] + seconds[at])
    near = np.flatnonzero(np.abs(seconds - middle) <= _REACH)
    t, e = seconds[near] - middle, errors[near]
    white = 1.4826 * float(np.median(np.abs(np.diff(errors, axis=0)))) / math.sqrt(2.0)
    K = sigma**2 * np.exp(-np.abs(t[:, None] - t) / _STAYS) + max(white, 1e-3 * sigma) ** 2 * np.eye(len(t))
    L = np.linalg.cholesky(K)

    # What the level and the slope leave of the errors and of every column: then each column alone says what it explains.
    shapes = [t > 0.0, *((t > 0.0) & (t < end) for end in t[(t > 1.0) & (t < _LONGEST)])]
    shapes += [(t < 0.0) & (t >= begin) for begin in t[(t < -1.0) & (t > -_LONGEST)]]
    whole = np.column_stack([np.ones(len(t)), t, e, *shapes]).astype(np.float64)
    whole = solve_triangular(L, whole, lower=True)
    Q = np.linalg.qr(whole[:, :2])[0]
    rest = whole[:, 2:] - Q @ (Q.T @ whole[:, 2:])
    r, columns = rest[:, :2], rest[:, 2:]
    energy = np.maximum((columns**2).sum(axis=0), 1e-12)
    length = columns.T @ r / energy[:, None]
    gain = (length**2).sum(axis=1) * energy
    if len(gain) == 1:
        metres = float(np.linalg.norm(length[0]))
        return Step(float(gain[0]), 0.0, float(gain[0]), metres, metres)
    best = 1 + int(np.argmax(gain[1:]))
    burst = columns[:, best] / math.sqrt(energy[best])
    own = columns[:, 0] - burst * (burst @ columns[:, 0])
    left = own @ r / math.sqrt(max(float(own @ own), 1e-12))
    beside = float(np.linalg.norm(left)) / math.sqrt(max(float(own @ own), 1e-12))
    return Step(float(gain[0]), float(gain[best]), float(left @ left), float(np.linalg.norm(length[0])), beside)
