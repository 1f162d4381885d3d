"""What a comparison of the sensors finds wrong."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Cause = Literal[
    "gyro_unit",
    "gyro_sign",
    "gyro_scale",
    "not_together",
    "extrinsic",
    "mirrored",
    "time_offset",
    "clock_drift",
    "force_sign",
    "length_scale",
    "astray",
    "corrected_points",
    "reversed_times",
]


@dataclass(frozen=True, slots=True)
class Finding:
    """A contradiction between the sensors, or between them and what was declared.

    Attributes:
        axis: about the IMU's axes, about which a mounting was found to be off that an estimator goes on correcting.
    """

    cause: Cause
    text: str
    axis: tuple[float, float, float] | None = None
