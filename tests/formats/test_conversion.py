"""Files in other formats of their kind: there and back again."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.errors import InputError
from boxplus.formats.clouds.cloud_file import cloud_writer, read_cloud
from boxplus.formats.clouds.ply import write_ply
from boxplus.formats.conversion import convert
from boxplus.formats.graphs.g2o import read_g2o
from boxplus.formats.reconstructions.bal import BalProblem, read_bal, write_bal
from boxplus.formats.reconstructions.colmap import read_colmap, write_colmap
from boxplus.formats.reconstructions.colmap_model import ColmapModel
from boxplus.formats.reconstructions.gbp import write_gbp
from boxplus.formats.trajectory import Trajectory, read_trajectory, write_csv
from tests.small_problems import bal_problem, colmap_model, gbp_problem, write_small_files


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


def test_the_verdict_on_each_pose_is_not_dropped_in_silence(tmp_path: Path) -> None:
    q = np.tile([1.0, 0.0, 0.0, 0.0], (3, 1))
    write_csv(tmp_path / "a.csv", Trajectory(10**9 * np.arange(3), np.eye(3), q, status=("ok", "weak", "lost")))
    assert convert(tmp_path / "a.csv", tmp_path / "b.csv") == "3 poses"
    assert read_trajectory(tmp_path / "b.csv").status == ("ok", "weak", "lost")
    assert convert(tmp_path / "a.csv", tmp_path / "a.tum") == "3 poses, without the status of the source"
    told = convert(tmp_path / "a.csv", tmp_path / "a.txt", "kitti")
    assert told == "3 poses, without the stamps and status of the source"
    row = ",".join(["1403636580838555648", *(["0"] * 3), "1", *(["0"] * 12)])
    (tmp_path / "euroc.csv").write_text(f"#timestamp, …\n{row}\n")
    assert convert(tmp_path / "euroc.csv", tmp_path / "e.tum") == "1 poses, without the 9 columns beside the poses of the source"


def cloud(count: int = 60) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    random = np.random.default_rng(1)
    columns = {
        **{color: random.integers(0, 256, count).astype(np.uint8) for color in ("red", "green", "blue")},
        "ring": random.integers(0, 64, count).astype(np.uint16),
        "time": random.uniform(0.0, 0.1, count),
        "curvature": random.normal(size=count).astype(np.float32),
    }
    return random.normal(size=(count, 3)).astype(np.float32), random.uniform(0, 255, count).astype(np.float32), columns


@pytest.mark.parametrize("ending", ["ply", "pcd", "las", "laz", "e57"])
def test_columns_of_a_cloud_go_along_where_they_can(tmp_path: Path, ending: str) -> None:
    """There and back: what a format holds comes back bit by bit, and what it does not is named."""
    points, intensity, columns = cloud()
    with cloud_writer(tmp_path / "a.ply") as writer:
        writer.append(points[:20], intensity[:20], {name: values[:20] for name, values in columns.items()})
        writer.append(points[20:], intensity[20:], {name: values[20:] for name, values in columns.items()})
    target = tmp_path / f"b.{ending}"
    told = convert(tmp_path / "a.ply", target)
    lost = ", without the curvature, ring and time of the source" if ending == "e57" else ""
    assert told == f"60 points{lost}"
    assert convert(target, tmp_path / "c.ply") == "60 points"
    back = read_cloud(tmp_path / "c.ply", everything=True)
    assert back.left_out == () and set(back.columns) == set(columns) - ({"curvature", "ring", "time"} if lost else set())
    for name, values in back.columns.items():
        assert values.dtype == columns[name].dtype
        np.testing.assert_array_equal(values, columns[name])
    np.testing.assert_allclose(back.points, points, atol=0.51e-4)
    np.testing.assert_array_equal(back.intensity, intensity)
    assert not read_cloud(target).columns  # only where they are asked for


def test_what_a_cloud_has_beside_its_points_is_named(tmp_path: Path) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {name}\n" for name in "xyz")
    mesh = f"{head}element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n3 0 1 0\n"
    (tmp_path / "mesh.ply").write_text(mesh)
    assert convert(tmp_path / "mesh.ply", tmp_path / "mesh.pcd") == "2 points, without the 1 face elements of the source"
    lines = ["VERSION 0.7", "FIELDS x y z rgb fpfh label", "SIZE 4 4 4 4 4 8", "TYPE F F F F F I", "COUNT 1 1 1 1 3 1"]
    lines += ["WIDTH 2", "HEIGHT 1", "VIEWPOINT 0 0 1 1 0 0 0", "POINTS 2", "DATA ascii"]
    packed = np.array([0x00FF8001, 0x00000102], np.uint32).view(np.float32)
    lines += [f"{k} 0 0 {value!r} 1 2 3 {2**53 - k}" for k, value in enumerate(packed.tolist())]
    (tmp_path / "a.pcd").write_text("\n".join(lines) + "\n")
    told = convert(tmp_path / "a.pcd", tmp_path / "a.ply")
    assert told == "2 points, without the fpfh, label and the viewpoint of the source"
    back = read_cloud(tmp_path / "a.ply", everything=True).columns
    assert [back[color].tolist() for color in ("red", "green", "blue")] == [[255, 0], [128, 1], [1, 2]]
    convert(tmp_path / "a.pcd", tmp_path / "b.pcd")
    assert read_cloud(tmp_path / "b.pcd", everything=True).columns["label"].tolist() == [2**53, 2**53 - 1]


def test_fields_of_las_stay_its_own(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    points, _, columns = cloud(8)
    made = laspy.LasData(laspy.LasHeader(version="1.4", point_format=7))
    made.xyz = points.astype(np.float64)
    made.classification, made.gps_time = np.arange(8, dtype=np.uint8), columns["time"]
    made.return_number[:] = made.number_of_returns[:] = 2
    made.red = made.green = made.blue = np.arange(1, 9, dtype=np.uint16) * 1001  # 16 bits of them
    made.write(tmp_path / "a.las")
    assert convert(tmp_path / "a.las", tmp_path / "b.laz") == "8 points"
    again = laspy.read(tmp_path / "b.laz")
    for name in ("classification", "gps_time", "return_number", "number_of_returns", "red", "blue"):
        np.testing.assert_array_equal(again[name], made[name])
    assert "blue, classification" in convert(tmp_path / "b.laz", tmp_path / "c.e57")


def test_columns_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    points, _, columns = cloud(4)
    with pytest.raises(InputError, match="the same columns in every block"), cloud_writer(tmp_path / "a.ply") as writer:
        writer.append(points, None, {"ring": columns["ring"]})
        writer.append(points)
    with pytest.raises(InputError, match=r"columns of shape \(4,\)"), cloud_writer(tmp_path / "a.ply") as writer:
        writer.append(points, None, {"ring": columns["ring"][:3]})
    assert list(tmp_path.iterdir()) == []


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


def seen_by_bal(problem: BalProblem) -> np.ndarray:
    """Reprojections by the formula of the format's authors."""
    w, t, f, k1, k2 = np.split(problem.cameras[problem.camera_of], [3, 6, 7, 8], axis=1)
    P = Rotation.from_rotvec(w).apply(problem.points[problem.point_of]) + t
    p = -P[:, :2] / P[:, 2:]
    r2 = (p**2).sum(axis=1, keepdims=True)
    return f * (1.0 + k1 * r2 + k2 * r2**2) * p


def seen_by_colmap(model: ColmapModel) -> np.ndarray:
    """Of its SIMPLE_RADIAL and RADIAL cameras, where the observations are of points."""
    kept = model.point_of >= 0
    image_of, points = model.image_of[kept], model.points[model.point_of[kept]]
    T = model.T_camera_world[image_of]
    P = Rotation.from_quat(T[:, [1, 2, 3, 0]]).apply(points) + T[:, 4:]
    lens = np.array([np.pad(params, (0, 5 - len(params))) for params in model.camera_params])[model.camera_of[image_of]]
    p = P[:, :2] / P[:, 2:]
    r2 = (p**2).sum(axis=1, keepdims=True)
    return lens[:, :1] * (1.0 + lens[:, 3:4] * r2 + lens[:, 4:] * r2**2) * p + lens[:, 1:3]


def test_a_bal_file_becomes_a_colmap_model_and_comes_back(tmp_path: Path) -> None:
    problem = bal_problem()
    write_bal(tmp_path / "a.txt", problem)
    told = convert(tmp_path / "a.txt", tmp_path / "model", "colmap-binary")
    assert told.endswith(" observations; names and sizes of the images and colours are made up")
    model = read_colmap(tmp_path / "model")
    assert set(model.camera_models) == {"RADIAL"} and len(model.camera_ids) == len(model.image_ids) == len(problem.cameras)
    sizes = model.camera_sizes[model.camera_of[model.image_of]]
    assert (model.pixels >= 0.0).all() and (model.pixels <= sizes).all()
    order = np.argsort(problem.camera_of, kind="stable")
    errors = (seen_by_bal(problem) - problem.pixels)[order]
    np.testing.assert_allclose(seen_by_colmap(model) - model.pixels, errors * [1.0, -1.0], atol=1e-9)
    told = convert(tmp_path / "model", tmp_path / "b.txt.bz2")
    assert told.endswith(", without the colours, ids, image names and image sizes of the source")
    back = read_bal(tmp_path / "b.txt.bz2")
    np.testing.assert_allclose(back.cameras, problem.cameras, atol=1e-9)
    np.testing.assert_allclose(back.pixels, problem.pixels[order], atol=1e-9)


def test_a_colmap_model_becomes_a_bal_file_with_the_same_errors(tmp_path: Path) -> None:
    model = colmap_model()
    write_colmap(tmp_path / "model", model)
    told = convert(tmp_path / "model", tmp_path / "a.txt", "bal")
    assert "cameras that images share (each image has its own now)" in told and "observations of no point" in told
    problem = read_bal(tmp_path / "a.txt")
    errors = seen_by_colmap(model) - model.pixels[model.point_of >= 0]
    np.testing.assert_allclose((seen_by_bal(problem) - problem.pixels) * [1.0, -1.0], errors, atol=1e-8)
    for name in ("OPENCV", "OPENCV_FISHEYE"):
        lens = (np.array([5e2, 5e2, 3e2, 2e2, 0.1, 0.0, 1e-3, 0.0]),)
        write_colmap(tmp_path / name, replace(model, camera_models=(name,), camera_params=lens))
        with pytest.raises(InputError, match=f"cameras that BAL can hold: .* – got camera 7 of the model {name}"):
            convert(tmp_path / name, tmp_path / "b.txt", "bal")
    write_colmap(
        tmp_path / "pinhole", replace(model, camera_models=("PINHOLE",), camera_params=(np.array([5e2, 5e2, 3e2, 2e2]),))
    )
    convert(tmp_path / "pinhole", tmp_path / "c.txt", "bal")
    np.testing.assert_array_equal(read_bal(tmp_path / "c.txt").cameras[:, 6:], np.tile([500.0, 0.0, 0.0], (6, 1)))


def test_a_file_of_the_graph_processor_is_converted_too(tmp_path: Path) -> None:
    given = gbp_problem()
    write_gbp(tmp_path / "a.txt", given)
    convert(tmp_path / "a.txt", tmp_path / "model", "colmap-text")
    model = read_colmap(tmp_path / "model")
    np.testing.assert_allclose(model.T_camera_world, given.T_camera_world, atol=1e-9)
    assert model.camera_models == ("PINHOLE",) and model.camera_params[0].tolist() == given.intrinsics.tolist()
    told = convert(tmp_path / "a.txt", tmp_path / "b.txt", "bal")
    assert told.endswith("without the cameras that images share (each image has its own now) of the source")
    assert len(read_bal(tmp_path / "b.txt").cameras) == len(given.T_camera_world)


def test_a_source_of_another_kind_is_named_without_options_of_other_commands(tmp_path: Path) -> None:
    write_small_files(tmp_path)
    q = np.tile([1.0, 0.0, 0.0, 0.0], (3, 1))
    write_csv(tmp_path / "path.csv", Trajectory(10**9 * np.arange(3), np.zeros((3, 3)), q))
    convert(tmp_path / "path.csv", tmp_path / "path.tum")
    (tmp_path / "drive.bag").write_bytes(b"#ROSBAG V2.0\nE\x00\x00\x00\x0c\x00\x00\x00conn_count=\x01\x00\x00\x00")
    (tmp_path / "bytes.txt").write_bytes(b"\x02\x01\xfe no trajectory\n")
    (tmp_path / "more.g2o").write_text("VERTEX_XY 5 1 2\n")
    for source, output, said in (
        ("path.tum", "a.g2o", r"a pose graph, to be written as g2o – got \S+path.tum, a trajectory – name an output of the same"),
        ("path.csv", "a.graph", r"a pose graph, to be written as toro – got \S+path.csv, a trajectory – "),
        ("drive.bag", "a.csv", r"a trajectory, to be written as csv – got \S+drive.bag, a recording – a recording is not"),
        ("loops.g2o", "a.tum", r"a trajectory, to be written as tum – got \S+loops.g2o, a pose graph – "),
        ("bytes.txt", "a.tum", r"boxplus CSV \(comma-separated\) format – got binary data \(\S+\) – give a file in one of these"),
        ("more.g2o", "a.graph", r"got 'VERTEX_XY 5 1 2' .* – check that it is a pose graph, and take other lines out"),
    ):
        result = CliRunner().invoke(app, ["convert", str(tmp_path / source), str(tmp_path / output)])
        assert result.exit_code == 2 and re.search(said, result.stderr), result.stderr
        assert "--" not in result.stderr and "\\x" not in result.stderr
