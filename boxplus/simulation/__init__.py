"""Recordings that are computed: worlds, smooth motions, LiDAR and IMU, with exact ground truth."""

from boxplus.simulation.faults import FAULTS, Fault, make_fault
from boxplus.simulation.imu import ImuModel
from boxplus.simulation.lidar import OmniLidar, RosetteLidar, SpinningLidar
from boxplus.simulation.live_recording import as_recording
from boxplus.simulation.motions.spline import Motion, SplineTrajectory, Trajectory
from boxplus.simulation.motions.thrust import ThrustTrajectory
from boxplus.simulation.recording_writer import write_recording
from boxplus.simulation.scenarios import SCENARIOS, Scenario, make_scenario, mounting
from boxplus.simulation.several_lidars import MountedLidar
from boxplus.simulation.simulation import Simulation, SimulationConfig, simulate
from boxplus.simulation.worlds.world import World, box, cylinder, rectangle, sphere

__all__ = [
    "FAULTS",
    "SCENARIOS",
    "Fault",
    "ImuModel",
    "Motion",
    "MountedLidar",
    "OmniLidar",
    "RosetteLidar",
    "Scenario",
    "Simulation",
    "SimulationConfig",
    "SpinningLidar",
    "SplineTrajectory",
    "ThrustTrajectory",
    "Trajectory",
    "World",
    "as_recording",
    "box",
    "cylinder",
    "make_fault",
    "make_scenario",
    "mounting",
    "rectangle",
    "simulate",
    "sphere",
    "write_recording",
]
