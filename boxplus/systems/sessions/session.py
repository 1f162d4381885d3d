"""One session: the local maps of one run, placed by its own loops, and what is known between any two of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.manifolds import quaternion
from boxplus.manifolds.se3 import SE3
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.maps.local_maps.local_map import LocalMap, drift_covariance
from boxplus.systems.slam.loop import Floats
from boxplus.systems.slam.odometry_chain import OdometryChain


@dataclass(frozen=True, slots=True, eq=False)
class OwnLoop:
    """A loop that the session closed: local map `query` against `place`, with the information (6, 6) of T_place_query."""

    query: int
    place: int
    information: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """What one run knows of where it was.

    Attributes:
        name: for messages.
        maps: n local maps in the order of time, numbered 0, 1, …
        T_session_map: (n, 7) where the session's own loops put them, in its own frame; the odometry's poses where it has none.
        loops: those loops. They hold the session together when encounters pull at it; without them it is softer.
    """

    name: str
    maps: Sequence[LocalMap]
    T_session_map: Floats
    loops: Sequence[OwnLoop] = ()

    @classmethod
    def of(
        cls, name: str, maps: Sequence[LocalMap], T_session_map: NDArray[np.float64] | None = None, loops: Sequence[OwnLoop] = ()
    ) -> Session:
        """Checked; see the attributes.

        Raises:
            InputError: no local map, numbers that do not count up, poses or loops of other maps.

        Example: docs/sessions.md.
        """
        if not maps or [m.number for m in maps] != list(range(len(maps))):
            raise InputError(
                f"local maps 0, 1, … of session {name}",
                f"{[m.number for m in maps][:5]}",
                "give all maps of one builder in order",
            )
        T = np.stack([m.T_odo_map for m in maps]) if T_session_map is None else SE3.check("T_session_map", T_session_map)
        if len(T) != len(maps):
            raise InputError(f"{len(maps)} poses, one for each local map", f"{len(T)}", "give where each of them is")
        for loop in loops:
            if not 0 <= loop.place < loop.query < len(maps):
                raise InputError(f"loops between local maps of {name}", f"({loop.query}, {loop.place})", "see its loops.csv")
        # The first map has none before it that its drift could be told from; the second one's stands for it.
        first = replace(maps[0], covariance=maps[1].covariance) if len(maps) > 1 else maps[0]
        return cls(name, (first, *maps[1:]), T, tuple(loops))

    @property
    def up(self) -> Floats:
        """(3,) against gravity in the session's frame: the mean of what its maps were levelled by."""
        mean = quaternion.to_matrix(self.T_session_map[:, :4])[:, :, 2].mean(axis=0)
        return np.asarray(mean / np.linalg.norm(mean))

    @property
    def start_covariance(self) -> Floats:
        """(6, 6) of the first map in the session's frame, on its right: what the odometry drifts by on the way there.

        The frame is where the session began; what is known of it goes through the first map. Zero where that stands in it. With
        one map nothing tells how the odometry drifts: what the settings add to every way by themselves is counted.
        """
        first_m = self.maps[0].path_m
        if first_m <= 0.0:
            return np.zeros((6, 6))
        if len(self.maps) == 1:
            settings = LocalMapConfig()
            return drift_covariance(first_m, settings.drift_rotation, settings.drift_position)
        way_m = self.maps[1].path_m - first_m
        return np.asarray(self.maps[0].covariance * (first_m / way_m)) if way_m > 0.0 else np.zeros((6, 6))

    def chain(self) -> OdometryChain:
        """What is known between any two maps: poses after loops, covariances of the odometry, which loops only make smaller."""
        chain = OdometryChain()
        for local_map, T in zip(self.maps, self.T_session_map, strict=True):
            chain.add(replace(local_map, T_odo_map=T))
        return chain
