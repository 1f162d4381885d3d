"""The settings of the odometry: what is refused, and in which words."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from boxplus.errors import InputError
from boxplus.manifolds import so3
from boxplus.systems.lidar_inertial_odometry.config import LioConfig


def _nested(T: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(value) for value in row) for row in T)


def test_nothing_has_to_be_given() -> None:
    assert LioConfig() == LioConfig.model_validate({})


def test_every_setting_is_described() -> None:
    assert all(field.description for field in LioConfig.model_fields.values())


def test_unknown_keys_are_refused() -> None:
    with pytest.raises(ValidationError, match="scan_voxels"):
        LioConfig.model_validate({"scan_voxels": 0.5})


def test_it_is_frozen() -> None:
    with pytest.raises(InputError, match="LioConfig as it was made – got another scan_voxel – make a new one"):
        LioConfig().scan_voxel = 1.0  # type: ignore[misc]


def test_it_survives_being_written_down() -> None:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = so3.exp([0.1, -0.2, 0.3]), [0.1, 0.2, 0.3]
    config = LioConfig(T_imu_lidar=_nested(T), threads=2)
    assert LioConfig.model_validate_json(config.model_dump_json()) == config


def test_an_extrinsic_with_few_digits_becomes_a_rotation() -> None:
    T = np.eye(4)
    T[:3, :3] = np.round(so3.exp([0.1, -0.2, 0.3]), 4)
    given = LioConfig(T_imu_lidar=_nested(T)).T_imu_lidar
    assert given is not None
    assert so3.is_rotation(np.array(given)[:3, :3], 1e-12)


@pytest.mark.parametrize(
    ("T", "message"),
    [
        (np.diag([1.0, 1.0, -1.0, 1.0]), "determinant -1"),
        (np.diag([0.5, 0.5, 0.5, 1.0]), "expected T_imu_lidar with an orthonormal rotation"),
        (np.eye(3), "expected T_imu_lidar as a 4×4 matrix – got shape (3, 3)"),
        (np.full((4, 4), np.nan), "RᵀR off by nan"),
    ],
)
def test_a_bad_extrinsic_is_explained(T: np.ndarray, message: str) -> None:
    with pytest.raises(InputError) as error:
        LioConfig(T_imu_lidar=_nested(T))
    assert message in str(error.value)


def test_a_box_that_would_oscillate_is_refused() -> None:
    with pytest.raises(InputError) as error:
        LioConfig(box_side=1000.0, detection_range=450.0)
    assert "expected box_side above 3.5 × detection_range = 1575 m – got 1000 m – enlarge box_side" in str(error.value)
    assert LioConfig(box_side=1576.0, detection_range=450.0).box_side == 1576.0


@pytest.mark.parametrize(
    "setting",
    [
        {"scan_voxel": 0.0},
        {"map_cell": -1.0},
        {"max_iterations": 0},
        {"gyro_noise": 0.0},
        {"threads": 0},
        {"min_points": 5},
        {"weak_threshold": -1.0},
        {"extrinsic_estimation": "maybe"},
        {"start_duration": 0.0},
    ],
)
def test_values_out_of_range_are_refused(setting: dict[str, object]) -> None:
    with pytest.raises(ValidationError, match=next(iter(setting))):
        LioConfig.model_validate(setting)
