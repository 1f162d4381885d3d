"""What a run of direct odometry says of recordings in which something is wrong: the cause by its name, or not to be trusted."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import pytest

from boxplus.errors import InputError
from boxplus.runs.direct.direct_run import run_direct_odometry
from boxplus.simulation.cameras import CameraFault, as_camera_recording, faults, make_rig, simulate_cameras

pytestmark = pytest.mark.slow
pytest.importorskip("cv2")
SEED = 3


def run(folder: Path, fault: CameraFault, rig: Literal["stereo", "mono"], seconds: float, seed: int = SEED) -> tuple[bool, str]:
    """Whether the run over a hand-held recording is not to be trusted or refused, and what it says."""
    simulation = simulate_cameras("room_moving", seed, duration_s=seconds, rig=make_rig(rig, None, 0.35, 10.0))
    try:
        with as_camera_recording(simulation, fault) as recording:
            summary = run_direct_odometry(recording, folder / "run")
    except InputError as refusal:
        return True, refusal.got
    said = " ".join([summary.contradiction or "", *(warning.text for warning in summary.warnings)])
    return summary.contradiction is not None, said


@pytest.mark.parametrize(
    ("fault", "rig", "seconds"),
    [
        (faults.covered_lens(0, 2.0, 2.0), "stereo", 4.5),
        (faults.darkness(2.0, 2.0), "stereo", 4.5),
        (faults.bare_walls(), "stereo", 3.0),
        (faults.swapped_cameras(), "stereo", 3.0),
        (faults.wrong_focal_length(), "stereo", 4.0),
        (faults.rotation_at_start(4.0), "mono", 3.0),
        (faults.moving_object(2.0, 3.0), "stereo", 5.0),
    ],
    ids=lambda value: value.name if isinstance(value, CameraFault) else None,
)
def test_a_run_is_not_to_be_trusted_and_names_the_cause(
    tmp_path: Path, fault: CameraFault, rig: Literal["stereo", "mono"], seconds: float
) -> None:
    doubted, said = run(tmp_path, fault, rig, seconds)
    assert doubted and fault.named_in(said), said
