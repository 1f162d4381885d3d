"""Rotations about their mean: how far orientations scatter, how worlds are turned against each other, how far a body turned."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.evaluation.statistics import rms
from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import so3


def scatter_deg(R_one: NDArray[np.float64], R_other: NDArray[np.float64]) -> float:
    """Root mean square of how far relative rotations are from their mean [degrees]."""
    between = np.swapaxes(R_other, 1, 2) @ R_one
    return float(np.degrees(rms(np.linalg.norm(so3.log(mean_rotation(between).T @ between), axis=1))))


def world_turn(estimate: Trajectory, truth: Trajectory) -> NDArray[np.float64]:
    """The rotation (3, 3) of the estimate's world to the true one, by orientations of the same body."""
    return mean_rotation(truth.R @ estimate.R.transpose(0, 2, 1))


def mean_rotation(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation (3, 3) nearest to all of (M, 3, 3); that of half turns, too, whose rotation vectors cancel."""
    U, _, Vt = np.linalg.svd(R.mean(axis=0))
    return np.asarray((U * np.array([1.0, 1.0, np.linalg.det(U @ Vt)])) @ Vt)


def turned_deg(trajectory: Trajectory) -> NDArray[np.float64]:
    """Turns (M,) from the mean orientation [degrees]."""
    R = trajectory.R
    return np.asarray(np.degrees(np.linalg.norm(so3.log(mean_rotation(R).T @ R), axis=1)))


def in_one_world_deg(estimate: Trajectory, truth: Trajectory) -> float:
    """Scatter of the orientations [deg], with the worlds laid over each other by these alone."""
    return scatter_deg(world_turn(estimate, truth) @ estimate.R, truth.R)
