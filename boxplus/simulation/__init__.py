"""Recordings that are computed: worlds, smooth motions, LiDAR and IMU, with exact ground truth."""

from boxplus.simulation.imu import ImuModel
from boxplus.simulation.lidar import RosetteLidar, SpinningLidar
from boxplus.simulation.scenarios import SCENARIOS, Scenario, make_scenario, mounting
from boxplus.simulation.simulation import Simulation, SimulationConfig, simulate
from boxplus.simulation.spline import Motion, SplineTrajectory
from boxplus.simulation.world import World, box, cylinder, rectangle, sphere

__all__ = [
    "SCENARIOS",
    "ImuModel",
    "Motion",
    "RosetteLidar",
    "Scenario",
    "Simulation",
    "SimulationConfig",
    "SpinningLidar",
    "SplineTrajectory",
    "World",
    "box",
    "cylinder",
    "make_scenario",
    "mounting",
    "rectangle",
    "simulate",
    "sphere",
]
