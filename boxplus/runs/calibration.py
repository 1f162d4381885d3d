"""A calibration from a recording: of LiDAR and IMU, from what their comparison shows over several stretches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from boxplus.errors import InputError
from boxplus.recordings.options import RecordingOptions
from boxplus.recordings.recording import Recording
from boxplus.recordings.stream_checks import StreamLog
from boxplus.runs.inspection.stretches import gather_scans, lively_stretches
from boxplus.runs.run_loop import versions
from boxplus.systems.lidar_inertial_agreement.agreement import compare_sensors, usable
from boxplus.systems.lidar_inertial_agreement.calibration import ARM, OFFSET, SCALE, SLOPE, THETA, Calibration, calibrate
from boxplus.systems.lidar_inertial_agreement.finding import Cause
from boxplus.systems.lidar_inertial_agreement.hypotheses import contradictions, judges_rotation, scale_finding
from boxplus.systems.lidar_inertial_agreement.lengths import SLOPE_FLOOR, slope_finding
from boxplus.systems.lidar_inertial_odometry.config import LioConfig

_STRETCH_S, _STRETCHES = 8.0, 5
_FEWEST_SAMPLES = 100
_AT_REST = 1.0  # standard deviations of the last step
_REFUSED: frozenset[Cause] = frozenset({"gyro_unit", "gyro_sign", "not_together", "mirrored", "force_sign"})
"""With these there is no mounting to be found."""
_ROTATION_DEG, _TRANSLATION_M, _OFFSET_S, _SCALE, _GYRO_BIAS = 0.6, 0.03, 5e-3, 0.03, 5e-3
"""Standard deviations up to which something counts as determined."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """One row of a calibration: its name, value and standard deviation as text, and what to do if the motion left it open.

    `advice` is empty where it is determined.
    """

    name: str
    value: str
    std: str
    advice: str

    @property
    def determined(self) -> bool:
        return not self.advice


@dataclass(frozen=True, slots=True)
class LidarImuCalibration:
    """What a recording shows about LiDAR and IMU.

    Attributes:
        estimate: the numbers with their covariance.
        lidar_time_offset_s: to add to the LiDAR's times as they are in the recording [s].
        quantities: the rows of the table.
        stretches: how many were used.
        warnings: what of the recording is wrong that no mounting or clock mends, one sentence each.
    """

    estimate: Calibration
    lidar_time_offset_s: float
    quantities: list[Quantity]
    stretches: int
    warnings: list[str]

    def determined(self, name: str) -> bool:
        """Whether the motion showed the quantity of this name."""
        return next(quantity.determined for quantity in self.quantities if quantity.name == name)

    @property
    def has_mounting(self) -> bool:
        """Whether T_imu_lidar is known completely."""
        return self.determined("R_imu_lidar") and self.determined("p_imu_lidar")


def calibrate_lidar_imu(
    recording: Recording, options: RecordingOptions | None = None, on_progress: Callable[[float], None] | None = None
) -> LidarImuCalibration:
    """Estimate mounting, clock offset, scales and gyroscope bias over the liveliest stretches of a recording.

    Args:
        recording: opened.
        options: it was opened with; its `lidar_time_offset_s` is added to the one found.
        on_progress: called with the fraction done, in [0, 1].

    Raises:
        RecordingError: nothing at all could be read.
        InputError: too few samples, too little rotation, or sensors that contradict each other in unit, sign or belonging.
    """
    report = on_progress or (lambda _: None)
    log = StreamLog()
    for event in recording:
        log.add(event)
        report(0.3 * recording.progress)
    imu = usable(log.all_imu())
    if len(imu) < _FEWEST_SAMPLES:
        raise InputError(
            f"at least {_FEWEST_SAMPLES} usable IMU samples", f"{len(imu)}", "record the IMU too: a calibration compares both"
        )
    stretches = lively_stretches(imu, _STRETCH_S, _STRETCHES)
    gather_scans(recording, stretches, lambda done: report(0.3 + 0.1 * done))
    config = LioConfig()  # type: ignore[call-arg]
    used = []
    for number, stretch in enumerate(stretches):
        agreement = compare_sensors(stretch.scans, stretch.imu, config, refine=True)
        for finding in contradictions(agreement, None):
            if finding.cause in _REFUSED:
                raise InputError("a LiDAR and an IMU that agree up to mounting and clocks", finding.text, "correct that first")
        if judges_rotation(agreement):
            used.append((agreement, stretch.imu))
        report(0.4 + 0.6 * (number + 1) / len(stretches))
    estimate = calibrate(used) if used else None
    if estimate is None:
        raise InputError(
            "a motion that turns LiDAR and IMU about two axes, in surroundings that determine how the LiDAR turns",
            f"none in the {len(stretches)} liveliest stretches of {recording.info.path.name}",
            "hold the platform in a room with walls and furniture, and turn it by 30 deg and more about all axes for 30 s",
        )
    given_s = 0.0 if options is None else options.lidar_time_offset_s
    quantities = _quantities(estimate, given_s)
    return LidarImuCalibration(estimate, given_s + estimate.offset_s, quantities, len(used), _wrong_scales(estimate, quantities))


class QuantityFacts(BaseModel):
    """One quantity for programs: its number or numbers, their standard deviations, and whether the motion showed them."""

    model_config = ConfigDict(frozen=True)

    value: list[float]
    sigma: list[float]
    determined: bool
    advice: str = Field(description="what motion would show it; empty where it is determined")


class LidarImuFacts(BaseModel):
    """A calibration for programs."""

    model_config = ConfigDict(frozen=True)

    program: Literal["boxplus calibrate lidar-imu"] = "boxplus calibrate lidar-imu"
    versions: dict[str, str]
    T_imu_lidar: list[list[float]] | None = Field(description="(4, 4): p_imu = T_imu_lidar p_lidar; null: not determined")
    stretches: int = Field(description="of the recording that were used")
    quantities: dict[str, QuantityFacts] = Field(description="R_imu_lidar row by row with sigmas about the IMU's axes [rad]; SI")
    warnings: list[str] = Field(description="what of the recording is wrong that no mounting or clock mends")


def calibration_facts(found: LidarImuCalibration) -> LidarImuFacts:
    """The numbers of a calibration."""
    estimate = found.estimate
    R, p, std = estimate.T_imu_lidar[:3, :3], estimate.T_imu_lidar[:3, 3], estimate.std
    numbers: dict[str, tuple[Any, Any]] = {
        "R_imu_lidar": (R, std[THETA]),
        "p_imu_lidar": (p, std[ARM]),
        "lidar_time_offset": (found.lidar_time_offset_s, std[OFFSET]),
        "gyro_scale": (estimate.gyro_scale, std[SCALE]),
        "length_ratio": (estimate.slope, std[SLOPE]),
        "gyro_bias": (estimate.gyro_bias, estimate.gyro_bias_std),
    }
    quantities = {}
    for quantity in found.quantities:
        value, sigma = (np.atleast_1d(np.asarray(part, np.float64)).ravel().tolist() for part in numbers[quantity.name])
        quantities[quantity.name] = QuantityFacts(
            value=value, sigma=sigma, determined=quantity.determined, advice=quantity.advice
        )
    return LidarImuFacts(
        versions=versions(),
        T_imu_lidar=estimate.T_imu_lidar.tolist() if found.has_mounting else None,
        stretches=found.stretches,
        quantities=quantities,
        warnings=found.warnings,
    )


def _wrong_scales(found: Calibration, quantities: list[Quantity]) -> list[str]:
    """Scales that are determined and wrong, by what is named wherever the sensors are compared."""
    known = {quantity.name for quantity in quantities if quantity.determined}
    slope_std = float(np.hypot(found.std[SLOPE], SLOPE_FLOOR))
    findings = [
        slope_finding(found.slope, slope_std) if "length_ratio" in known else None,
        scale_finding(found.gyro_scale, float(found.std[SCALE])) if "gyro_scale" in known else None,
    ]
    return [f"{finding.text}; correct that and calibrate anew" for finding in findings if finding is not None]


def _quantities(found: Calibration, given_s: float) -> list[Quantity]:
    std = found.std
    R, p = found.T_imu_lidar[:3, :3], found.T_imu_lidar[:3, 3]
    moving = found.moving
    turn = _open_axes(found.covariance[THETA, THETA], np.deg2rad(_ROTATION_DEG))
    move = _open_axes(found.covariance[ARM, ARM], _TRANSLATION_M)
    rows = [
        Quantity(
            "R_imu_lidar",
            "[" + "; ".join(", ".join(f"{value:.5f}" for value in row) for row in R) + "]",
            f"{_numbers(np.degrees(std[THETA]), 2)} deg about the IMU's axes",
            f"open about {turn} (IMU axes): turn the platform quickly about axes across it" if turn else _unrest(moving[THETA]),
        ),
        Quantity(
            "p_imu_lidar",
            f"({_numbers(p, 4)}) m",
            f"{_numbers(std[ARM], 3)} m along the IMU's axes",
            f"open along {move} (IMU axes): turn the platform to and fro, quickly, about axes across it"
            if move
            else _unrest(moving[ARM]),
        ),
        Quantity(
            "lidar_time_offset",
            f"{(given_s + found.offset_s) * 1e3:+.2f} ms",
            f"{std[OFFSET] * 1e3:.2f} ms",
            "turn to and fro: a steady turn shows no time" if std[OFFSET] > _OFFSET_S else _unrest(moving[OFFSET]),
        ),
        Quantity(
            "gyro_scale",
            f"{found.gyro_scale:.4f}",
            f"{std[SCALE]:.4f}",
            "turn farther and faster" if std[SCALE] > _SCALE else _unrest(moving[SCALE]),
        ),
        Quantity(
            "length_ratio",
            f"{found.slope:.4f}",
            f"{std[SLOPE]:.4f}",
            "accelerate: move to and fro by half a metre" if std[SLOPE] > _SCALE else _unrest(moving[SLOPE]),
        ),
        Quantity(
            "gyro_bias",
            f"({_numbers(found.gyro_bias, 5)}) rad/s",
            f"{_numbers(found.gyro_bias_std, 5)} rad/s",
            "record longer, or include a rest" if found.gyro_bias_std.max() > _GYRO_BIAS else "",
        ),
    ]
    return rows


def _unrest(moving: NDArray[np.float64] | float) -> str:
    """Advice where the search ended while a quantity still moved by more than its own standard deviation."""
    most = float(np.max(moving))
    if not most > _AT_REST:
        return ""
    return (
        f"the search did not come to rest: in its last round this moved by {most:.2g} standard deviations; turn farther and "
        "faster about all axes, in surroundings with walls"
    )


def _open_axes(covariance: NDArray[np.float64], limit: float) -> str:
    """The principal axes with a standard deviation above the limit, as text."""
    variance, axes = np.linalg.eigh(covariance)
    wide = np.flatnonzero(np.sqrt(variance) > limit)
    return " and ".join(f"({_numbers(axes[:, k] * np.sign(axes[np.argmax(np.abs(axes[:, k])), k]), 2)})" for k in wide)


def _numbers(values: NDArray[np.float64], digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


def calibration_yaml(calibration: LidarImuCalibration, options: RecordingOptions, name: str) -> str:
    """The text of a file for `boxplus lio --config`; what is not determined is left out and says why.

    Args:
        calibration: of a recording.
        options: the recording was read with; kept, but for the part of the recording they choose.
        name: of the recording, for the first line.
    """
    found = calibration.estimate
    reading = options.model_dump(exclude_defaults=True, exclude={"start_s", "duration_s", "lidar_time_offset_s"})
    lines = [f"# Calibration of LiDAR and IMU from {name}: 'boxplus lio RECORDING --config FILE' uses it.", "recording:"]
    lines += [f"  {key}: {value}" for key, value in reading.items()]
    if calibration.determined("lidar_time_offset"):
        lines.append(f"  lidar_time_offset_s: {calibration.lidar_time_offset_s:.5f}  # ± {found.std[OFFSET]:.5f}")
    lines.append("odometry:")
    if calibration.has_mounting:
        rotation = float(np.degrees(np.sqrt(np.linalg.eigvalsh(found.covariance[THETA, THETA])[-1])))
        translation = float(np.sqrt(np.linalg.eigvalsh(found.covariance[ARM, ARM])[-1]))
        rows = ",\n    ".join("[" + ", ".join(f"{value:.8f}" for value in row) + "]" for row in found.T_imu_lidar)
        lines += [
            f"  T_imu_lidar: [\n    {rows}]",
            f"  extrinsic_rotation_sigma_deg: {rotation:.3f}",
            f"  extrinsic_translation_sigma: {translation:.4f}",
        ]
    lines += [f"# WARNING: {text}" for text in calibration.warnings]
    lines.append("# found with, and not settings:")
    for quantity in calibration.quantities:
        kept = "" if quantity.determined else f"; NOT DETERMINED: {quantity.advice}"
        lines.append(f"#   {quantity.name}: {quantity.value}, std {quantity.std}{kept}")
    return "\n".join(lines) + "\n"
