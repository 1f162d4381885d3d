"""Error terms for `Problem.add_residuals`: one kind a file, each a group of N residuals with analytic Jacobians."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from boxplus.residuals.bal_reprojection import BalReprojection
    from boxplus.residuals.chordal_pose import ChordalPose, ChordalPose2D
    from boxplus.residuals.gicp import Gicp
    from boxplus.residuals.imu import ImuPreintegration
    from boxplus.residuals.inverse_depth import InverseDepthReprojection
    from boxplus.residuals.inverse_depth_intrinsics import InverseDepthIntrinsics
    from boxplus.residuals.line_reprojection import LineReprojection
    from boxplus.residuals.photometric import Photometric
    from boxplus.residuals.point_to_plane import PointToPlane
    from boxplus.residuals.point_to_point import PointToPoint
    from boxplus.residuals.prior import Prior
    from boxplus.residuals.relative_pose import RelativePose
    from boxplus.residuals.relative_pose_2d import RelativePose2D
    from boxplus.residuals.reprojection import Reprojection
    from boxplus.residuals.reprojection_intrinsics import ReprojectionIntrinsics
    from boxplus.residuals.residual import Linearization, Residual
    from boxplus.residuals.user_residual import UserResidual

_HOME = {
    "BalReprojection": "bal_reprojection",
    "ChordalPose": "chordal_pose",
    "ChordalPose2D": "chordal_pose",
    "Gicp": "gicp",
    "ImuPreintegration": "imu",
    "InverseDepthIntrinsics": "inverse_depth_intrinsics",
    "InverseDepthReprojection": "inverse_depth",
    "LineReprojection": "line_reprojection",
    "Linearization": "residual",
    "Photometric": "photometric",
    "PointToPlane": "point_to_plane",
    "PointToPoint": "point_to_point",
    "Prior": "prior",
    "RelativePose": "relative_pose",
    "RelativePose2D": "relative_pose_2d",
    "Reprojection": "reprojection",
    "ReprojectionIntrinsics": "reprojection_intrinsics",
    "Residual": "residual",
    "UserResidual": "user_residual",
}

__all__ = [
    "BalReprojection",
    "ChordalPose",
    "ChordalPose2D",
    "Gicp",
    "ImuPreintegration",
    "InverseDepthIntrinsics",
    "InverseDepthReprojection",
    "LineReprojection",
    "Linearization",
    "Photometric",
    "PointToPlane",
    "PointToPoint",
    "Prior",
    "RelativePose",
    "RelativePose2D",
    "Reprojection",
    "ReprojectionIntrinsics",
    "Residual",
    "UserResidual",
]


def __getattr__(name: str) -> object:
    """Import a residual from its home when it is first used (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value
