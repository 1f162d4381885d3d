"""A measurement whose time stamp is not exact.

What was measured at t + δ, but is stamped t, sees the platform δ ẋ farther on: an error of one number that all parts of the
measurement share, however many they are. With δ of variance σ² and H the measurement's Jacobian, its residuals have the
covariance R + σ² (Hẋ)(Hẋ)ᵀ, and by the Sherman-Morrison formula it says, with A = HᵀR⁻¹H, b = HᵀR⁻¹z and u = σ ẋ,

    A − A u uᵀA / (1 + uᵀA u),      b − A u (uᵀb) / (1 + uᵀA u),

which is A and b with δ eliminated. A thousand points that agree on where a car is to a millimetre do not know where it
was when the stamp says, at 10 m/s and half a millisecond, better than to five. At rest nothing changes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
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

    @property
    def shift(self) -> NDArray[np.float64]:
        """(6,) how far one standard deviation of the stamp moves the pose: [θ about the IMU's axes, p along the world's]."""
        return self._u[:6]

    def at(self, x: NDArray[np.float64], *, rematch: bool) -> Information:
        """See `Measurement`."""
        exact = self._measurement.at(x, rematch=rematch)
        A, b, pull = exact.A.copy(), exact.b.copy(), exact.pull.copy()
        _eliminate(self._u, A, b, pull)
        return Information(A, b, pull, exact.directions, exact.used, exact.residual_rms)

    def has_moved(self, x: NDArray[np.float64]) -> bool:
        """See `Measurement`."""
        return self._measurement.has_moved(x)


@kernel
def _eliminate(u: NDArray[np.float64], A: NDArray[np.float64], b: NDArray[np.float64], pull: NDArray[np.float64]) -> None:
    """A (n, n), b and `pull` (n,), without what an error along u (n,) of unit variance leaves open, in place."""
    n = len(u)
    Au, known, shift, shift_of_pull = np.zeros(n), 1.0, 0.0, 0.0
    for i in range(n):
        for j in range(n):
            Au[i] += A[i, j] * u[j]
        known += u[i] * Au[i]
        shift += u[i] * b[i]
        shift_of_pull += u[i] * pull[i]
    for i in range(n):
        gain = Au[i] / known
        b[i] -= gain * shift
        pull[i] -= gain * shift_of_pull
        for j in range(n):
            A[i, j] -= gain * Au[j]
