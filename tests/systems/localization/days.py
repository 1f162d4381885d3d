"""A map from a simulated drive, and drives of other days in it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.manifolds import se3
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.maps.tiles.voxel_thinning import first_per_voxel
from boxplus.simulation.drifting_drive import DriftConfig, DriftingDrive, simulate_drifting_drive
from boxplus.simulation.worlds.world import World
from boxplus.systems.localization.localizer import Localization, Localizer
from tests.systems.slam.drives import mapped_drive

INDOORS = DriftConfig(
    speed=1.5,
    step_m=0.5,
    corner_radius=0.8,
    max_range=40.0,
    height=1.6,
    channels=16,
    azimuth_steps=180,
    vertical_fov_deg=(-25.0, 25.0),
)


@dataclass(frozen=True, eq=False)
class KnownMap:
    """A `PlaceMap` of the scans of a drive at their true poses."""

    local_maps: list[LocalMap]
    points: NDArray[np.float32]
    voxel: float = 0.25

    def points_near(self, centre: ArrayLike, radius: float) -> NDArray[np.float32]:
        d = self.points - np.asarray(centre, dtype=np.float32)
        return np.asarray(self.points[np.einsum("na,na->n", d, d) <= radius**2])


def known_map(world: World, route: ArrayLike, config: DriftConfig, seed: int) -> KnownMap:
    found = mapped_drive(world, route, config, seed, LocalMapConfig(length=8.0))
    scans = [se3.act(T, scan.astype(np.float64)) for T, scan in zip(found.drive.T_world_body, found.drive.scans, strict=True)]
    points = np.concatenate(scans).astype(np.float32)
    places = [replace(m, T_odo_map=T) for m, T in zip(found.maps, found.T_true, strict=True)]
    return KnownMap(places, points[first_per_voxel(points, 0.25)])


def own_world(drive: DriftingDrive, yaw: float = 2.0) -> NDArray[np.float64]:
    """(K, 7) the odometry of a drive in a world of its own, which knows nothing of the map but where down is."""
    T_own = np.array([np.cos(0.5 * yaw), 0.0, 0.0, np.sin(0.5 * yaw), 30.0, -12.0, 4.0])
    return se3.compose(T_own, drive.T_odo_body)


def push_all(
    localizer: Localizer,
    drive: DriftingDrive,
    T_odo: NDArray[np.float64],
    begin_ns: int = 0,
    up_odo: ArrayLike | None = (0.0, 0.0, 1.0),
) -> list[Localization]:
    rows = zip(drive.time_ns.tolist(), T_odo, drive.scans, strict=True)
    return [localizer.push(begin_ns + time_ns, T, scan, up_odo) for time_ns, T, scan in rows]


def errors(found: list[Localization], drive: DriftingDrive) -> NDArray[np.float64]:
    """(k, 6) of the poses in the map that were given out."""
    xi = [
        se3.log(se3.compose(se3.inverse(truth), one.T_map_body))
        for one, truth in zip(found, drive.T_world_body, strict=True)
        if one.T_map_body is not None
    ]
    return np.array(xi).reshape(-1, 6)


def drive_of(world: World, route: ArrayLike, seed: int) -> DriftingDrive:
    return simulate_drifting_drive(world, route, INDOORS, seed)
