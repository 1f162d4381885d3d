"""The course of the exposure: a controller that follows the brightness of small images taken along the motion."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from boxplus.simulation.cameras.sensor import GREY_PER_LIGHT_SECOND, Exposure

Floats = NDArray[np.float64]

STEP_S = 0.2


class ExposureCourse:
    """Time and gain of each image.

    Args:
        exposure: the controller.
        brightness: mean radiance of an image, light included, at times (N,) since the start [s].
        duration_s: length [s].
        random: of the jumps.
    """

    def __init__(
        self, exposure: Exposure, brightness: Callable[[Floats], Floats], duration_s: float, random: np.random.Generator
    ) -> None:
        self._exposure = exposure
        self._time = np.arange(int(np.ceil(duration_s / STEP_S)) + 2) * STEP_S
        self._jumps = 1.0 + exposure.jumps * random.uniform(-1.0, 1.0, int(duration_s) + 2)
        if exposure.auto:
            light = np.maximum(brightness(np.minimum(self._time, duration_s)), 1e-9)
            wanted = np.clip(exposure.target / (GREY_PER_LIGHT_SECOND * light), exposure.shortest_s, self._largest)
            self._log = _followed(np.log(wanted), STEP_S / exposure.delay_s)
        else:
            self._log = np.full(len(self._time), np.log(exposure.shortest_s * exposure.fixed))

    @property
    def _largest(self) -> float:
        return self._exposure.longest_s * self._exposure.largest_gain

    def at(self, since_s: float) -> tuple[float, float]:
        """Exposure [s] and gain `since_s` after the start."""
        product = float(np.exp(np.interp(since_s, self._time, self._log))) * float(self._jumps[int(max(since_s, 0.0))])
        product = min(max(product, self._exposure.shortest_s), self._largest)
        exposure_s = min(product, self._exposure.longest_s)
        return exposure_s, product / exposure_s


def _followed(wanted: Floats, step: float) -> Floats:
    """A first-order lag; the first value has settled."""
    share = 1.0 - np.exp(-step)
    course = np.empty_like(wanted)
    course[0] = wanted[0]
    for k in range(1, len(wanted)):
        course[k] = course[k - 1] + share * (wanted[k - 1] - course[k - 1])
    return course
