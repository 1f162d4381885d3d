"""The verdict on a run of `boxplus vio`: right, flagged with the right cause, flagged, or silently wrong.

What a user sees is the message of a run that refuses, its contradiction, its warnings and the status of its frames. A run is
right when its position, aligned in position and yaw, is off by no more than max(5 cm, 2 % of the true way) as root mean square. A
flag is a refusal, a contradiction, a warning of the run other than how many frames are weak, or three in ten frames that are not
`ok`. What names a cause is fixed by the fault's own words (`CameraFault.words`).
"""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from boxplus.errors import BoxplusError
from boxplus.evaluation.evaluation import evaluate
from boxplus.formats.trajectory import read_trajectory
from boxplus.recordings.cameras.open import open_camera_recording
from boxplus.runs.visual_inertial.visual_run import run_visual_odometry
from boxplus.simulation.cameras.recorded import Recorded
from vio_campaign.draws import Draw

FLOOR_M, SHARE_OF_WAY = 0.05, 0.02
MANY_NOT_OK = 0.3
_WEAK = re.compile(r"frames are weak|frames that were read have no pose")


@dataclass
class Outcome:
    """What a user gets.

    Attributes:
        error_m: root mean square of the position error, aligned in position and yaw; None without a trajectory.
        way_m: true length of the way.
        not_ok: share of the frames that are `weak` or `lost`.
        flags: sentences that tell that something is wrong.
    """

    error_m: float | None
    way_m: float
    not_ok: float = 0.0
    flags: list[str] = field(default_factory=list)

    @property
    def right(self) -> bool:
        """Whether there is a trajectory that is good enough."""
        return self.error_m is not None and self.error_m <= max(FLOOR_M, SHARE_OF_WAY * self.way_m)


def judge_run(made: Draw, outcome: Outcome) -> str:
    """The verdict; of a sound recording that is refused or doubted although it came out right: `false alarm`."""
    flagged = bool(outcome.flags) or outcome.not_ok >= MANY_NOT_OK
    if outcome.right:
        return "false alarm" if made.fault is None and outcome.flags else "right"
    if made.fault is not None and made.fault.named_in(" ".join(outcome.flags)):
        return "right cause"
    return "flagged" if flagged else "silent"


def run_odometry(made: Draw) -> tuple[Outcome, dict[str, Any]]:
    """Write the recording, run the odometry as `boxplus vio` does, compare with the truth."""
    truth = Recorded(made.truth(), made.fault).simulation  # some faults are of the motion
    every = np.arange(truth.start_ns, truth.end_ns, 20_000_000)
    way = float(np.linalg.norm(np.diff(truth.ground_truth(every).p_world_imu, axis=0), axis=1).sum())
    with tempfile.TemporaryDirectory() as work:
        path = made.write(Path(work) / "recording")
        folder = Path(work) / "run"
        try:
            with open_camera_recording(path) as recording:
                summary = run_visual_odometry(recording, folder)
        except BoxplusError as problem:
            return Outcome(None, way, 1.0, [str(problem)]), {}
        flags = [warning.text for warning in summary.warnings if not _WEAK.search(warning.text)]
        if summary.contradiction:
            flags.insert(0, summary.contradiction)
        estimate = read_trajectory(folder / "trajectory.csv")
        reference = read_trajectory(Path(f"{path}.gt.tum"))
        error = float(evaluate(estimate, reference, alignment="yaw", method="interpolate").ate.rmse)
        not_ok = float(np.mean([status != "ok" for status in estimate.status or ()])) if estimate.status else 0.0
    return Outcome(error, way, not_ok, flags), {"frames": summary.frames, "before_start": summary.frames_before_start}
