"""Files of graphs and reconstructions with random damage are read or refused with an InputError, and nothing else happens."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.formats.graphs.g2o import read_g2o, write_g2o
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.formats.graphs.toro import read_toro, write_toro
from boxplus.formats.reconstructions.bal import BalProblem, read_bal, write_bal
from boxplus.formats.reconstructions.colmap import read_colmap, write_colmap
from boxplus.formats.reconstructions.colmap_model import ColmapModel

IDENTITY = np.array([1.0, 0, 0, 0, 0, 0, 0])


def write_graph(path: Path, write: Callable[[Path, PoseGraph], None]) -> None:
    edges = np.array([[0, 1], [1, 2], [2, 0]])
    information = np.tile(np.eye(6) * 4.5, (3, 1, 1))
    write(
        path,
        PoseGraph(3, np.array([3, 7, 9]), np.tile(IDENTITY, (3, 1)), edges, np.tile(IDENTITY, (3, 1)), information, edges[0]),
    )


def write_problem(path: Path) -> None:
    pixels = np.arange(8.0).reshape(4, 2)
    write_bal(path, BalProblem(np.ones((2, 9)), np.ones((3, 3)), np.array([0, 1, 0, 1]), np.array([0, 1, 2, 2]), pixels))


def write_model(folder: Path, form: str) -> None:
    model = ColmapModel(
        camera_ids=np.array([4]),
        camera_models=("PINHOLE",),
        camera_sizes=np.array([[640, 480]]),
        camera_params=(np.array([500.0, 500.0, 320.0, 240.0]),),
        image_ids=np.array([2, 5]),
        image_names=("a.png", "b.png"),
        camera_of=np.array([0, 0]),
        T_camera_world=np.tile(IDENTITY, (2, 1)),
        point_ids=np.array([11, 12]),
        points=np.ones((2, 3)),
        colors=np.zeros((2, 3), np.uint8),
        errors=np.ones(2),
        image_of=np.array([0, 0, 1]),
        point_of=np.array([0, -1, 0]),
        pixels=np.ones((3, 2)),
    )
    write_colmap(folder, model, form)


def damaged(rng: np.random.Generator, data: bytes) -> bytes:
    """The data with one to three places overwritten, cut out or filled in."""
    broken = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(0, len(broken) + 1))
        kind = rng.integers(0, 3)
        letters = bytes(rng.choice(list(b" \n-+.e0123456789#naif\xff\0"), int(rng.integers(1, 6))).astype(np.uint8))
        if kind == 0:
            broken[at : at + len(letters)] = letters
        elif kind == 1:
            del broken[at : at + int(rng.integers(1, 20))]
        else:
            broken[at:at] = letters
    return bytes(broken)


@pytest.mark.filterwarnings("error:invalid value:RuntimeWarning", "error:overflow encountered in multiply:RuntimeWarning")
@pytest.mark.parametrize(
    ("write", "read", "names"),
    [
        (lambda folder: write_graph(folder / "graph.g2o", write_g2o), read_g2o, ["graph.g2o"]),
        (lambda folder: write_graph(folder / "graph.toro", write_toro), read_toro, ["graph.toro"]),
        (lambda folder: write_problem(folder / "problem.txt"), read_bal, ["problem.txt"]),
        (lambda folder: write_problem(folder / "problem.bz2"), read_bal, ["problem.bz2"]),
        (lambda folder: write_model(folder, "text"), read_colmap, ["cameras.txt", "images.txt", "points3D.txt"]),
        (lambda folder: write_model(folder, "binary"), read_colmap, ["cameras.bin", "images.bin", "points3D.bin"]),
    ],
    ids=["g2o", "toro", "bal", "bal.bz2", "colmap text", "colmap binary"],
)
def test_damage_is_refused_or_harmless(
    tmp_path: Path, write: Callable[[Path], None], read: Callable[[Path], object], names: list[str]
) -> None:
    write(tmp_path)
    rng = np.random.default_rng(7)
    refused = 0
    for name in names:
        path = tmp_path / name
        original = path.read_bytes()
        for _ in range(150):
            path.write_bytes(damaged(rng, original))
            try:
                read(path)
            except InputError:
                refused += 1
        path.write_bytes(original)
    read(tmp_path / names[0])
    assert refused > 50 * len(names)
