"""What the motion of a run has shown of its sensors, and how wrong each could be without a word.

A comparison names what it contradicts, and says nothing of the rest, for one of two reasons: the sensors agree, or the motion
does not show it. Who drives straight on at a steady speed gets as quiet a run with points a tenth too short as with right ones.
So beside the contradictions stands what would have become one.

Source: docs/agreement.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.systems.lidar_inertial_agreement.agreement import ROTATION_KNOWN_RAD, Agreement
from boxplus.systems.lidar_inertial_agreement.finding import Cause, Finding
from boxplus.systems.lidar_inertial_agreement.hypotheses import (
    judges,
    judges_lengths,
    judges_rotation,
    judges_scale,
    least_offset,
    least_scale,
    slope_of,
)
from boxplus.systems.lidar_inertial_agreement.lengths import FEWEST_SLOPES, least_factor
from boxplus.systems.lidar_inertial_agreement.mountings import Turn, combined, least_turn, turn_from
from boxplus.systems.lidar_inertial_agreement.stretches import Stretches

_LENGTHS_SHOWN = 0.1  # a factor of as much is named

Part = Literal["gyroscope", "clocks", "mounting", "lengths"]
_PARTS: dict[Cause, tuple[Part, ...]] = {
    "gyro_unit": ("gyroscope",),
    "gyro_sign": ("gyroscope",),
    "gyro_scale": ("gyroscope",),
    "not_together": ("gyroscope", "clocks", "mounting"),
    "extrinsic": ("mounting",),
    "mirrored": ("mounting", "lengths"),
    "time_offset": ("clocks",),
    "clock_drift": ("clocks",),
    "corrected_points": ("clocks",),
    "reversed_times": ("clocks",),
    "force_sign": ("lengths",),
    "length_scale": ("lengths",),
}
"""Of what a finding is an error."""


@dataclass(frozen=True, slots=True)
class Shown:
    """What a motion has shown of one part of the sensors.

    Attributes:
        part: "gyroscope": its scale, with unit and sign; "clocks": the LiDAR's times against the IMU's; "mounting": the rotation
            of T_imu_lidar, by turns; "lengths": the LiDAR's accelerations over the IMU's.
        shown: whether an error of it would have been named, or was.
        value: as the sensors show it: a factor, or what the LiDAR's times lack [s]; None for a mounting.
        std: standard deviation of it, of a mounting about its worst axis [deg]; None where nothing is known.
        unnoticed: how far it may be off without being named [as `value`, deg]; None for any error.
        text: for a user: what was found or shown, or the error that would not have been.
    """

    part: Part
    shown: bool
    value: float | None
    std: float | None
    unnoticed: float | None
    text: str


class ShownByMotion:
    """Follows the comparisons of one run.

    Args:
        R_declared: (3, 3) the rotation of T_imu_lidar as given; None where it is estimated.
    """

    def __init__(self, R_declared: NDArray[np.float64] | None = None) -> None:
        self._R_imu_lidar = R_declared
        self._has_turned = self._has_accelerated = False
        self._gyroscope: tuple[float, float, float] | None = None
        self._clocks: tuple[float, float, float] | None = None
        self._turns: Stretches[Turn] = Stretches()

    def add(self, agreement: Agreement) -> None:
        """One more comparison."""
        rotation = agreement.rotation
        self._has_accelerated |= judges_lengths(agreement) and slope_of(agreement) is not None
        if rotation is None or not judges_rotation(agreement):
            return
        self._has_turned = True
        if judges_scale(rotation):
            self._gyroscope = _surer(self._gyroscope, (rotation.scale, rotation.scale_std, least_scale(rotation)))
        if judges("time_offset", agreement):
            least = least_offset(rotation, agreement.imu_rate_hz)
            self._clocks = _surer(self._clocks, (rotation.offset_s, rotation.offset_std_s, least))
        if self._R_imu_lidar is None:
            self._R_imu_lidar = rotation.R_imu_lidar
        self._turns.add(agreement, turn_from(rotation, self._R_imu_lidar))

    def parts(self, slopes: Sequence[tuple[float, float]], contradiction: Finding | None = None) -> tuple[Shown, ...]:
        """Part by part.

        Args:
            slopes: of the accelerations, with their standard deviations, of stretches that show them.
            contradiction: what stands against the sensors; the motion has shown what it is an error of.
        """
        found = (self._of_gyroscope(), self._of_clocks(), self._of_mounting(), self._of_lengths(slopes))
        if contradiction is None:
            return found
        wrong, text = _PARTS.get(contradiction.cause, ()), f"found wrong: {contradiction.text}"
        return tuple(replace(one, shown=True, text=text) if one.part in wrong else one for one in found)

    def _of_gyroscope(self) -> Shown:
        if self._gyroscope is None:
            what = "a wrong scale of the gyroscope" if self._has_turned else "a wrong unit, sign or scale of the gyroscope"
            return Shown("gyroscope", False, None, None, None, what)
        value, std, least = self._gyroscope
        text = f"the gyroscope turns {value:.3f} ± {std:.3f} times as far as the LiDAR"
        return Shown("gyroscope", True, value, std, least, text)

    def _of_clocks(self) -> Shown:
        if self._clocks is None:
            return Shown("clocks", False, None, None, None, "clocks that are apart")
        value, std, least = self._clocks
        side = "late" if value < 0.0 else "early"
        text = f"the LiDAR's times are {abs(value) * 1e3:.1f} ± {std * 1e3:.1f} ms {side} on the IMU's clock"
        return Shown("clocks", True, value, std, least, text)

    def _of_mounting(self) -> Shown:
        std = combined(self._turns.said)[1] if self._turns.said else np.full(3, np.inf)
        known = std < ROTATION_KNOWN_RAD
        if known.all():
            worst, least = float(np.degrees(std[-1])), float(np.degrees(least_turn(std)))
            text = f"turns show the rotation of T_imu_lidar: {least:.1f} deg off would have been named"
            return Shown("mounting", True, None, worst, least, text)
        about = ("", " about two axes", " about one axis")[int(known.sum())]
        return Shown("mounting", False, None, None, None, f"a wrong rotation of T_imu_lidar{about}, by turns")

    def _of_lengths(self, slopes: Sequence[tuple[float, float]]) -> Shown:
        wrong = "points too long or too short"
        # One stretch alone names a factor only where it fits well.
        if not slopes or (len(slopes) < FEWEST_SLOPES and not self._has_accelerated):
            return Shown("lengths", False, None, None, None, f"{wrong} by any factor")
        value, std, least = least_factor(slopes)
        said = f"the LiDAR's accelerations are {value:.2f} ± {std:.2f} times the accelerometer's"
        if not np.isfinite(least):
            return Shown("lengths", False, value, std, None, f"{wrong} by any factor ({said})")
        if least > _LENGTHS_SHOWN:
            return Shown("lengths", False, value, std, least, f"{wrong} by less than {least:.0%} ({said})")
        return Shown("lengths", True, value, std, least, f"{said}; lengths that are off by {least:.0%} would have been named")


def _surer(before: tuple[float, float, float] | None, now: tuple[float, float, float]) -> tuple[float, float, float]:
    return now if before is None or now[1] < before[1] else before
