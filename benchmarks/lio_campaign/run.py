"""One recording of the campaign: make it, run the odometry as `boxplus lio` does, judge."""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from boxplus.cli import EXIT_BAD_INPUT, EXIT_FAILED, EXIT_UNTRUSTED
from boxplus.errors import BoxplusError, InputError
from boxplus.formats.trajectory import Trajectory, read_trajectory
from boxplus.recordings import open_recording
from boxplus.recordings.options import RecordingOptions
from boxplus.recordings.recording import Recording
from boxplus.runs.lidar_inertial.config import MapConfig, RunConfig
from boxplus.runs.lidar_inertial.extrinsic import choose_extrinsic
from boxplus.runs.lidar_inertial.odometry_run import run_odometry
from boxplus.runs.lidar_inertial.summary import RunSummary, read_summary
from boxplus.runs.vague_pose import largest_sigmas
from boxplus.simulation import Fault, Simulation, as_recording, write_recording
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from lio_campaign.draws import Draw, draw
from lio_campaign.judge import NO_JUMPS, Drawn, Errors, Outcome, Truth, errors_of, judge
from lio_campaign.nuisances import Scene, draw_nuisances
from lio_campaign.real import RealDraw, RecordedTruth, draw_real, opened_real
from lio_campaign.traffic import traffic

_AnyDraw = TypeVar("_AnyDraw", Draw, RealDraw)

_ENOUGH_SHARE = 0.01
"""Least eigenvalue of the true information over that of all points, above which no direction of a scan is weak: 2.5 times the
filter's own threshold."""
_POINTS_LOOKED_AT = 500
_COMMAND = (sys.executable, "-c", "from boxplus.cli import main; main()", "lio")


def run_seed(seed: int, *, command_line: bool = False, rough: bool = False, variety: str = "usual") -> dict[str, Any]:
    """Everything about one seed, as a line of JSON.

    Args:
        seed: which.
        command_line: write a bag and run the real `boxplus lio` in a process of its own.
        rough: with what real recordings have besides, see nuisances.py.
        variety: of `VARIETIES`.
    """
    clock = _Clock()
    made = draw(seed, variety)
    simulation = made.truth()
    lidar = simulation.scenario.lidar
    elevation = getattr(lidar, "vertical_fov_deg", (0.0, 0.0))
    scene = Scene(simulation, simulation.T_imu_lidar, getattr(lidar, "channels", 1), elevation)
    if rough:
        made = _roughened(made, *draw_nuisances(scene, seed))
    if variety == "fast" and seed % 4 >= 2:  # on every other pair of roads, so that tuned and untouched seeds have both
        made = _roughened(made, traffic(scene, seed), "traffic")
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        if command_line:
            outcome = _by_command(made, simulation, work)
        else:
            outcome = _in_process(lambda options: _opened(made, simulation, work, options), made, work)
    suspects: list[dict[str, float]] = []
    if _looked_at(made) and outcome.estimate is not None:
        suspects = falsely_weak(outcome.estimate, simulation)
    facts = {"seed": seed, "real": False, "rough": rough, "variety": variety, **_drawn(made)}
    if command_line:
        facts["bag"] = "command"
    return facts | _judged(made, outcome, simulation, suspects) | clock.read()


def run_real(seed: int, shared: Path, *, rough: bool = False) -> dict[str, Any]:
    """The same of a recording with a real IMU and a real motion.

    Args:
        seed: which.
        shared: folder with `tools/make_lio_recording.py` and `data/imu`.
        rough: as of `run_seed`.
    """
    clock = _Clock()
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        made = draw_real(seed, shared, work)
        if rough:
            scene = Scene(made.truth(), made.T_true, made.channels, made.elevation_deg)
            made = _roughened(made, *draw_nuisances(scene, seed))
        outcome = _in_process(lambda options: opened_real(made, options), made, work)
        truth = made.truth()
    facts = {"seed": seed, "real": True, "rough": rough, "variety": "usual", **_drawn(made)}
    return facts | _judged(made, outcome, truth, []) | clock.read()


def _drawn(made: _AnyDraw) -> dict[str, Any]:
    return asdict(made.kinds) | {"detail": made.detail, "duration_s": round(made.duration_s, 2)}


def _roughened(made: _AnyDraw, nuisance: Fault, names: str) -> _AnyDraw:
    """The draw with a nuisance laid upon it before its fault."""
    detail = f"{made.detail}; {nuisance.description}".lstrip("; ")
    names = names if made.kinds.nuisance == "none" else f"{made.kinds.nuisance}+{names}"
    return replace(made, spoiled=nuisance.then(made.spoiled), kinds=replace(made.kinds, nuisance=names), detail=detail)


def _looked_at(made: Drawn) -> bool:
    """Whether the exact geometry says which scans are weak: of a sound simulation whose points are those of the LiDAR's model."""
    sound = made.kinds.fault == "none" and made.kinds.nuisance == "none"
    return sound and not made.featureless and not isinstance(made, RealDraw)


def _judged(made: Drawn, outcome: Outcome, truth: Truth, suspects: list[dict[str, float]]) -> dict[str, Any]:
    jumps_ns = truth.jumps_ns if isinstance(truth, RecordedTruth) else NO_JUMPS
    errors = None if outcome.estimate is None else errors_of(outcome.estimate, truth, jumps_ns)
    weak = outcome.estimate is not None and outcome.estimate.status is not None and "weak" in set(outcome.estimate.status)
    verdict = judge(outcome, errors, made, falsely_weak=bool(suspects), truly_weak=weak and _looked_at(made) and not suspects)
    return asdict(verdict) | _figures(errors) | _facts(outcome) | {"falsely_weak_scans": suspects}


def _in_process(
    opened: Callable[[RecordingOptions], AbstractContextManager[Recording]], made: Draw | RealDraw, work: Path
) -> Outcome:
    """The steps of `boxplus.cli.lidar.lio.run`, without a terminal, on a recording in memory or in a file."""
    given = None if made.T_imu_lidar is None else tuple(map(tuple, made.T_imu_lidar.tolist()))
    config = RunConfig(
        recording=RecordingOptions.model_validate(made.recording_options),
        odometry=LioConfig(T_imu_lidar=given),
        map=MapConfig(save=False),
    )
    run = work / "run"
    try:
        with opened(config.recording) as recording:
            extrinsic = choose_extrinsic(recording, config.odometry)
            summary = run_odometry(recording, run, config, extrinsic=extrinsic)
        return Outcome(exit_code_of(summary), None, summary, _estimate(run))
    except BoxplusError as problem:
        code = EXIT_BAD_INPUT if isinstance(problem, InputError) else EXIT_FAILED
        return Outcome(code, str(problem))


def exit_code_of(summary: RunSummary) -> int:
    """The exit code of `boxplus lio` for a run that came to its end."""
    return 0 if summary.contradiction is None else EXIT_UNTRUSTED


def _opened(made: Draw, simulation: Simulation, work: Path, options: RecordingOptions) -> Recording:
    if made.kinds.bag != "true":
        return as_recording(simulation, made.spoiled)
    return open_recording(_written(made, simulation, work), options)


def _written(made: Draw, simulation: Simulation, work: Path) -> Path:
    file_format = "ros1" if made.file_format == "ros1" else "ros2"
    return write_recording(simulation, work / "recording", file_format, made.spoiled)


def _by_command(made: Draw, simulation: Simulation, work: Path) -> Outcome:
    """The real command line on a real file."""
    recording, run = _written(made, simulation, work), work / "run"
    command = [*_COMMAND, str(recording), "-o", str(run), "--no-map", "--no-report", "--threads", "1"]
    for key, value in made.recording_options.items():
        command += [f"--{key.replace('_', '-')}", str(value)]
    if made.T_imu_lidar is not None:
        command += ["--T-imu-lidar", " ".join(f"{value:.12g}" for value in made.T_imu_lidar.ravel())]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    summary = read_summary(run / "run.json") if (run / "run.json").exists() else None
    error = None if done.returncode == 0 else done.stderr.strip() or None
    return Outcome(done.returncode, error, summary, _estimate(run))


def _estimate(run: Path) -> Trajectory | None:
    """The trajectory of a run with at least two poses."""
    path = run / "trajectory.csv"
    if not path.exists() or len(path.read_text(encoding="utf-8").splitlines()) < 3:
        return None
    return read_trajectory(path, "csv")


def falsely_weak(estimate: Trajectory, simulation: Simulation, most: int = 8) -> list[dict[str, float]]:
    """Scans called weak or lost although their exact points tell every direction of the pose: up to `most` are looked at."""
    assert estimate.status is not None and estimate.time_ns is not None
    weak = np.flatnonzero(np.array(estimate.status) != "ok")
    found = []
    period_ns = simulation.scan_start_ns(1) - simulation.scan_start_ns(0)
    for index in weak[np.unique(np.linspace(0, len(weak) - 1, min(most, len(weak))).astype(int))] if len(weak) else []:
        scan = int((estimate.time_ns[index] - 1 - simulation.scan_start_ns(0)) // period_ns)
        share = true_information_share(simulation, min(max(scan, 0), simulation.scan_count - 1))
        if share > _ENOUGH_SHARE:
            found.append({"scan": float(scan), "share": round(share, 4)})
    return found


def true_information_share(simulation: Simulation, index: int) -> float:
    """Least information of scan `index` along any direction of the pose, over that of all its points if each measured it.

    From exact points and exact normals, the gradient of the distance to the surfaces a centimetre before each point.
    """
    points, time_ns = simulation.exact_points(index)
    if len(points) < 20:
        return 0.0
    chosen = np.linspace(0, len(points) - 1, min(_POINTS_LOOKED_AT, len(points))).astype(int)
    points, time_ns = points[chosen], time_ns[chosen]
    motion, T = simulation.ground_truth(time_ns), simulation.T_imu_lidar
    ranges = np.linalg.norm(points, axis=1, keepdims=True)

    def to_world(p_lidar: NDArray[np.float64]) -> NDArray[np.float64]:
        p_imu = p_lidar @ T[:3, :3].T + T[:3, 3]
        p_world: NDArray[np.float64] = np.einsum("nij,nj->ni", motion.R_world_imu, p_imu) + motion.p_world_imu
        return p_world

    before = to_world(points * (1.0 - 0.01 / ranges))
    step = 1e-4
    gradient = [
        (simulation.world.distance(before + step * axis) - simulation.world.distance(before - step * axis)) / (2 * step)
        for axis in np.eye(3)
    ]
    normals = np.stack(gradient, axis=1)
    lever = to_world(points) - motion.p_world_imu
    arm = float(np.sqrt(np.mean(np.sum(lever**2, axis=1))))
    J = np.concatenate([np.cross(lever, normals) / max(arm, 1e-6), normals], axis=1)
    return float(np.linalg.eigvalsh(J.T @ J / len(J))[0])


class _Clock:
    """Processor time of this process and of those it started, and wall time."""

    def __init__(self) -> None:
        self._began = self._now()

    def _now(self) -> tuple[float, float]:
        used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return sum(usage.ru_utime + usage.ru_stime for usage in used), time.perf_counter()

    def read(self) -> dict[str, float]:
        """Since it was made [s]."""
        cpu, wall = (now - began for now, began in zip(self._now(), self._began, strict=True))
        return {"cpu_s": round(cpu, 2), "wall_s": round(wall, 2)}


def _figures(errors: Errors | None) -> dict[str, Any]:
    if errors is None:
        return {"way_m": None, "worst_m": None, "worst_deg": None, "nees": None}
    return {
        "way_m": round(errors.way_m, 3),
        "worst_m": round(float(errors.position_m.max()), 4),
        "worst_deg": round(float(errors.rotation_deg.max()), 3),
        "last_m": round(float(errors.position_m[-1]), 4),
        "worst_sigmas": round(float(max(errors.position_sigmas.max(), errors.rotation_sigmas.max())), 2),
        "nees": round(errors.nees, 3),
        "jumped": round(float(errors.jumped.mean()), 3),
    }


def _facts(outcome: Outcome) -> dict[str, Any]:
    summary = outcome.summary
    evidence = [] if summary is None else summary.recording.evidence
    return {
        "exit_code": outcome.exit_code,
        "status": {} if summary is None else summary.status,
        "start": None if summary is None or summary.start is None else summary.start.kind,
        "extrinsic_source": None if summary is None else summary.extrinsic.source,
        "read_as": {entry["key"]: entry["value"] for entry in evidence if entry["key"].endswith("_unit")},
        **_last_sigmas(outcome.estimate),
    }


def _last_sigmas(estimate: Trajectory | None) -> dict[str, float]:
    """How well a run claims to know its last pose, along the axis that it knows least: rotation [deg] and position [m]."""
    if estimate is None or estimate.covariance is None:
        return {}
    turn, place = largest_sigmas(estimate.covariance[-1])
    return {"last_sigma_deg": round(float(np.rad2deg(turn)), 3), "last_sigma_m": round(place, 4)}
