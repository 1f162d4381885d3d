"""boxplus: state estimation on manifolds for SLAM.

The public names below are imported when they are first used, so that `import boxplus` itself is quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from boxplus import formats, residuals
    from boxplus.cameras.distortion import Radial, RadialTangential
    from boxplus.cameras.pinhole import Pinhole
    from boxplus.errors import (
        AmbiguityError,
        BoxplusError,
        InputError,
        NotFiniteError,
        OutputError,
        RecordingError,
        SingularProblemError,
    )
    from boxplus.evaluation.evaluation import Evaluation, evaluate
    from boxplus.filtering.nav_state import NavState
    from boxplus.formats.pose_graph import PoseGraph
    from boxplus.formats.pose_graph_file import read_pose_graph
    from boxplus.formats.reconstruction import read_reconstruction
    from boxplus.formats.trajectory import Trajectory, read_trajectory
    from boxplus.manifolds.euclidean import Euclidean
    from boxplus.manifolds.lines import Line3D
    from boxplus.manifolds.manifold import Manifold
    from boxplus.manifolds.product import Product
    from boxplus.manifolds.quaternion import UnitQuaternion
    from boxplus.manifolds.se2 import SE2
    from boxplus.manifolds.se3 import SE3, SE3Left
    from boxplus.manifolds.so3 import SO3
    from boxplus.maps.ikd_tree import IkdTree
    from boxplus.optimization import losses
    from boxplus.optimization.graduated import graduate
    from boxplus.optimization.jacobian_check import check_jacobian
    from boxplus.optimization.marginalization import marginalize
    from boxplus.optimization.problem import Problem
    from boxplus.optimization.solution import Solution
    from boxplus.optimization.solver_options import SolverOptions
    from boxplus.recordings.doctor import Diagnosis, diagnose
    from boxplus.recordings.options import RecordingOptions
    from boxplus.recordings.recording import Recording, open_recording
    from boxplus.sensors.image import Image
    from boxplus.sensors.imu import ImuSamples
    from boxplus.sensors.scan import Scan
    from boxplus.simulation.simulation import Simulation, simulate
    from boxplus.sparse.cholesky import SparseCholesky
    from boxplus.systems.bundle_adjustment import BundleAdjustmentConfig, adjust_bundle
    from boxplus.systems.direct_alignment import Alignment, align_rgbd
    from boxplus.systems.estimate import Estimate
    from boxplus.systems.lidar_inertial_odometry import LidarInertialOdometry
    from boxplus.systems.lio_config import LioConfig
    from boxplus.systems.pose_graph import PoseGraphConfig, optimize_pose_graph

__version__ = "0.1.0"

_HOME = {
    "Alignment": "systems.direct_alignment",
    "AmbiguityError": "errors",
    "BoxplusError": "errors",
    "BundleAdjustmentConfig": "systems.bundle_adjustment",
    "Diagnosis": "recordings.doctor",
    "Estimate": "systems.estimate",
    "Euclidean": "manifolds.euclidean",
    "Evaluation": "evaluation.evaluation",
    "IkdTree": "maps.ikd_tree",
    "Image": "sensors.image",
    "ImuSamples": "sensors.imu",
    "InputError": "errors",
    "LidarInertialOdometry": "systems.lidar_inertial_odometry",
    "Line3D": "manifolds.lines",
    "LioConfig": "systems.lio_config",
    "Manifold": "manifolds.manifold",
    "NavState": "filtering.nav_state",
    "NotFiniteError": "errors",
    "OutputError": "errors",
    "Pinhole": "cameras.pinhole",
    "PoseGraph": "formats.pose_graph",
    "PoseGraphConfig": "systems.pose_graph",
    "Problem": "optimization.problem",
    "Product": "manifolds.product",
    "Radial": "cameras.distortion",
    "RadialTangential": "cameras.distortion",
    "Recording": "recordings.recording",
    "RecordingError": "errors",
    "RecordingOptions": "recordings.options",
    "SE2": "manifolds.se2",
    "SE3": "manifolds.se3",
    "SE3Left": "manifolds.se3",
    "SO3": "manifolds.so3",
    "Scan": "sensors.scan",
    "Simulation": "simulation.simulation",
    "SingularProblemError": "errors",
    "Solution": "optimization.solution",
    "SolverOptions": "optimization.solver_options",
    "SparseCholesky": "sparse.cholesky",
    "Trajectory": "formats.trajectory",
    "UnitQuaternion": "manifolds.quaternion",
    "adjust_bundle": "systems.bundle_adjustment",
    "align_rgbd": "systems.direct_alignment",
    "check_jacobian": "optimization.jacobian_check",
    "diagnose": "recordings.doctor",
    "evaluate": "evaluation.evaluation",
    "graduate": "optimization.graduated",
    "marginalize": "optimization.marginalization",
    "open_recording": "recordings.recording",
    "optimize_pose_graph": "systems.pose_graph",
    "read_pose_graph": "formats.pose_graph_file",
    "read_reconstruction": "formats.reconstruction",
    "read_trajectory": "formats.trajectory",
    "simulate": "simulation.simulation",
}

_MODULES = {"formats": "formats", "losses": "optimization.losses", "residuals": "residuals"}

__all__ = [
    "SE2",
    "SE3",
    "SO3",
    "Alignment",
    "AmbiguityError",
    "BoxplusError",
    "BundleAdjustmentConfig",
    "Diagnosis",
    "Estimate",
    "Euclidean",
    "Evaluation",
    "IkdTree",
    "Image",
    "ImuSamples",
    "InputError",
    "LidarInertialOdometry",
    "Line3D",
    "LioConfig",
    "Manifold",
    "NavState",
    "NotFiniteError",
    "OutputError",
    "Pinhole",
    "PoseGraph",
    "PoseGraphConfig",
    "Problem",
    "Product",
    "Radial",
    "RadialTangential",
    "Recording",
    "RecordingError",
    "RecordingOptions",
    "SE3Left",
    "Scan",
    "Simulation",
    "SingularProblemError",
    "Solution",
    "SolverOptions",
    "SparseCholesky",
    "Trajectory",
    "UnitQuaternion",
    "__version__",
    "adjust_bundle",
    "align_rgbd",
    "check_jacobian",
    "diagnose",
    "evaluate",
    "formats",
    "graduate",
    "losses",
    "marginalize",
    "open_recording",
    "optimize_pose_graph",
    "read_pose_graph",
    "read_reconstruction",
    "read_trajectory",
    "residuals",
    "simulate",
]


def __getattr__(name: str) -> object:
    """Import a public name from its home (PEP 562)."""
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{_MODULES[name]}")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
