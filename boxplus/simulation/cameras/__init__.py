"""Recordings of cameras that are computed: textured worlds, lenses, exposure, noise, shutters, faults, and the exact truth."""

from boxplus.simulation.cameras.faults import CAMERA_FAULTS, CameraFault, make_camera_fault
from boxplus.simulation.cameras.recorded import as_camera_recording
from boxplus.simulation.cameras.recording_writer import write_camera_recording
from boxplus.simulation.cameras.scenarios import CAMERA_SCENARIOS, CameraScenario, Light, make_camera_scenario
from boxplus.simulation.cameras.sensor import CameraRig, CameraSensor, Exposure, Lens, MountedCamera, camera_mounting, make_rig
from boxplus.simulation.cameras.simulation import CameraSimulation, CameraSimulationConfig, simulate_cameras

__all__ = [
    "CAMERA_FAULTS",
    "CAMERA_SCENARIOS",
    "CameraFault",
    "CameraRig",
    "CameraScenario",
    "CameraSensor",
    "CameraSimulation",
    "CameraSimulationConfig",
    "Exposure",
    "Lens",
    "Light",
    "MountedCamera",
    "as_camera_recording",
    "camera_mounting",
    "make_camera_fault",
    "make_camera_scenario",
    "make_rig",
    "simulate_cameras",
    "write_camera_recording",
]
