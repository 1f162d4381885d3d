"""Random recordings for `boxplus vo`, and the verdict on what it makes of them.

Faults are those that cameras alone meet, and a focal length that is declared wrong. A run is right when the camera's positions,
aligned in pose (of one camera alone by a similarity), are off by no more than max(2 cm, 2 % of the true way) as root mean
square. What a user sees is the message of a run that refuses, its contradiction (exit code 3), warnings about the whole run, and
three in ten frames that are not `ok`. A baseline that is declared wrong makes the world larger or smaller, which images cannot
tell: such a run that is right but for its scale is `right but for scale`.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import BoxplusError
from boxplus.evaluation.alignment import UndeterminedAlignmentError, align
from boxplus.formats.trajectory import Trajectory, read_trajectory
from boxplus.runs.cameras.causes import MAY_BE
from boxplus.runs.direct.direct_run import run_direct_odometry
from boxplus.simulation.cameras import as_camera_recording
from boxplus.simulation.cameras.recorded import Recorded
from vio_campaign.draws import FAULTY_SHARE, MOTIONS, Draw, Kinds, draw_of, make_fault, with_fault

FLOOR_M, SHARE_OF_WAY, MANY_NOT_OK = 0.02, 0.02, 0.3
FAULT_KINDS = (
    "covered_lens", "darkness", "drop_frames", "swapped_cameras", "wrong_baseline", "bent_rig", "rolling_shutter", "bare_walls",
    "rotation_at_start", "moving_object", "wrong_focal_length", "wrong_second_focal_length",
)  # fmt: skip


def draw_direct_kinds(seed: int) -> Kinds:
    """The kinds of a seed."""
    random = np.random.Generator(np.random.PCG64([seed, 31]))
    motion = str(random.choice(list(MOTIONS)))
    world = str(random.choice(MOTIONS[motion]))
    rig, lens = str(random.choice(("stereo", "mono", "rgbd"), p=(0.6, 0.2, 0.2))), str(random.choice(("radtan", "pinhole")))
    light = str(random.choice(("steady", "swinging", "jumping"), p=(0.6, 0.25, 0.15)))
    fault = str(random.choice(FAULT_KINDS)) if random.uniform() < FAULTY_SHARE else "none"
    kinds = with_fault(Kinds(world, motion, rig, lens, light, "none", "none"), fault)
    return replace(kinds, lens="pinhole") if kinds.rig == "rgbd" else kinds


def draw_direct(seed: int, fault: str | None = None) -> Draw:
    """Everything about a seed, with a fault of another name where one is given; the IMU is drawn and not recorded."""
    kinds = draw_direct_kinds(seed)
    if fault is not None:
        kinds = with_fault(kinds, fault)
    made = draw_of(seed, replace(kinds, imu="industrial", fault="none"))
    random = np.random.Generator(np.random.PCG64([seed, 32]))
    begin_s = float(random.uniform(3.0, 0.5 * made.duration_s))
    return replace(made, kinds=kinds, fault=make_fault(kinds, begin_s, random))


def run_direct(made: Draw) -> dict[str, Any]:
    """The verdict and what led to it."""
    simulation = made.truth()
    truth = Recorded(simulation, made.fault).simulation  # some faults are of the motion
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work) / "run"
        try:
            with as_camera_recording(simulation, made.fault) as recording:
                summary = run_direct_odometry(recording, folder)
        except BoxplusError as problem:
            return {"verdict": _verdict(made, None, None, [str(problem)], True), "wrong": [["flag", "", str(problem)]]}
        estimate = read_trajectory(folder / "trajectory.csv")
    body = truth.ground_truth(estimate.time_ns)
    mounting = made.scenario.rig.cameras[0].mounting
    p_true = body.p_world_imu + body.R_world_imu @ mounting[:3, 3]
    errors = {kind: _error(estimate, p_true, kind) for kind in ("se3", "sim3")}
    way = float(np.linalg.norm(np.diff(p_true, axis=0), axis=1).sum())
    most = max(FLOOR_M, SHARE_OF_WAY * way)
    frames = max(sum(summary.status.values()), 1)
    not_ok = 1.0 - summary.status.get("ok", 0) / frames
    said = [summary.contradiction] if summary.contradiction else []
    noted = [warning.text for warning in summary.warnings]
    said += [text for text in noted if text.startswith((MAY_BE, "grey values look like"))]
    error = errors["sim3" if summary.kind == "mono" else "se3"]
    verdict = _verdict(made, error <= most, errors["sim3"] <= most, said + noted, bool(said) or not_ok >= MANY_NOT_OK)
    shares = {kind: round(100.0 * value / max(way, 1e-9), 3) for kind, value in errors.items()}
    wrong = [["error_%", shares["sim3" if summary.kind == "mono" else "se3"], f"of {way:.1f} m"], ["sim3_%", shares["sim3"], ""]]
    wrong += [["not_ok", round(not_ok, 2), ""], *(["flag", "", text] for text in said), *(["note", "", text] for text in noted)]
    before = summary.frames_before_start
    return {"verdict": verdict, "wrong": wrong, "frames": summary.frames, "before_start": before, "keyframes": summary.keyframes}


def _verdict(made: Draw, right: bool | None, right_but_for_scale: bool | None, said: list[str], flagged: bool) -> str:
    if right:
        return "false alarm" if made.fault is None and flagged else "right"
    if flagged:
        return "right cause" if made.fault is not None and made.fault.named_in(" ".join(said)) else "flagged"
    return "right but for scale" if made.kinds.fault == "wrong_baseline" and right_but_for_scale else "silent"


def _error(estimate: Trajectory, p_true: NDArray[np.float64], kind: str) -> float:
    """Root mean square of what an alignment leaves [m]; of poses that never moved, of the truth about its mean."""
    try:
        p = align(estimate.p, p_true, kind).apply(estimate).p  # type: ignore[arg-type]
    except UndeterminedAlignmentError:
        p = p_true.mean(axis=0)
    return float(np.sqrt(((p - p_true) ** 2).sum(axis=1).mean()))
