"""Where an alignment starts from: lights to try, and whether it ended away from all starts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.systems.direct_alignment.keyframe import Keyframe

Matrix = NDArray[np.float64]
_SAME_LIGHT = 0.1  # of the spread of grey values: nearer starts of gain and offset are one
_ELSEWHERE = 0.005  # of width + height, from all starts, from which on they are followed once more


def is_elsewhere(T_21: Matrix, starts: Matrix, keyframe: Keyframe) -> bool:
    """Whether the search ended where none of the starts had been, by pixels."""
    off = se3.log(se3.compose(np.tile(T_21, (len(starts), 1)), se3.inverse(starts)))
    turned, moved = np.linalg.norm(off[:, :3], axis=1), np.linalg.norm(off[:, 3:], axis=1) / keyframe.median_depth
    return float((turned + moved).min()) * keyframe.camera.fx > _ELSEWHERE * sum(keyframe.shape)


def lights_to_try(grey_1: Matrix, grey_2: NDArray[np.float32], before: tuple[float, float] | None) -> list[Matrix]:
    """Gain and offset of image 2: of the image before; none; what makes its median and its spread those of image 1.

    Those that are next to the same as an earlier one are left out.
    """
    median_1, median_2 = float(np.median(grey_1)), float(np.median(grey_2))
    spread_1, spread_2 = float(np.median(np.abs(grey_1 - median_1))), float(np.median(np.abs(grey_2 - median_2)))
    lights = [] if before is None else [np.array([np.exp(before[0]), before[1]])]
    lights.append(np.array([1.0, 0.0]))
    if spread_1 > 0.0 and spread_2 > 0.0:
        gain = spread_1 / spread_2
        lights.append(np.array([gain, median_1 - gain * median_2]))
    greys = np.array([median_2 - 2.0 * spread_2, median_2 + 2.0 * spread_2])
    distinct: list[Matrix] = []
    for light in lights:
        off = [float(np.abs((light[0] - other[0]) * greys + light[1] - other[1]).max()) for other in distinct]
        if not any(each < _SAME_LIGHT * spread_1 for each in off):
            distinct.append(light)
    return distinct
