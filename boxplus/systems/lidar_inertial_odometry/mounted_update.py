"""The update by one scan where the mounting is known, where the scan is asked about it, and where it is held."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.iterated_update import Measurement, Posterior, iterated_update
from boxplus.filtering.nav_state import RL
from boxplus.filtering.pose_covariance.correction import Correction
from boxplus.filtering.pose_covariance.map_datum import SHARED_ERRORS
from boxplus.filtering.uncertain_instant import UncertainInstant
from boxplus.maps.first_arrivals import FirstArrivals
from boxplus.maps.plane_measurement import PlaneMeasurement
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.mounting.unknown_mounting import (
    MOUNTING,
    HeldMounting,
    mounting_known,
    moved_sensitivity,
    with_mounting,
)
from boxplus.systems.lidar_inertial_odometry.unshown_motion import UnshownMotion

_KNOWN = np.zeros((18, 6))


@dataclass(frozen=True, slots=True)
class MountedUpdate:
    """What a scan has made of the state.

    Attributes:
        posterior: state and covariance, that of the mounting included.
        cov_prior, cov: (24, 24) before and after the scan, with the mounting known.
        B_prior, B: (18, 6) how the rest of the state moves with the mounting, before and after; zero where it is taken for exact.
    """

    posterior: Posterior
    cov_prior: NDArray[np.float64]
    cov: NDArray[np.float64]
    B_prior: NDArray[np.float64]
    B: NDArray[np.float64]

    def correction(
        self, measurement: PlaneMeasurement, stamped: UncertainInstant, arrivals: FirstArrivals, share: float
    ) -> Correction:
        """What the scan has done to the pose, its points as far off as their residuals bear out, its stamp as far as is set.

        Args:
            measurement, stamped: the scan against the map.
            arrivals: of the map; share: of it, what the last scan has brought.
        """
        posterior, x = self.posterior, self.posterior.x
        facing, scatter = x[RL : RL + 9].reshape(3, 3) @ measurement.facing, measurement.scatter(x)
        return Correction.of(
            self.cov, posterior.A, posterior.last.directions, facing, scatter=scatter, shared_shift=stamped.shift,
            deskewed=np.sqrt(measurement.weight), renewed=measurement.renewal(x, arrivals, share),
        )  # fmt: skip


def mounted_update(
    x: NDArray[np.float64],
    cov: NDArray[np.float64],
    measurement: Measurement,
    config: LioConfig,
    unshown: UnshownMotion,
    *,
    turns: bool,
) -> MountedUpdate:
    """Update a prediction by a scan.

    Args:
        x, cov: (36,) and (24, 24), predicted.
        measurement: the scan against the map.
        config: of the odometry.
        unshown: marks directions that nothing has shown.
        turns: whether the platform turns so that a scan says something of the mounting.
    """
    limits = {"max_iterations": config.max_iterations, "min_used": config.min_points}
    if config.extrinsic_estimation == "off":
        posterior = unshown.mark(iterated_update(x, cov, measurement, **limits))
        return MountedUpdate(posterior, cov.copy(), posterior.cov, _KNOWN, _KNOWN)
    known, B = mounting_known(cov)
    if config.extrinsic_estimation == "on" or turns:
        posterior = unshown.mark(iterated_update(x, cov, measurement, **limits))
        after, moved = mounting_known(posterior.cov)
        if posterior.valid:
            after[MOUNTING, MOUNTING] = less_sure(cov[MOUNTING, MOUNTING], after[MOUNTING, MOUNTING])
            posterior = replace(posterior, cov=with_mounting(after, moved))
        return MountedUpdate(posterior, known, after, B, moved)
    held = HeldMounting(measurement)
    posterior = unshown.mark(iterated_update(x, known, held, **limits))
    after, moved = posterior.cov, B
    if posterior.valid:
        moved = moved_sensitivity(B, known, after, replace(held.last, directions=posterior.last.directions))
    return MountedUpdate(replace(posterior, cov=with_mounting(after, moved)), known, after, B, moved)


def less_sure(before: NDArray[np.float64], after: NDArray[np.float64]) -> NDArray[np.float64]:
    """(6, 6) covariance of the mounting where what a scan has said of it counts less, for its points are not independent.

    Of the information that was gained, 1 / `SHARED_ERRORS`: a mean of both informations, so that it stays positive definite.
    """
    gained = 1.0 / SHARED_ERRORS
    covariance: NDArray[np.float64] = np.linalg.inv((1.0 - gained) * np.linalg.inv(before) + gained * np.linalg.inv(after))
    return 0.5 * (covariance + covariance.T)
