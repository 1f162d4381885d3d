"""Refinement of simulated runs: error before and after, NEES, thickness, time. Worlds, motions, sensors and IMUs by seed.

    python benchmarks/refine_campaign.py --seeds 107,121,123

Sound recordings of `lio_campaign`; `--list` prints the seeds that are. Where most of the scans were weak, as in tunnels, it is
refused, and from the first weak one on covariances are the filter's. Settings were chosen on
even seeds. NEES are of the pose relative to the first one, divided by 6: 1 is honest, above is too sure. The seconds are of the
processor, for reading and for refining.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from lio_campaign.draws import draw, draw_kinds
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.evaluation.nees import nees
from boxplus.manifolds import quaternion, se3, so3
from boxplus.sensors.scan import Scan
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from boxplus.systems.refinement.collecting import OdometryRows, collect
from boxplus.systems.refinement.config import RefinementConfig
from boxplus.systems.refinement.refinement import refine
from boxplus.systems.refinement.unshown import after_unshown, is_mostly_unshown

Floats = NDArray[np.float64]


def is_sound(seed: int) -> bool:
    """Whether nothing is spoilt, and the mounting is known."""
    kinds = draw_kinds(seed)
    return kinds.fault == "none" and kinds.extrinsic != "absent"


def run(seed: int, config: RefinementConfig) -> tuple[str, float, float]:
    """One recording, as a row of text; ratio of the errors and NEES / 6 of what is written."""
    case, kinds = draw(seed), draw_kinds(seed)
    simulation = case.truth()
    lio = LioConfig(T_imu_lidar=tuple(map(tuple, case.scenario.T_imu_lidar.tolist())))  # type: ignore[call-arg]
    odometry, events, estimates = LidarInertialOdometry(lio), list(simulation), []
    for event in events:
        estimates += odometry.push_scan(event) if isinstance(event, Scan) else odometry.push_imu(event)
    estimates += odometry.flush()
    name = f"{seed:4d} {kinds.world:10s} {kinds.motion:17s} {kinds.sensor:11s} {kinds.imu:10s}"
    if len(estimates) < 30:
        return f"{name} no run: {odometry.start_problem}", np.nan, np.nan
    times = np.array([e.time_ns for e in estimates])
    status, of_rows = np.array([e.status for e in estimates]), np.stack([e.pose_covariance for e in estimates])
    rows = OdometryRows(times, [e.state for e in estimates], status, of_rows)
    if is_mostly_unshown(rows.status):
        return f"{name} refused: {np.count_nonzero(rows.status != 'ok')} of {len(times)} scans weak or lost", np.nan, np.nan
    began = time.process_time()
    try:
        finished = collect(events, rows, lio, config)
        read = time.process_time()
        found = refine(finished, config)
    except InputError as error:
        return f"{name} refused: {error}", np.nan, np.nan
    done = time.process_time()
    ends = np.flatnonzero(finished.is_end)
    at = np.searchsorted(times, finished.time_ns[ends])
    motion = simulation.ground_truth(times[at])
    truth = np.hstack([quaternion.from_matrix(motion.R_world_imu), motion.p_world_imu])
    before, after = finished.T_world_imu[ends], found.after.T_world_imu[ends]
    errors = [_ate(T[:, 4:], truth[:, 4:]) for T in (before, after)]
    of_run = of_rows[at]
    unshown = after_unshown(rows.status)[at]
    own = [
        _nees(before, truth, of_run),
        _nees(after, truth, np.where(unshown[:, None, None], of_run, found.pose_covariance[ends])),
    ]
    accepted = found.refusal is None
    ratio, said = (errors[1] / errors[0], own[1]) if accepted else (1.0, own[0])
    thickness = [1e3 * s.thickness for s in found.sharpness]
    text = (
        f"{name} {len(ends):4d} scans {found.keyframes:3d} keyframes {found.planes:5d} planes  "
        f"ATE {1e3 * errors[0]:7.2f} -> {1e3 * errors[1]:7.2f} mm ({errors[1] / errors[0]:.2f})  "
        f"NEES {own[0]:5.2f} -> {own[1]:5.2f}  {np.count_nonzero(rows.status != 'ok'):3d} weak  "
        f"thickness {thickness[0]:.3f} -> {thickness[1]:.3f} mm {'accepted' if accepted else 'REFUSED'}  "
        f"{read - began:.1f} + {done - read:.1f} s of {case.duration_s:.0f} s"
    )
    return text, ratio, said


def _nees(T: Floats, truth: Floats, covariance: Floats) -> float:
    """Mean over scans, by 6, relative to the first pose."""
    moved = se3.compose(np.broadcast_to(se3.compose(T[0], se3.inverse(truth[0])), T.shape), truth)
    turn = so3.log(np.swapaxes(quaternion.to_matrix(moved[:, :4]), 1, 2) @ quaternion.to_matrix(T[:, :4]))
    errors = np.hstack([turn, T[:, 4:] - moved[:, 4:]])[1:]
    return float(nees(errors, covariance[1:]).mean() / 6.0)


def _ate(p: Floats, q: Floats) -> float:
    a, b = p - p.mean(axis=0), q - q.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = (U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt).T
    return float(np.sqrt(((a @ R.T - b) ** 2).sum(axis=1).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="107,121,123", help="comma-separated")
    parser.add_argument("--list", action="store_true", help="print the sound seeds below 400")
    options = parser.parse_args()
    if options.list:
        print(*(seed for seed in range(100, 400) if is_sound(seed)))
        return
    ratios, said = [], []
    for seed in map(int, options.seeds.split(",")):
        text, ratio, own = run(seed, RefinementConfig())  # type: ignore[call-arg]
        print(text, flush=True)
        ratios.append(ratio)
        said.append(own)
    print(f"ratio of the errors, what is written: median {np.nanmedian(ratios):.2f}, worst {np.nanmax(ratios):.2f}")
    print(f"NEES / 6, what is written: median {np.nanmedian(said):.2f}, worst {np.nanmax(said):.2f}")


if __name__ == "__main__":
    main()
