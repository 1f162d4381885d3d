"""The settings of recognising places by their density images."""

from __future__ import annotations

from pydantic import Field

from boxplus._settings import Settings


class DescriptorConfig(Settings):
    """How a local map is described, and how alike two have to be.

    Raises:
        InputError: a setting is unknown or out of range.

    Example:
        >>> DescriptorConfig(cell=0.25).cell
        0.25
    """

    cell: float = Field(0.5, gt=0, description="side of a pixel of the density image [m]; 0.25 within buildings")
    features: int = Field(500, ge=8, description="corners of a density image, at most")
    corner_threshold: int = Field(
        20, ge=1, le=254, description="contrast of a corner to the circle around it, in grey values of 255"
    )
    max_distance: int = Field(50, ge=0, le=256, description="bits of 256 in which two features that match differ, at most")
    own_distance: int = Field(
        35, ge=0, le=256, description="a feature as near as this to another one of its map is left out [bits]"
    )
    inlier_distance: float = Field(1.5, gt=0, description="between matched features under the rigid motion found [m]")
    least_inliers: int = Field(6, ge=3, description="matches that a rigid motion explains, for a candidate")
    candidates: int = Field(4, ge=1, description="places that look most alike and are aligned")
