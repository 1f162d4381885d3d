"""Small calibration sessions."""

from __future__ import annotations

from typing import Any

import numpy as np

from boxplus.cameras.model import CameraModel
from boxplus.manifolds import se3
from boxplus.simulation.cameras.target_session import TargetSession, simulate_target_session
from boxplus.systems.camera_calibration.lens import LensKind, lens
from boxplus.systems.camera_calibration.target import AprilGrid

GRID = AprilGrid(rows=4, columns=4, tag_size=0.1, spacing=0.3)
SIZE = (752, 480)
LENSES: dict[LensKind, CameraModel] = {
    "pinhole-radtan": lens("pinhole-radtan", np.array([458.6, 457.3, 367.2, 248.4, -0.283, 0.074, 2e-4, 1.7e-5])),
    "pinhole-equi": lens("pinhole-equi", np.array([190.0, 189.5, 370.2, 238.4, 0.003, 0.0007, -0.002, 0.0002])),
    "ds-none": lens("ds-none", np.array([160.0, 159.5, 370.2, 238.4, -0.2, 0.59])),
}
RADTAN = LENSES["pinhole-radtan"]
T_IMU_CAM0 = se3.exp(np.array([0.7, -0.5, 1.5, 0.05, -0.03, 0.08]))
T_CAM0_CAM1 = se3.exp(np.array([0.01, -0.02, 0.005, 0.11, 0.0, 0.002]))
MOUNTINGS = np.stack([T_IMU_CAM0, se3.compose(T_IMU_CAM0, T_CAM0_CAM1)])


def session(*models: CameraModel, **settings: Any) -> TargetSession:
    """A session of these cameras, the first two mountings."""
    return simulate_target_session(models, MOUNTINGS[: len(models)], SIZE, GRID, **{"frames": 14, **settings})
