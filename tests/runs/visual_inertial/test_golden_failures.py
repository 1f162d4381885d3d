"""What a run of visual-inertial odometry says of recordings in which something is wrong: the cause by its name, or a refusal.

All are hand-held walks in full motion from the first image on, of a camera with a third of the pixels of a usual one.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.evaluation.evaluation import evaluate
from boxplus.formats.trajectory import Trajectory, read_trajectory
from boxplus.manifolds import quaternion, so3
from boxplus.runs.visual_inertial.config import VioRunConfig
from boxplus.runs.visual_inertial.visual_run import run_visual_odometry
from boxplus.sensors.images.camera_image import CameraImage
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.simulation.cameras import CameraFault, as_camera_recording, faults, make_rig, simulate_cameras
from boxplus.simulation.cameras.sensor import CameraRig

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="corners are followed with OpenCV"),
]
CONFIG = VioRunConfig.model_validate({"odometry": {"cell_size": 12, "features": 100}})
SEED = 3
Rig = Literal["stereo", "mono"] | CameraRig
Faulty = tuple[CameraFault, Rig, float, float]


class Outcome(NamedTuple):
    """What a user sees.

    Attributes:
        end: how the run ended.
        said: its refusal without the advice that every one carries, or its contradiction and warnings.
        lost: share of the frames.
        error: of the positions after alignment by yaw, by the length of the way; NaN of a refusal.
    """

    end: Literal["refused", "contradicted", "finished"]
    said: str
    lost: float = 0.0
    error: float = float("nan")


def run(
    folder: Path, fault: CameraFault | None, rig: Rig, seconds: float, rate_hz: float, scenario: str = "room_moving"
) -> Outcome:
    made = rig if isinstance(rig, CameraRig) else make_rig(rig, None, 0.3, rate_hz)
    simulation = simulate_cameras(scenario, SEED, duration_s=seconds, rig=made)
    try:
        with as_camera_recording(simulation, fault) as recording:
            summary = run_visual_odometry(recording, folder / "run", CONFIG)
    except InputError as refusal:
        return Outcome("refused", refusal.got)
    estimate = read_trajectory(folder / "run" / "trajectory.csv")
    motion = simulation.ground_truth(estimate.time_ns)
    truth = Trajectory(estimate.time_ns, motion.p_world_imu, quaternion.from_matrix(motion.R_world_imu))
    off = evaluate(estimate, truth, alignment="yaw", method="interpolate").ate.rmse
    way = float(np.linalg.norm(np.diff(truth.p, axis=0), axis=1).sum())
    end: Literal["contradicted", "finished"] = "finished" if summary.contradiction is None else "contradicted"
    said = " ".join([summary.contradiction or "", *(warning.text for warning in summary.warnings)])
    return Outcome(end, said, summary.status.get("lost", 0) / summary.frames, off / way)


def name(value: object) -> str | None:
    return value.name if isinstance(value, CameraFault) else None


def test_a_sound_recording_says_nothing(tmp_path: Path) -> None:
    sound = run(tmp_path, None, "stereo", 6.0, 10.0)
    assert sound.end == "finished" and not sound.said and not sound.lost and sound.error < 0.01


@pytest.mark.parametrize(("yaw_deg", "baseline"), [(75.0, 0.11), (0.0, 1.1)])
def test_a_pair_that_shares_little_of_its_view_or_stands_far_apart_is_as_sound(
    tmp_path: Path, yaw_deg: float, baseline: float
) -> None:
    rig = make_rig("stereo", None, 0.3, 10.0)
    T = np.array(rig.cameras[1].T_imu_camera)
    T[:3, :3] = T[:3, :3] @ so3.exp(np.array([0.0, np.deg2rad(yaw_deg), 0.0]))
    T[:3, 3] = np.array(rig.cameras[0].T_imu_camera)[:3, 3] - [0.0, baseline, 0.0]
    second = rig.cameras[1].model_copy(update={"T_imu_camera": T})
    outcome = run(tmp_path, None, rig.model_copy(update={"cameras": (rig.cameras[0], second)}), 6.0, 10.0)
    assert outcome.end == "finished" and not outcome.said and not outcome.lost and outcome.error < 0.01, outcome


def test_a_rate_that_falls_is_no_gap(tmp_path: Path) -> None:
    def slower(incoming: Iterable[faults.Event]) -> Iterator[faults.Event]:
        images = 0
        for event in incoming:
            if isinstance(event, CameraImage):
                images += 1
                if images > 90 and images % 4:
                    continue
            yield event

    fault = CameraFault("slower", "30 Hz, then 7.5 Hz", ("gap",), "estimator", events=slower)
    outcome = run(tmp_path, fault, "mono", 6.0, 30.0)
    assert outcome.end == "finished" and "gap" not in outcome.said and outcome.error < 0.02, outcome


@pytest.mark.parametrize(
    ("fault", "rig", "seconds", "rate_hz"),
    [
        (faults.rotation_at_start(6.0), "mono", 4.0, 10.0),
        (faults.constant_velocity_start(6.0), "mono", 4.0, 10.0),
        (faults.bare_walls(), "stereo", 4.0, 10.0),
        (faults.swapped_cameras(), "stereo", 4.5, 10.0),
        # Clock, mounting, shutter and focal length are told by some forty turns from image to image.
        (faults.imu_clock_offset(0.05), "mono", 6.0, 15.0),
        (faults.other_imu(), "mono", 6.0, 15.0),
        (faults.inverted_extrinsic(), "mono", 6.0, 15.0),
        (faults.wrong_focal_length(), "mono", 6.0, 15.0),
    ],
    ids=name,
)
def test_without_a_start_the_refusal_names_the_cause(
    tmp_path: Path, fault: CameraFault, rig: Rig, seconds: float, rate_hz: float
) -> None:
    outcome = run(tmp_path, fault, rig, seconds, rate_hz)
    assert outcome.end == "refused"
    assert fault.named_in(outcome.said), outcome.said


@pytest.mark.parametrize("rotvec_deg", [(90.0, 0.0, 0.0), (0.0, 180.0, 0.0)], ids=str)
def test_an_imu_that_is_turned_beside_one_camera_is_named_and_not_to_be_trusted(
    tmp_path: Path, rotvec_deg: tuple[float, float, float]
) -> None:
    R = so3.exp(np.deg2rad(rotvec_deg))

    def turned(incoming: Iterable[faults.Event]) -> Iterator[faults.Event]:
        for event in incoming:
            if isinstance(event, ImuSamples):
                event = ImuSamples(event.time_ns, event.gyro @ R.T, event.accel @ R.T)
            yield event

    fault = CameraFault("turned_imu", "an IMU that is turned", ("r_imu_cam0",), "inspect", events=turned)
    outcome = run(tmp_path, fault, "mono", 10.0, 15.0, scenario="room")
    assert outcome.end == "contradicted" and fault.named_in(outcome.said), outcome


def test_a_baseline_that_the_imu_contradicts_is_named(tmp_path: Path) -> None:
    fault = faults.wrong_baseline()
    outcome = run(tmp_path, fault, "stereo", 11.0, 10.0)
    assert outcome.end == "contradicted" and fault.named_in(outcome.said), outcome.said


@pytest.mark.parametrize("fault", [faults.covered_lens(0, 3.0, 2.0), faults.darkness(3.0, 2.0)], ids=name)
def test_a_view_that_goes_away_is_lost_and_says_why(tmp_path: Path, fault: CameraFault) -> None:
    outcome = run(tmp_path, fault, "mono", 6.0, 10.0)
    assert outcome.lost > 0.1 and fault.named_in(outcome.said), outcome.said


def test_images_that_are_missing_are_a_warning_and_the_way_goes_on(tmp_path: Path) -> None:
    fault = faults.drop_frames(3.0, 0.6)
    outcome = run(tmp_path, fault, "mono", 5.0, 10.0)
    assert outcome.end == "finished" and not outcome.lost and outcome.error < 0.02
    assert fault.named_in(outcome.said) and "images of the first camera" in outcome.said


def test_a_rolling_shutter_that_nothing_states_is_a_warning(tmp_path: Path) -> None:
    fault = faults.rolling_shutter()
    outcome = run(tmp_path, fault, "mono", 6.0, 15.0)
    assert outcome.end == "finished" and fault.named_in(outcome.said), outcome.said


def test_clocks_apart_that_leave_no_position_known_are_named_and_not_to_be_trusted(tmp_path: Path) -> None:
    fault = faults.imu_clock_offset(0.03)
    outcome = run(tmp_path, fault, "stereo", 6.0, 15.0)
    assert outcome.end == "contradicted" and fault.named_in(outcome.said), outcome


@pytest.mark.parametrize("rig", ["stereo", "mono"])
def test_an_object_that_fills_half_of_the_view_is_named_or_does_no_harm(tmp_path: Path, rig: Rig) -> None:
    fault = faults.moving_object(3.0, 3.0)
    outcome = run(tmp_path, fault, rig, 7.0, 10.0)
    assert outcome.error < 0.02 or (outcome.end == "contradicted" and fault.named_in(outcome.said)), outcome
