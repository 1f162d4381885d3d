"""A saved map from a run's folder, from tiles alone, from a cloud; with damaged tiles; and what is none."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.errors import InputError
from boxplus.formats.clouds.pcd import write_pcd
from boxplus.formats.clouds.ply import write_ply
from boxplus.formats.trajectory_writer import TrajectoryWriter
from boxplus.manifolds import se3
from boxplus.maps.local_maps.config import LocalMapConfig
from boxplus.maps.local_maps.visibility import visible
from boxplus.maps.tiles.voxel_thinning import first_per_voxel
from boxplus.maps.tiles.writer import TileWriter
from boxplus.runs.saved_map.saved_map import SavedMap, _refuse_another_unit, open_saved_map

CONFIG = LocalMapConfig(length=8.0, voxel=0.25, max_range=30.0)


def two_rooms() -> NDArray[np.float32]:
    """Two rooms of 12 m × 8 m × 3 m side by side along y with a wall between, points every 0.2 m; and nothing above."""
    x, y, z = np.arange(0.1, 12.0, 0.2), np.arange(0.1, 16.0, 0.2), np.arange(0.1, 3.0, 0.2)
    floor = np.stack(np.meshgrid(x, y, [0.0]), axis=-1).reshape(-1, 3)
    walls = [np.stack(np.meshgrid(x, [at], z), axis=-1).reshape(-1, 3) for at in (0.0, 8.0, 16.0)]
    ends = [np.stack(np.meshgrid([at], y, z), axis=-1).reshape(-1, 3) for at in (0.0, 12.0)]
    return np.concatenate([floor, *walls, *ends]).astype(np.float32)


def write_run(folder: Path, points: NDArray[np.float32]) -> None:
    """What is read of a run: its summary, its trajectory through the first room, its tiles."""
    folder.mkdir()
    (folder / "run.json").write_text(json.dumps({"program": "boxplus slam"}))
    with TrajectoryWriter(folder) as writer:
        for k in range(21):
            status = "lost" if k == 20 else "ok"
            at = (50.0, 50.0, 0.0) if k == 20 else (1.0 + 0.5 * k, 4.0, 1.2)
            writer.append(k * 100_000_000, np.eye(3), np.array(at), 1e-6 * (k + 1) * np.eye(6), status)
    with TileWriter(folder / "map", tile_size=10.0) as tiles:
        tiles.append(points)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("saved") / "run"
    write_run(folder, two_rooms())
    return folder


def in_map(saved: SavedMap, number: int) -> NDArray[np.float64]:
    local_map = saved.local_maps[number]
    return se3.act(local_map.T_odo_map, local_map.points.astype(np.float64))


def test_of_a_run_local_maps_stand_on_its_trajectory_and_hold_what_is_seen_from_there(run: Path) -> None:
    saved = open_saved_map(run, CONFIG)
    assert saved.kind == "boxplus slam" and [len(trajectory) for trajectory in saved.trajectories] == [21]
    assert len(saved.local_maps) == 2
    for number, local_map in enumerate(saved.local_maps):
        assert local_map.number == number
        np.testing.assert_allclose(local_map.T_odo_map[[5, 6]], [4.0, 1.2], atol=1e-6)
        assert local_map.T_odo_map[4] < 11.0  # the scan that was lost at x = 50 makes none
        points = in_map(saved, number)
        assert len(points) > 2000
        # The wall at y = 8 hides the second room; a little behind a surface is let through.
        assert np.mean(points[:, 1] > 10.0) < 0.01
        assert np.mean(points[:, 1] < 8.1) > 0.9
    assert np.linalg.norm(saved.local_maps[1].covariance) > 0.0
    assert any("2 local maps were computed" in text for text in saved.report)


def test_the_map_folder_within_a_run_is_that_run(run: Path) -> None:
    inner = open_saved_map(run / "map", CONFIG)
    assert inner.kind == "boxplus slam" and len(inner.local_maps) == 2
    assert any("belongs to the run" in text for text in inner.report)


def test_points_near_are_all_of_the_map_within_the_radius(run: Path) -> None:
    saved, points = open_saved_map(run, CONFIG), two_rooms()
    centre = np.array([9.0, 9.5, 1.0])
    near = saved.points_near(centre, 3.0)
    assert (np.linalg.norm(near - centre, axis=1) <= 3.0 + 1e-5).all()
    expected = points[np.linalg.norm(points - centre, axis=1) <= 2.5]
    gap = np.linalg.norm(expected[:, None] - near[None], axis=2).min(axis=1)
    assert gap.max() <= np.sqrt(3.0) * saved.voxel  # one a voxel is left of them
    assert len(saved.points_near([500.0, 0.0, 0.0], 3.0)) == 0


def test_a_survey_in_coordinates_of_the_earth_is_counted_from_a_near_origin(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    at = np.array([691_234.5, 5_334_321.25, 512.0])
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 1e-3), np.floor(at)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = (two_rooms() + at).T
    cloud.write(str(tmp_path / "survey.laz"))
    saved = open_saved_map(tmp_path / "survey.laz", CONFIG)
    np.testing.assert_array_equal(saved.origin, [691_000.0, 5_334_000.0, 0.0])
    assert any("counted from 691000, 5334000, 0 m" in text for text in saved.report)
    near = saved.points_near(at - saved.origin + (6.0, 4.0, 0.0), 50.0) + saved.origin - at
    gap = np.linalg.norm(two_rooms()[::50, None] - near[None], axis=2).min(axis=1)
    assert gap.max() <= np.sqrt(3.0) * saved.voxel


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
def test_a_bare_cloud_has_places_over_its_ground(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cloud{suffix}"
    (write_ply if suffix == ".ply" else write_pcd)(path, two_rooms())
    saved = open_saved_map(path, CONFIG)
    assert saved.kind == "point cloud" and not saved.trajectories
    eyes = np.stack([m.T_odo_map[4:] for m in saved.local_maps])
    on_floor = eyes[eyes[:, 2] < 3.0]
    assert len(on_floor) >= 6 and (np.abs(on_floor[:, 2] - 2.0) < 0.3).all()
    assert {bool(y > 8.0) for y in on_floor[:, 1]} == {True, False}  # in either room
    assert any("no trajectory" in text and "z is taken to be up" in text for text in saved.report)


@pytest.mark.parametrize("far", [7e5, 3.4e38])
def test_points_that_are_none_take_nothing_of_a_cloud(tmp_path: Path, far: float) -> None:
    """Drivers write the largest number for no return: it is left out, and all others stay."""
    write_ply(tmp_path / "cloud.ply", two_rooms())
    write_ply(tmp_path / "marked.ply", np.concatenate([two_rooms(), [[far, 0.0, 0.0], [0.0, 0.0, -far]]]))
    whole, marked = (open_saved_map(tmp_path / f"{name}.ply", CONFIG) for name in ("cloud", "marked"))
    assert marked.damage == [f"2 of {len(two_rooms()) + 2} points lie farther than 66 km from the origin and are left out"]
    assert whole.damage == [] and len(marked.local_maps) == len(whole.local_maps)
    np.testing.assert_array_equal(marked.points_near([6.0, 8.0, 1.0], 30.0), whole.points_near([6.0, 8.0, 1.0], 30.0))


def test_a_cloud_whose_digits_were_lost_is_refused(tmp_path: Path) -> None:
    """Eastings and northings written as float32 lie on a grid of half a metre."""
    write_ply(tmp_path / "utm.ply", two_rooms() + np.array([5e5, 5.4e6, 0.0]))
    with pytest.raises(InputError, match=r"points farther away, up to 54000\d\d m, which it holds to 0\.5 m .*utm\.ply"):
        open_saved_map(tmp_path / "utm.ply", CONFIG)


@pytest.mark.parametrize(("factor", "spread"), [(1e3, 0.0), (1e2, 0.0), (1e4, 0.0), (1e3, 5e5)])
def test_a_cloud_in_millimetres_or_centimetres_is_refused_by_that(tmp_path: Path, factor: float, spread: float) -> None:
    """Whatever its origin, and before anything is computed of it: each of its points would be a tile."""
    write_ply(tmp_path / "scan.ply", factor * two_rooms() + spread)
    with pytest.raises(
        InputError, match=r"points in a cube of 2 m .* in a cloud of .* m \(.*scan\.ply\).* 0\.001 .* millimetres"
    ):
        open_saved_map(tmp_path / "scan.ply", CONFIG)


@given(seed=st.integers(0, 2**32 - 1), spacing=st.floats(0.2, 1.6))
@settings(max_examples=25)
def test_a_cloud_as_coarse_as_is_of_any_use_is_none_of_these(seed: int, spacing: float) -> None:
    """Rooms that are scanned every 0.2 to 1.6 m (half a metre is 1.6 ft), of any origin, and markers of no return."""
    random = np.random.default_rng(seed)
    rooms = np.concatenate([two_rooms() + np.float32([x, y, 0.0]) for x in 30.0 * np.arange(5) for y in (0.0, 30.0)])
    points = rooms[first_per_voxel(rooms, spacing)] + random.uniform(-1e3, 1e3, 3)
    assert len(points) >= 1000
    _refuse_another_unit(Path("map.ply"), random.permutation(np.concatenate([points, np.full((10, 3), 3e38)]).astype(np.float32)))


def test_missing_tiles_are_counted(tmp_path: Path) -> None:
    write_run(tmp_path / "run", two_rooms())
    tiles = sorted((tmp_path / "run" / "map" / "tiles").iterdir())
    assert open_saved_map(tmp_path / "run", CONFIG).damage == []
    shutil.rmtree(tiles[0])
    (damage,) = open_saved_map(tmp_path / "run", CONFIG).damage
    assert damage.startswith(f"1 of the {len(tiles)} segments that were written are not there")
    for tile in tiles[1:]:
        shutil.rmtree(tile)
    with pytest.raises(InputError, match=f"none in .*run – {len(tiles)} of the {len(tiles)} segments"):
        open_saved_map(tmp_path / "run", CONFIG)


def test_a_damaged_tile_is_named_and_the_rest_is_used(tmp_path: Path) -> None:
    write_run(tmp_path / "run", two_rooms())
    segments = sorted((tmp_path / "run" / "map" / "tiles").glob("*/*.ply"))
    cut, overwritten = segments[0], segments[-1]
    cut.write_bytes(cut.read_bytes()[:-100])
    content = bytearray(overwritten.read_bytes())
    content[-600:-300] = b"\x7f" * 300
    overwritten.write_bytes(bytes(content))
    saved = open_saved_map(tmp_path / "run", CONFIG)
    saved.points_near([6.0, 8.0, 1.0], 30.0)
    assert any(str(cut) in text and "damaged" in text for text in saved.damage)
    assert any(overwritten.parent.name in text and "lie outside" in text for text in saved.damage)
    assert np.isfinite(saved.points_near([6.0, 8.0, 1.0], 30.0)).all()
    assert len(saved.local_maps) == 2 and all(len(m.points) > 500 for m in saved.local_maps)


def test_a_tile_that_is_read_again_is_named_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_run(tmp_path / "run", two_rooms())
    segment = sorted((tmp_path / "run" / "map" / "tiles").glob("*/*.ply"))[0]
    content = bytearray(segment.read_bytes())
    content[-600:-300] = b"\x7f" * 300
    segment.write_bytes(bytes(content))
    monkeypatch.setattr("boxplus.runs.saved_map.tiled_points._KEPT", 1)
    saved = open_saved_map(tmp_path / "run", CONFIG)
    for _ in range(3):
        saved.points_near([6.0, 8.0, 1.0], 30.0)
    assert len(saved.damage) == 1 and segment.parent.name in saved.damage[0]


def test_a_map_that_was_recovered_is_not_damaged(tmp_path: Path) -> None:
    """Of a run that was killed: all of its points are in the journal, and the last line of its trajectory is cut."""
    write_run(tmp_path / "run", two_rooms())
    shutil.rmtree(tmp_path / "run" / "map")
    writer = TileWriter(tmp_path / "run" / "map", tile_size=10.0)
    writer.append(two_rooms())
    shutil.copytree(tmp_path / "run", tmp_path / "killed")  # before it is closed
    writer.close()
    trajectory = tmp_path / "killed" / "trajectory.csv"
    trajectory.write_bytes(trajectory.read_bytes()[:-20])
    saved = open_saved_map(tmp_path / "killed", CONFIG)
    assert saved.damage == []
    for text in ("did not close it", "points were read from journal", "is incomplete and was left out"):
        assert any(text in line for line in saved.report), text


def test_what_its_run_says_against_a_map_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the map in one file nothing was, nor of a folder that one stood in."""
    write_run(tmp_path / "run", two_rooms())
    summary, file = tmp_path / "run" / "run.json", tmp_path / "run" / "map.ply"
    write_ply(file, two_rooms())
    write_ply(tmp_path / "run" / "mine.ply", two_rooms())
    monkeypatch.chdir(tmp_path / "run" / "map")
    assert open_saved_map(tmp_path / "run", CONFIG).doubts == []
    for found, expected in (
        ({"program": "boxplus map merge", "doubts": ["two places of a kind", "a burst"]}, ["two places of a kind", "a burst"]),
        ({"program": "boxplus map merge", "doubts": ["two places", "a burst"], "accepted": ["a burst"]}, ["two places"]),
        ({"program": "boxplus refine", "doubt": "poses moved by 9 sigma"}, ["poses moved by 9 sigma"]),
        ({"program": "boxplus slam", "contradiction": "loops contradict"}, ["loops contradict"]),
        ({"program": "boxplus slam", "contradiction": None, "doubts": None}, []),
        (["no summary"], []),
    ):
        summary.write_text(json.dumps(found))
        assert open_saved_map(tmp_path / "run", CONFIG).doubts == expected
        for path in (tmp_path / "run" / "map", Path("."), file, Path("../map.ply")):
            bare = open_saved_map(path, CONFIG)
            assert bare.doubts == expected and bare.accepted == (["a burst"] if "accepted" in found else [])
        assert open_saved_map(tmp_path / "run" / "mine.ply", CONFIG).doubts == []


@pytest.mark.parametrize(("missing", "opened"), [("run/map", "run"), ("run/map", "run/map"), ("run", "run"), ("run", "run/map")])
def test_a_map_left_between_two_renames_is_found(tmp_path: Path, missing: str, opened: str) -> None:
    write_run(tmp_path / "run", two_rooms())
    folder, earlier = tmp_path / missing, tmp_path / f"{missing}.boxplus-earlier"
    folder.rename(earlier)
    advice = f"rename {earlier}, in which the one that was there is whole, to {folder.name}"
    with pytest.raises(InputError, match=f"{re.escape(advice)}$"):
        open_saved_map(tmp_path / opened, CONFIG)
    called = CliRunner().invoke(app, ["map", "info", str(tmp_path / opened)])
    assert called.exit_code and advice.replace(" ", "") in "".join(called.output.split())


def test_what_is_no_map_is_refused(tmp_path: Path) -> None:
    for nowhere in (tmp_path / "nowhere", Path("/nowhere")):  # the root of the file system has no name to look beside
        with pytest.raises(InputError, match=f"got nothing at {nowhere} – check the path"):
            open_saved_map(nowhere)
        called = CliRunner().invoke(app, ["map", "info", str(nowhere)])
        assert called.exit_code == 2 and called.stderr.startswith("error: expected ")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"without map tiles, .*empty – give the output folder of a run"):
        open_saved_map(tmp_path / "empty")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text('{"program": "boxplus lio"}')
    with pytest.raises(InputError, match=r"a folder of 'boxplus lio' without map tiles, .*run – run without --no-map"):
        open_saved_map(tmp_path / "run")
    (tmp_path / "ros2").mkdir()
    (tmp_path / "ros2" / "metadata.yaml").touch()
    (tmp_path / "drive.bag").touch()
    for recording in ("ros2", "drive.bag"):
        with pytest.raises(InputError, match=f"{recording} – make a map of it by 'boxplus slam', and give its output folder"):
            open_saved_map(tmp_path / recording)
    (tmp_path / "text.txt").write_text("no points")
    with pytest.raises(InputError, match="LAZ or E57 file"):
        open_saved_map(tmp_path / "text.txt")
    with TileWriter(tmp_path / "none"):
        pass
    with pytest.raises(InputError, match="a map with points"):
        open_saved_map(tmp_path / "none")


def test_what_a_wall_hides_is_not_visible() -> None:
    random = np.random.default_rng(4)
    near = np.column_stack([np.full(4000, 4.0), random.uniform(-4, 4, 4000), random.uniform(-2, 2, 4000)])
    points = np.concatenate([near, 3.0 * near]).astype(np.float32)
    mask = visible(points, [0.0, 0.0, 0.0], 50.0)
    assert mask[:4000].all() and np.mean(mask[4000:]) < 0.05
    assert not visible(points, [0.0, 0.0, 0.0], 3.0).any()
