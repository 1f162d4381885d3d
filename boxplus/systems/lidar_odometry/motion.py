"""A motion that is continuous in time: poses and velocities at the ends of scans, and what lies between them.

The acceleration is white noise, that of the turning and that of the position (Barfoot, Tong, Särkkä, RSS 2014; Anderson and
Barfoot, IROS 2015): between two states the most likely motion is then a cubic that meets both with their velocities, and the
expected change of a velocity grows with the square root of the time. See docs/lidar_odometry.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import NavState
from boxplus.filtering.propagation import NODE
from boxplus.manifolds import so3
from boxplus.systems.lidar_odometry.between import jacobians_into, nodes_into, poses_into

DOF = 12
THETA, POSITION, RATE, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)


@dataclass(frozen=True, slots=True)
class MotionState:
    """Where a LiDAR is and how it moves; its error is `[θ, p, ω, v]`, with θ on the right of the attitude.

    Attributes:
        time_ns: the instant, absolute [ns].
        R_world_lidar: (3, 3); p_world_lidar: (3,) [m].
        rate: (3,) turn rate, LiDAR frame [rad/s]; velocity: (3,) along the world's axes [m/s].
    """

    time_ns: int
    R_world_lidar: NDArray[np.float64]
    p_world_lidar: NDArray[np.float64]
    rate: NDArray[np.float64]
    velocity: NDArray[np.float64]

    def plus(self, delta: NDArray[np.float64]) -> MotionState:
        """The state moved by an error (12,)."""
        return MotionState(
            self.time_ns,
            self.R_world_lidar @ so3.exp(delta[THETA]),
            self.p_world_lidar + delta[POSITION],
            self.rate + delta[RATE],
            self.velocity + delta[VELOCITY],
        )

    def minus(self, base: MotionState) -> NDArray[np.float64]:
        """The error (12,) that moves `base` here."""
        return np.concatenate(
            [
                so3.log(base.R_world_lidar.T @ self.R_world_lidar),
                self.p_world_lidar - base.p_world_lidar,
                self.rate - base.rate,
                self.velocity - base.velocity,
            ]
        )

    def predicted(self, time_ns: int) -> MotionState:
        """The state at a later time, without an acceleration."""
        seconds = (time_ns - self.time_ns) * 1e-9
        return MotionState(
            time_ns,
            self.R_world_lidar @ so3.exp(self.rate * seconds),
            self.p_world_lidar + self.velocity * seconds,
            self.rate,
            self.velocity,
        )


def nav_state(state: MotionState) -> NavState:
    """As the parts of the filter take it: the LiDAR is the body; of gravity and biases nothing is known."""
    zero = np.zeros(3)
    return NavState(state.R_world_lidar, state.p_world_lidar, state.velocity, zero, zero, zero, np.eye(3), zero)


def joint_prior(
    state: MotionState, cov: NDArray[np.float64], seconds: float, density: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(24, 24) covariance of a state and the one predicted from it.

    Args:
        state, cov: the earlier one with its covariance (12, 12).
        seconds: to the later one.
        density: (2,) power spectral densities of the accelerations, of the turning [rad²/s³] and of the position [m²/s³].
    """
    F = np.eye(DOF)
    F[THETA, THETA] = so3.exp(-state.rate * seconds)
    F[THETA, RATE] = seconds * so3.right_jacobian(state.rate * seconds)
    F[POSITION, VELOCITY] = seconds * np.eye(3)
    Q = np.zeros((DOF, DOF))
    for pose, speed, q in ((THETA, RATE, density[0]), (POSITION, VELOCITY, density[1])):
        Q[pose, pose] = q * seconds**3 / 3.0 * np.eye(3)
        Q[pose, speed] = Q[speed, pose] = q * seconds**2 / 2.0 * np.eye(3)
        Q[speed, speed] = q * seconds * np.eye(3)
    joint = np.empty((2 * DOF, 2 * DOF))
    joint[:DOF, :DOF] = cov
    joint[DOF:, :DOF] = F @ cov
    joint[:DOF, DOF:] = joint[DOF:, :DOF].T
    joint[DOF:, DOF:] = F @ cov @ F.T + Q
    return joint


class MotionBetween:
    """The motion from one state to the next: a cubic of the position, and one of the turning since the first.

    Args:
        first, last: the states.
    """

    def __init__(self, first: MotionState, last: MotionState) -> None:
        self.first, self.last = first, last
        self.seconds = (last.time_ns - first.time_ns) * 1e-9
        turn = so3.log(first.R_world_lidar.T @ last.R_world_lidar)
        rates = first.rate, turn, so3.right_jacobian_inverse(turn) @ last.rate
        self._ends = np.array([*rates, first.p_world_lidar, first.velocity, last.p_world_lidar, last.velocity])

    def poses(self, seconds: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Turning since the first state (n, 3), position (n, 3) and velocity (n, 3) so long after it [s]."""
        turn, p, v = np.empty((3, len(seconds), 3))
        poses_into(self._ends, self.seconds, seconds, turn, p, v)
        return turn, p, v

    def nodes(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Nodes (n − 1, 22) at so many seconds (n,) after the first state, as the deskewing of points takes them."""
        nodes = np.zeros((len(seconds) - 1, NODE))
        nodes_into(self._ends, self.seconds, self.first.R_world_lidar, seconds, nodes)
        return nodes

    def jacobians(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 6, 24): how a point seen so long after the first state moves in the world with both states' errors.

        In terms of the last pose: the error `[θ, p]` of it that moves the point as the errors of the states do.
        """
        J = np.empty((len(seconds), 6, 2 * DOF))
        first, last = self.first, self.last
        jacobians_into(self._ends, self.seconds, first.R_world_lidar, last.R_world_lidar, last.rate, seconds, J)
        return J
