"""Are all rows of an image taken at once? The time from the first to the last row, from corners and the gyroscope.

Row v of a rolling shutter is taken τ(v) = T (v / (H − 1) − ½) after the middle row. Directions of a corner in two images, turned
by the gyroscope from the instants of their rows to those of the middle rows, y_k = Exp(τ(v_k) ω_k) x_k with the angular velocity
ω_k at image k, lie in one plane with the translation (`known_turns.py`). T is where they fit best over all pairs of images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from boxplus.recordings.cameras.info import CameraStream
from boxplus.recordings.info import Evidence
from boxplus.runs.inspection.cameras.known_turns import KnownTurn, best_of

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


def estimate_readout(camera: CameraStream, turns: Sequence[KnownTurn]) -> Readout | None:
    """The readout time, or None where there are too few corners, or nothing that turns."""
    if camera.model is None or not turns:
        return None
    times = np.arange(-_SEARCH_S, _SEARCH_S + 0.5 * _STEP_S, _STEP_S)
    rays = [(camera.model.bearings(pair.pixels1)[0], camera.model.bearings(pair.pixels2)[0]) for pair in turns]
    costs = np.array([[pair.misfit(*x, time) for pair, x in zip(turns, rays, strict=True)] for time in times])
    corners = float(np.mean([len(pair.pixels1) for pair in turns]))
    found = best_of(times, costs, max(corners / _ALIKE, 1.0))
    return None if found is None else Readout(*found)


def check_readout(camera: CameraStream, turns: Sequence[KnownTurn]) -> Evidence:
    """A finding about the shutter of this camera."""
    key = f"{camera.name}_shutter"
    found = estimate_readout(camera, turns)
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
