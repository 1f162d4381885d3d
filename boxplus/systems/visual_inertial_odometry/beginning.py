"""What a window knows of a pose and state: of the first one beforehand, and of any once it is solved."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import SingularProblemError
from boxplus.manifolds import quaternion
from boxplus.manifolds.body_pose import BodyPose
from boxplus.manifolds.euclidean import Euclidean
from boxplus.optimization.solution import Solution
from boxplus.optimization.terms.variables import VariableRows
from boxplus.residuals.marginal_prior import MarginalPrior
from boxplus.systems.visual_inertial_odometry.start.start import Start

TO_STATE_ORDER = [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 13, 14, 9, 10, 11]
"""From [θ, p, v, b_ω, b_a], as estimates have it, to [θ, p, v, b_a, b_ω], as the variables do, and back."""

_KNOWN = 1e-4  # rad, m: of the first yaw and position, which are known by definition
_UNKNOWN = np.repeat([np.pi, 1e3, 1e2, 1.0, 1.0], 3)  # rad, m, m/s, rad/s, m/s²: of a pose that nothing determines
_LEAST_VARIANCE = 1e-10  # of what a start takes for certain


def beginning(start: Start) -> MarginalPrior:
    """What is known of the first pose and state: as the start says, but position and yaw by definition."""
    to_world = np.eye(15)
    to_world[:3, :3] = quaternion.to_matrix(start.T_world_imu[0, :4])
    P = to_world @ start.covariance @ to_world.T
    defined = [2, 3, 4, 5]
    P[defined], P[:, defined] = 0.0, 0.0
    P[range(15), range(15)] += _LEAST_VARIANCE
    P[defined, defined] = _KNOWN**2
    P = (to_world.T @ P @ to_world)[np.ix_(TO_STATE_ORDER, TO_STATE_ORDER)]
    J = np.linalg.inv(np.linalg.cholesky(P))
    state = np.concatenate([start.velocity_world[0], start.accel_bias, start.gyro_bias])
    manifolds, x0 = (BodyPose, Euclidean(9)), (start.T_world_imu[0], state)
    off = np.zeros(15)  # of x0 from the middle of what was known
    off[9:] = state[3:] - np.concatenate([start.bias_before[3:], start.bias_before[:3]])
    # First estimates are kept from the first marginalisation on; a start may be far from where the window finds it.
    return MarginalPrior(
        manifolds, x0, J, J @ off, roles=("first pose", "first state"), fixes_gauge=True, keeps_first_estimates=False
    )


def covariance_of(solution: Solution, body: VariableRows, state: VariableRows) -> NDArray[np.float64]:
    """(15, 15) of a pose and state at a solution, in the order of `VioEstimate`; very large where nothing determines them."""
    try:
        P = solution.joint_covariance(body, state, is_determined=True)
    except SingularProblemError:  # little seen after a silent IMU: what is known spans more than numbers hold
        return np.diag(_UNKNOWN**2)
    return P[np.ix_(TO_STATE_ORDER, TO_STATE_ORDER)]
