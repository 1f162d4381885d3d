"""Line sets of the Visual Geometry Group: malformed files, and the published sets against the stated residuals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.formats.reconstructions.vgg_lines import read_vgg_lines
from boxplus.formats.reconstructions.vgg_writer import write_vgg_lines
from boxplus.manifolds import lines, quaternion
from boxplus.residuals.camera.line_reprojection import LineReprojection

K = np.array([[500.0, 3.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two views of two lines; the second camera is written with a negative scale."""
    for view, scale in enumerate((1.0, -2.5)):
        P = scale * K @ np.hstack([np.eye(3), [[0.1 * view], [0.2], [3.0]]])
        np.savetxt(tmp_path / f"{view:03d}.P", P)
        (tmp_path / f"{view:03d}.lines").write_text("1 2 30 40 9.5 0.1\n5 6 70 80\n\n9 10 11 120\n")
    (tmp_path / "set.l3d").write_text("0 0 0 1 0 0\n0 1 0 0 1 5\n")
    (tmp_path / "set.nview-lines").write_text("0 *\n2 1\n")
    return tmp_path


def test_reads_cameras_segments_and_matches(folder: Path) -> None:
    data = read_vgg_lines(folder)
    assert data.names == ("000", "001")
    np.testing.assert_allclose(data.K, [K, K], atol=1e-9)
    np.testing.assert_allclose(data.T_camera_world, [[1, 0, 0, 0, 0, 0.2, 3], [1, 0, 0, 0, 0.1, 0.2, 3]], atol=1e-12)
    assert data.view_of.tolist() == [0, 0, 1] and data.line_of.tolist() == [0, 1, 1]
    np.testing.assert_array_equal(data.segments, [[1, 2, 30, 40], [9, 10, 11, 120], [5, 6, 70, 80]])
    np.testing.assert_array_equal(data.end_points_world, [[0, 0, 0, 1, 0, 0], [0, 1, 0, 0, 1, 5]])


def test_reads_the_matches_that_have_a_row_for_each_line(folder: Path) -> None:
    (folder / "other.nview-lines").write_text("0 0\n")
    assert len(read_vgg_lines(folder).segments) == 3


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("000.lines", "1 2 3 4\n1 2 x 4\n", r"expected 4 numbers – got '1 2 x 4' \(.*000\.lines, line 2\) – repair the line"),
        ("000.lines", "1 2 3\n", "expected 4 numbers"),
        ("set.l3d", "0 0 0 1 0 nan\n0 0 0 1 0 0\n", r"expected 6 numbers – got .*set\.l3d, line 1"),
        ("001.P", "1 2 3 4\n", r"a projection matrix of 3 × 4 numbers, the left 3 × 3 regular – got shape \(1, 4\)"),
        ("001.P", "1 2 3 4\n2 4 6 8\n1 1 1 1\n", "the left 3 × 3 regular"),
        ("set.nview-lines", "0 *\n3 1\n", r"a segment from 0 to 2 in view 0 – got 3 \(.*nview-lines, line 2\)"),
        ("set.nview-lines", "0 *\n-1 1\n", "2 row numbers or"),
        ("set.nview-lines", "0 *\n1\n", r"2 row numbers or \*, one for each view – got '1'"),
        ("set.nview-lines", "0 *\n", "one file .*nview-lines with 2 rows, one for each 3D line – got 0 of"),
    ],
)
def test_malformed_files_are_refused(folder: Path, file: str, text: str, message: str) -> None:
    (folder / file).write_text(text)
    with pytest.raises(InputError, match=message):
        read_vgg_lines(folder)


def test_missing_files_are_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a folder with"):
        read_vgg_lines(tmp_path / "nowhere")
    (folder / "001.lines").unlink()
    with pytest.raises(InputError, match=r"the segments of the view in 001\.lines – got no such file"):
        read_vgg_lines(folder)
    (folder / "set.l3d").unlink()
    (folder / "001.lines").write_text("1 2 3 4\n")
    with pytest.raises(InputError, match=r"one file \*l3d of 3D lines – got 0"):
        read_vgg_lines(folder)
    for file in folder.glob("*.P"):
        file.unlink()
    with pytest.raises(InputError, match=r"a camera file \*\.P for every view – got none"):
        read_vgg_lines(folder)


@pytest.mark.parametrize(
    ("name", "views", "count", "observations", "median"),
    [("Corridor", 11, 69, 632, 0.16), ("Model-House", 10, 30, 223, 0.24), ("Merton-College-I", 3, 295, 885, 0.28)],
)
def test_published_sets_have_the_stated_residuals(
    shared_data: Path, name: str, views: int, count: int, observations: int, median: float
) -> None:
    folder = shared_data / "lines" / "vgg" / name
    if not folder.is_dir():
        pytest.skip(f"{name} is not on this machine")
    data = read_vgg_lines(folder)
    assert (len(data.names), len(data.end_points_world), len(data.segments)) == (views, count, observations)
    np.testing.assert_allclose(np.linalg.det(quaternion.to_matrix(data.T_camera_world[:, :4])), 1.0)
    line = lines.from_points(data.end_points_world[:, :3], data.end_points_world[:, 3:])
    residual = LineReprojection(data.K[data.view_of], data.segments)
    linear = residual.linearize(data.T_camera_world[data.view_of], line[data.line_of])
    assert linear.valid.all()
    # Stated as the median over the observations of the root mean square of their two distances.
    assert float(np.median(np.sqrt((linear.residuals**2).mean(axis=1)))) == pytest.approx(median, abs=0.005)


def test_points_are_read_with_the_lines(folder: Path) -> None:
    for view in range(2):
        (folder / f"{view:03d}.corners").write_text("10 20\n30 40\n")
    (folder / "set.p3d").write_text("0 0 0\n1 1 1\n2 2 2\n")
    (folder / "set.nview-corners").write_text("1 *\n0 1\n* *\n")
    data = read_vgg_lines(folder)
    np.testing.assert_array_equal(data.points_world, [[0, 0, 0], [1, 1, 1], [2, 2, 2]])
    assert data.point_view_of.tolist() == [0, 0, 1] and data.point_of.tolist() == [0, 1, 1]
    np.testing.assert_array_equal(data.pixels, [[30, 40], [10, 20], [30, 40]])
    (folder / "set.nview-corners").write_text("1 *\n0 1\n")
    with pytest.raises(InputError, match=r"3 rows in set\.nview-corners, one for each point – got 2"):
        read_vgg_lines(folder)
    (folder / "set.nview-corners").unlink()
    with pytest.raises(InputError, match=r"one file \*p3d of points and one \*nview-corners"):
        read_vgg_lines(folder)


def test_a_world_behind_the_cameras_is_reflected(folder: Path, tmp_path: Path) -> None:
    data = read_vgg_lines(folder)
    assert not data.reflected
    for view in range(2):
        P = np.loadtxt(folder / f"{view:03d}.P") @ np.diag([-1.0, -1.0, -1.0, 1.0])
        np.savetxt(folder / f"{view:03d}.P", P)
    np.savetxt(folder / "set.l3d", -data.end_points_world)
    mirrored = read_vgg_lines(folder)
    assert mirrored.reflected
    np.testing.assert_allclose(mirrored.end_points_world, data.end_points_world)
    np.testing.assert_allclose(mirrored.T_camera_world, data.T_camera_world, atol=1e-12)


def test_what_is_written_is_read_again(folder: Path, tmp_path: Path) -> None:
    data = read_vgg_lines(folder)
    again = read_vgg_lines(write_vgg_lines(tmp_path / "out", data))
    for name in ("K", "T_camera_world", "end_points_world"):
        np.testing.assert_allclose(getattr(again, name), getattr(data, name), atol=1e-12)
    order, other = (np.lexsort((d.view_of, d.line_of)) for d in (data, again))
    np.testing.assert_array_equal(data.segments[order], again.segments[other])
    assert (data.line_of[order] == again.line_of[other]).all() and not again.reflected and len(again.points_world) == 0
