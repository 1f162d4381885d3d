"""Are all rows of an image taken at once? The time from the first to the last row, from corners and the gyroscope.

Row v of a rolling shutter is taken τ(v) = T (v / (H − 1) − ½) after the middle row. Directions of a corner in two images, turned
by the gyroscope from the instants of their rows to those of the middle rows, y_k = Exp(τ(v_k) ω_k) x_k with the angular velocity
ω_k at image k, lie in one plane with the translation (`known_turns.py`). T is where they fit best over all pairs of images. An
offset between the clocks of camera and gyroscope pulls T along. So both are fitted: the misfits are asked for at the offset that
is known and a standard deviation to either side, and T is that of the offset where they, and what is known, fit best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.model import CameraModel
from boxplus.recordings.cameras.info import CameraStream
from boxplus.recordings.info import Evidence
from boxplus.runs.inspection.cameras.known_turns import KnownTurn, best_of, optimum, weighed

Floats = NDArray[np.float64]

_SEARCH_S, _STEP_S = 0.04, 0.002
_SMALL_S = 0.004
_SURE = 5.0
# Corners that err alike, as neighbours do. With it, four rendered global shutters came to 0.0 to 0.4 deviations from none, four
# rolling ones to 1 to 3 from theirs (6 ms too short at most), EuRoC's MH_01, V1_03 and MH_05 to 3.7, 1 and 1 (1.1 ms at most).
# A focal length is pulled by what all corners share, and counts pairs of images.
_ALIKE = 4.0


@dataclass(frozen=True, slots=True)
class Readout:
    """Time from the first to the last row [s], negative from below, and its standard deviation."""

    time_s: float
    std_s: float


def estimate_readout(
    camera: CameraStream, turns: Sequence[KnownTurn], apart: Sequence[Sequence[KnownTurn]] = ()
) -> Readout | None:
    """The readout time, or None where there are too few corners, or nothing that turns.

    Args:
        turns: of the camera.
        apart: the same pairs where the camera's clock is a standard deviation before what is known of it, and behind it; none:
            it is exact.
    """
    if camera.model is None or not turns:
        return None
    times = np.arange(-_SEARCH_S, _SEARCH_S + 0.5 * _STEP_S, _STEP_S)
    costs = _costs(camera.model, turns, times)
    corners = float(np.mean([len(pair.pixels1) for pair in turns]))
    found = best_of(times, costs, max(corners / _ALIKE, 1.0))
    if found is None or not apart:
        return None if found is None else Readout(*found)
    before, behind = (_costs(camera.model, known, times) for known in apart)
    pulled = _pulled(times, np.stack([before, costs, behind]))
    return None if pulled is None else Readout(pulled.time_s, float(np.hypot(found[1], pulled.std_s)))


def _costs(model: CameraModel, turns: Sequence[KnownTurn], times: Floats) -> Floats:
    """Misfits (V, P) of all pairs for each time."""
    rays = [(model.bearings(pair.pixels1)[0], model.bearings(pair.pixels2)[0]) for pair in turns]
    return np.stack([pair.misfits(*x, times) for pair, x in zip(turns, rays, strict=True)], axis=1)


def _pulled(times: Floats, costs: Floats) -> Readout | None:
    """The time where the offset fits best, with the deviation that the offset leaves it; None where one lies at an end.

    Args:
        costs: (3, V, P) misfits with the offset a standard deviation before, as known, and behind.
    """
    totals = weighed(costs.reshape(-1, costs.shape[2])).reshape(costs.shape).sum(axis=2)
    best = totals.argmin(axis=1)
    if best.min() == 0 or best.max() == len(times) - 1:
        return None
    earlier, known, later = (optimum(times, total) for total in totals)
    # All corners of a pair share what its turn is off by: each pair counts once, beside what is known of the offset.
    misfit = totals.min(axis=1) + np.array([1.0, 0.0, 1.0])
    curvature = max(misfit[0] + misfit[2] - 2.0 * misfit[1], 2.0)
    offset = float(np.clip(0.5 * (misfit[0] - misfit[2]) / curvature, -2.0, 2.0))
    slope, bend = 0.5 * (later - earlier), 0.5 * (later + earlier) - known
    return Readout(known + offset * (slope + offset * bend), abs(slope) * float(np.sqrt(2.0 / curvature)))


def check_readout(camera: CameraStream, turns: Sequence[KnownTurn], apart: Sequence[Sequence[KnownTurn]] = ()) -> Evidence:
    """A finding about the shutter of this camera; arguments as of `estimate_readout`."""
    key = f"{camera.name}_shutter"
    found = estimate_readout(camera, turns, apart)
    if found is None:
        return Evidence(key, "unchecked", "ok", "the camera turns too little, or too few corners agree: rows are not compared")
    text = "time from the first to the last row by which corners agree best with the gyroscope, "
    text += f"standard deviation {found.std_s * 1e3:.1f} ms"
    value, stated = f"{found.time_s * 1e3:+.1f} ms", f"; {camera.readout_s * 1e3:+.1f} ms as stated" if camera.readout_s else ""
    text += stated
    if abs(found.time_s - camera.readout_s) > max(_SMALL_S, _SURE * found.std_s):
        text += ": check line_delay" if stated else ": a rolling shutter is suspected; state it as line_delay in the camchain"
        text += ", what takes rows for taken at other times than they were errs by what moves meanwhile"
        return Evidence(key, value, "warning", text)
    return Evidence(key, value, "ok", text)
