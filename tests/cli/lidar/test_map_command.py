"""`boxplus map info` and `boxplus map export`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.cli.lidar.map import map_app
from boxplus.errors import InputError
from boxplus.formats.clouds.cloud_file import read_cloud
from boxplus.formats.clouds.pcd import read_pcd
from boxplus.formats.clouds.ply import read_ply
from boxplus.maps.tiles.writer import TileWriter


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    with TileWriter(tmp_path / "map") as writer:
        writer.append([[1.0, 2.0, 3.0], [1.01, 2.0, 3.0], [-60.0, 0.0, 0.0]], [1.0, 2.0, 3.0])
    return tmp_path / "map"


def test_info(folder: Path) -> None:
    result = CliRunner().invoke(map_app, ["info", str(folder)])
    assert result.exit_code == 0
    assert "3 points in 2 tiles of 50 m, every point" in result.output
    assert "tiles span x -100 … 50 m, y 0 … 50 m, z 0 … 50 m" in result.output
    assert "whole: the run that wrote it closed it" in result.output


def test_export(folder: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(map_app, ["export", str(folder)])
    assert result.exit_code == 0
    assert len(read_ply(tmp_path / "map.ply")) == 3
    result = CliRunner().invoke(
        map_app, ["export", str(folder), "-o", str(tmp_path / "a.pcd"), "-o", str(tmp_path / "a.laz"), "--voxel", "0.5"]
    )
    assert result.output.startswith("2 points → ")
    np.testing.assert_array_equal(read_pcd(tmp_path / "a.pcd").intensity, [3.0, 1.0])
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.laz").intensity, [3.0, 1.0])


def test_export_replaces_nothing_unasked(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "map.ply").write_text("mine")
    result = CliRunner().invoke(map_app, ["export", str(folder)])
    assert isinstance(result.exception, InputError)
    assert (tmp_path / "map.ply").read_text() == "mine"
    assert CliRunner().invoke(map_app, ["export", str(folder), "--overwrite"]).exit_code == 0
    assert len(read_ply(tmp_path / "map.ply")) == 3


def test_the_output_folder_of_a_run_will_do(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("{}")
    said = CliRunner().invoke(map_app, ["info", str(tmp_path)]).output
    assert "3 points in 2 tiles" in said and "not to be trusted" not in said


def test_what_its_run_says_against_a_map_is_told(folder: Path, tmp_path: Path) -> None:
    """It was called whole, and exported without a word."""
    (tmp_path / "run.json").write_text(json.dumps({"doubts": ["two places of a kind", "a burst"], "accepted": ["a burst"]}))
    said = "not to be trusted, as the run that wrote it says: two places of a kind"
    for path in (tmp_path, folder):
        info = CliRunner().invoke(map_app, ["info", str(path)])
        assert info.output.endswith(f"{said}\n") and "burst" not in info.output
    exported = CliRunner().invoke(map_app, ["export", str(folder), "-o", str(tmp_path / "a.ply")])
    assert exported.exit_code == 0 and f"warning: {said}" in exported.stderr


def test_a_dot_in_the_folder_is_kept(tmp_path: Path) -> None:
    with TileWriter(tmp_path / "map.v1") as writer:
        writer.append([[1.0, 2.0, 3.0]])
    assert CliRunner().invoke(map_app, ["export", str(tmp_path / "map.v1")]).exit_code == 0
    assert (tmp_path / "map.v1.ply").is_file()


def test_export_of_an_interrupted_run_warns(folder: Path) -> None:
    writer = TileWriter(folder)
    result = CliRunner().invoke(map_app, ["export", str(folder)])
    assert "warning: the run that wrote this map did not close it" in result.output
    writer.close()


def test_a_map_that_a_killed_process_left_beside_is_named(folder: Path) -> None:
    earlier = folder.with_name("map.boxplus-earlier")
    folder.rename(earlier)
    result = CliRunner().invoke(map_app, ["info", str(folder)])
    assert isinstance(result.exception, InputError) and f"rename {earlier}, in which" in str(result.exception)


def test_no_map(tmp_path: Path) -> None:
    result = CliRunner().invoke(map_app, ["info", str(tmp_path)])
    assert isinstance(result.exception, InputError)


def test_the_folder_of_another_command_is_named_in_a_line(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text('{"program": "boxplus slam", "state": "finished"}', encoding="utf-8")
    result = CliRunner().invoke(app, ["map", "update", str(tmp_path), str(tmp_path / "later")])
    assert result.exit_code == 2 and len(result.stderr.splitlines()) == 1
    assert "expected the output folder of 'boxplus map merge' – got one of 'boxplus slam'" in result.stderr
