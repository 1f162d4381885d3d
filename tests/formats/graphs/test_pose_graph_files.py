"""g2o and TORO: conventions on written-out examples, round trips, and every way a line can be wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from boxplus.errors import InputError
from boxplus.formats.graphs.g2o import read_g2o, write_g2o
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.formats.graphs.toro import read_toro, write_toro

ROW = "0 0 0 0 0 0 1"
UNIT = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"


def random_graph(seed: int, dimension: int, poses: int = 6, edges: int = 9) -> PoseGraph:
    rng = np.random.default_rng(seed)
    tangent = 6 if dimension == 3 else 3

    def random_poses(count: int) -> np.ndarray:
        if dimension == 2:
            return np.column_stack([rng.uniform(-3.0, 3.0, count), rng.normal(size=(count, 2))])
        return np.hstack([Rotation.random(count, rng).as_quat()[:, [3, 0, 1, 2]], rng.normal(size=(count, 3))])

    first = rng.integers(0, poses, edges)
    square = rng.normal(size=(edges, tangent, tangent))
    information = square @ square.transpose(0, 2, 1)
    return PoseGraph(
        dimension=dimension,
        ids=rng.choice(2**62, poses, replace=False) - 2**61,
        poses=random_poses(poses),
        edges=np.column_stack([first, (first + rng.integers(1, poses, edges)) % poses]),
        measurements=random_poses(edges),
        information=0.5 * (information + information.transpose(0, 2, 1)),
        fixed=np.sort(rng.choice(poses, 2, replace=False)),
    )


def assert_same(left: PoseGraph, right: PoseGraph) -> None:
    assert left.dimension == right.dimension
    for name in ("ids", "edges", "fixed", "poses", "measurements", "information"):
        assert np.array_equal(getattr(left, name), getattr(right, name)), name


@given(st.integers(0, 1000), st.sampled_from([2, 3]))
def test_g2o_round_trip_keeps_every_bit(tmp_path_factory: pytest.TempPathFactory, seed: int, dimension: int) -> None:
    path = tmp_path_factory.mktemp("g2o") / "graph.g2o"
    graph = random_graph(seed, dimension)
    write_g2o(path, graph)
    again = read_g2o(path)
    write_g2o(path, again)
    assert_same(again, read_g2o(path))
    for name in ("ids", "edges", "fixed", "information"):
        assert np.array_equal(getattr(graph, name), getattr(again, name))
    assert graph.poses is not None and again.poses is not None
    np.testing.assert_allclose(graph.poses, again.poses, rtol=0, atol=1e-15)


@given(st.integers(0, 1000), st.sampled_from([2, 3]))
def test_toro_round_trip(tmp_path_factory: pytest.TempPathFactory, seed: int, dimension: int) -> None:
    path = tmp_path_factory.mktemp("toro") / "graph.graph"
    graph = random_graph(seed, dimension)
    write_toro(path, graph)
    again = read_toro(path)
    assert np.array_equal(graph.information, again.information)
    assert np.array_equal(graph.edges, again.edges) and np.array_equal(graph.ids, again.ids)
    for before, after in ((graph.poses, again.poses), (graph.measurements, again.measurements)):
        assert before is not None and after is not None
        if dimension == 3:
            after[:, :4] *= np.sign(np.einsum("ni,ni->n", before[:, :4], after[:, :4]))[:, None]
        np.testing.assert_allclose(before, after, rtol=0, atol=1e-14)


def test_g2o_in_space(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    upper = " ".join(str(v) for v in [11, 1, 2, 3, 4, 5, 22, 6, 7, 8, 9, 33, 10, 11, 12, 44, 13, 14, 55, 15, 66])
    path.write_text(
        f"EDGE_SE3:QUAT 7 -2 1 2 3 0.1 0.2 0.3 0.9273618495495704 {upper}\n"
        "VERTEX_SE3:QUAT -2 4 5 6 0 0 0.6 0.8\nVERTEX_SE3:QUAT 7 0 0 0 0 0 0 1\nFIX 7\n"
    )
    graph = read_g2o(path)
    assert graph.dimension == 3 and graph.ids.tolist() == [-2, 7] and graph.edges.tolist() == [[1, 0]]
    assert graph.fixed.tolist() == [1]
    assert graph.poses is not None
    np.testing.assert_allclose(graph.poses[0], [0.8, 0, 0, 0.6, 4, 5, 6])
    np.testing.assert_allclose(graph.measurements[0], [0.9273618495495704, 0.1, 0.2, 0.3, 1, 2, 3])
    rotation, translation = graph.information[0, :3, :3], graph.information[0, 3:, 3:]
    assert rotation.tolist() == [[44, 13, 14], [13, 55, 15], [14, 15, 66]]
    assert translation.tolist() == [[11, 1, 2], [1, 22, 6], [2, 6, 33]]
    # rows translation, columns rotation in the file
    assert graph.information[0, 3:, :3].tolist() == [[3, 4, 5], [7, 8, 9], [10, 11, 12]]
    half = read_g2o(path, rotation_error="quaternion").information[0]
    np.testing.assert_allclose(half[:3, :3], rotation / 4)
    np.testing.assert_allclose(half[3:, :3], graph.information[0, 3:, :3] / 2)
    np.testing.assert_allclose(half[3:, 3:], translation)
    quarter = read_g2o(path, rotation_error="quaternion")
    write_g2o(path, quarter, rotation_error="quaternion")
    np.testing.assert_allclose(read_g2o(path).information, graph.information)


def test_the_quaternion_convention_weighs_the_half_angle() -> None:
    # g2o: chi2 = eᵀ Ω e with e = [t, q_vec]; ours with the rotation vector w = 2 q_vec (to first order).
    small = np.array([1e-4, -2e-4, 3e-4])
    q_vec = Rotation.from_rotvec(small).as_quat()[:3]
    omega = np.array([[5.0, 1.0, 0.0], [1.0, 7.0, 2.0], [0.0, 2.0, 9.0]])
    assert q_vec @ omega @ q_vec == pytest.approx(small @ (omega / 4) @ small, rel=1e-6)


def test_g2o_in_the_plane(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text("VERTEX_SE2 0 1 2 0.5\nVERTEX_SE2 1 3 4 -0.5\nEDGE_SE2 0 1 1 2 0.25 11 1 2 22 3 33\n")
    graph = read_g2o(path)
    assert graph.dimension == 2 and graph.poses is not None
    assert graph.poses.tolist() == [[0.5, 1, 2], [-0.5, 3, 4]]
    assert graph.measurements.tolist() == [[0.25, 1, 2]]
    assert graph.information[0].tolist() == [[33, 2, 3], [2, 11, 1], [3, 1, 22]]


def test_toro_in_the_plane_has_its_own_order(tmp_path: Path) -> None:
    path = tmp_path / "graph.graph"
    path.write_text("VERTEX2 0 1 2 0.5\nVERTEX2 1 3 4 -0.5\nEDGE2 0 1 1 2 0.25 11 1 22 33 2 3\n")
    graph = read_toro(path)
    assert graph.information[0].tolist() == [[33, 2, 3], [2, 11, 1], [3, 1, 22]]
    assert graph.measurements.tolist() == [[0.25, 1, 2]]


def test_toro_in_space_has_roll_pitch_yaw(tmp_path: Path) -> None:
    path = tmp_path / "graph.graph"
    path.write_text(f"VERTEX3 0 1 2 3 0.1 0.2 0.3\nVERTEX3 1 0 0 0 0.4 1.5707963267948966 0.5\nEDGE3 0 1 {ROW[:-2]} {UNIT}\n")
    graph = read_toro(path)
    assert graph.poses is not None
    expected = Rotation.from_euler("ZYX", [[0.3, 0.2, 0.1], [0.5, np.pi / 2, 0.4]]).as_quat()[:, [3, 0, 1, 2]]
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", graph.poses[:, :4], expected)), 1.0, atol=1e-15)
    write_toro(path, graph)
    again = read_toro(path)
    assert again.poses is not None
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", graph.poses[:, :4], again.poses[:, :4])), 1.0, atol=1e-12)


def test_a_file_without_poses(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text("EDGE_SE2 9 3 1 2 0.25 1 0 0 1 0 1\nEDGE_SE2 3 9 1 2 0.25 1 0 0 1 0 1\n")
    graph = read_g2o(path)
    assert graph.poses is None and graph.ids.tolist() == [3, 9] and graph.edges.tolist() == [[1, 0], [0, 1]]
    text = path.read_text()
    write_g2o(path, graph)
    assert (
        path.read_text().split() == text.replace(" 1 2 ", " 1.0 2.0 ").replace("1 0 0 1 0 1", "1.0 0.0 0.0 1.0 0.0 1.0").split()
    )


def test_ids_are_exact_up_to_64_bits(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(f"EDGE_SE2 8646911284551352320 8646911284551352321 {ROW[:5]} 1 0 0 1 0 1\n")
    assert read_g2o(path).ids.tolist() == [8646911284551352320, 8646911284551352321]


def test_unknown_words_are_refused_or_counted(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(
        "VERTEX_SE2 0 0 0 0\nVERTEX_XY 5 1 2\nVERTEX_XY 6 1 2\nVERTEX_SE2 1 0 0 0\n"
        "EDGE_SE2 0 1 0 0 0 1 0 0 1 0 1\nEDGE_SE2_XY 0 5 1 1 1 0 1\n"
    )
    with pytest.raises(
        InputError,
        match=r"expected a line that begins with VERTEX_SE2, EDGE_SE2, VERTEX_SE3:QUAT, EDGE_SE3:QUAT or FIX – "
        r"got 'VERTEX_XY 5 1 2' \(.*, line 2\) – check that it is a pose graph; ignore_unknown leaves",
    ):
        read_g2o(path)
    graph = read_g2o(path, ignore_unknown=True)
    assert len(graph.edges) == 1
    assert graph.warnings == (
        f"2 lines VERTEX_XY were left out (first: {path}, line 2)",
        f"1 line EDGE_SE2_XY was left out (first: {path}, line 6)",
    )


VERTICES = f"VERTEX_SE3:QUAT 0 {ROW}\nVERTEX_SE3:QUAT 1 {ROW}\n"
EDGE = f"EDGE_SE3:QUAT 0 1 {ROW} {UNIT}\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            VERTICES + "EDGE_SE3:QUAT 0 1 0 0 0\n",
            r"two ids, x y z qx qy qz qw and the 21 upper .* got 'EDGE_SE3:QUAT 0 1 0 0 0' .*line 3",
        ),
        (
            VERTICES.replace("1 0 0 0", "1 0 zero 0") + EDGE,
            r"VERTEX_SE3:QUAT with id x y z .*line 2\) – correct or remove the line",
        ),
        (VERTICES.replace("QUAT 1", "QUAT 1.5") + EDGE, r"line 2\) – .*ids are whole numbers"),
        (
            VERTICES.replace("QUAT 1", "QUAT 0") + f"VERTEX_SE3:QUAT 1 {ROW}\n" + EDGE,
            r"each pose once – got pose 0 again \(.*line 2; first: .*line 1\) – remove one",
        ),
        (VERTICES + EDGE.replace("0 1 ", "0 5 ", 1), r"edges between poses that the file has – got pose 5 \(.*line 3; 1 such\)"),
        (VERTICES + EDGE.replace("0 1 ", "1 1 ", 1), r"two different poses – got one from pose 1 to itself \(.*line 3\)"),
        (VERTICES + EDGE + "FIX 8\n", r"fixed poses that the file has – got pose 8 \(.*line 4\)"),
        (VERTICES + EDGE + "FIX\n", r"expected FIX with an id – got 'FIX' \(.*line 4\)"),
        (VERTICES + EDGE + "VERTEX_SE2 4 0 0 0\n", r"in 2D or in 3D – got both \(.*2D first in line 4, 3D first in line 1\)"),
        (VERTICES, r"at least one edge – got none"),
        ("", r"at least one edge – got none"),
        (VERTICES.replace("0 0 1\n", "0 0 2\n", 1) + EDGE, r"a unit quaternion in each pose – got length 2 \(.*line 1; 1 such\)"),
        (VERTICES.replace("1 0 0 0", "1 0 nan 0") + EDGE, r"a finite pose – got .*nan.* \(.*line 2; 1 such\)"),
        (VERTICES + EDGE.replace(ROW, "0 0 0 0 0 0 0.5"), r"a unit quaternion in each measurement – got length 0.5 \(.*line 3"),
        (VERTICES + EDGE.replace(ROW, "inf 0 0 0 0 0 1"), r"a finite measurement .*line 3"),
        (
            VERTICES + EDGE + EDGE.replace(UNIT, "inf" + UNIT[1:]),
            r"a finite information matrix – .*line 4; 1 such.*deviation of zero",
        ),
        (
            VERTICES + EDGE.replace(UNIT, "-1" + UNIT[1:]),
            r"semi-definite information matrix – got one with the eigenvalue -1 \(.*line 3",
        ),
        (
            VERTICES + EDGE.replace(UNIT, "1 2" + UNIT[3:]),
            r"semi-definite information matrix – got one with the eigenvalue -1 \(",
        ),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_g2o(path)


def test_an_edge_without_information_is_read(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(VERTICES + EDGE + EDGE.replace(UNIT, UNIT.replace("1", "0")))
    graph = read_g2o(path)
    assert len(graph.edges) == 2 and graph.information[0].any() and not graph.information[1].any()


def test_bad_toro_lines_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "graph.graph"
    path.write_text("VERTEX2 0 0 0 0\nVERTEX2 1 0 0 0\nEDGE2 0 1 0 0 0 1 0 1 1 0\n")
    with pytest.raises(
        InputError, match=r"EDGE2 with two ids, x y theta and the information I11 I12 I22 I33 I13 I23 – got .*line 3"
    ):
        read_toro(path)
    path.write_text("VERTEX3 0 0 0 0 inf 0 0\nVERTEX3 1 0 0 0 0 0 0\n" + f"EDGE3 0 1 {ROW[:-2]} {UNIT}\n")
    with pytest.raises(InputError, match=r"a finite pose – got .*nan.*line 1"):
        read_toro(path)
    path.write_text("VERTEX_SE2 0 0 0 0\n")
    with pytest.raises(InputError, match=r"begins with VERTEX2, EDGE2, VERTEX3 or EDGE3 – got 'VERTEX_SE2"):
        read_toro(path)


def test_a_semidefinite_matrix_is_taken(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(VERTICES + EDGE.replace(UNIT, "1 1 0 0 0 0 1 0 0 0 0 0 0 0 0 1 0 0 1 0 1"))
    eigenvalues = np.linalg.eigvalsh(read_g2o(path).information[0])
    assert eigenvalues[1] == pytest.approx(0.0, abs=1e-12)


def test_a_transposed_cross_block_is_recognised_and_said(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    # The information of (x, yaw) is [[4, 5.9], [5.9, 9]]; its cross term stands where z and wx meet.
    wrong = "4 0 0 0 0 0 1 0 0 0 0 1 5.9 0 0 1 0 0 1 0 9"
    path.write_text(VERTICES + EDGE + EDGE.replace(UNIT, wrong))
    graph = read_g2o(path)
    assert graph.warnings == (
        f"1 of 2 information matrices of {path} are indefinite as g2o orders them, and none with the block between translation "
        "and rotation transposed, as GTSAM wrote it; they were read so",
    )
    assert graph.information[1, 2, 3] == graph.information[1, 3, 2] == 5.9
    assert read_g2o(path, cross_block="dropped").information[1, 2, 3] == 0.0
    np.testing.assert_array_equal(read_g2o(path, cross_block="transposed").information, graph.information)
    with pytest.raises(InputError, match=r"semi-definite information matrix – got one with the eigenvalue -4.9 \(.*line 4"):
        read_g2o(path, cross_block="upper")


@pytest.mark.parametrize(("option", "value"), [("rotation_error", "euler"), ("cross_block", "lower")])
def test_unknown_options_are_refused(tmp_path: Path, option: str, value: str) -> None:
    with pytest.raises(InputError, match=f"expected {option} as one of .* – got '{value}'"):
        read_g2o(tmp_path / "graph.g2o", **{option: value})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"edges": np.array([[0, 9]] * 9)}, r"edges between poses 0 to 5 – got \[0, 9\] \(pose graph, edge 0\)"),
        ({"fixed": np.array([6])}, r"fixed poses from 0 to 5 – got 6"),
        ({"poses": np.zeros((6, 3))}, r"poses of shape \(6, 7\) – got \(6, 3\) .* a row is qw, qx, qy, qz, x, y, z"),
        ({"dimension": 4}, r"dimension 2 or 3 – got 4"),
        (
            {"information": np.zeros((9, 6, 6)) + np.triu(np.ones((6, 6)))},
            r"a symmetric information matrix – got one that is not",
        ),
    ],
)
def test_bad_arrays_are_refused(change: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(random_graph(0, 3), pose_lines=None, edge_lines=None, **change)


@pytest.mark.parametrize(
    ("name", "dimension", "poses", "edges", "has_poses"),
    [
        ("sphere2500", 3, 2500, 4949, True),
        ("torus3D", 3, 5000, 9048, True),
        ("parking-garage", 3, 1661, 6275, True),
        ("cubicle", 3, 5750, 16869, True),
        ("manhattan", 2, 3500, 5453, False),
        ("CSAIL", 2, 1045, 1172, False),
        ("intel", 2, 1728, 2512, True),
        ("MIT", 2, 808, 827, True),
    ],
)
def test_published_graphs(shared_data: Path, name: str, dimension: int, poses: int, edges: int, has_poses: bool) -> None:
    graph = read_g2o(shared_data / "graphs" / f"{name}.g2o")
    assert (graph.dimension, len(graph.ids), len(graph.edges)) == (dimension, poses, edges)
    assert (graph.poses is not None) == has_poses
    assert (len(graph.warnings) > 0) == (name == "cubicle")
    assert np.linalg.eigvalsh(graph.information).min() > 0.0
