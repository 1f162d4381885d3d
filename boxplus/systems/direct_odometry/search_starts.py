"""From where a frame is aligned to a keyframe: where the camera should be, and what is tried when that fails."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import se3

Matrix = NDArray[np.float64]

_TURN_DEG = 3.0


def starts_around(T_last: Matrix, T_predicted: Matrix, T_world_keyframe: Matrix, is_hard: bool) -> Matrix:
    """Starts T_camera_keyframe (n, 7): the motion going on, and standstill; then half and double of it, and small turns."""
    poses = [T_predicted, T_last]
    if is_hard:
        step = se3.log(se3.compose(se3.inverse(T_last), T_predicted))
        poses += [se3.compose(T_last, se3.exp(share * step)) for share in (0.5, 2.0)]
        turns = np.radians(_TURN_DEG) * np.vstack([np.eye(3), -np.eye(3)])
        poses += [se3.compose(T_predicted, se3.exp(np.concatenate([turn, np.zeros(3)]))) for turn in turns]
    return np.array([se3.compose(se3.inverse(pose), T_world_keyframe) for pose in poses])
