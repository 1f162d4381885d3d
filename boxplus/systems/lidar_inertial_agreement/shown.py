"""What the motion of a run has shown of its sensors, and how wrong each could be without a word.

A comparison names what it contradicts, and says nothing of the rest, for one of two reasons: the sensors agree, or the motion
does not show it. Who drives straight on at a steady speed gets as quiet a run with points a tenth too long as with right ones. So
beside the contradictions stands what would have become one.

Source: docs/agreement.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.systems.lidar_inertial_agreement.agreement import LAG_RAD, ROTATION_KNOWN_RAD, Agreement
from boxplus.systems.lidar_inertial_agreement.hypotheses import (
    judges,
    judges_rotation,
    judges_scale,
    least_offset,
    least_scale,
)
from boxplus.systems.lidar_inertial_agreement.lengths import least_factor
from boxplus.systems.lidar_inertial_agreement.mountings import turn_from

_LENGTHS_SHOWN = 0.1  # a factor of as much is named
_DEVIATIONS = 3.0

Part = Literal["gyroscope", "clocks", "mounting", "lengths"]


@dataclass(frozen=True, slots=True)
class Shown:
    """What a motion has shown of one part of the sensors.

    Attributes:
        part: "gyroscope": its scale, with unit and sign; "clocks": the LiDAR's times against the IMU's [s]; "mounting": the
            rotation of T_imu_lidar about the axis known worst [deg]; "lengths": the LiDAR's accelerations over the IMU's.
        shown: whether an error of it would have been named.
        value: as the sensors show it; None for a mounting.
        std: standard deviation of it; None where nothing is known.
        unnoticed: how far it may be off without being named; None for any error.
        text: a clause for a user.
    """

    part: Part
    shown: bool
    value: float | None
    std: float | None
    unnoticed: float | None
    text: str


class ShownByMotion:
    """Follows the comparisons of one run."""

    def __init__(self) -> None:
        self._has_turned = False
        self._gyroscope: tuple[float, float, float] | None = None
        self._clocks: tuple[float, float, float] | None = None
        self._mounting: NDArray[np.float64] = np.zeros((3, 3))
        self._until_ns = 0

    def add(self, agreement: Agreement) -> None:
        """One more comparison."""
        rotation = agreement.rotation
        if rotation is None or not judges_rotation(agreement):
            return
        self._has_turned = True
        if judges_scale(rotation):
            self._gyroscope = _surer(self._gyroscope, (rotation.scale, rotation.scale_std, least_scale(rotation)))
        if judges("time_offset", agreement):
            least = least_offset(rotation, agreement.imu_rate_hz)
            self._clocks = _surer(self._clocks, (rotation.offset_s, rotation.offset_std_s, least))
        if int(agreement.path.time_ns[0]) >= self._until_ns:
            self._until_ns = int(agreement.path.time_ns[-1])
            self._mounting = self._mounting + turn_from(rotation, rotation.R_imu_lidar)[1]

    def parts(self, slopes: Sequence[tuple[float, float]]) -> tuple[Shown, ...]:
        """Part by part.

        Args:
            slopes: of the accelerations, with their standard deviations, of stretches that show them.
        """
        return self._of_gyroscope(), self._of_clocks(), self._of_mounting(), _of_lengths(slopes)

    def _of_gyroscope(self) -> Shown:
        if self._gyroscope is None:
            what = "the gyroscope's scale" if self._has_turned else "the gyroscope's unit, sign and scale"
            return Shown("gyroscope", False, None, None, None, what)
        value, std, least = self._gyroscope
        return Shown(
            "gyroscope", True, value, std, least, f"the gyroscope turns {value:.3f} ± {std:.3f} times as far as the LiDAR"
        )

    def _of_clocks(self) -> Shown:
        if self._clocks is None:
            return Shown("clocks", False, None, None, None, "whether the clocks of LiDAR and IMU are apart")
        value, std, least = self._clocks
        text = f"the LiDAR's times lie {value * 1e3:+.1f} ± {std * 1e3:.1f} ms from the IMU's clock"
        return Shown("clocks", True, value, std, least, text)

    def _of_mounting(self) -> Shown:
        known = np.linalg.eigvalsh(self._mounting)
        std = 1.0 / np.sqrt(np.maximum(known, 1e-6))
        axes, worst = int((std < ROTATION_KNOWN_RAD).sum()), float(np.degrees(std[0]))
        unnoticed = float(np.degrees(LAG_RAD)) + _DEVIATIONS * worst
        if axes == 3:
            text = f"the rotation of T_imu_lidar is known to {worst:.1f} deg about its worst axis"
            return Shown("mounting", True, None, worst, unnoticed, text)
        about = (
            "the rotation of T_imu_lidar",
            "the rotation of T_imu_lidar about two axes",
            "the rotation of T_imu_lidar about one axis",
        )
        return Shown("mounting", False, None, None, None, about[axes])


def _of_lengths(slopes: Sequence[tuple[float, float]]) -> Shown:
    if not slopes:
        text = "lengths: points too long or too short by any factor"
        return Shown("lengths", False, None, None, None, text)
    value, std, least = least_factor(slopes)
    said = f"the LiDAR's accelerations are {value:.2f} ± {std:.2f} times the accelerometer's"
    if least > _LENGTHS_SHOWN:
        text = f"lengths: points too long or too short by less than {least:.0%} ({said})"
        return Shown("lengths", False, value, std, least, text)
    return Shown("lengths", True, value, std, least, f"{said}; lengths that are off by {least:.0%} would have been named")


def _surer(before: tuple[float, float, float] | None, now: tuple[float, float, float]) -> tuple[float, float, float]:
    return now if before is None or now[1] < before[1] else before
