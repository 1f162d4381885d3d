"""What a run of visual-inertial odometry says of recordings in which something is wrong: the cause by its name, or a refusal.

All are hand-held walks in full motion from the first image on, of a camera with a third of the pixels of a usual one.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.evaluation.evaluation import evaluate
from boxplus.formats.trajectory import Trajectory, read_trajectory
from boxplus.manifolds import quaternion
from boxplus.runs.visual_inertial.config import VioRunConfig
from boxplus.runs.visual_inertial.visual_run import run_visual_odometry
from boxplus.simulation.cameras import CameraFault, as_camera_recording, faults, make_rig, simulate_cameras

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="corners are followed with OpenCV"),
]
CONFIG = VioRunConfig.model_validate({"odometry": {"cell_size": 12, "features": 100}})
SEED = 3
Rig = Literal["stereo", "mono"]
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


def run(folder: Path, fault: CameraFault | None, rig: Rig, seconds: float, rate_hz: float, seed: int = SEED) -> Outcome:
    simulation = simulate_cameras("room_moving", seed, duration_s=seconds, rig=make_rig(rig, None, 0.3, rate_hz))
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


@pytest.mark.parametrize("rig", ["stereo", "mono"])
def test_an_object_that_fills_half_of_the_view_is_named_or_does_no_harm(tmp_path: Path, rig: Rig) -> None:
    fault = faults.moving_object(3.0, 3.0)
    outcome = run(tmp_path, fault, rig, 7.0, 10.0)
    assert outcome.error < 0.02 or (outcome.end == "contradicted" and fault.named_in(outcome.said)), outcome
