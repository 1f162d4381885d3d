"""Is the focal length right? By how much a camera seems to turn, and by how much the gyroscope says that it does.

With a focal length that is stated 1/(1 + ε) times as long as it is, corners lie 1 + ε times as far from the principal point as
they should, and a turn about an axis in the image looks 1 + ε times as large; one about the optical axis looks the same. ε is
where the directions of corners, drawn to the principal point by it, fit best to the gyroscope's turns (`known_turns.py`). Their
noise is one of pixels: directions drawn together have less of it, and would fit the better the longer the focal length, so that
misfits are counted in pixels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from boxplus.recordings.cameras.info import CameraStream
from boxplus.recordings.info import Evidence
from boxplus.runs.inspection.cameras.known_turns import FEWEST_PAIRS, KnownTurn, best_of, end_behind

_SHORTEST, _LONGEST, _STEP = -0.28, 0.36, 0.04
_FEWEST_CORNERS = 20
_SMALL = 0.03
_SURE = 5.0


def estimate_focal_length(camera: CameraStream, turns: Sequence[KnownTurn]) -> tuple[float, float] | None:
    """ε and its standard deviation; None where there are too few corners, or nothing that turns.

    Where ε is beyond what is looked at, that end of it, and an infinite standard deviation.
    """
    if camera.model is None or not turns:
        return None
    model, centre = camera.model, np.array([camera.model.cx, camera.model.cy])
    # Corners that the shortest focal length puts beyond the lens would be missing where it is tried, and nowhere else.
    pairs = []
    for turn in turns:
        first, second = (model.bearings(centre + (p - centre) / (1.0 + _SHORTEST))[1] for p in (turn.pixels1, turn.pixels2))
        if np.count_nonzero(first & second) >= _FEWEST_CORNERS:
            pairs.append(turn.only(first & second))
    if len(pairs) < FEWEST_PAIRS:
        return None
    pixels = np.concatenate([p for pair in pairs for p in (pair.pixels1, pair.pixels2)]) - centre
    ends = np.cumsum([len(pair.pixels1) for pair in pairs for _ in range(2)])[:-1]
    longer, costs = np.arange(_SHORTEST, _LONGEST + 0.5 * _STEP, _STEP), []
    stated = np.array([camera.readout_s])
    for epsilon in longer:
        rays = np.split(model.bearings(centre + pixels / (1.0 + epsilon))[0], ends)
        costs.append([float(pair.misfits(rays[2 * k], rays[2 * k + 1], stated)[0]) for k, pair in enumerate(pairs)])
    in_pixels = np.array(costs) * (1.0 + longer[:, None]) ** 2
    if (end := end_behind(longer, in_pixels)) is not None:
        return end, np.inf
    return best_of(longer, in_pixels)


def check_focal_length(camera: CameraStream, turns: Sequence[KnownTurn]) -> Evidence:
    """A finding about the focal length of this camera."""
    key, found = f"{camera.name}_focal_length", estimate_focal_length(camera, turns)
    if found is None:
        text = "the camera turns too little, or too few corners agree: its focal length is not compared with the gyroscope"
        return Evidence(key, "unchecked", "ok", text)
    epsilon, sigma = found
    text = "share by which the focal length would have to be longer for corners to agree best with the gyroscope"
    advice = (
        ": check focal length and distortion, whether images were scaled or cropped since the camera was calibrated, and the "
        "scale of the gyroscope"
    )
    if np.isinf(sigma):
        beyond = f"beyond what is looked at, {100.0 * _SHORTEST:+.0f} to {100.0 * _LONGEST:+.0f} %"
        return Evidence(key, f"beyond {100.0 * epsilon:+.0f} %", "warning", f"{text}, {beyond}{advice}")
    value, text = f"{100.0 * epsilon:+.1f} %", f"{text}, standard deviation {100.0 * sigma:.1f} %"
    if abs(epsilon) <= max(_SMALL, _SURE * sigma):
        return Evidence(key, value, "ok", text)
    return Evidence(key, value, "warning", text + advice)
