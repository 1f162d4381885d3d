"""IMU samples as they arrive, without those that their neighbours deny."""

from __future__ import annotations

from collections import Counter

import numpy as np

from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.inertial.imu_values import BEFORE, EMPTY, GLITCH, empty, glitches

_CONTEXT = BEFORE + 2  # samples: the ends of the steps that tell what is usual, and the one that may wait


class GlitchFilter:
    """Takes samples in order of time, hands on all but glitches (`imu_values.glitches`) and messages that nobody filled.

    A sample that is far from the one before waits for the next one, which tells. What is handed on does not depend on how the
    samples are cut into blocks. An IMU that has only ever delivered zeros is handed on: what looks for gravity says so.

    Attributes:
        rejected: reason → samples.
    """

    def __init__(self) -> None:
        self.rejected: Counter[str] = Counter()
        self._is_alive = False
        self._before = ImuSamples.joined([])  # as they came, the newest last
        self._waits = False  # the newest one

    def take(self, samples: ImuSamples) -> ImuSamples:
        """What is known by now to be none."""
        if not samples.accel.any(axis=1).all():
            zero = empty(samples)
            dropped = zero & (self._is_alive | np.logical_or.accumulate(~zero))
            self._reject(EMPTY, int(dropped.sum()))
            samples = samples.where(~dropped)
            self._is_alive = self._is_alive or not bool(zero.all())
        elif len(samples):
            self._is_alive = True
        if not len(samples):
            return samples
        known = len(self._before) - int(self._waits)  # of them, what has been judged
        seen = ImuSamples.joined([self._before, samples])
        odd = glitches(seen)
        self._before = seen.where(slice(-_CONTEXT, None))
        if not (self._waits or odd.any()):  # as nearly always
            return seen.where(slice(known, None))  # not the caller's memory, which he may use again
        self._waits = bool(odd[-1])
        odd[-1] = False
        keep = ~odd
        keep[:known] = False
        keep[len(seen) - int(self._waits) :] = False
        self._reject(GLITCH, int(odd[known:].sum()))
        return seen.where(keep)

    def rest(self) -> ImuSamples:
        """The sample that still waits, of which no other will tell."""
        waits, self._waits = self._waits, False
        return self._before.where(slice(len(self._before) - int(waits), None))

    def _reject(self, reason: str, count: int) -> None:
        if count:
            self.rejected[reason] += count
