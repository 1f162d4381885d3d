"""What else a refinement may find: the mounting of the LiDAR and the time offset between its clock and that of the IMU.

Neither is guessed. What the motion does not tell is held where it was, and what was found comes with its standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.systems.refinement.config import RefinementConfig
from boxplus.systems.refinement.finished_run import FinishedRun
from boxplus.systems.refinement.state import RefinedState

Floats = NDArray[np.float64]

_SECOND_AXIS = 0.1  # rad/s
_TOLD = 0.5  # of the standard deviation that it had before, for a time offset that the motion tells
_SURPRISING = 3.0  # standard deviations from what was believed


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationFound:
    """What became of the mounting and of the time offset.

    Attributes:
        extrinsic, time_offset: whether they were refined, and why, in words.
        extrinsic_sigma: (6,) [rad, m] of T_imu_lidar, zero where it was held. time_offset_sigma: [s], likewise.
        doubts: a sentence each on what is farther from what was believed than that allows.
    """

    extrinsic: str
    time_offset: str
    extrinsic_sigma: Floats
    time_offset_sigma: float
    doubts: list[str]


@dataclass(frozen=True, slots=True)
class Calibrated:
    """Which of the two are variables, and why.

    Attributes:
        mounting, time_offset: whether.
        extrinsic_text, time_offset_text: why.
    """

    mounting: bool
    time_offset: bool
    extrinsic_text: str
    time_offset_text: str

    @classmethod
    def of(cls, run: FinishedRun, config: RefinementConfig) -> Self:
        """What the settings ask for, and of the mounting whether the motion turns about two axes."""
        mounting, why = config.extrinsic_estimation == "on", "as extrinsic_estimation says"
        if config.extrinsic_estimation == "gated":
            rates = run.imu.gyro - run.velocity_bias[:, 6:].mean(axis=0)
            second = float(np.sqrt(np.linalg.eigvalsh(rates.T @ rates / len(rates))[1]))
            why = f"the body turned about a second axis at {second:.2f} rad/s (root mean square)"
            mounting = second >= _SECOND_AXIS
            why += "" if mounting else f", and {_SECOND_AXIS:g} would be needed to tell it"
        offset = config.time_offset_estimation != "off"
        return cls(mounting, offset, why, "as time_offset_estimation says")

    def judged(self, state: RefinedState, sigma_s: float, config: RefinementConfig) -> tuple[Self, RefinedState]:
        """The time offset is held from now on, where it was, if it turns out that the motion does not tell it."""
        if not self.time_offset or config.time_offset_estimation == "on" or sigma_s < _TOLD * config.time_offset_sigma:
            return self, state
        why = f"the motion tells it to {1e3 * sigma_s:.1f} ms only"
        return replace(self, time_offset=False, time_offset_text=why), replace(state, time_offset_s=0.0)

    def found(
        self, run: FinishedRun, state: RefinedState, mounting_sigma: Floats, offset_sigma: float, config: RefinementConfig
    ) -> CalibrationFound:
        """What became of it."""
        extrinsic, offset, doubts = f"held: {self.extrinsic_text}", f"held: {self.time_offset_text}", []
        if self.mounting:
            moved = np.abs(se3.log(se3.compose(se3.inverse(run.T_imu_lidar), state.T_imu_lidar)))
            turn, shift = (float(np.linalg.norm(part)) for part in (moved[:3], moved[3:]))
            degrees, millimetres = np.degrees(mounting_sigma[:3].max()), 1e3 * mounting_sigma[3:].max()
            by = f"{np.degrees(turn):.3f}° ± {degrees:.3f}° and {1e3 * shift:.1f} ± {millimetres:.1f} mm"
            extrinsic = f"refined by {by}: {self.extrinsic_text}"
            before = np.repeat([np.deg2rad(config.extrinsic_rotation_sigma_deg), config.extrinsic_translation_sigma], 3)
            if (moved > _SURPRISING * before).any():
                doubts.append(
                    "the mounting came out farther from what was given than its standard deviations allow: they are too "
                    "small, or something else is wrong"
                )
        if self.time_offset:
            t = state.time_offset_s
            offset = f"refined to {1e3 * t:+.2f} ± {1e3 * offset_sigma:.2f} ms: {self.time_offset_text}"
            if abs(t) > _SURPRISING * config.time_offset_sigma:
                doubts.append(
                    f"the clock of the IMU is {1e3 * t:+.1f} ms from that of the LiDAR, more than was thought possible: "
                    f"add {t:.4f} to recording.lidar_time_offset_s and run 'boxplus lio' again"
                )
        return CalibrationFound(extrinsic, offset, mounting_sigma, offset_sigma if self.time_offset else 0.0, doubts)
