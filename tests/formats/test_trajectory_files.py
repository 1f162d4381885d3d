"""Trajectories in memory and in TUM, KITTI, EuRoC and CSV files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from boxplus.errors import InputError, OutputError
from boxplus.formats.trajectory import Trajectory, read_trajectory, write_csv, write_kitti, write_tum
from boxplus.formats.trajectory_rows import ns_to_seconds, seconds_to_ns


def make(count: int, seed: int = 0, start_ns: int = 1_403_715_888_379_057_920) -> Trajectory:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(count, 6, 6))
    return Trajectory(
        time_ns=start_ns + np.cumsum(rng.integers(1, 10**9, count)),
        p=rng.normal(scale=100.0, size=(count, 3)),
        q_wxyz=Rotation.random(count, rng=rng).as_quat()[:, [3, 0, 1, 2]],
        covariance=root @ root.transpose(0, 2, 1),
        status=tuple(rng.choice(["ok", "weak(x, yaw)", 'a "quoted" word', "lost"], count)),
    )


def same_rotation(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.max(1.0 - np.abs(np.einsum("ij,ij->i", a, b))))


@settings(max_examples=30, deadline=None)
@given(count=st.integers(1, 20), seed=st.integers(0, 2**32 - 1), start=st.integers(-(2**62), 2**62))
def test_files_round_trip(tmp_path_factory: pytest.TempPathFactory, count: int, seed: int, start: int) -> None:
    folder = tmp_path_factory.mktemp("trajectory")
    given_poses = make(count, seed, start)
    for name, write, format in (("a.tum", write_tum, "tum"), ("a.txt", write_kitti, "kitti"), ("a.csv", write_csv, "csv")):
        write(folder / name, given_poses)
        for asked in ("auto", format):
            back = read_trajectory(folder / name, asked)
            np.testing.assert_allclose(back.p, given_poses.p, atol=1e-9, rtol=1e-9)
            assert same_rotation(back.q_wxyz, given_poses.q_wxyz) < 1e-8
            assert back.warnings == ()
            if format == "kitti":
                assert back.time_ns is None
            else:
                np.testing.assert_array_equal(back.times, given_poses.times)
    np.testing.assert_allclose(back.covariance, given_poses.covariance, rtol=1e-8, atol=1e-8)
    assert back.status == given_poses.status


def test_csv_without_covariance_reads_back_without(tmp_path: Path) -> None:
    poses = make(3)
    write_csv(tmp_path / "a.csv", Trajectory(poses.time_ns, poses.p, poses.q_wxyz))
    back = read_trajectory(tmp_path / "a.csv")
    assert back.covariance is None
    assert back.status == ("", "", "")


@given(time_ns=st.integers(-(2**63) + 1, 2**63 - 1))
def test_stamps_keep_every_digit(time_ns: int) -> None:
    assert seconds_to_ns(ns_to_seconds(time_ns)) == time_ns


@pytest.mark.parametrize(
    ("text", "time_ns"),
    [
        ("1403715529.112143517", 1403715529112143517),
        ("1.403715529112143517e+09", 1403715529112143517),
        ("-0.000000001", -1),
        ("7", 7_000_000_000),
        (".5", 500_000_000),
    ],
)
def test_stamps_in_every_notation(text: str, time_ns: int) -> None:
    assert seconds_to_ns(text) == time_ns


@pytest.mark.parametrize("text", ["nan", "inf", "abc", "", "1403715529112143517", "1e400", "1e999999999"])
def test_impossible_stamps_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is not a"):
        seconds_to_ns(text)


def test_quaternion_order_on_disk(tmp_path: Path) -> None:
    half = np.sqrt(0.5)
    poses = Trajectory(np.array([1_500_000_000]), np.array([[1.0, 2.0, 3.0]]), np.array([[half, 0.0, 0.0, half]]))
    write_tum(tmp_path / "a.tum", poses)
    text = (tmp_path / "a.tum").read_text()
    assert text == "1.500000000 1.000000000 2.000000000 3.000000000 0.000000000 0.000000000 0.707106781 0.707106781\n"


def test_euroc_ground_truth(tmp_path: Path) -> None:
    file = tmp_path / "data.csv"
    file.write_text(
        "#timestamp, p_RS_R_x [m], ...\n"
        "1403715888379057920,0.898029,2.028208,0.955711,0.051153,0.827881,-0.050831,0.556249,0.0,0.1,0.2\n"
        "1403715888384058112,0.898059,2.028148,0.955674,0.051146,0.827886,-0.050832,0.556242,0.0,0.1,0.2\n"
    )
    poses = read_trajectory(file)
    assert poses.times.tolist() == [1403715888379057920, 1403715888384058112]
    np.testing.assert_allclose(poses.q_wxyz[0], [0.051153, 0.827881, -0.050831, 0.556249], atol=1e-5)


TUM = [f"{i}.5 {i} 0 0 0 0 0 1" for i in range(4)]


def write_lines(path: Path, lines: list[str], end: str = "\n") -> Path:
    path.write_text("\n".join(lines) + end)
    return path


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["# header", *TUM[:2], "2.5 1 2 3"], r"expected 8 columns .* – got 4 columns \(.*, line 4\) – correct the line"),
        ([*TUM[:2], "2.5 1 x 3 0 0 0 1"], r"'x' is not a number \(.*, line 3\)"),
        ([*TUM[:2], "2.5 1 nan 3 0 0 0 1"], r"expected a finite position – got .* \(.*, line 3\)"),
        ([*TUM[:2], "2.5 1 2 3 0 0 0 0"], r"expected unit quaternions – got length 0 \(.*, line 3; 1 such rows\)"),
        (
            [*TUM[:3], TUM[1]],
            r"strictly increasing time stamps – got a step of -1.0{9} s \(.*, line 4; 1 .*more than one trajectory",
        ),
        (
            ["1403715529112143517 0 0 0 0 0 0 1"],
            r"not a time in seconds \(nanoseconds or milliseconds\? divide them\) \(.*, line 1\)",
        ),
        (["1 2 3"], r"expected a trajectory in TUM .*'1 2 3' \(.*\) – give a file in one of these formats"),
        (["# only a comment"], r"at least one pose – got none"),
        ([" ".join(["2"] * 12)], r"rotation matrices .* 11 off|rotation matrices"),
        (["1.5,0,0,0,1,0,0,0"], r"'1.5' is not a whole number of nanoseconds \(.*, line 1\)"),
    ],
)
def test_malformed_files_name_file_and_line(tmp_path: Path, lines: list[str], message: str) -> None:
    file = write_lines(tmp_path / "bad.txt", lines)
    with pytest.raises(InputError, match=message) as caught:
        read_trajectory(file)
    assert "bad.txt" in str(caught.value)


def test_missing_and_binary_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"readable trajectory file – got .*nothing.tum"):
        read_trajectory(tmp_path / "nothing.tum")
    (tmp_path / "x.bag").write_bytes(b"\x13\x00\x00\x01" * 100)
    with pytest.raises(InputError, match="a binary file"):
        read_trajectory(tmp_path / "x.bag")
    (tmp_path / "x.tum").write_bytes("0 1 2 3 0 0 0 1\n".encode("utf-16"))
    with pytest.raises(InputError, match=r"got text in UTF-16 .* save it again as UTF-8"):
        read_trajectory(tmp_path / "x.tum")


@pytest.mark.parametrize("layout", ["tum", "kitti", "csv"])
def test_a_file_cut_anywhere_in_its_last_line_keeps_the_lines_before(tmp_path: Path, layout: str) -> None:
    poses = make(4)
    file = tmp_path / "a"
    {"tum": write_tum, "kitti": write_kitti, "csv": write_csv}[layout](file, poses)
    data = file.read_bytes()
    last = data[:-1].rfind(b"\n") + 1
    for end in range(last + 1, len(data) - 1):
        file.write_bytes(data[:end])
        back = read_trajectory(file)
        assert len(back) == 3, end
        assert "incomplete and was left out" in back.warnings[0]
    file.write_bytes(data[:-1])
    assert len(read_trajectory(file)) == 4  # whole but for its newline


def test_repeated_stamps_are_left_out_and_counted(tmp_path: Path) -> None:
    back = read_trajectory(write_lines(tmp_path / "a.tum", [*TUM[:2], "# comment", TUM[1], TUM[1], *TUM[2:]]))
    assert len(back) == 4
    assert back.warnings[0].startswith("2 poses of ")
    assert back.warnings[0].endswith("repeat the time stamp before them and were left out (first: line 4)")


def test_zeros_after_a_power_cut_are_an_incomplete_line(tmp_path: Path) -> None:
    file = tmp_path / "a.tum"
    file.write_bytes(("\n".join(TUM) + "\n").encode() + b"\0" * 300)
    back = read_trajectory(file)
    assert len(back) == 4
    assert len(back.warnings) == 1


@given(data=st.binary(max_size=300))
@settings(max_examples=200, deadline=None)
def test_any_bytes_give_poses_or_an_input_error(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    file = tmp_path_factory.getbasetemp() / "fuzz.txt"
    file.write_bytes(data)
    for format in ("auto", "tum", "kitti", "euroc", "csv"):
        try:
            assert len(read_trajectory(file, format)) > 0
        except InputError as error:
            assert "expected" in str(error)


def test_unwritable_target_is_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"expected to write .* – got something else of that name in the way"):
        write_tum(tmp_path / "file" / "a.tum", make(2))


def test_arrays_are_checked() -> None:
    good = make(3)
    with pytest.raises(InputError, match=r"positions p of shape \(N, 3\) – got shape \(3, 2\)"):
        Trajectory(good.time_ns, good.p[:, :2], good.q_wxyz)
    with pytest.raises(InputError, match=r"quaternions q_wxyz of shape \(3, 4\) – got shape \(2, 4\)"):
        Trajectory(good.time_ns, good.p, good.q_wxyz[:2])
    with pytest.raises(InputError, match=r"strictly increasing time stamps – got a step of 0.0{9} s \(trajectory, row 1; 2 such"):
        Trajectory(np.array([5, 5, 5]), good.p, good.q_wxyz)
    with pytest.raises(InputError, match="time_ns as integer nanoseconds"):
        Trajectory(np.array([0.0, 1.0, 2.0]), good.p, good.q_wxyz)
    with pytest.raises(InputError, match="3 status words"):
        Trajectory(good.time_ns, good.p, good.q_wxyz, status=("ok",))
    with pytest.raises(InputError, match="with time stamps"):
        _ = Trajectory(None, good.p, good.q_wxyz).times


def test_real_files(shared_data: Path) -> None:
    trajectories = shared_data / "trajectories"
    assert len(read_trajectory(trajectories / "KITTI_00_gt.txt")) == 4541
    assert len(read_trajectory(trajectories / "freiburg1_xyz-groundtruth.txt")) == 3000
    assert read_trajectory(trajectories / "V102.txt").times[0] == 1403715529112143517
    assert len(read_trajectory(shared_data / "imu" / "V1_03_difficult.gt.csv")) > 20_000
