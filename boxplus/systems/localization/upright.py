"""Frames whose z is up."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion

Floats = NDArray[np.float64]


def up_in_body(T_odo_body: Floats, up_odo: Floats) -> Floats:
    """(3,) unit vector against gravity in the body's frame, of up (3,) in the odometry's world and the body's pose (7,) in it.

    Example:
        >>> import numpy as np
        >>> on_its_side = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0, 0.0, 0.0, 0.0])
        >>> up_in_body(on_its_side, np.array([0.0, 0.0, 9.8])).round(3) + 0.0
        array([0., 1., 0.])
    """
    return np.asarray(quaternion.to_matrix(T_odo_body[:4]).T @ (up_odo / np.linalg.norm(up_odo)))


def level(up_body: Floats) -> Floats:
    """(3, 3) from the body to a frame whose z is up, a unit vector (3,) in the body's frame, whatever its x.

    Example:
        >>> import numpy as np
        >>> level(np.array([0.0, 1.0, 0.0])) @ np.array([0.0, 1.0, 0.0])
        array([0., 0., 1.])
    """
    x = np.eye(3)[int(np.argmin(np.abs(up_body)))]
    x = x - up_body * (up_body @ x)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up_body, x), up_body])
