"""`boxplus map grid` and `boxplus map height` over the folder of a run."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import rasterio
import yaml
from PIL import Image
from typer.testing import CliRunner

from boxplus._extras import installation
from boxplus.cli import app
from boxplus.formats.trajectory_writer import TrajectoryWriter
from boxplus.maps.tiles.writer import TileWriter
from boxplus.sensors.satellites.geodesy import EnuFrame


def run_folder(folder: Path, z_of_second_lap: float = 0.0) -> Path:
    """A path along a street of 20 m between two walls."""
    random = np.random.default_rng(0)
    floor = np.column_stack([random.uniform([0.0, -3.0], [20.0, 3.0], (60_000, 2)), np.full(60_000, 0.3)])
    walls = np.column_stack([random.uniform(0.0, 20.0, 20_000), np.repeat([-3.0, 3.0], 10_000), random.uniform(0.3, 4.0, 20_000)])
    with TileWriter(folder / "map", voxel=0.1) as tiles:
        tiles.append(np.concatenate([floor, walls]))
    write_path(folder, z_of_second_lap)
    return folder


def write_path(folder: Path, z_of_second_lap: float = 0.0, name: str = "trajectory") -> None:
    with TrajectoryWriter(folder, name) as writer:
        for k in range(60):
            z = 1.8 if k < 30 else 1.8 + z_of_second_lap
            writer.append(10**9 + k * 10**8, np.eye(3), [1.0 + 0.6 * (k % 30), 0.0, z], np.zeros((6, 6)), "ok")


def read_heights(folder: Path) -> tuple[np.ndarray, object]:
    with rasterio.open(folder / "height.tif") as file:
        return file.read(1), file.crs


def call(*words: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, [str(word) for word in words])
    return result.exit_code, result.output


def test_a_joint_map_is_cut_around_the_paths_of_its_sessions(tmp_path: Path) -> None:
    folder = run_folder(tmp_path / "street")
    for path in folder.glob("trajectory.*"):
        path.unlink()
    code, out = call("map", "grid", folder)
    assert code == 2 and "trajectory" in out  # as no command leaves it
    (folder / "run.json").write_text('{"program": "boxplus map merge"}')
    for name in ("monday", "friday"):
        write_path(folder / "sessions", name=name)
    for words in (("grid",), ("height",)):
        code, out = call("map", *words, folder)
        assert code == 0, out
    assert (np.asarray(Image.open(folder / "grid.pgm"))[5:-5, 2:-2] == 254).mean() > 0.98


def test_floor_plan_and_heights_of_a_run(tmp_path: Path) -> None:
    folder = run_folder(tmp_path / "run")
    code, out = call("map", "grid", folder)
    assert code == 0 and "m² free" in out, out
    pixels = np.asarray(Image.open(folder / "grid.pgm"))
    assert pixels.shape[0] in (60, 61) and pixels.shape[1] == 200
    assert (pixels[5:-5, 2:-2] == 254).mean() > 0.98 and (pixels[[0, -1], 2:-2] == 0).mean() > 0.95
    code, out = call("map", "grid", folder)
    assert code == 2 and "--overwrite" in out
    code, out = call("map", "height", folder)
    assert code == 0 and "0.30 to 0." in out, out
    # Cells that hold the wall alone have the ground beside them, and what a slope of 0.3 would rise to there.
    heights = read_heights(folder)
    assert np.nanmax(heights[0]) <= 0.3 + 0.3 * 0.5 + 1e-4
    assert heights[1] is None
    assert call("map", "height", folder, "--surface", "--overwrite")[0] == 0
    assert np.nanmax(read_heights(folder)[0]) > 3.5
    code, out = call("map", "grid", folder, "-o", tmp_path / "fine", "--resolution", "0.05")
    assert code == 0 and "smaller than the map's voxels" in out


def test_heights_of_a_run_on_the_earth_are_above_its_ellipsoid(tmp_path: Path) -> None:
    folder = run_folder(tmp_path / "run")
    assert call("map", "height", folder)[0] == 0
    local, _ = read_heights(folder)
    place = EnuFrame(48.0, 11.0, 500.0)
    origin = {"latitude_deg": place.latitude, "longitude_deg": place.longitude, "height_m": place.altitude}
    (folder / "georeference.yaml").write_text(yaml.safe_dump({"origin": origin}))
    assert call("map", "height", folder, "--overwrite")[0] == 0
    laid, crs = read_heights(folder)
    known = np.isfinite(local)
    np.testing.assert_array_equal(known, np.isfinite(laid))
    np.testing.assert_allclose(laid[known], local[known] + 500.0, atol=1e-3)  # 20 m away the Earth curves by 0.03 mm
    assert crs.to_dict()["proj"] == "tmerc" and crs.to_dict()["lat_0"] == 48.0


def test_a_missing_library_is_said_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rasterio", None)
    code, out = call("map", "height", tmp_path / "no run at all")
    assert code == 2 and installation("geo") in out


def test_storeys_over_each_other_are_not_mixed(tmp_path: Path) -> None:
    folder = run_folder(tmp_path / "run", z_of_second_lap=4.0)
    code, out = call("map", "grid", folder)
    assert code == 2 and "a path that is on one storey" in out and "--z LOW HIGH" in out
    code, out = call("map", "grid", folder, "--z", "100", "200")
    assert code == 2 and "expected a storey (--z) on which the path runs, which lies between " in out
    assert call("map", "grid", folder, "--z", "1", "3")[0] == 0


@pytest.mark.parametrize("words", [["map", "grid"], ["map", "height"]])
def test_a_folder_without_a_map_is_refused(tmp_path: Path, words: list[str]) -> None:
    code, out = call(*words, tmp_path)
    assert code == 2 and "expected" in out and "Traceback" not in out
