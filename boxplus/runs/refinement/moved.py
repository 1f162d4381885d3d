"""How far refining has moved a run, against what that run claimed to know."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion, se3, so3
from boxplus.runs.slam.summary import GnssFacts

Floats = NDArray[np.float64]

_LEAST_SIGMA_M = 0.002


def moved_by(before: Floats, after: Floats, covariance: Floats, place: GnssFacts | None = None) -> float:
    """The largest move of a pose, in standard deviations of what the run claimed.

    A run's covariances are those against its first pose, and so are the moves that are measured by them: on the Earth nothing
    holds the first one. There, moves on the ground are measured as well, by these and what the run knew of its place.

    Args:
        before, after: (N, 7) poses, the first one first. covariance: (N, 6, 6) of the run, [θ, p] [rad, m].
        place: what positions by satellite came to; None, or without a covariance: the run does not lie on the Earth.
    """
    own = _variance(covariance[:, 3:, 3:])
    T_before, T_after = (se3.compose(np.broadcast_to(se3.inverse(T[0]), T.shape), T) for T in (before, after))
    most = _most(T_after - T_before, own)
    if place is None or place.covariance is None or place.T_enu_map is None:
        return most
    T_enu_map = np.array(place.T_enu_map)
    p_map = se3.act(se3.inverse(T_enu_map), before[:, 4:])
    R = quaternion.to_matrix(T_enu_map[:4])
    J = np.concatenate([-R @ so3.hat(p_map), np.broadcast_to(R, (len(p_map), 3, 3))], axis=2)
    of_place = _variance(J @ np.array(place.covariance) @ np.swapaxes(J, 1, 2))
    return max(most, _most(after - before, own + of_place))


def _variance(covariance: Floats) -> Floats:
    """(N,) of the axis that is known least."""
    return np.asarray(np.diagonal(covariance, axis1=1, axis2=2).max(axis=1))


def _most(move: Floats, variance: Floats) -> float:
    return float((np.linalg.norm(move[:, 4:], axis=1) / (np.sqrt(variance) + _LEAST_SIGMA_M)).max())
