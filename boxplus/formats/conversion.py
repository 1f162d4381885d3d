"""One file in another format of its kind: trajectories, point clouds, pose graphs, reconstructions."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal, TypeVar

from boxplus.errors import InputError
from boxplus.formats.clouds.cloud_file import CLOUD_ENDINGS, cloud_writer, read_cloud
from boxplus.formats.graphs.pose_graph_file import read_pose_graph, write_pose_graph
from boxplus.formats.numbers.lines import first_text
from boxplus.formats.reconstructions.bal import BalProblem, write_bal
from boxplus.formats.reconstructions.between_formats import bal_of, colmap_of
from boxplus.formats.reconstructions.colmap import write_colmap
from boxplus.formats.reconstructions.colmap_model import ColmapModel
from boxplus.formats.reconstructions.reconstruction import read_reconstruction
from boxplus.formats.trajectory import read_trajectory, write_csv, write_kitti, write_tum
from boxplus.formats.trajectory_rows import detect_format, is_header, parse_row

Target = Literal["tum", "kitti", "csv", "cloud", "g2o", "toro", "colmap-text", "colmap-binary", "bal"]

_TRAJECTORIES = {"tum": write_tum, "kitti": write_kitti, "csv": write_csv}
_LOST = {"tum": ("covariances", "status"), "kitti": ("stamps", "covariances", "status"), "csv": ()}
_RECORDINGS = (".bag", ".mcap", ".db3", ".pcap")
_LOOKED_AT = 1 << 16  # bytes, for what kind of thing a file holds
_ReadT = TypeVar("_ReadT")
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
        source: a trajectory (TUM, KITTI, EuRoC, boxplus CSV), a cloud (PLY, PCD, LAS, LAZ, E57), a graph (g2o, TORO), a BAL
            file, one of the graph processor's, or the folder of a COLMAP model.
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
        trajectory = _read(read_trajectory, path, "a trajectory", to)
        _TRAJECTORIES[to](target, trajectory)
        has = {
            "stamps": trajectory.time_ns is not None,
            "covariances": trajectory.covariance is not None,
            "status": any(trajectory.status or ()),
        }
        lost = [name for name in _LOST[to] if has[name]] + _columns_beside_poses(path)
        return _sentence(f"{len(trajectory):,} poses", lost, trajectory.warnings)
    if to == "cloud":
        cloud = read_cloud(path, everything=True)
        with cloud_writer(target) as writer:
            held = writer.holds(cloud.columns)
            writer.append(cloud.points, cloud.intensity, {name: cloud.columns[name] for name in cloud.columns if name in held})
        return _sentence(f"{len(cloud):,} points", [*(set(cloud.columns) - held), *cloud.left_out], ())
    if to in ("g2o", "toro"):
        graph = _read(read_pose_graph, path, "a pose graph", to)
        write_pose_graph(target, graph, "g2o" if to == "g2o" else "toro")
        lost = [f"{len(graph.fixed)} FIX"] if to == "toro" and len(graph.fixed) else []
        return _sentence(f"{len(graph.ids):,} poses, {len(graph.edges):,} edges", lost, graph.warnings)
    return _convert_reconstruction(path, target, to)


def _read(read: Callable[[Path], _ReadT], source: Path, kind: str, to: str) -> _ReadT:
    """What the source holds; where it holds another kind of thing that is said, as no option makes it this one."""
    try:
        return read(source)
    except InputError as error:
        other = _kind(source)
        if other not in ("", kind):
            advice = "name an output of the same kind, or give another source"
            if other == "a recording":
                advice = "a recording is not converted; 'boxplus lio', 'vio' and 'vo' make a trajectory of one"
            raise InputError(f"{kind}, to be written as {to}", f"{source}, {other}", advice) from error
        if "ignore_unknown" in error.advice:
            advice = "check that it is a pose graph, and take other lines out: a graph is converted as a whole"
            raise InputError(error.expected, error.got, advice) from error
        raise


def _kind(source: Path) -> str:
    """What a file seems to hold, or nothing where that cannot be told."""
    if source.is_dir() or not source.is_file():
        return "a folder" if source.is_dir() else ""
    if source.suffix.lower() in _RECORDINGS:
        return "a recording"
    if source.suffix.lower() in CLOUD_ENDINGS:
        return "a point cloud"
    lines = (line.strip() for line in first_text(source, _LOOKED_AT).splitlines())
    first = next((line for line in lines if line and not line.startswith("#")), "")
    if first.startswith(("VERTEX", "EDGE")):
        return "a pose graph"
    try:
        layout = detect_format(first, str(source))
        if not is_header(first):
            parse_row(first, layout)
    except (InputError, ValueError):
        return ""
    return "a trajectory"


def _convert_reconstruction(source: Path, target: Path, to: Target) -> str:
    found = read_reconstruction(source)
    count = f"{len(found.points):,} points, {len(found.pixels):,} observations"
    if to == "bal" and isinstance(found, BalProblem):
        write_bal(target, found)
        return count
    model, lost, made_up = found, list[str](), ""
    if not isinstance(model, ColmapModel):
        model, made_up = colmap_of(model), "; names and sizes of the images and colours are made up"
    else:
        folder = source if source.is_dir() else source.parent
        lost += [kind for kind in ("rigs", "frames") if any((folder / f"{kind}.{end}").exists() for end in ("bin", "txt"))]
    if to == "bal":
        problem, beside = bal_of(model)
        write_bal(target, problem)
        lost += beside if isinstance(found, ColmapModel) else ["cameras that images share (each image has its own now)"]
        return _sentence(f"{len(problem.points):,} points, {len(problem.pixels):,} observations", lost, ())
    write_colmap(target, model, "text" if to == "colmap-text" else "binary")
    return _sentence(count, lost, ()) + made_up


def _columns_beside_poses(path: Path) -> list[str]:
    """What a file of EuRoC's ground truth has beside poses: velocities and biases, which no other format holds."""
    with path.open(encoding="utf-8", errors="replace") as file:
        first = next((line for line in file if line.strip() and not line.startswith("#")), "")
    count = len(first.split(","))
    return [f"{count - 8} columns beside the poses"] if count > 8 and detect_format(first, str(path)) == "euroc" else []


def _sentence(what: str, lost: list[str], warnings: tuple[str, ...]) -> str:
    *before, last = sorted(lost, key=str.lower) or [""]
    without = f", without the {', '.join(before)}{' and ' if before else ''}{last} of the source" if last else ""
    return what + without + "".join(f"; {warning}" for warning in warnings)
