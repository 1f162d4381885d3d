"""The iterated update of the error-state Kalman filter: a prior and a measurement give a posterior.

Derivation: docs/lidar_inertial_odometry.md, section 7.
What was measured is not known here: planes of a growing map, a fixed one, features of an image. A measurement is asked for
its information at one iterate after the other, and says itself which directions of the pose it determines; in the others
the posterior keeps the prior.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.degeneracy import PoseDirections
from boxplus.filtering.errors_in_variables import without_noise
from boxplus.filtering.nav_state import TANGENT, boxminus_into, boxplus_into
from boxplus.filtering.update_step import map_step, move_covariance

_CONVERGED = 1e-3  # every component of the step, rad and m (docs/lidar_inertial_odometry.md, section 7)


@dataclass(frozen=True, slots=True)
class Information:
    """What a measurement says about the components [θ, p, θ_L, p_L] at one state.

    Attributes:
        A, b: (12, 12), (12,), Hᵀ R⁻¹ H and Hᵀ R⁻¹ z.
        pull: (12,) what noise of H alone is expected to have made of b where the correspondences were searched.
        directions: which directions of the pose it determines.
        used: how many of its parts (points, pixels) took part.
        residual_rms: root mean square of their residuals [m].
    """

    A: NDArray[np.float64]
    b: NDArray[np.float64]
    pull: NDArray[np.float64]
    directions: PoseDirections
    used: int
    residual_rms: float


class Measurement(Protocol):
    """What an update needs to know of a measurement."""

    def at(self, x: NDArray[np.float64], *, rematch: bool) -> Information:
        """The information at the packed state x (36,); with `rematch`, after searching its correspondences anew."""

    def has_moved(self, x: NDArray[np.float64]) -> bool:
        """Whether a search at x could find other correspondences than the last one; always false where there are none."""


@dataclass(frozen=True, slots=True)
class Posterior:
    """The outcome of an update.

    Attributes:
        x: (36,) packed state; cov: (24, 24) its covariance. Both are the prior's where `valid` is false.
        valid: false when fewer parts than wanted took part, or a matrix was not positive definite.
        A: (12, 12) the information that was taken in, without the share of noise.
        last: what the measurement said at the last iterate.
        steps: Gauss-Newton steps taken.
        converged: whether the last one was below 10⁻³ rad and m in every component.
    """

    x: NDArray[np.float64]
    cov: NDArray[np.float64]
    valid: bool
    A: NDArray[np.float64]
    last: Information
    steps: int
    converged: bool


def iterated_update(
    x_prior: NDArray[np.float64],
    cov_prior: NDArray[np.float64],
    measurement: Measurement,
    *,
    max_iterations: int = 4,
    min_used: int = 1,
) -> Posterior:
    """The minimum of the measurement's cost and ‖x ⊟ x_prior‖², by Gauss-Newton (Bell and Cathey, 1993).

    Correspondences are searched in the first iteration, after one that converged, and once before the last. The iteration
    ends with the second step that is small, or with the first if no search could find anything else.

    Args:
        x_prior: (36,) packed state; cov_prior: (24, 24) in the tangent space there. Neither is changed.
        measurement: what was measured.
        max_iterations: most steps after the first.
        min_used: fewest parts of the measurement that make an update.

    A scan against the map: `iterated_update(x, cov, PlaneMeasurement(points, tree, config, with_extrinsic=False))`.
    """
    x = x_prior.copy()
    delta = np.zeros(TANGENT)
    cov = np.zeros((TANGENT, TANGENT))
    since_match, x_match = np.zeros(TANGENT), x
    pose_prior = np.ascontiguousarray(cov_prior[:6, :6])
    rematch, converged_before, converged = True, False, False
    steps = 0
    while True:
        if rematch:
            x_match = x.copy()
        boxminus_into(x, x_match, since_match)
        information = measurement.at(x, rematch=rematch)
        left = without_noise(
            information.A,
            information.b - information.pull,
            information.directions,
            cov_prior=pose_prior,
            used=information.used,
            since_match=since_match[:6],
        )
        if information.used < min_used or left is None or not map_step(x, x_prior, cov_prior, *left, delta, cov):
            nothing = np.zeros_like(information.A)
            return Posterior(x_prior.copy(), cov_prior.copy(), False, nothing, information, steps, converged)
        boxplus_into(x, delta, x)
        steps += 1
        converged = bool(np.abs(delta).max() < _CONVERGED)
        settled = converged and (converged_before or not measurement.has_moved(x))
        if settled or steps > max_iterations:
            break
        rematch = converged or (steps == max_iterations and not converged_before)
        converged_before |= converged
    move_covariance(cov, delta)
    return Posterior(x, cov, True, left[0], information, steps, converged)
