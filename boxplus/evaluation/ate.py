"""Absolute trajectory error: how far each pose of an aligned estimate is from the ground truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import so3


def translation_errors(estimate: Trajectory, ground_truth: Trajectory) -> NDArray[np.float64]:
    """(M,) distances ‖p_ground_truth − p_estimate‖ of matched poses [m] (Sturm et al. 2012, without the alignment)."""
    return np.asarray(np.linalg.norm(ground_truth.p - estimate.p, axis=1))


def rotation_differences(estimate: Trajectory, ground_truth: Trajectory) -> NDArray[np.float64]:
    """(M, 3) rotation vectors Log(R_ground_truthᵀ R_estimate) of matched poses, in the body frame [rad]."""
    return so3.log(ground_truth.R.transpose(0, 2, 1) @ estimate.R)
