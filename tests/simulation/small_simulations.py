"""Simulations small enough for kernels that run as plain Python."""

from __future__ import annotations

from dataclasses import replace

from boxplus.simulation import Simulation, SpinningLidar, make_scenario
from boxplus.simulation.lidar import RosetteLidar


def small_lidar(lidar: SpinningLidar | RosetteLidar) -> SpinningLidar | RosetteLidar:
    if isinstance(lidar, SpinningLidar):
        return lidar.model_copy(update={"channels": 4, "azimuth_steps": 24})
    return lidar.model_copy(update={"points_per_scan": 96})


def small(name: str, seed: int = 0, duration_s: float | None = 1.5, **changes: object) -> Simulation:
    """A built-in scenario with about a hundred rays a scan."""
    scenario = make_scenario(name, seed)
    return Simulation(replace(scenario, **{"lidar": small_lidar(scenario.lidar), **changes}), seed, duration_s)
