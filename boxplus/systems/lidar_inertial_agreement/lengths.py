"""Lengths by what the accelerations say: from one stretch, from several together, and taken for feet."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from boxplus.systems.lidar_inertial_agreement.agreement import FEET_PER_METRE
from boxplus.systems.lidar_inertial_agreement.finding import Finding
from boxplus.systems.lidar_inertial_agreement.translation import TranslationFit

_SLOPE_OFF = 0.07
_METRES = 0.15  # a scale is 1, where 3.28 is the other choice
_SLOPE_WELL_KNOWN = 0.033
_DEVIATIONS, _DEVIATIONS_OF_MANY = 3.0, 2.7
FEWEST_SLOPES = 2
_EXPLAINED = 0.8
SLOPE_FLOOR = 0.02  # of any slope: what no fit knows
SLOPE_KNOWN = 0.3
MISFIT_M = 0.03


def feet_finding(in_feet: TranslationFit) -> Finding | None:
    """Lengths that only agree in feet: in metres no path is found that could have a scale."""
    std = float(np.hypot(in_feet.slope_std, SLOPE_FLOOR))
    if in_feet.explained < _EXPLAINED or in_feet.sigma > MISFIT_M or abs(in_feet.slope - 1.0) + std > _METRES:
        return None
    return Finding(
        "length_scale",
        f"taken for feet the LiDAR's points accelerate {in_feet.slope:.2f} ± {std:.2f} times as the accelerometer does (1 is "
        "right), and taken for metres they lie on no planes: the points are in feet (a metre is 3.28 of them)",
    )


def lengths_of_many(slopes: Sequence[tuple[float, float]]) -> Finding | None:
    """What several stretches say of the lengths, each by `slope_of`, where none of them decides alone."""
    return slope_finding(*_mean(slopes), deviations=_DEVIATIONS_OF_MANY) if len(slopes) >= FEWEST_SLOPES else None


def least_factor(slopes: Sequence[tuple[float, float]]) -> tuple[float, float, float]:
    """The slope of these stretches, its standard deviation, and how far it is off at least where it is named; inf where never."""
    together = len(slopes) >= FEWEST_SLOPES
    slope, std = _mean(slopes) if together else slopes[0]
    return slope, std, _least(std, _DEVIATIONS_OF_MANY if together else _DEVIATIONS) if std <= SLOPE_KNOWN else np.inf


def lengths_known(slopes: Sequence[tuple[float, float]]) -> bool:
    """Whether lengths that are wrong by a tenth would have shown in these stretches."""
    return len(slopes) >= FEWEST_SLOPES and _mean(slopes)[1] < _SLOPE_WELL_KNOWN


def _mean(slopes: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """The weighted mean and its standard deviation, widened where the stretches differ by more than theirs."""
    slope, std = np.array(slopes).T
    information = float((1.0 / std**2).sum())
    mean = float((slope / std**2).sum()) / information
    scatter = float((((slope - mean) / std) ** 2).sum()) / (len(slope) - 1)
    return mean, float(np.hypot(np.sqrt(max(scatter, 1.0) / information), SLOPE_FLOOR))


def _least(std: float, deviations: float) -> float:
    return max(_SLOPE_OFF, deviations * std)


def slope_finding(slope: float, std: float, deviations: float = _DEVIATIONS) -> Finding | None:
    """Lengths that are wrong by the slope of the accelerations and its standard deviation; None where they may be right."""
    if abs(slope - 1.0) < _least(std, deviations) or std > SLOPE_KNOWN or slope < 0.0:
        return None
    name = " (feet are 3.28)" if abs(slope / FEET_PER_METRE - 1.0) < 0.25 else ""
    return Finding(
        "length_scale",
        f"the LiDAR's accelerations are {slope:.2f} ± {std:.2f} times those of the accelerometer (1 is right): the points "
        f"are not in metres{name}, or the accelerometer's scale is wrong",
    )
