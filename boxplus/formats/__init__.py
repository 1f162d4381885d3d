"""Plain files: pose graphs, reconstructions, trajectories, point clouds; read and written as their formats say."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from boxplus.formats.bal import BalProblem, read_bal, write_bal
    from boxplus.formats.colmap import read_colmap, write_colmap
    from boxplus.formats.colmap_model import ColmapModel
    from boxplus.formats.g2o import read_g2o, write_g2o
    from boxplus.formats.gbp import GbpProblem, read_gbp, write_gbp
    from boxplus.formats.pcd import read_pcd, write_pcd
    from boxplus.formats.ply import read_ply, write_ply
    from boxplus.formats.point_cloud import PointCloud
    from boxplus.formats.pose_graph import PoseGraph
    from boxplus.formats.pose_graph_file import read_pose_graph, write_pose_graph
    from boxplus.formats.reconstruction import read_reconstruction, write_reconstruction
    from boxplus.formats.scene_ply import write_scene_ply
    from boxplus.formats.toro import read_toro, write_toro
    from boxplus.formats.trajectory import Trajectory, read_trajectory, write_csv, write_kitti, write_tum
    from boxplus.formats.vgg_lines import VggLines, read_vgg_lines

_HOME = {
    "BalProblem": "bal",
    "ColmapModel": "colmap_model",
    "GbpProblem": "gbp",
    "PointCloud": "point_cloud",
    "PoseGraph": "pose_graph",
    "Trajectory": "trajectory",
    "VggLines": "vgg_lines",
    "read_bal": "bal",
    "read_colmap": "colmap",
    "read_g2o": "g2o",
    "read_gbp": "gbp",
    "read_pcd": "pcd",
    "read_ply": "ply",
    "read_pose_graph": "pose_graph_file",
    "read_reconstruction": "reconstruction",
    "read_toro": "toro",
    "read_trajectory": "trajectory",
    "read_vgg_lines": "vgg_lines",
    "write_bal": "bal",
    "write_colmap": "colmap",
    "write_csv": "trajectory",
    "write_g2o": "g2o",
    "write_gbp": "gbp",
    "write_kitti": "trajectory",
    "write_pcd": "pcd",
    "write_ply": "ply",
    "write_pose_graph": "pose_graph_file",
    "write_reconstruction": "reconstruction",
    "write_scene_ply": "scene_ply",
    "write_toro": "toro",
    "write_tum": "trajectory",
}

__all__ = [
    "BalProblem",
    "ColmapModel",
    "GbpProblem",
    "PointCloud",
    "PoseGraph",
    "Trajectory",
    "VggLines",
    "read_bal",
    "read_colmap",
    "read_g2o",
    "read_gbp",
    "read_pcd",
    "read_ply",
    "read_pose_graph",
    "read_reconstruction",
    "read_toro",
    "read_trajectory",
    "read_vgg_lines",
    "write_bal",
    "write_colmap",
    "write_csv",
    "write_g2o",
    "write_gbp",
    "write_kitti",
    "write_pcd",
    "write_ply",
    "write_pose_graph",
    "write_reconstruction",
    "write_scene_ply",
    "write_toro",
    "write_tum",
]


def __getattr__(name: str) -> object:
    """Import a reader or writer from its home when it is first used (PEP 562)."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value
