"""Units of the IMU from its own measurements."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boxplus.errors import AmbiguityError, RecordingError
from boxplus.recordings.imu_units import gravity_misfits, read_accel_unit, read_gyro_unit
from boxplus.recordings.options import RecordingOptions

FREE = RecordingOptions()


def swinging(seed: int, swing_deg: float, bias: float = 0.0, noise: float = 0.0) -> tuple[NDArray, NDArray, NDArray]:
    """Time [ns], gyro [rad/s] and accelerometer [m/s²] of an IMU that swings about random axes for 6 s at 100 Hz."""
    rng = np.random.default_rng(seed)
    time = np.arange(600) * 0.01
    phase, speed = rng.uniform(0, 6, (3, 1)), rng.uniform(0.5, 2.0, (3, 1))
    vectors = (np.radians(swing_deg) * np.sin(speed * time + phase)).T
    R = Rotation.from_rotvec(vectors)
    gyro = np.vstack(((R[:-1].inv() * R[1:]).as_rotvec() / 0.01, np.zeros(3)))
    gyro[-1] = gyro[-2]
    accel = R.inv().apply([0.0, 0.0, 9.81])
    return (
        (time * 1e9).astype(np.int64),
        gyro + bias + rng.normal(size=gyro.shape) * noise,
        accel + rng.normal(size=accel.shape) * 10 * noise,
    )


@settings(max_examples=20)
@given(seed=st.integers(0, 1000), swing=st.floats(5.0, 40.0))
def test_gyro_unit_from_the_turn_of_gravity(seed: int, swing: float) -> None:
    time_ns, gyro, accel = swinging(seed, swing, bias=0.02, noise=0.01)
    assert read_gyro_unit(time_ns, gyro, accel, FREE)[0] == "rad/s"
    assert read_gyro_unit(time_ns, np.degrees(gyro), accel, FREE)[0] == "deg/s"
    # The accelerometer's unit does not matter.
    assert read_gyro_unit(time_ns, np.degrees(gyro), accel / 9.81, FREE)[0] == "deg/s"


def test_without_rotation_the_definition_holds() -> None:
    time_ns, gyro, accel = swinging(1, 0.0, noise=0.003)
    unit, evidence = read_gyro_unit(time_ns, gyro, accel, FREE)
    assert unit == "rad/s" and "by the message's definition" in evidence.text
    rad, deg = gravity_misfits(time_ns, gyro, accel)
    assert abs(rad - deg) < 0.1 * deg


def test_a_given_unit_is_kept_and_contradicted() -> None:
    time_ns, gyro, accel = swinging(2, 20.0)
    unit, evidence = read_gyro_unit(time_ns, gyro, accel, RecordingOptions(gyro_unit="deg/s"))
    assert unit == "deg/s" and evidence.verdict == "warning" and "check --gyro-unit" in evidence.text
    unit, evidence = read_accel_unit(accel, RecordingOptions(accel_unit="g"))
    assert unit == "g" and evidence.verdict == "warning" and "check --accel-unit" in evidence.text


@given(st.floats(0.9, 1.1), st.sampled_from(["g", "m/s2"]))
def test_accel_unit(size: float, unit: str) -> None:
    accel = np.tile([0.0, 0.6, 0.8], (50, 1)) * size * (1.0 if unit == "g" else 9.81)
    assert read_accel_unit(accel, FREE)[0] == unit


@pytest.mark.parametrize("norm", [0.0, 0.3, 3.0, 40.0, 981.0])
def test_accelerations_that_fit_no_unit(norm: float) -> None:
    with pytest.raises(AmbiguityError, match=r"about 1 \(g\) or 9.8 \(m/s2\) – got .* – say the unit with --accel-unit"):
        read_accel_unit(np.tile([norm, 0.0, 0.0], (50, 1)), FREE)


def test_values_that_are_no_numbers() -> None:
    nothing = np.full((50, 3), np.nan)
    with pytest.raises(RecordingError, match="finite accelerations"):
        read_accel_unit(nothing, FREE)
    time_ns = np.arange(50) * 10_000_000
    assert read_gyro_unit(time_ns, nothing, nothing, FREE)[0] == "rad/s"
