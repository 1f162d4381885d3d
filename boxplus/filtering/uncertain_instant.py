"""A measurement whose time stamp is not exact.

What was measured at t + δ, but is stamped t, sees the platform δ ẋ farther on: an error of one number that all parts of the
measurement share, however many they are. With δ of variance σ² and H the measurement's Jacobian, its residuals have the
covariance R + σ² (Hẋ)(Hẋ)ᵀ, and by the Sherman-Morrison formula it says, with A = HᵀR⁻¹H, b = HᵀR⁻¹z and u = σ ẋ,

    A − A u uᵀA / (1 + uᵀA u),      b − A u (uᵀb) / (1 + uᵀA u),

which is A and b with δ eliminated. A thousand points that agree on where a car is to a millimetre do not know where it
was when the stamp says, at 10 m/s and half a millisecond, better than to five. At rest nothing changes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.iterated_update import Information, Measurement
from boxplus.filtering.nav_state import MEASURED


class UncertainInstant:
    """A measurement at an instant that is known to `sigma_s` only.

    Args:
        measurement: as if its stamp were exact.
        motion: (2, 3) turn rate of the platform about the IMU's axes [rad/s], its velocity in the world [m/s].
        sigma_s: standard deviation of the stamp [s].
    """

    def __init__(self, measurement: Measurement, motion: NDArray[np.float64], sigma_s: float) -> None:
        self._measurement = measurement
        self._u = np.zeros(len(MEASURED))
        self._u[:6] = sigma_s * motion.ravel()

    def at(self, x: NDArray[np.float64], *, rematch: bool) -> Information:
        """See `Measurement`."""
        exact, u = self._measurement.at(x, rematch=rematch), self._u
        Au = exact.A @ u
        gain = Au / (1.0 + float(u @ Au))
        b, pull = (vector - gain * float(u @ vector) for vector in (exact.b, exact.pull))
        return replace(exact, A=exact.A - np.outer(gain, Au), b=b, pull=pull)

    def has_moved(self, x: NDArray[np.float64]) -> bool:
        """See `Measurement`."""
        return self._measurement.has_moved(x)
