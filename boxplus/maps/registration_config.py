"""The settings of registering a scan to a map. None has to be given."""

from __future__ import annotations

from pydantic import Field

from boxplus._settings import Settings


class RegistrationConfig(Settings):
    """How a scan is thinned, matched to the planes of a map and weighed; lengths in metres.

    `LioConfig` has these settings and those of the filter.

    Raises:
        InputError: a setting is unknown or out of range.

    Example:
        >>> RegistrationConfig(map_cell=0.5).map_cell
        0.5
    """

    scan_voxel: float = Field(0.15, gt=0, description="side of the voxels that thin a scan before the update, at least [m]")
    map_cell: float = Field(0.25, gt=0, description="side of the map's cells, each keeps one point [m]")
    max_neighbour_distance: float = Field(2.236, gt=0, description="the fifth neighbour of a point lies within this [m]")
    plane_threshold: float = Field(0.1, gt=0, description="a plane's five points lie within this of it [m]")
    range_sigma: float = Field(0.02, gt=0, description="standard deviation of a LiDAR point along a plane's normal [m]")
    map_sigma: float = Field(0.02, ge=0, description="standard deviation of a map point along a plane's normal [m]")
    min_points: int = Field(20, ge=6, description="fewest used points for an update; with fewer the scan is lost")
    weak_threshold: float = Field(
        1.3,
        ge=0,
        description="a direction is only predicted when 2000 points say less about it than so many times what noise would; "
        "fewer ask for more",
    )
    threads: int = Field(1, ge=1, description="threads that share the work of a scan; the result does not depend on it")
