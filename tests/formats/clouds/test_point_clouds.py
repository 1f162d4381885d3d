"""PLY and PCD files."""

from __future__ import annotations

import errno
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from boxplus.errors import InputError, OutputError
from boxplus.formats.clouds.cloud_writer import RecordWriter
from boxplus.formats.clouds.pcd import PcdWriter, read_pcd, write_pcd
from boxplus.formats.clouds.ply import PlyWriter, ply_vertex_count, read_ply, write_ply
from boxplus.formats.clouds.point_cloud import PointCloud

FIELDS = [(name, np.dtype("<f4")) for name in ("x", "y", "z", "intensity")]
KINDS = [pytest.param((PlyWriter, read_ply), id="ply"), pytest.param((PcdWriter, read_pcd), id="pcd")]
Kind = tuple[type[RecordWriter], Callable[[Path], PointCloud]]
blocks = st.lists(arrays(np.float32, st.tuples(st.integers(0, 5), st.just(4))), max_size=4)


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=60, deadline=None)
@given(data=blocks, with_intensity=st.booleans())
def test_blocks_round_trip(tmp_path_factory: pytest.TempPathFactory, kind: Kind, data: list[Any], with_intensity: bool) -> None:
    path = tmp_path_factory.getbasetemp() / "cloud"
    with kind[0](path) as writer:
        for block in data:
            writer.append(block[:, :3], block[:, 3] if with_intensity else None)
    cloud = kind[1](path)
    everything = np.concatenate([np.empty((0, 4), np.float32), *data])
    np.testing.assert_array_equal(cloud.points, everything[:, :3])
    if with_intensity and data:
        np.testing.assert_array_equal(cloud.intensity, everything[:, 3])
    else:
        assert cloud.intensity is None
    assert cloud.points.dtype == np.float32


@pytest.mark.parametrize("kind", KINDS)
def test_header_length_does_not_depend_on_the_count(kind: Kind) -> None:
    for fields in (FIELDS[:3], FIELDS):
        assert len({len(kind[0].header(count, fields)) for count in (0, 7, 10**6, 10**12)}) == 1


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_gets_its_name_only_when_it_is_whole(tmp_path: Path, kind: Kind) -> None:
    path = tmp_path / "cloud"
    path.write_text("what was here before")
    with pytest.raises(KeyError), kind[0](path) as writer:
        writer.append(np.zeros((10, 3)))
        raise KeyError
    assert path.read_text() == "what was here before"
    assert [p.name for p in tmp_path.iterdir()] == ["cloud"]
    with pytest.raises(OutputError, match="append before close"):
        writer.append(np.zeros((1, 3)))


@pytest.mark.parametrize("kind", KINDS)
def test_full_disk(tmp_path: Path, kind: Kind, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OutputError, match="a full disk"), kind[0](tmp_path / "cloud") as writer:
        writer.append(np.zeros((10, 3)))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", KINDS)
def test_wrong_shapes(tmp_path: Path, kind: Kind) -> None:
    writer = kind[0](tmp_path / "cloud")
    with pytest.raises(InputError, match=r"shape \(N, 3\)"):
        writer.append(np.zeros((3, 2)))
    with pytest.raises(InputError, match=r"intensity of shape \(3,\)"):
        writer.append(np.zeros((3, 3)), np.zeros(2))
    writer.append(np.zeros((3, 3)), np.zeros(3))
    with pytest.raises(InputError, match="in every block or in none"):
        writer.append(np.zeros((3, 3)))
    writer.close()
    assert kind[1](tmp_path / "cloud").points.shape == (3, 3)


@pytest.mark.parametrize("kind", KINDS)
def test_every_cut_is_noticed(tmp_path: Path, kind: Kind) -> None:
    path = tmp_path / "cloud"
    with kind[0](path) as writer:
        writer.append(np.ones((3, 3)), np.ones(3))
    data = path.read_bytes()
    for end in range(len(data)):
        path.write_bytes(data[:end])
        with pytest.raises(InputError, match="cloud"):
            kind[1](path)


def test_ascii_ply_with_other_elements_and_properties(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    header = """ply
format ascii 1.0
comment by hand
element camera 1
property float focal
element vertex 2
property double x
property double y
property double z
property uchar red
property float scalar_Intensity
element face 1
property list uchar int vertex_indices
end_header
525
1 2 3 255 0.5
4 5 6 0 0.25
3 0 1 0
"""
    path.write_text(header)
    cloud = read_ply(path)
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(cloud.intensity, [0.5, 0.25])
    assert ply_vertex_count(path) == 2
    path.write_text(header.replace("4 5 6 0 0.25", "4 5 six 0 0.25"))
    with pytest.raises(InputError, match=r"expected 5 numbers – got '4 5 six 0 0.25' \(.*a.ply, line 17\)"):
        read_ply(path)


def test_big_endian_ply(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    header = (
        "ply\nformat binary_big_endian 1.0\nelement vertex 2\n"
        + "".join(f"property double {a}\n" for a in "zyx")
        + "end_header\n"
    )
    path.write_bytes(header.encode() + np.arange(6, dtype=">f8").tobytes())
    np.testing.assert_array_equal(read_ply(path).points, [[2, 1, 0], [5, 4, 3]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"begins with 'ply' – got something else \(.*, line 1\)"),
        ("ply\nformat ascii 2\n", "ends with 'end_header' – got none"),
        ("ply\nformat text 1.0\nend_header\n", r"'format text 1.0' \(.*, line 2\)"),
        ("ply\nformat ascii 1.0\nelement vertex many\nend_header\n", r"'element vertex many' \(.*, line 3\)"),
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty half x\nend_header\n", r"'property half x' \(.*, line 4\)"),
        ("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n", "points with x, y and z – got x"),
        ("ply\nelement vertex 1\nend_header\n", "a header line 'format …' – got none"),
        ("ply\nformat ascii 1.0\nend_header\n", "an element 'vertex' – got none"),
        (
            "ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int i\nelement vertex 0\nend_header\n",
            "the list property 'i' of 'face' first",
        ),
    ],
)
def test_malformed_ply(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.ply").write_text(text)
    with pytest.raises(InputError, match=message):
        read_ply(tmp_path / "a.ply")


PCD = """# .PCD v.7
VERSION .7
FIELDS x y z _ intensity
SIZE 4 4 4 1 2
TYPE F F F U U
COUNT 1 1 1 3 1
WIDTH 2
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 2
DATA ascii
1 2 3 0 0 0 40000
4 5 6 0 0 0 7
"""


def test_ascii_and_padded_pcd(tmp_path: Path) -> None:
    path = tmp_path / "a.pcd"
    path.write_text(PCD)
    cloud = read_pcd(path)
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(cloud.intensity, [40000, 7])
    records = np.zeros(2, dtype=[("p", "<f4", 3), ("pad", "u1", 3), ("i", "<u2")])
    records["p"], records["i"] = cloud.points, [40000, 7]
    path.write_bytes(PCD.split("ascii")[0].encode() + b"binary\n" + records.tobytes())
    back = read_pcd(path)
    np.testing.assert_array_equal(back.points, cloud.points)
    np.testing.assert_array_equal(back.intensity, cloud.intensity)


def test_rows_of_an_organised_pcd_count_where_its_points_are_not_said(tmp_path: Path) -> None:
    """Only the first row was read, and the others were left out in silence."""
    path = tmp_path / "a.pcd"
    path.write_text(PCD.replace("WIDTH 2\nHEIGHT 1", "WIDTH 1\nHEIGHT 2").replace("POINTS 2\n", ""))
    np.testing.assert_array_equal(read_pcd(path).points, [[1, 2, 3], [4, 5, 6]])
    path.write_text(PCD.replace("HEIGHT 1\n", "").replace("POINTS 2\n", ""))
    assert len(read_pcd(path)) == 2


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("DATA ascii", "DATA binary_compressed", r"got DATA binary_compressed \(.*, line 11\) – convert the file"),
        ("POINTS 2", "POINTS two", r"POINTS with a number – got 'two' \(.*, line 10\)"),
        ("POINTS 2", "POINTS 3", r"expected 3 points, as the header says – got 2 \(.*, line 14\)"),
        ("SIZE 4 4 4 1 2", "SIZE 4 4", r"of the same length .*line 3"),
        ("TYPE F F F U U", "TYPE F F F U Q", "of known types"),
        ("SIZE 4 4 4 1 2", "SIZE 3 4 4 1 2", "of known types"),
        ("VERSION .7", "VERSIO .7", r"'VERSIO .7' \(.*, line 2\)"),
        ("4 5 6 0 0 0 7", "4 5 6 0 0 0", r"expected 7 numbers – got '4 5 6 0 0 0' \(.*, line 13\)"),
        ("FIELDS x y z _", "FIELDS x y y _", "of the same length"),
        ("FIELDS x y z _", "FIELDS x y q _", "points with x, y and z"),
    ],
)
def test_malformed_pcd(tmp_path: Path, old: str, new: str, message: str) -> None:
    (tmp_path / "a.pcd").write_text(PCD.replace(old, new))
    with pytest.raises(InputError, match=message):
        read_pcd(tmp_path / "a.pcd")


@given(data=st.binary(max_size=200), kind=st.sampled_from(["ply", "pcd"]))
@settings(max_examples=200, deadline=None)
def test_any_bytes_give_points_or_an_input_error(tmp_path_factory: pytest.TempPathFactory, data: bytes, kind: str) -> None:
    path = tmp_path_factory.getbasetemp() / "fuzz"
    beginning = {"ply": PlyWriter, "pcd": PcdWriter}[kind].header(3, FIELDS)
    cut = data[0] if data else 0
    path.write_bytes(beginning[: len(beginning) * cut // 200] + data)
    try:
        for everything in (False, True):
            cloud = {"ply": read_ply, "pcd": read_pcd}[kind](path, everything=everything)
            assert cloud.points.ndim == 2
    except InputError as error:
        assert "expected" in str(error)


def test_missing_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="readable PLY file"):
        read_ply(tmp_path / "none.ply")
    with pytest.raises(InputError, match="readable PCD file"):
        read_pcd(tmp_path / "none.pcd")


def test_real_clouds(shared_data: Path, tmp_path: Path) -> None:
    for name, count in (("source", 69_792), ("target", 69_088)):
        path = shared_data / "clouds" / "small-gicp-pair" / f"{name}.ply"
        cloud = read_ply(path)
        assert len(cloud) == count == ply_vertex_count(path)
        assert np.isfinite(cloud.points).all()
        write_pcd(tmp_path / "a.pcd", cloud.points, cloud.intensity)
        write_ply(tmp_path / "a.ply", cloud.points, cloud.intensity)
        for back in (read_pcd(tmp_path / "a.pcd"), read_ply(tmp_path / "a.ply")):
            np.testing.assert_array_equal(back.points, cloud.points)
            np.testing.assert_array_equal(back.intensity, cloud.intensity)
