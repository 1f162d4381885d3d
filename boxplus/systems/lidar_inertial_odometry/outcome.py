"""What became of one scan, and what an estimate says of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.iterated_update import Posterior
from boxplus.maps.plane_measurement import PlaneMeasurement
from boxplus.systems.lidar_inertial_odometry.estimate import Status, WeakDirection


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one scan.

    Attributes:
        measurement, posterior: the scan against the map, and the update.
        taken: whether the posterior became the state.
        cov_prior, cov: (24, 24) of the prediction and after the update, with the mounting known.
        status: of the estimate.
    """

    measurement: PlaneMeasurement
    posterior: Posterior
    taken: bool
    cov_prior: NDArray[np.float64]
    cov: NDArray[np.float64]
    status: Status

    @property
    def weak_directions(self) -> tuple[WeakDirection, ...]:
        """Of the pose that the scan did not determine; none where it was not taken."""
        return WeakDirection.all_of(self.posterior.last.directions) if self.taken else ()

    @property
    def points_used(self) -> int:
        """In the last iteration."""
        return self.posterior.last.used if self.taken else 0

    @property
    def rejected(self) -> dict[str, int]:
        """Points that were not used, by reason."""
        unused = {} if self.taken else {"scan without an update": self.posterior.last.used}
        return {**self.measurement.rejected(), **unused}

    @property
    def lidar_share(self) -> NDArray[np.float64]:
        """(6,) 1 − posterior / prior variance of the pose."""
        if not self.taken:
            return np.zeros(6)
        share: NDArray[np.float64] = np.clip(1.0 - self.cov.diagonal()[:6] / self.cov_prior.diagonal()[:6], 0.0, 1.0)
        return share
