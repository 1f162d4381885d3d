"""Simulated drives as local maps, with the truth beside them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.manifolds import se3
from boxplus.maps.local_maps.builder import LocalMapBuilder
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.simulation.drifting_drive import DriftConfig, DriftingDrive, simulate_drifting_drive
from boxplus.simulation.worlds.world import World
from boxplus.systems.slam.loop import Loop


@dataclass(frozen=True, slots=True, eq=False)
class MappedDrive:
    drive: DriftingDrive
    maps: list[LocalMap]
    T_true: NDArray[np.float64]

    def error(self, loop: Loop) -> NDArray[np.float64]:
        """(6,) of a loop's measurement."""
        T = se3.compose(se3.inverse(self.T_true[loop.place]), self.T_true[loop.query])
        return se3.log(se3.compose(se3.inverse(T), loop.T_place_query))

    def distance(self, loop: Loop) -> float:
        return float(np.linalg.norm(self.T_true[loop.place][4:] - self.T_true[loop.query][4:]))


def mapped_drive(
    world: World, route: ArrayLike, config: DriftConfig | None = None, seed: int = 0, maps: LocalMapConfig | None = None
) -> MappedDrive:
    drive = simulate_drifting_drive(world, route, config, seed)
    # The covariance of the drift is what the builder adds by itself.
    builder, made, zero = LocalMapBuilder(maps), [], np.zeros((6, 6))
    for time_ns, T, scan in zip(drive.time_ns.tolist(), drive.T_odo_body, drive.scans, strict=True):
        made += builder.push(time_ns, T, zero, scan)
    made += builder.flush()
    at = np.searchsorted(drive.time_ns, [m.time_ns for m in made])
    T_body_map = se3.compose(se3.inverse(drive.T_odo_body[at]), np.stack([m.T_odo_map for m in made]))
    return MappedDrive(drive, made, se3.compose(drive.T_world_body[at], T_body_map))


def ate(p: NDArray[np.float64], q: NDArray[np.float64]) -> float:
    """Root mean square distance of positions (n, 3) after the best rigid motion [m]."""
    a, b = p - p.mean(axis=0), q - q.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = (U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt).T
    return float(np.sqrt(((a @ R.T - b) ** 2).sum(axis=1).mean()))
