"""IMU samples as they arrive, without those that their neighbours deny."""

from __future__ import annotations

from boxplus.sensors.imu import ImuSamples
from boxplus.sensors.imu_values import calm, glitches

_CONTEXT = 20  # samples before one tell what they usually differ by


class GlitchFilter:
    """Takes samples in order of time, hands on all but glitches (`imu_values.glitches`).

    A sample that is far from the one before waits for the next one, which tells. What is handed on does not depend on how the
    samples are cut into blocks.

    Attributes:
        found: how many were left out.
    """

    def __init__(self) -> None:
        self.found = 0
        self._before = ImuSamples.joined([])
        self._doubted = ImuSamples.joined([])

    def take(self, samples: ImuSamples) -> ImuSamples:
        """What is known by now to be none."""
        if not len(self._doubted) and calm(ImuSamples.joined([self._before.where(slice(-1, None)), samples])):
            return self._known(samples)
        return ImuSamples.joined([self._one(samples.where(slice(k, k + 1))) for k in range(len(samples))])

    def rest(self) -> ImuSamples:
        """The sample that still waits, of which no other will tell."""
        doubted, self._doubted = self._doubted, ImuSamples.joined([])
        return self._known(doubted)

    def _one(self, sample: ImuSamples) -> ImuSamples:
        taken = ImuSamples.joined([])
        if len(self._doubted):
            if glitches(ImuSamples.joined([self._before, self._doubted, sample]))[-2]:
                self.found += 1
                self._doubted = taken
            taken = self.rest()
        if glitches(ImuSamples.joined([self._before, sample]))[-1]:
            self._doubted = sample
            return taken
        return ImuSamples.joined([taken, self._known(sample)])

    def _known(self, samples: ImuSamples) -> ImuSamples:
        self._before = ImuSamples.joined([self._before, samples]).where(slice(-_CONTEXT, None))
        return samples
