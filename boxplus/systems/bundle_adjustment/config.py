"""Options of bundle adjustment, on points and on lines."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from boxplus._settings import Settings
from boxplus.optimization.solver_options import SolverOptions

# Points far away creep on for many steps that change nothing but their distance.
_COST_TOLERANCE = 1e-8


class BundleAdjustmentConfig(Settings):
    """Options of `adjust_bundle`.

    Example:
        >>> bp.BundleAdjustmentConfig(sigma_px=0.5, intrinsics="refined").principal_point
        'held'
    """

    sigma_px: float = Field(1.0, gt=0, description="[px] standard deviation of a pixel measurement")
    intrinsics: Literal["held", "refined"] = Field(
        "held", description="of COLMAP's cameras; those of a BAL file are always refined, as its cameras carry them"
    )
    principal_point: Literal["held", "refined"] = Field(
        "held", description="of COLMAP's cameras where the intrinsics are refined; few scenes determine it well"
    )
    solver: SolverOptions = Field(
        SolverOptions(cost_tolerance=_COST_TOLERANCE), description="see SolverOptions; stops once the cost settles to 8 digits"
    )


class LineAdjustmentConfig(Settings):
    """Options of `adjust_lines`.

    Example:
        >>> from boxplus.systems.bundle_adjustment import LineAdjustmentConfig
        >>> LineAdjustmentConfig(sigma_px=0.5, triangulate=True).use_points
        True
    """

    sigma_px: float = Field(0.3, gt=0, description="[px] standard deviation of a segment's end across the segment")
    sigma_point_px: float = Field(0.5, gt=0, description="[px] standard deviation of a point's pixel")
    use_points: bool = Field(True, description="adjust the points with the lines, where there are any")
    triangulate: bool = Field(False, description="take only cameras and segments from the input, and find the lines from them")
    solver: SolverOptions = Field(
        SolverOptions(max_iterations=1000, cost_tolerance=1e-9),
        description="see SolverOptions; lines that are hardly determined creep on for many steps",
    )
