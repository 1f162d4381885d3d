"""Two clocks that do not run at the same rate: offset and rate, found together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_SURE = 6.0  # standard deviations; drift that looks like a rate comes to four


@dataclass(frozen=True, slots=True)
class ClockRate:
    """Offset and rate that fit together, as one signal tells them.

    Attributes:
        rate: seconds that the estimate's stamps lack more for every second of them.
        deviation: its standard deviation, by the jackknife over stretches.
        offset_s: to be added to the estimate's stamps at `middle_ns` [s].
        offset_deviation_s: its standard deviation [s].
        middle_ns: middle of the time that both cover, on the clock of the estimate [ns].
        half_s: half of that time [s].
    """

    rate: float
    deviation: float
    offset_s: float
    offset_deviation_s: float
    middle_ns: int
    half_s: float

    @property
    def shows(self) -> bool:
        """Whether the rate is known well enough not to have come about by noise or drift."""
        return abs(self.rate) > _SURE * self.deviation

    @property
    def ends_s(self) -> tuple[float, float]:
        """What the stamps lack at the beginning and at the end [s]."""
        return self.offset_s - self.rate * self.half_s, self.offset_s + self.rate * self.half_s

    def __str__(self) -> str:
        loses = "loses" if self.rate > 0.0 else "gains"
        first, last = (round(end, 3) + 0.0 for end in self.ends_s)  # no minus before a zero
        return (
            f"the estimate's clock {loses} {1e3 * abs(self.rate):.3g} ± {1e3 * self.deviation:.2g} ms every second: its stamps "
            f"lack {first:+.3f} s at the beginning and {last:+.3f} s at the end"
        )

    def corrected(self, time_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Stamps of the estimate [ns] on the clock of the ground truth."""
        since = time_ns - self.middle_ns
        return np.asarray(time_ns + round(self.offset_s * 1e9) + np.round(self.rate * since).astype(np.int64))
