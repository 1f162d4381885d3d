"""What loop closure leaves behind: where the local maps are, and every loop that was looked at."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from boxplus.manifolds import quaternion, se3
from boxplus.manifolds.upright_rotation import upright_rotation
from boxplus.systems.slam.correction import Correction
from boxplus.systems.slam.graph import MapGraph
from boxplus.systems.slam.loop import Floats, Loop


@dataclass(frozen=True, slots=True, eq=False)
class SlamOutcome:
    """The end of `Slam`, without its local maps.

    Attributes:
        correction: poses of the local maps before and after.
        loops: every loop that was looked at, with what spoke for and against it.
        doubt: a sentence where local maps or loops contradict the odometry, see `Slam.doubt`.
        drift_scale: factor of the odometry's covariances in the graph.
        T_world_map: (7,) the frame of `correction.T_map` in that of trajectory and map: another one where the map was laid onto
            the Earth, or set upright.
    """

    correction: Correction
    loops: list[Loop]
    doubt: str | None
    drift_scale: float = 1.0
    T_world_map: Floats = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]))

    @property
    def accepted(self) -> list[Loop]:
        """The loops that the result rests on."""
        return [loop for loop in self.loops if loop.is_accepted]

    @property
    def placed(self) -> Correction:
        """The correction to the frame of trajectory and map."""
        return replace(self.correction, T_map=se3.compose(self.T_world_map, self.correction.T_map))

    def upright(self, number: int) -> SlamOutcome:
        """The same with trajectory and map turned about their origin, the shortest way, until one of the local maps is level.

        For an odometry without an IMU, whose world stands as its LiDAR did.

        Args:
            number: of a map whose z axis is up.
        """
        up = quaternion.to_matrix(self.correction.T_map[number, :4])[:, 2]
        return replace(self, T_world_map=np.concatenate([quaternion.from_matrix(upright_rotation(up)), np.zeros(3)]))

    def laid(self, T_map: Floats, T_enu_map: Floats) -> SlamOutcome:
        """The same with local maps (n, 7) where positions by satellite put them, and the map's frame in ENU (7,)."""
        return replace(self, correction=replace(self.correction, T_map=T_map), T_world_map=np.asarray(T_enu_map))

    def graph(self, gravity_sigma: float) -> MapGraph:
        """Local maps, odometry and the loops believed now: what positions by satellite are added to.

        Args:
            gravity_sigma: as in `SlamConfig`.
        """
        own, weighed = self.correction, min(self.drift_scale, 1.0)
        return MapGraph(own.time_ns, own.T_odo, own.T_map, weighed * own.step_covariance, self.accepted, gravity_sigma)
