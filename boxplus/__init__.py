"""boxplus: state estimation on manifolds for SLAM.

The public names below are imported when they are first used, so that `import boxplus` itself is quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from boxplus.errors import AmbiguityError, BoxplusError, InputError, OutputError, RecordingError
    from boxplus.evaluation.evaluation import Evaluation, evaluate
    from boxplus.filtering.nav_state import NavState
    from boxplus.formats.trajectory import Trajectory, read_trajectory
    from boxplus.maps.ikd_tree import IkdTree
    from boxplus.recordings.doctor import Diagnosis, diagnose
    from boxplus.recordings.options import RecordingOptions
    from boxplus.recordings.recording import Recording, open_recording
    from boxplus.sensors.imu import ImuSamples
    from boxplus.sensors.scan import Scan
    from boxplus.simulation.simulation import Simulation, simulate
    from boxplus.systems.estimate import Estimate
    from boxplus.systems.lidar_inertial_odometry import LidarInertialOdometry
    from boxplus.systems.lio_config import LioConfig

__version__ = "0.1.0"

_HOME = {
    "AmbiguityError": "errors",
    "BoxplusError": "errors",
    "Diagnosis": "recordings.doctor",
    "Estimate": "systems.estimate",
    "Evaluation": "evaluation.evaluation",
    "IkdTree": "maps.ikd_tree",
    "ImuSamples": "sensors.imu",
    "InputError": "errors",
    "LidarInertialOdometry": "systems.lidar_inertial_odometry",
    "LioConfig": "systems.lio_config",
    "NavState": "filtering.nav_state",
    "OutputError": "errors",
    "Recording": "recordings.recording",
    "RecordingError": "errors",
    "RecordingOptions": "recordings.options",
    "Scan": "sensors.scan",
    "Simulation": "simulation.simulation",
    "Trajectory": "formats.trajectory",
    "diagnose": "recordings.doctor",
    "evaluate": "evaluation.evaluation",
    "open_recording": "recordings.recording",
    "read_trajectory": "formats.trajectory",
    "simulate": "simulation.simulation",
}

__all__ = [
    "AmbiguityError",
    "BoxplusError",
    "Diagnosis",
    "Estimate",
    "Evaluation",
    "IkdTree",
    "ImuSamples",
    "InputError",
    "LidarInertialOdometry",
    "LioConfig",
    "NavState",
    "OutputError",
    "Recording",
    "RecordingError",
    "RecordingOptions",
    "Scan",
    "Simulation",
    "Trajectory",
    "__version__",
    "diagnose",
    "evaluate",
    "open_recording",
    "read_trajectory",
    "simulate",
]


def __getattr__(name: str) -> object:
    """Import a public name from its home (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
