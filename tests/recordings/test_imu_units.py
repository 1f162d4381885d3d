"""Units of the IMU from its own measurements."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.errors import AmbiguityError, RecordingError
from boxplus.recordings import open_recording
from boxplus.recordings.imu_units import read_accel_unit, read_gyro_unit
from boxplus.recordings.options import RecordingOptions

FREE = RecordingOptions()


@settings(max_examples=20)
@given(seed=st.integers(0, 1000), fastest=st.floats(0.01, 30.0))
def test_the_definition_holds_whatever_the_motion(seed: int, fastest: float) -> None:
    gyro = np.random.default_rng(seed).uniform(-1.0, 1.0, (600, 3)) * fastest / np.sqrt(3.0)
    unit, evidence = read_gyro_unit(gyro, FREE)
    assert unit == "rad/s" and "by the message's definition" in evidence.text


@given(st.floats(36.0, 1000.0))
def test_rates_beyond_any_gyroscope_are_in_degrees(rate: float) -> None:
    gyro = np.zeros((600, 3))
    gyro[:70, 1] = rate
    unit, evidence = read_gyro_unit(gyro, FREE)
    assert unit == "deg/s" and "no gyroscope reaches 35 rad/s" in evidence.text
    # A few wild samples are no evidence.
    gyro[20:] = 0.0
    assert read_gyro_unit(gyro, FREE)[0] == "rad/s"


def test_a_given_unit_is_kept_and_contradicted() -> None:
    slow, fast = np.full((100, 3), 0.3), np.full((100, 3), 50.0)
    for unit, gyro, verdict in (("deg/s", slow, "ok"), ("rad/s", slow, "ok"), ("deg/s", fast, "ok"), ("rad/s", fast, "warning")):
        kept, evidence = read_gyro_unit(gyro, RecordingOptions(gyro_unit=unit))
        assert (kept, evidence.verdict) == (unit, verdict)
    accel = np.tile([0.0, 0.0, 9.81], (50, 1))
    kept, evidence = read_accel_unit(accel, RecordingOptions(accel_unit="g"))
    assert kept == "g" and evidence.verdict == "warning" and "check --accel-unit" in evidence.text


@pytest.mark.parametrize("name", ["v103_velodyne.bag", "mh05_ouster_ros2", "v201_livox.bag"])
def test_flights_are_read_in_rad_per_second_from_any_start(shared_data: Path, name: str) -> None:
    """A multirotor's specific force does not turn with its body: gravity's turn says nothing about the gyroscope."""
    for start_s in range(0, 14, 2):
        with open_recording(shared_data / "recordings" / name, RecordingOptions(start_s=float(start_s))) as recording:
            assert recording.info.gyro_unit == "rad/s"


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
    assert read_gyro_unit(nothing, FREE)[0] == "rad/s"


@given(seed=st.integers(0, 1000), size=st.floats(0.65, 1.55))
def test_accelerations_without_gravity_are_not_taken_for_those_in_g(seed: int, size: float) -> None:
    accel = np.random.default_rng(seed).normal(size=(600, 3)) * [1.0, 0.4, 0.1]
    accel *= size / np.median(np.linalg.norm(accel, axis=1))
    with pytest.raises(AmbiguityError, match=r"gravity in them.*without gravity – .*gravity included.*--accel-unit g"):
        read_accel_unit(accel, FREE)
    assert read_accel_unit(accel, RecordingOptions(accel_unit="g"))[0] == "g"
    # Shaken as hard, but with gravity.
    assert read_accel_unit(0.4 * accel / size + [0.0, 0.0, 1.0], FREE)[0] == "g"


@given(seed=st.integers(0, 1000), aloft=st.floats(0.05, 0.3), steps_hz=st.floats(1.5, 4.0), turn=st.floats(-1.0, 1.0))
def test_a_robot_that_trots_with_an_accelerometer_in_g_falls_freely_between_its_steps(
    seed: int, aloft: float, steps_hz: float, turn: float
) -> None:
    time = np.arange(1200) / 200.0
    phase = (time * steps_hz) % 1.0
    stance = np.pi / 2.0 / (1.0 - aloft) * np.sin(np.pi * np.clip((phase - aloft) / (1.0 - aloft), 0.0, 1.0))
    tilt = 0.2 * np.sin(turn * time)
    accel = np.where(phase < aloft, 0.0, stance)[:, None] * np.stack([np.sin(tilt), 0.0 * tilt, np.cos(tilt)], axis=1)
    accel += 0.05 * np.random.default_rng(seed).normal(size=accel.shape)
    assert read_accel_unit(accel, FREE)[0] == "g"
