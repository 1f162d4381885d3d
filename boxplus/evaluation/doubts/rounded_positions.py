"""Were positions rounded? Written with six digits, as programs do by themselves, those of a map projection are whole metres."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from boxplus.formats.trajectory import Trajectory

_UNITS_M = (100.0, 10.0, 1.0, 0.1, 0.01, 0.001)
_EXACT = 1e-6  # of the unit, by which multiples of it are off
_OF_ERROR, _MOST = 0.3, 1.2  # times the whole error, that rounding makes at least to be told, and at most to have made it
_LEAST = 30  # poses
_EVEN = 0.9  # share of the steps, of those along an axis, that are as long as one beside them where they were driven so


def rounded_position_doubts(estimate: Trajectory, ground_truth: Trajectory, rmse: float) -> Iterator[str]:
    """A sentence on a file whose positions are all multiples of a unit, where rounding to it makes much of the error.

    Args:
        estimate, ground_truth: as they were read. rmse: of the compared positions [m].
    """
    for poses, name in ((estimate, "estimate"), (ground_truth, "ground truth")):
        if len(poses) < _LEAST:
            continue
        units = {axis: unit for axis, values in zip("xyz", poses.p.T, strict=True) if (unit := _unit(values)) is not None}
        makes = float(np.sqrt(sum(unit**2 for unit in units.values()) / 12.0))
        if len(units) < 2 or not _OF_ERROR * rmse < makes < _MOST * rmse:  # one alone may be what was driven
            continue
        told = ", ".join(f"{axis} of {unit:g} m" for axis, unit in units.items())
        yield (
            f"all positions of the {name} are multiples, {told}: if they were rounded to that, it makes an error of about "
            f"{makes:.3g} m of the {rmse:.3g} m; write them with more digits"
        )


def _unit(values: NDArray[np.float64]) -> float | None:
    """The largest unit of which all values (n,) are multiples; None where they are of none, all the same, or go on evenly.

    Rounding makes even steps uneven, or, of short ones, single steps of a unit.
    """
    if not np.ptp(values) > 0.0:
        return None
    unit = next((unit for unit in _UNITS_M if (np.abs(values / unit - np.round(values / unit)) < _EXACT).all()), None)
    if unit is None:
        return None
    steps = np.round(np.diff(values) / unit)
    alike = steps[1:] == steps[:-1]
    is_even = np.append(alike, False) | np.append(False, alike)
    return None if is_even[steps != 0.0].mean() > _EVEN else unit
