"""Simulated sessions whose frames begin where their first scan was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.manifolds import se3
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.simulation.drifting_drive import DriftConfig
from boxplus.simulation.worlds.world import World
from boxplus.systems.sessions.session import OwnLoop, Session
from boxplus.systems.slam.loop import Loop
from tests.systems.slam.drives import MappedDrive, mapped_drive


def driven(
    name: str, world: World, route: ArrayLike, config: DriftConfig, seed: int, maps: LocalMapConfig | None = None
) -> tuple[Session, MappedDrive]:
    """A session, and the drive with the truth."""
    drive = mapped_drive(world, route, config, seed, maps)
    start = se3.inverse(drive.drive.T_world_body[0])
    return Session.of(name, [replace(m, T_odo_map=se3.compose(start, m.T_odo_map)) for m in drive.maps]), drive


def drawn(name: str, T: NDArray[np.float64], loops: list[OwnLoop] = []) -> Session:  # noqa: B006
    """A session of poses (n, 7) alone: local maps without points, a metre of drift in a hundred steps."""
    covariance = np.diag(np.repeat([1e-6, 1e-4], 3))
    points = np.zeros((0, 3), np.float32)
    maps = [LocalMap(k, k, k, k, pose, covariance, 20.0 * k, points, 1) for k, pose in enumerate(T)]
    return Session.of(name, maps, T, loops)


def measured(place: int, query: int, T: NDArray[np.float64], sigma: float = 0.02) -> Loop:
    """A loop that passed every test."""
    covariance = np.diag(np.repeat([(0.05 * sigma) ** 2, sigma**2], 3))
    return Loop(query, place, "appearance", 20, T, T, covariance, np.linalg.inv(covariance), measured=6, weight=1.0)
