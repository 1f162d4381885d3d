"""One file in another format of its kind: trajectories, point clouds, pose graphs, reconstructions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

from boxplus.errors import InputError
from boxplus.formats.clouds.cloud_file import CLOUD_ENDINGS, cloud_writer, read_cloud
from boxplus.formats.graphs.pose_graph_file import read_pose_graph, write_pose_graph
from boxplus.formats.reconstructions.colmap_model import ColmapModel
from boxplus.formats.reconstructions.reconstruction import read_reconstruction, write_reconstruction
from boxplus.formats.trajectory import read_trajectory, write_csv, write_kitti, write_tum

Target = Literal["tum", "kitti", "csv", "cloud", "g2o", "toro", "colmap-text", "colmap-binary", "bal"]

_TRAJECTORIES = {"tum": write_tum, "kitti": write_kitti, "csv": write_csv}
_LOST = {"tum": ("covariances",), "kitti": ("stamps", "covariances"), "csv": ()}
_OF_ENDINGS: dict[str, Target] = {
    ".tum": "tum",
    ".csv": "csv",
    ".g2o": "g2o",
    ".graph": "toro",
    ".toro": "toro",
    ".bz2": "bal",
    **dict.fromkeys(CLOUD_ENDINGS, "cloud"),  # type: ignore[dict-item]
}


def convert(source: str | Path, output: str | Path, to: Target | Literal["auto"] = "auto") -> str:
    """Write what a file holds in another format; what the other format cannot hold is refused or said.

    Args:
        source: a trajectory (TUM, KITTI, EuRoC, boxplus CSV), a cloud (PLY, PCD, LAS, LAZ, E57), a graph (g2o, TORO), a BAL file
            or the folder of a COLMAP model.
        output: a new file or, for COLMAP, folder.
        to: the format; auto: by the ending of `output`.

    Returns:
        A sentence about what was written, and what was left out.

    Raises:
        InputError: an ending that tells no format; an output that exists; a source of another kind, or as its reader says.
        OutputError: the output cannot be written.
    """
    path, target = Path(source), Path(output)
    if to == "auto":
        if target.suffix.lower() not in _OF_ENDINGS:
            raise InputError(f"an output that ends in {', '.join(_OF_ENDINGS)}", f"{target.name}", "name the format with --to")
        to = _OF_ENDINGS[target.suffix.lower()]
    if target.exists():
        raise InputError("a new output", f"{target}, which exists", "give another name, or remove it")
    if to in _TRAJECTORIES:
        trajectory = read_trajectory(path)
        _TRAJECTORIES[to](target, trajectory)
        held = {"stamps": trajectory.time_ns, "covariances": trajectory.covariance}
        lost = [name for name in _LOST[to] if held[name] is not None]
        return _sentence(f"{len(trajectory):,} poses", lost, trajectory.warnings)
    if to == "cloud":
        cloud = read_cloud(path)
        with cloud_writer(target) as writer:
            writer.append(cloud.points, cloud.intensity)
        return _sentence(f"{len(cloud):,} points", [], ())
    if to in ("g2o", "toro"):
        graph = read_pose_graph(path)
        write_pose_graph(target, graph, "g2o" if to == "g2o" else "toro")
        return _sentence(f"{len(graph.ids):,} poses, {len(graph.edges):,} edges", [], graph.warnings)
    found = read_reconstruction(path)
    if isinstance(found, ColmapModel) != to.startswith("colmap"):
        raise InputError(
            "COLMAP as text or binary, or BAL plain or compressed",
            f"{type(found).__name__} to {to}",
            "their cameras are of other models: there is no exact conversion between them here",
        )
    if isinstance(found, ColmapModel):
        found = replace(found, format="text" if to == "colmap-text" else "binary")
    write_reconstruction(target, found)
    return _sentence(f"{len(found.points):,} points, {len(found.pixels):,} observations", [], ())


def _sentence(what: str, lost: list[str], warnings: tuple[str, ...]) -> str:
    without = f", without the {' and '.join(lost)} of the source" if lost else ""
    return what + without + "".join(f"; {warning}" for warning in warnings)
