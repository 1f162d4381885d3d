"""Error terms for `Problem.add_residuals`: one kind a file, each a group of N residuals with analytic Jacobians."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from boxplus.residuals.bal_reprojection import BalCamera, BalReprojection
    from boxplus.residuals.chordal_pose import ChordalPose, ChordalPose2D, chordal_weights
    from boxplus.residuals.gicp import Gicp, plane_covariances
    from boxplus.residuals.imu import ImuPreintegration
    from boxplus.residuals.imu_preintegration import ImuNoise, Preintegration
    from boxplus.residuals.inverse_depth import InverseDepthReprojection
    from boxplus.residuals.inverse_depth_intrinsics import InverseDepthIntrinsics
    from boxplus.residuals.line_reprojection import LineReprojection
    from boxplus.residuals.marginal_prior import MarginalPrior
    from boxplus.residuals.photometric import DSO_PATTERN, Photometric
    from boxplus.residuals.point_to_plane import PointToPlane
    from boxplus.residuals.point_to_point import PointToPoint
    from boxplus.residuals.prior import Prior
    from boxplus.residuals.relative_pose import RelativePose
    from boxplus.residuals.relative_pose_2d import RelativePose2D
    from boxplus.residuals.reprojection import Reprojection
    from boxplus.residuals.reprojection_intrinsics import ReprojectionIntrinsics
    from boxplus.residuals.reprojection_tied_intrinsics import ReprojectionTiedIntrinsics
    from boxplus.residuals.residual import Linearization, Residual
    from boxplus.residuals.user_residual import UserResidual

_HOME = {
    "BalCamera": "bal_reprojection",
    "BalReprojection": "bal_reprojection",
    "ChordalPose": "chordal_pose",
    "ChordalPose2D": "chordal_pose",
    "DSO_PATTERN": "photometric",
    "Gicp": "gicp",
    "ImuNoise": "imu_preintegration",
    "ImuPreintegration": "imu",
    "InverseDepthIntrinsics": "inverse_depth_intrinsics",
    "InverseDepthReprojection": "inverse_depth",
    "LineReprojection": "line_reprojection",
    "Linearization": "residual",
    "MarginalPrior": "marginal_prior",
    "Photometric": "photometric",
    "PointToPlane": "point_to_plane",
    "PointToPoint": "point_to_point",
    "Preintegration": "imu_preintegration",
    "Prior": "prior",
    "RelativePose": "relative_pose",
    "RelativePose2D": "relative_pose_2d",
    "Reprojection": "reprojection",
    "ReprojectionIntrinsics": "reprojection_intrinsics",
    "ReprojectionTiedIntrinsics": "reprojection_tied_intrinsics",
    "Residual": "residual",
    "UserResidual": "user_residual",
    "chordal_weights": "chordal_pose",
    "plane_covariances": "gicp",
}

__all__ = [
    "DSO_PATTERN",
    "BalCamera",
    "BalReprojection",
    "ChordalPose",
    "ChordalPose2D",
    "Gicp",
    "ImuNoise",
    "ImuPreintegration",
    "InverseDepthIntrinsics",
    "InverseDepthReprojection",
    "LineReprojection",
    "Linearization",
    "MarginalPrior",
    "Photometric",
    "PointToPlane",
    "PointToPoint",
    "Preintegration",
    "Prior",
    "RelativePose",
    "RelativePose2D",
    "Reprojection",
    "ReprojectionIntrinsics",
    "ReprojectionTiedIntrinsics",
    "Residual",
    "UserResidual",
    "chordal_weights",
    "plane_covariances",
]


def __getattr__(name: str) -> object:
    """Import a residual from its home when it is first used (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value
