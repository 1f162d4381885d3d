"""Files in other formats of their kind: there and back again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.errors import InputError
from boxplus.formats.clouds.cloud_file import read_cloud
from boxplus.formats.clouds.ply import write_ply
from boxplus.formats.conversion import convert
from boxplus.formats.graphs.g2o import read_g2o
from boxplus.formats.reconstructions.bal import read_bal
from boxplus.formats.reconstructions.colmap import read_colmap, write_colmap
from boxplus.formats.trajectory import Trajectory, read_trajectory, write_csv
from tests.small_problems import colmap_model, write_small_files


def test_trajectories(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    q = random.normal(size=(20, 4))
    q /= np.linalg.norm(q, axis=1)[:, None]
    given = Trajectory(10**9 * np.arange(20), random.normal(size=(20, 3)), q, covariance=np.tile(np.eye(6), (20, 1, 1)))
    write_csv(tmp_path / "a.csv", given)
    assert convert(tmp_path / "a.csv", tmp_path / "a.tum") == "20 poses, without the covariances of the source"
    assert convert(tmp_path / "a.tum", tmp_path / "a.txt", "kitti") == "20 poses, without the stamps of the source"
    assert convert(tmp_path / "a.tum", tmp_path / "b.csv") == "20 poses"
    for name in ("a.tum", "a.txt", "b.csv"):
        np.testing.assert_allclose(read_trajectory(tmp_path / name).p, given.p, atol=2e-9)
        np.testing.assert_allclose(read_trajectory(tmp_path / name).R, given.R, atol=1e-7)
    assert read_trajectory(tmp_path / "b.csv").times.tolist() == given.times.tolist()
    with pytest.raises(InputError, match="time stamps"):
        convert(tmp_path / "a.txt", tmp_path / "c.tum")
    with pytest.raises(InputError, match=r"a new output – got .*a\.tum, which exists"):
        convert(tmp_path / "a.csv", tmp_path / "a.tum")
    with pytest.raises(InputError, match=r"an output that ends in \.tum, .* – got a\.xyz – name the format with --to"):
        convert(tmp_path / "a.csv", tmp_path / "a.xyz")


def test_clouds(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    write_ply(tmp_path / "a.ply", points, points[:, 0])
    result = CliRunner().invoke(app, ["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.laz")])
    assert result.exit_code == 0 and result.output.startswith("50 points → ")
    convert(tmp_path / "b.laz", tmp_path / "c.pcd")
    back = read_cloud(tmp_path / "c.pcd")
    np.testing.assert_allclose(back.points, points, atol=0.51e-4)
    np.testing.assert_array_equal(back.intensity, points[:, 0])


def test_graphs_and_reconstructions(tmp_path: Path) -> None:
    write_small_files(tmp_path)
    write_colmap(tmp_path / "colmap", colmap_model())
    graph = read_g2o(tmp_path / "loops.g2o")
    convert(tmp_path / "loops.g2o", tmp_path / "loops.graph")
    convert(tmp_path / "loops.graph", tmp_path / "again.g2o")
    again = read_g2o(tmp_path / "again.g2o")
    np.testing.assert_array_equal(again.edges, graph.edges)
    np.testing.assert_allclose(again.information, graph.information, rtol=1e-6, atol=1e-9)
    convert(tmp_path / "scene.txt.bz2", tmp_path / "scene.txt", "bal")
    np.testing.assert_array_equal(read_bal(tmp_path / "scene.txt").pixels, read_bal(tmp_path / "scene.txt.bz2").pixels)
    convert(tmp_path / "colmap", tmp_path / "text", "colmap-text")
    convert(tmp_path / "text", tmp_path / "binary", "colmap-binary")
    assert read_colmap(tmp_path / "text").format == "text" and read_colmap(tmp_path / "binary").format == "binary"
    np.testing.assert_array_equal(read_colmap(tmp_path / "binary").points, read_colmap(tmp_path / "colmap").points)
    with pytest.raises(InputError, match="there is no exact conversion between them here"):
        convert(tmp_path / "colmap", tmp_path / "b.txt", "bal")
