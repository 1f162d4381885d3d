"""What refinement estimates."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion, se3
from boxplus.systems.refinement.outside.evidence import Receiver

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class RefinedState:
    """Everything that is estimated, for N scans.

    Attributes:
        T_world_imu: (N, 7); velocity_bias: (N, 9), as in `FinishedRun`.
        gravity_direction: (3,) unit vector, down.
        T_imu_lidar: (7,).
        time_offset_s: clock of the IMU minus that of the LiDAR.
        receiver: of positions by satellite; None without.
    """

    T_world_imu: Floats
    velocity_bias: Floats
    gravity_direction: Floats
    T_imu_lidar: Floats
    time_offset_s: float = 0.0
    receiver: Receiver | None = None

    def moved(self, T: Floats) -> RefinedState:
        """The same in another world, T = T_new_old (7,)."""
        R = quaternion.to_matrix(T[:4])
        receiver = self.receiver
        if receiver is not None:
            receiver = replace(receiver, T_enu_world=se3.compose(receiver.T_enu_world, se3.inverse(T)))
        return replace(
            self,
            T_world_imu=se3.compose(np.broadcast_to(T, self.T_world_imu.shape), self.T_world_imu),
            velocity_bias=np.hstack([self.velocity_bias[:, :3] @ R.T, self.velocity_bias[:, 3:]]),
            gravity_direction=R @ self.gravity_direction,
            receiver=receiver,
        )
