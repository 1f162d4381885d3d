"""What a run of visual-inertial odometry says of recordings in which something is wrong: the cause by its name, or a refusal."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Literal

import pytest

from boxplus.errors import InputError
from boxplus.runs.visual_inertial.config import VioRunConfig
from boxplus.runs.visual_inertial.visual_run import run_visual_odometry
from boxplus.simulation.cameras import CameraFault, as_camera_recording, faults, make_rig, simulate_cameras

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="corners are followed with OpenCV"),
]
CONFIG = VioRunConfig.model_validate({"odometry": {"cell_size": 12, "features": 100}})
End = Literal["refused", "contradicted", "finished"]


def run(
    folder: Path, fault: CameraFault, rig: Literal["stereo", "mono"], seconds: float, seed: int, rate_hz: float = 10.0
) -> tuple[End, str]:
    """How the run over a hand-held recording in full motion ends, and all it says but the advice that every refusal carries."""
    simulation = simulate_cameras("room_moving", seed, duration_s=seconds, rig=make_rig(rig, None, 0.3, rate_hz))
    try:
        with as_camera_recording(simulation, fault) as recording:
            summary = run_visual_odometry(recording, folder / "run", CONFIG)
    except InputError as refusal:
        return "refused", refusal.got
    said = " ".join([summary.contradiction or "", *(warning.text for warning in summary.warnings)])
    return "finished" if summary.contradiction is None else "contradicted", said


@pytest.mark.parametrize(
    ("fault", "rig", "seconds"),
    [
        (faults.rotation_at_start(6.0), "mono", 4.0),
        (faults.constant_velocity_start(6.0), "mono", 4.0),
        (faults.bare_walls(), "stereo", 4.0),
        (faults.swapped_cameras(), "stereo", 4.5),
    ],
    ids=lambda value: value.name if isinstance(value, CameraFault) else str(value),
)
def test_no_start_is_given_and_the_refusal_names_the_cause(
    tmp_path: Path, fault: CameraFault, rig: Literal["stereo", "mono"], seconds: float
) -> None:
    end, said = run(tmp_path, fault, rig, seconds, 3)
    assert end == "refused"
    assert fault.named_in(said), said
