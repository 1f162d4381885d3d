"""LAS, LAZ and E57 through their libraries, and the choice of a format by its ending."""

from __future__ import annotations

import errno
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from boxplus.errors import InputError, OutputError
from boxplus.formats.clouds.cloud_file import CLOUD_ENDINGS, cloud_writer, read_cloud
from boxplus.formats.clouds.las import read_survey
from boxplus.formats.clouds.ply import read_ply
from boxplus.formats.clouds.point_cloud import FARTHEST_M

laspy = pytest.importorskip("laspy", reason="laspy (pip install 'boxplus[las]') is not installed")
NO_E57 = pytest.mark.skipif(find_spec("pye57") is None, reason="pye57 (pip install 'boxplus[e57]') is not installed")
ENDINGS = [pytest.param(ending, marks=[NO_E57] if ending == ".e57" else []) for ending in CLOUD_ENDINGS]
HALF_STEP = 0.5e-4 + 1e-9  # of LAS, m
numbers = st.floats(-60_000, 60_000, width=32)
blocks = st.lists(arrays(np.float32, st.tuples(st.integers(0, 5), st.just(4)), elements=numbers), max_size=3)


@pytest.fixture(scope="module", autouse=True)
def short_scans() -> Iterator[None]:
    """E57 files of several scans from few points."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("boxplus.formats.clouds.e57._SCAN", 4)
        yield


@pytest.mark.parametrize("ending", ENDINGS)
@settings(max_examples=25, deadline=None)
@given(data=blocks, with_intensity=st.booleans())
def test_blocks_round_trip(tmp_path_factory: pytest.TempPathFactory, ending: str, data: list[Any], with_intensity: bool) -> None:
    path = tmp_path_factory.getbasetemp() / f"cloud{ending}"
    with cloud_writer(path) as writer:
        for block in data:
            writer.append(block[:, :3], block[:, 3] if with_intensity else None)
    cloud = read_cloud(path)
    everything = np.concatenate([np.empty((0, 4), np.float32), *data])
    rounded = HALF_STEP if ending in (".las", ".laz") else 0.0
    # What is read is float32 again: half of its last digit beside the rounding of LAS.
    assert np.abs(cloud.points.astype(float) - everything[:, :3]).max(initial=0.0) <= rounded + (0.004 if rounded else 0.0)
    small = np.abs(everything[:, :3]).max(axis=1, initial=0.0) < 500
    assert np.abs(cloud.points[small].astype(float) - everything[small, :3]).max(initial=0.0) <= rounded * 1.4
    if with_intensity and len(everything):
        np.testing.assert_array_equal(cloud.intensity, everything[:, 3])
    assert writer.count == len(cloud) == len(everything)


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_file_gets_its_name_only_when_it_is_whole(tmp_path: Path, ending: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / f"cloud{ending}"
    path.write_text("what was here before")
    with pytest.raises(KeyError), cloud_writer(path) as writer:
        writer.append(np.zeros((10, 3)))
        raise KeyError

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OutputError, match="a full disk"), cloud_writer(path) as writer:
        writer.append(np.zeros((10, 3)))
    assert path.read_text() == "what was here before"
    assert [found.name for found in tmp_path.iterdir()] == [path.name]
    with pytest.raises(OutputError, match="append before close"):
        writer.append(np.zeros((1, 3)))


@pytest.mark.parametrize("ending", ENDINGS)
def test_cut_and_other_files_are_refused(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"cloud{ending}"
    with cloud_writer(path) as writer:
        writer.append(np.arange(300.0).reshape(100, 3), np.arange(100.0))
    whole = path.read_bytes()
    for end in (0, 3, len(whole) // 3, len(whole) - 1):
        path.write_bytes(whole[:end])
        with pytest.raises(InputError, match="expected"):
            read_cloud(path)
    path.write_bytes(b"something else entirely " * 40)
    with pytest.raises(InputError, match="expected"):
        read_cloud(path)
    with pytest.raises(InputError, match="readable"):
        read_cloud(tmp_path / f"none{ending}")


def test_what_other_programs_see_in_a_las_file(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(scale=50.0, size=(500, 3)).astype(np.float32)
    intensity = np.linspace(-3.0, 70_000.0, 500).astype(np.float32)
    for name in ("a.las", "a.laz"):
        with cloud_writer(tmp_path / name) as writer:
            writer.append(points, intensity)
        found = laspy.read(tmp_path / name)
        np.testing.assert_allclose(found.xyz, points, atol=HALF_STEP)
        np.testing.assert_array_equal(found.intensity, np.clip(np.round(intensity), 0, 65535))
        assert (found.header.version.major, found.header.version.minor, found.header.point_format.id) == (1, 4, 6)
        np.testing.assert_allclose(found.header.maxs, points.max(axis=0), atol=HALF_STEP)
        assert set(np.asarray(found.return_number)) == {1}
    assert (tmp_path / "a.laz").stat().st_size < (tmp_path / "a.las").stat().st_size


def test_las_files_of_other_programs(tmp_path: Path) -> None:
    header = laspy.LasHeader(version="1.2", point_format=1)
    header.scales, header.offsets = [0.01] * 3, [1000.0, 2000.0, 0.0]
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = np.array([[1000.5, 1001.25], [2000.0, 1999.5], [3.0, -3.0]])
    cloud.write(tmp_path / "b.las")
    back = read_cloud(tmp_path / "b.las")
    np.testing.assert_allclose(back.points, [[1000.5, 2000.0, 3.0], [1001.25, 1999.5, -3.0]])
    assert back.intensity is None  # all zero: the format always has the field
    cloud.x = np.array([FARTHEST_M + 500_000.0, 0.0])
    cloud.write(tmp_path / "utm.las")
    with pytest.raises(InputError, match=r"within 66 km of the origin.* got x up to 565536\.0 m .* subtract a local"):
        read_cloud(tmp_path / "utm.las")
    with pytest.raises(InputError, match="within 215 km of the origin"), cloud_writer(tmp_path / "far.las") as writer:
        writer.append([[300_000.0, 0.0, 0.0]])
    assert not (tmp_path / "far.las").exists()


def test_surveys_keep_their_millimetres_about_an_origin_nearby(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    xyz = random.uniform((691_200.0, 5_334_100.0, 480.0), (691_700.0, 5_334_900.0, 560.0), (2000, 3))

    def write(name: str, points: np.ndarray, epsg: int | str | None = None) -> Path:
        header = laspy.LasHeader(version="1.4", point_format=6)
        header.scales, header.offsets = [1e-3] * 3, np.floor(points.min(axis=0))
        if epsg is not None:
            header.add_crs(pytest.importorskip("pyproj").CRS.from_user_input(epsg))
        cloud = laspy.LasData(header)
        cloud.x, cloud.y, cloud.z = points.T
        cloud.write(str(tmp_path / name))
        return tmp_path / name

    found, origin = read_survey(write("survey.laz", xyz))
    assert (np.abs(origin[:2] - xyz.mean(axis=0)[:2]) <= 500.0).all() and (origin % 1000.0 == 0.0).all() and origin[2] == 0.0
    np.testing.assert_allclose(origin + found.points, xyz, atol=0.5e-3 + np.spacing(np.float32(1000.0)))
    found, origin = read_survey(write("near.las", xyz - (691_000.0, 5_334_000.0, 0.0)))
    np.testing.assert_array_equal(origin, np.zeros(3))
    np.testing.assert_array_equal(found.points, read_cloud(tmp_path / "near.las").points)
    with pytest.raises(InputError, match="in degrees"):
        read_survey(write("degrees.las", np.array([[11.5, 48.1, 500.0]]), epsg=4326))
    # Surveys of the United States have heights in feet also where the place is in metres.
    with pytest.raises(InputError, match=r"Easting in US survey foot, Northing in US survey foot .* by 0\.3048006"):
        read_survey(write("feet.laz", xyz, epsg=2263))
    with pytest.raises(InputError, match=r": Gravity-related height in US survey foot \("):
        read_survey(write("heights.laz", xyz, epsg="EPSG:26918+6360"))
    with pytest.raises(InputError, match="from the middle of the Earth"):
        read_survey(write("geocentric.laz", xyz, epsg=4978))
    assert len(read_survey(write("metres.laz", xyz, epsg="EPSG:25832+5783"))[0]) == len(xyz)


def test_ply_files_in_a_map_projection_are_not_read_to_half_a_metre(tmp_path: Path) -> None:
    header = "ply\nformat ascii 1.0\nelement vertex 1\n" + "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
    (tmp_path / "utm.ply").write_text(header + "457000.25 5400000.125 115\n")
    with pytest.raises(InputError, match=r"which float32 holds to 4 mm – got x up to 457000"):
        read_ply(tmp_path / "utm.ply")


@pytest.mark.parametrize(("module", "ending"), [("laspy", "las"), ("lazrs", "laz"), ("pye57", "e57")])
def test_a_missing_library_is_a_sentence(tmp_path: Path, module: str, ending: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(InputError, match=rf"pip install .*{'pye57' if ending == 'e57' else 'laspy'}"):
        cloud_writer(tmp_path / f"a.{ending}")
    assert not list(tmp_path.iterdir())


def test_endings_of_no_format_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a point cloud that ends in \.ply, \.pcd, \.las, \.laz, \.e57 – got a\.xyz"):
        cloud_writer(tmp_path / "a.xyz")
    assert type(cloud_writer(tmp_path / "A.PLY")).__name__ == "PlyWriter"
