"""What may have been the cause of a run that failed, told without an odometry."""

from __future__ import annotations

import dataclasses
import importlib.util
from collections.abc import Iterator

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.recordings.cameras.events import CameraEvent
from boxplus.recordings.cameras.info import CameraRecordingInfo
from boxplus.runs.cameras.causes import calibration_doubts, likely_causes, sentence
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.simulation.cameras import as_camera_recording, make_camera_fault, make_rig, simulate_cameras

pytestmark = pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="corners are followed with OpenCV")


@pytest.fixture(scope="module")
def recorded() -> tuple[CameraRecordingInfo, list[CameraEvent]]:
    made = as_camera_recording(simulate_cameras("room_moving", 4, duration_s=7.5, rig=make_rig("mono", None, 0.35, 10.0)))
    return made.info, list(made)


def late(event: CameraEvent, offset_ns: int) -> CameraEvent:
    return dataclasses.replace(event, time_ns=event.time_ns + offset_ns) if isinstance(event, ImuSamples) else event


@pytest.mark.slow
def test_a_sound_recording_has_no_cause(recorded: tuple[CameraRecordingInfo, list[CameraEvent]]) -> None:
    info, events = recorded
    assert likely_causes(info, iter(events), 1, None) == []


def test_a_clock_that_is_off_is_named_with_its_offset(recorded: tuple[CameraRecordingInfo, list[CameraEvent]]) -> None:
    info, events = recorded
    (found,) = likely_causes(info, (late(event, 50_000_000) for event in events), 1, None)
    said = sentence(found)
    assert "offset of the clocks" in said
    offset_ms = float(said.split(" ms")[0].split()[-1])
    assert abs(offset_ms - 50.0) < 10.0


def test_a_run_without_trouble_is_told_of_a_clock_that_it_has_not_found_itself(
    recorded: tuple[CameraRecordingInfo, list[CameraEvent]],
) -> None:
    info, events = recorded
    end_ns = max(event.time_ns for event in events if not isinstance(event, ImuSamples))
    for late_ns, found_s, offset_ms in ((50_000_000, 0.0, 50.0), (50_000_000, 0.05, None), (0, 0.05, -50.0)):
        said = calibration_doubts(info, (late(event, late_ns) for event in events), end_ns, time_offset_s=found_s)
        assert len(said) == (offset_ms is not None)
        if offset_ms is not None:
            assert "offset of the clocks" in said[0]
            assert float(said[0].split(" ms")[0].split()[-1]) == pytest.approx(offset_ms, abs=10.0)


def test_a_run_without_trouble_is_told_of_a_mounting_that_the_turns_contradict(
    recorded: tuple[CameraRecordingInfo, list[CameraEvent]],
) -> None:
    info, events = recorded
    end_ns = max(event.time_ns for event in events if not isinstance(event, ImuSamples))
    (camera,) = info.cameras
    assert camera.T_body_camera is not None
    T = camera.T_body_camera.copy()
    T[:3, :3] = T[:3, :3] @ so3.exp(np.deg2rad([0.0, 15.0, 0.0]))
    (said,) = calibration_doubts(
        dataclasses.replace(info, cameras=[dataclasses.replace(camera, T_body_camera=T)]), iter(events), end_ns
    )
    assert "the stated mounting does not fit" in said


@pytest.mark.slow
def test_a_run_without_trouble_is_told_of_a_rolling_shutter_and_of_nothing_else(
    recorded: tuple[CameraRecordingInfo, list[CameraEvent]],
) -> None:
    info, events = recorded
    end_ns = max(event.time_ns for event in events if not isinstance(event, ImuSamples))
    assert calibration_doubts(info, iter(events), end_ns) == []
    simulation = simulate_cameras("room_moving", 4, duration_s=7.5, rig=make_rig("mono", None, 0.35, 10.0))
    rolling = as_camera_recording(simulation, make_camera_fault("rolling_shutter"))
    (said,) = calibration_doubts(rolling.info, iter(rolling), end_ns)
    assert "a rolling shutter is suspected" in said
    # Images 0.3 s apart do not turn steadily between: less than the 20 ms there are.
    assert 12.0 < float(said.split("_shutter ")[1].split(" ms")[0]) < 22.0


def test_a_mounting_the_wrong_way_round_is_named(recorded: tuple[CameraRecordingInfo, list[CameraEvent]]) -> None:
    info, events = recorded
    (camera,) = info.cameras
    assert camera.T_body_camera is not None
    inverted = dataclasses.replace(camera, T_body_camera=np.linalg.inv(camera.T_body_camera))
    (found,) = likely_causes(dataclasses.replace(info, cameras=[inverted]), iter(events), 1, None)
    assert "the inverse of what is stated fits" in sentence(found)
    assert found.verdict == "error"


@pytest.mark.parametrize(("trouble_s", "read_s"), [(None, 16.0), (5.0, 16.0), (40.0, 42.0)])
def test_sixteen_seconds_are_looked_at(
    recorded: tuple[CameraRecordingInfo, list[CameraEvent]], trouble_s: float | None, read_s: float
) -> None:
    info, _ = recorded
    read: list[float] = []

    def samples() -> Iterator[CameraEvent]:
        for k in range(120):
            read.append(0.5 * k)
            yield ImuSamples.from_arrays(
                np.array([500_000_000 * k]), np.full((1, 3), 0.1 * (k % 2)), np.full((1, 3), 0.1 * (k % 2))
            )

    assert likely_causes(info, samples(), 1, None if trouble_s is None else round(1e9 * trouble_s)) == []
    assert abs(read[-1] - read_s) <= 1.0


def test_reading_again_leaves_the_counts_of_the_reading_before() -> None:
    made = as_camera_recording(simulate_cameras("room_moving", 4, duration_s=0.5, rig=make_rig("mono", None, 0.2, 10.0)))
    events = list(made)
    assert made.progress == 1.0
    again = made.read_again()
    next(again)
    assert made.progress == 1.0
    assert 1 + len(list(again)) == len(events)


@pytest.mark.slow
def test_images_that_come_again_with_another_stamp_are_no_shutter_and_no_turn(
    recorded: tuple[CameraRecordingInfo, list[CameraEvent]],
) -> None:
    info, events = recorded
    end_ns = max(event.time_ns for event in events if not isinstance(event, ImuSamples))

    def twice() -> Iterator[CameraEvent]:
        for event in events:
            yield event
            if not isinstance(event, ImuSamples):
                yield dataclasses.replace(event, time_ns=event.time_ns + 40_000_000)

    assert calibration_doubts(info, twice(), end_ns) == []
    said = [sentence(found) for found in likely_causes(info, twice(), 1, None)]
    assert all("imu" not in text and "shutter" not in text for text in said)


@pytest.mark.parametrize("seconds", [0.1, 1.0])
def test_an_imu_that_repeats_one_value_for_long_is_a_cause(
    recorded: tuple[CameraRecordingInfo, list[CameraEvent]], seconds: float
) -> None:
    info, events = recorded
    begin_ns = events[0].time_ns[0] + 3_000_000_000 if isinstance(events[0], ImuSamples) else events[0].time_ns + 3_000_000_000

    def stuck() -> Iterator[CameraEvent]:
        held = None
        for event in events:
            if isinstance(event, ImuSamples):
                gyro = event.gyro.copy()
                repeats = (event.time_ns >= begin_ns) & (event.time_ns < begin_ns + round(seconds * 1e9))
                if repeats.any():
                    held = gyro[repeats][0] if held is None else held
                    gyro[repeats] = held
                event = dataclasses.replace(event, gyro=gyro)
            yield event

    said = [found for found in likely_causes(info, stuck(), 1, None) if found.key == "imu_repeats"]
    assert len(said) == (seconds > 0.2)
    assert all("the gyroscope for 0.9" in found.text or "the gyroscope for 1.0" in found.text for found in said)
