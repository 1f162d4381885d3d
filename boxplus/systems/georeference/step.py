"""A step in the errors of fixes, looked at from near: does it last, and is it one, or does multipath begin or end there?

Half a minute on either side the errors on the ground are a level, a slope (the map bends slowly) and noise: white, such as stays
for τ, and what the odometry drifts at random, of variance w since the first of these fixes, with the covariance

    K = diag σ_w² + min(σ_i² … σ_j²) exp(−|t_i − t_j| / τ) + min(w_i, w_j).

As few fixes count beside those near to them in time, the map does not bend after every one: without the last, fixes known to
centimetres step wherever the odometry drifts by more than that.

Two fixes share what the best of them and of all between them states. A receiver that loses its fixed solution states half a metre
in place of centimetres, and stays off by that for as long: all of these fixes are one measurement, and where they begin and end a
step is held against what they state. What is off before and after them is known to centimetres all the same, and a second such
stretch is off by something else. White noise is that of the successive fixes that state as much.

Generalised least squares says by how much a step there lowers the cost, and by how much a burst does, of any duration, that
begins or ends there. Either explains what the other does in part: of a datum that jumps, a burst explains little more than the
step; of multipath, a third more and beyond. A datum that jumps while multipath lasts is both: the burst explains most, and beside
it the step is still there. So it is beside the first of two bursts in a row; but there another burst explains what is left by a
third better than the step does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular

Floats = NDArray[np.float64]

_REACH = 30.0  # s, on either side
_LONGEST = 25.0  # s, from the first to the last fix of a burst: of a longer one hardly anything is seen beyond it
_SHORTEST = 1.0  # s
_DISTINCT = 1e-3  # of a column, what the first burst has to leave of it
_STAYS = 30.0  # s, of the noise that stays
_PAIRS = 5  # of fixes in a row: fewer do not tell their noise, which may be all that they state
_SEEN = 12.0  # by which a step or burst lowers the cost at least: less is made by noise and by what the odometry drifts
_BLOCK = 5.0  # s
LEAST = 20.0  # by which a step lowers the cost where there is one; two numbers, looked for all over a recording
_SURE = 40.0  # where nothing else has to be asked: RTK that jumps by 0.35 m comes to 38 to 86, by 0.5 m to 70 to 165
_BURST = 1.3  # times as much by a burst: then it is one


@dataclass(frozen=True, slots=True)
class Step:
    """What a step in errors is.

    Attributes:
        gain: by which it lowers the cost. burst_gain: by which the best burst does that begins or ends there. beside: by which
            the step does where that burst has been taken off. other: by which the best of all bursts does there; 0 where the
            step is none beside the first.
        metres: length of the step. metres_beside: and beside that burst.
    """

    gain: float
    burst_gain: float
    beside: float
    other: float
    metres: float
    metres_beside: float

    @property
    def is_seen(self) -> bool:
        """Whether there is more than noise, be it a step or a burst."""
        return max(self.gain, self.burst_gain, self.beside) >= _SEEN

    @property
    def is_burst(self) -> bool:
        """Whether it comes and goes, or another burst follows one that does."""
        return self._comes_and_goes and not self.is_beside

    @property
    def is_beside(self) -> bool:
        """Whether it is there beside a burst, which explains most of it."""
        return self._comes_and_goes and self.beside >= LEAST and self.other <= _BURST * self.beside

    @property
    def _comes_and_goes(self) -> bool:
        return self.burst_gain > _BURST * self.gain

    @property
    def alone(self) -> float:
        """Its length without the burst that it is beside, if it is beside one [m]."""
        return self.metres_beside if self.is_beside else self.metres

    @property
    def is_told(self) -> bool:
        """Whether noise makes no such step, nor a burst."""
        return self.gain >= LEAST and not self.is_burst

    @property
    def is_sure(self) -> bool:
        """Whether it is far beyond what noise makes, and no burst explains as much: for half a minute nothing comes back."""
        return self.gain >= _SURE and self.burst_gain <= self.gain


def step_at(seconds: Floats, errors: Floats, at: int, sigma: ArrayLike, walked: Floats | None = None) -> Step:
    """The step between fix `at` and the one before it; none where it lies in a gap of a minute.

    Args:
        seconds: (N,) of the fixes. errors: (N, 2) on the ground [m].
        sigma: (N,) standard deviation that each of them is believed to have [m], or the same of all; all of it may stay.
        walked: (N,) variance that the odometry gained by drifting at random, from anywhere on [m²]; none if left out.
    """
    middle = 0.5 * (seconds[at - 1] + seconds[at])
    near = np.flatnonzero(np.abs(seconds - middle) <= _REACH)
    t, e = seconds[near] - middle, errors[near]
    if not (t < 0.0).any() or not (t > 0.0).any():  # a gap in which nothing shows whether it lasts
        return Step(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    L = _root(t, errors, np.broadcast_to(np.asarray(sigma, dtype=np.float64), seconds.shape), walked, near)

    after, before = t[t > 0.0], t[t < 0.0]
    ends = after[1:][(after[1:] > _SHORTEST) & (after[:-1] - after[0] <= _LONGEST)]
    begins = before[(before < -_SHORTEST) & (before[-1] - before <= _LONGEST)]
    shapes = [t > 0.0, *((t > 0.0) & (t < end) for end in ends), *((t < 0.0) & (t >= begin) for begin in begins)]
    Q = _base(L, t)
    r, columns = (_without(Q, solve_triangular(L, own, lower=True)) for own in (e, np.column_stack(shapes).astype(np.float64)))
    gain, metres = _explained(columns, r)
    if len(gain) == 1:
        return Step(float(gain[0]), 0.0, float(gain[0]), 0.0, float(metres[0]), float(metres[0]))
    best = 1 + int(np.argmax(gain[1:]))
    burst = columns[:, [best]] / np.linalg.norm(columns[:, best])
    left = _without(burst, r)
    beside, metres_beside = _explained(_without(burst, columns[:, :1]), left)
    step = Step(float(gain[0]), float(gain[best]), float(beside[0]), 0.0, float(metres[0]), float(metres_beside[0]))
    if not step.is_beside:
        return step
    whitened = solve_triangular(L, (t[:, None] >= t[1:]).astype(np.float64), lower=True)
    return replace(step, other=_best_of_all(t[1:], _without(Q, whitened), burst, left))


def step_gains(seconds: Floats, errors: Floats, sigma: Floats, walked: Floats) -> Floats:
    """(N,) by how much a step between each fix and the one before it lowers the cost; 0 of the first, and in a gap of a minute.

    Those of five seconds are asked of what lies about their middle.

    Args:
        As `step_at`.
    """
    gains, block = np.zeros(len(seconds)), np.floor((seconds - seconds[0]) / _BLOCK)
    for one in np.unique(block[1:]):
        at = 1 + np.flatnonzero(block[1:] == one)
        middle = 0.5 * (seconds[at[0] - 1] + seconds[at[-1]])
        near = np.flatnonzero(np.abs(seconds - middle) <= _REACH)
        at = at[(at > near[0]) & (at <= near[-1])] if len(near) else at[:0]
        if not len(at):
            continue
        t = seconds[near] - middle
        L = _root(t, errors, sigma, walked, near)
        Q = _base(L, t)
        r, columns = (_without(Q, solve_triangular(L, own, lower=True)) for own in (errors[near], 1.0 * (near[:, None] >= at)))
        gains[at] = _explained(columns, r)[0]
    return gains


def _root(t: Floats, errors: Floats, sigma: Floats, walked: Floats | None, near: NDArray[np.intp]) -> Floats:
    """(n, n) lower root of K at times t (n,), of fixes `near` (n,) of all (N,)."""
    stated = sigma[near]
    K = _shared(stated) * np.exp(-np.abs(t[:, None] - t) / _STAYS)
    K += np.diag(np.maximum(_white(errors, sigma, stated), 1e-3 * stated) ** 2)
    if walked is not None:
        w = np.maximum.accumulate(walked[near] - walked[near[0]])
        K += np.minimum(w[:, None], w)
    return np.asarray(np.linalg.cholesky(K))


def _base(L: Floats, t: Floats) -> Floats:
    """(n, 2) orthonormal columns that a level and a slope span."""
    return np.asarray(np.linalg.qr(solve_triangular(L, np.column_stack([np.ones(len(t)), t]), lower=True))[0])


def _shared(sigma: Floats) -> Floats:
    """(n, n) variance that each two of successive fixes may share [m²]: the least that any from the one to the other states."""
    least = np.minimum.accumulate(np.where(np.tri(len(sigma), k=-1), np.inf, sigma**2), axis=1)
    return np.minimum(least, least.T)


def _white(errors: Floats, sigma: Floats, stated: Floats) -> Floats:
    """(n,) standard deviations [m] of what does not stay, of fixes that state so much: from how others that do differ in a row.

    Args:
        errors: (N, 2) of all fixes, sigma: (N,) what they state. stated: (n,).
    """
    level, wanted = (np.round(2.0 * np.log2(own)) for own in (sigma, stated))  # in steps of √2
    least, most = np.minimum(level[1:], level[:-1]), np.maximum(level[1:], level[:-1])
    differences, white = np.abs(np.diff(errors, axis=0)), stated.copy()
    for own in np.unique(wanted):
        alike = (least >= own - 1.0) & (most <= own + 1.0)
        if np.count_nonzero(alike) >= _PAIRS:
            white[wanted == own] = 1.4826 * float(np.median(differences[alike])) / math.sqrt(2.0)
    return white


def _best_of_all(edges: Floats, steps: Floats, burst: Floats, left: Floats) -> float:
    """By how much the best burst of any begin and end lowers the cost of `left` (N, 2), where `burst` (N, 1) is off.

    A burst is the difference of two of the steps (N, M), that at its begin and that at its end.
    """
    own = _without(burst, steps)
    length = edges - edges[:, None]
    energy, whole = _of_differences(own), _of_differences(steps)
    is_one = (length > _SHORTEST) & (length <= _LONGEST) & (energy > _DISTINCT * whole)
    along = own.T @ left
    gain = ((along[:, None] - along) ** 2).sum(axis=-1)[is_one] / energy[is_one]
    return float(gain.max(initial=0.0))


def _of_differences(columns: Floats) -> Floats:
    """(M, M) squared norms of the differences of columns (N, M)."""
    G = columns.T @ columns
    return np.diag(G)[:, None] + np.diag(G) - 2.0 * G


def _without(Q: Floats, columns: Floats) -> Floats:
    """What orthonormal columns leave of others: then each of these alone says what it explains."""
    return columns - Q @ (Q.T @ columns)


def _explained(columns: Floats, r: Floats) -> tuple[Floats, Floats]:
    """By how much each of (N, M) lowers the cost of (N, 2), and the length of the step that it then is [m]."""
    energy = np.maximum((columns**2).sum(axis=0), 1e-12)
    length = np.linalg.norm(columns.T @ r, axis=1) / energy
    return length**2 * energy, length
