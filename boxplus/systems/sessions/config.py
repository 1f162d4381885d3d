"""The settings of aligning sessions. None has to be given."""

from __future__ import annotations

from pydantic import Field

from boxplus._settings import Settings
from boxplus.systems.slam.config import SlamConfig


class SessionsConfig(Settings):
    """Which encounters of two sessions are looked for, and how many of them have to agree before the two are joined.

    Raises:
        InputError: a setting is unknown or out of range.

    Example:
        >>> SessionsConfig(least_encounters=5).least_encounters
        5
    """

    slam: SlamConfig = Field(
        SlamConfig(least_overlap=0.6, rival_fit=0.85),
        description="descriptors, registration and what a fit has to be, as for loops",
    )
    reach: float = Field(
        25.0, gt=0, description="two places that fit as well this far apart cannot be told from each other: no encounter [m]"
    )
    least_encounters: int = Field(3, ge=2, description="that agree with each other, each of a local map of its own")
    least_spread: float = Field(10.0, ge=0, description="way between the first and the last of them in either session [m]")
    nearby: float = Field(
        8.0, gt=0, description="local maps of two sessions that should lie this near are laid over each other [m]"
    )
    least_confirmed: float = Field(0.7, ge=0, le=1, description="share of these that have to fit")
    least_standing: float = Field(
        0.7, ge=0, le=1, description="share of what stands upright in one session that stands at the same place in the other"
    )
    least_lead: float = Field(
        0.2, ge=0, lt=1, description="part by which what stands is less far off the other's surfaces than at any other alignment"
    )
    rival_share: float = Field(
        0.5, gt=0, le=1, description="another alignment with this share of the encounters makes the first one ambiguous"
    )
