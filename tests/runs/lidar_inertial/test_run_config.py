"""Settings from a file, single values and options, and the transform people give."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from boxplus.errors import InputError
from boxplus.runs.lidar_inertial.config import RunConfig, load_run_config
from boxplus.runs.transform import parse_transform


def test_nothing_has_to_be_given() -> None:
    assert load_run_config() == RunConfig()


def test_later_settings_win(tmp_path: Path) -> None:
    file = tmp_path / "a.yaml"
    file.write_text("odometry:\n  scan_voxel: 0.5\n  map_cell: 0.4\nmap:\n  voxel: null\n")
    config = load_run_config(file, ["scan_voxel=0.3", "odometry.max_iterations=2"], {"odometry": {"max_iterations": 3}})
    assert (config.odometry.scan_voxel, config.odometry.map_cell, config.odometry.max_iterations) == (0.3, 0.4, 3)
    assert config.map.voxel is None


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            ["scan_voxl=0.5"],
            r"expected the name of a setting – got 'scan_voxl' – did you mean odometry.scan_voxel\? the settings are:",
        ),
        (
            ["odometry.voxel=1"],
            r"expected a known setting in section 'odometry' – got 'voxel' – .*the settings are: .*scan_voxel",
        ),
        (["filter.x=1"], "expected a section .recording, odometry, map, scans. – got 'filter'"),
        (["scan_voxel"], "expected a setting as key=value – got 'scan_voxel' – write e.g. --set scan_voxel=0.5"),
        (["scan_voxel=-1"], "expected a valid value for odometry.scan_voxel .side of the voxels.*– got -1"),
        (["threads=many"], "expected a valid value for odometry.threads .*– got 'many'"),
        (["box_side=10"], "expected box_side above 3.5 × detection_range"),
        (["T_imu_lidar=[[1,0],[0,1]]"], "expected T_imu_lidar as a 4×4 matrix – got shape"),
    ],
)
def test_wrong_settings_are_explained(settings: list[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_run_config(settings=settings)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("scan_voxel: 0.5", "got 'scan_voxel' – write it below 'odometry:'"),
        ("odometri:\n  scan_voxel: 0.5", "got 'odometri' – did you mean odometry"),
        ("odometry: 3", "expected keys and values below 'odometry:'"),
        ("[1, 2]", r"expected a YAML file with the sections recording, odometry, map.*– got none of them in .*a\.yaml"),
        ("a: [1", "expected a YAML file – got .*line"),
        ("odometry:\n  scan_voxl: 1", "got 'scan_voxl' – did you mean scan_voxel"),
    ],
)
def test_wrong_files_are_explained(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "a.yaml"
    file.write_text(text)
    with pytest.raises(InputError, match=message):
        load_run_config(file)


def test_missing_file() -> None:
    with pytest.raises(InputError, match=r"expected a readable configuration file – got nowhere.yaml"):
        load_run_config("nowhere.yaml")


_angle = st.floats(-179.0, 179.0)
_metre = st.floats(-5.0, 5.0)


@given(st.tuples(_angle, st.floats(-89.0, 89.0), _angle), st.tuples(_metre, _metre, _metre))
def test_all_forms_of_a_transform_agree(rpy: tuple[float, float, float], p: tuple[float, float, float]) -> None:
    rotation = Rotation.from_euler("ZYX", rpy[::-1], degrees=True)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), p
    x, y, z, w = rotation.as_quat()
    position = " ".join(map(repr, p))
    forms = [
        " ".join(map(repr, T.ravel().tolist())),
        str(T.tolist()),
        f"xyz_qwxyz: {position} {float(w)!r} {float(x)!r} {float(y)!r} {float(z)!r}",
        f"xyz_qxyzw: {position} {float(x)!r} {float(y)!r} {float(z)!r} {float(w)!r}",
        f"xyz_rpy_deg: {position} {' '.join(map(repr, rpy))}",
        " ".join(map(repr, T[:3].ravel().tolist())),
        json.dumps(dict(zip(("x", "y", "z", "qx", "qy", "qz", "qw"), [*p, *rotation.as_quat().tolist()], strict=True))),
    ]
    for form in forms:
        np.testing.assert_allclose(parse_transform(form), T, atol=1e-9)


@pytest.mark.parametrize(
    "content",
    [
        "1 0 0 0.1\n0 1 0 0.2\n0 0 1 0.3\n0 0 0 1\n",
        "xyz_qwxyz: 0.1 0.2 0.3 1 0 0 0",
        "T_imu_lidar: [[1, 0, 0, 0.1], [0, 1, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]",
        '{"R_imu_lidar": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "t_imu_lidar": [0.1, 0.2, 0.3]}',
        '{"x": 0.1, "y": 0.2, "z": 0.3, "qx": 0, "qy": 0, "qz": 0, "qw": 1, "scale": 1.0}',
        "xyz: 0.1, 0.2, 0.3",
        "1,0,0,0.1\n0,1,0,0.2\n0,0,1,0.3\n",
    ],
)
def test_transform_from_a_file(tmp_path: Path, content: str) -> None:
    file = tmp_path / "T.txt"
    file.write_text(content)
    T = parse_transform(str(file))
    np.testing.assert_allclose(T[:3, 3], [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(T[:3, :3], np.eye(3))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3", "got 3 numbers without a tag – check that all were copied; without a turn: 'xyz: x y z'"),
        ("1 2", "got 2 numbers – check that all were copied"),
        ("xyz: 1 2 nan", "determinant nan"),
        ('{"x": 0, "y": 0, "z": 0}', "got the keys x, y, z"),
        ('{"x": 0, "y": 0, "z": 0, "qx": 0, "qy": 0, "qz": 0, "qw": 1, "scale": 2}', "got one with the scale 2"),
        ("0 0 0 1 0 0 0", "got 7 numbers without a tag – say in which order the quaternion is"),
        ("xyz_qwxyz: 0 0 0 1 1 0 0", "expected a unit quaternion in T_imu_lidar – got one of norm 1.414"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0 0 0 0 1", "orthonormal rotation of determinant .1 .*got .*determinant -1"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 1 2 3 1", "last row .*check the order of the numbers"),
        ("nowhere.txt", "or a file with these – got 'nowhere.txt'"),
        ("xyz_rpy_deg: a b c d e f", "correct the numbers"),
    ],
)
def test_wrong_transforms_are_explained(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_transform(text)


def test_wrong_keys_in_a_file(tmp_path: Path) -> None:
    file = tmp_path / "T.yaml"
    file.write_text("T_lidar_imu: [1, 2]\n")
    with pytest.raises(
        InputError, match=r"expected the key T_imu_lidar, or R_imu_lidar and p_imu_lidar, or x, y, .* – got the keys T_lidar_imu"
    ):
        parse_transform(str(file))


def test_a_transform_without_a_name_in_files_is_asked_for_by_its_numbers(tmp_path: Path) -> None:
    file = tmp_path / "T.json"
    file.write_text('{"x": 0.1, "y": 0, "z": 0, "qx": 0, "qy": 0, "qz": 0, "qw": 1}')
    assert parse_transform(str(file), "--transform-right", key=None)[0, 3] == 0.1
    for content in ('{"p": [1, 2, 3]}', '{"T_imu_lidar": [1]}', '{"--transform-right": [1]}'):
        file.write_text(content)
        with pytest.raises(
            InputError,
            match=r"expected the keys x, y, z, qx, qy, qz, qw in the file for --transform-right – got .* – rename the keys$",
        ):
            parse_transform(str(file), "--transform-right", key=None)


@pytest.mark.parametrize("text", ["odometry: {1: 2}", "map:\n  null: 3", "recording: {2.5: a}"])
def test_a_setting_without_a_name_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(InputError, match=r"expected names of settings below '\w+:' in .*config.yaml – got (1|None|2.5) – "):
        load_run_config(tmp_path / "config.yaml")
