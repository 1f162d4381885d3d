"""The settings of localisation. None has to be given."""

from __future__ import annotations

from pydantic import Field

from boxplus._settings import Settings
from boxplus.maps.local_maps.config import LocalMapRegistrationConfig


class LocalizationConfig(Settings):
    """When a place is believed to be found, and when it is lost again.

    Raises:
        InputError: a setting is unknown or out of range.

    Example:
        >>> LocalizationConfig(least_fit=0.6).least_fit
        0.6
    """

    registration: LocalMapRegistrationConfig = Field(
        LocalMapRegistrationConfig(), description="see LocalMapRegistrationConfig of loop closure"
    )
    query_duration: float = Field(3.0, gt=0, description="scans are collected for this long, then looked for in the map [s]")
    query_length: float = Field(20.0, gt=0, description="or over this way [m]")
    candidates: int = Field(10, ge=2, description="poses that agree best from above and are registered")
    least_fit: float = Field(0.5, ge=0, le=1, description="share of what stands, near a point of the map")
    least_overlap: float = Field(0.6, ge=0, le=1, description="share of all points near a point of the map")
    largest_rms: float = Field(0.12, gt=0, description="spread of distances to the map's planes [m]")
    most_seen_through: float = Field(0.2, ge=0, le=1, description="share of directions in which the map has something nearer")
    decisive: float = Field(3.0, ge=1, description="fit over that of the second-best place to be believed at once")
    telling: float = Field(0.1, gt=0, lt=1, description="fit more than any other pose to be believed when two queries agree")
    telling_misfit: float = Field(3.0, gt=1, description="or half of that, and so many times less that does not fit")
    telling_lead: float = Field(0.3, gt=0, lt=1, description="or half of that, and so much less far off the map's surfaces")
    least_lead: float = Field(
        0.23, ge=0, lt=1, description="part by which what stands is less far off the map's surfaces than at any other pose, mean"
    )
    lead_margin: float = Field(
        0.06, ge=0, description="and over the root of the number of queries so much more, before the place is told from its kind"
    )
    told_fit: float = Field(0.65, ge=0, le=1, description="share of what stands, near a point of the map, before it is told")
    track_interval: float = Field(0.3, ge=0, description="time between registrations of a scan to the map [s]")
    track_voxel: float = Field(0.5, gt=0, description="voxel that thins a scan for it [m]")
    track_points: int = Field(1000, ge=100, description="points of a scan for it, at most")
    track_radius: float = Field(60.0, gt=0, description="reach of the map around the sensor [m]")
    walk_rotation: float = Field(1.7e-4, gt=0, description="random walk of the odometry against the map [rad/√s]")
    walk_position: float = Field(0.01, gt=0, description="and of its position [m/√s]")
    drift_rotation: float = Field(5e-4, ge=0, description="and along the way [rad/√m]")
    drift_position: float = Field(0.01, ge=0, description="and of its position along the way [m/√m]")
    innovation: float = Field(0.999, gt=0, lt=1, description="probability of a true registration to agree with the prediction")
    failures: int = Field(10, ge=1, description="registrations in a row that do not, after which the place is lost")
    least_share: float = Field(0.5, ge=0, le=1, description="share of what stands that is in the map, where there is a map")
    lost_after: float = Field(2.0, gt=0, description="time below it after which the place is lost [s]")
    recheck_after: float = Field(
        5.0, ge=0, description="time after which a place is looked for again; 0: never, also where it is not told [s]"
    )
    recheck_interval: float = Field(
        120.0, gt=0, description="twice as late each time, up to this; at once where contradicted [s]"
    )
    largest_sigma: float = Field(1.0, gt=0, description="σ of the position up to which odometry alone is followed [m]")
