"""Whether the covariances of visual-inertial odometry mean something: NEES over simulated flights.

    python benchmarks/bench_vio_nees.py [--seeds 500:550] [--seconds 8] [--bias 0.2] [--cameras 2] [--out FILE]

The flights, corners and IMU samples are those of the tests (`simulated_rays.py`); corners have the noise that the settings say,
images are not rendered. The accelerometer's bias gets `--bias` m/s² more in every axis (one standard deviation). Once a second of
a flight the squared error of position and yaw, of roll and pitch, and of the accelerometer's bias, each over its covariance, is
compared with its degrees of freedom. Covariances are relative to the first pose of the start, whose position and yaw are known by
definition, so errors are counted from there: the first estimate, up to four seconds later, has errors of its own. The mean over N
independent flights lies below the bar, the 97.5 % quantile of χ², when the covariance is right. `--out` appends a line of JSON
for every flight, and flights that are in it already are not run again: so a long run may be cut into pieces.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from metrics import Metric, run_as_script
from numpy.typing import NDArray
from scipy.stats import chi2

from boxplus.manifolds import quaternion, so3
from boxplus.systems.visual_inertial_odometry import VioConfig, VioEstimate
from boxplus.systems.visual_inertial_odometry.start.start import Start

sys.path.append(str(Path(__file__).resolve().parents[1]))
from tests.systems.visual_inertial_odometry.simulated_rays import (
    PIXEL_SIGMA,
    Flight,
    at,
    rig,
    run,
)

EVERY = 20  # frames: a second
STATES = {"position and yaw": 4, "roll and pitch": 2, "accelerometer bias": 3}


def errors(flight: Flight, start: Start, estimate: VioEstimate) -> list[float]:
    """NEES of `STATES` in one frame."""
    k, first = at(flight, estimate), int(np.searchsorted(flight.time_ns, start.time_ns[0]))
    # A turn about the world's z axis alone: headings would turn with an error of the tilt as well, where the body leans.
    M = quaternion.to_matrix(start.T_world_imu[:1, :4])[0] @ flight.R[first].T
    Z = so3.exp(np.array([0.0, 0.0, np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1])]))
    R, p = Z @ flight.R[k], Z @ (flight.p[k] - flight.p[first]) + start.T_world_imu[0, 4:]
    turn = R @ so3.log(R.T @ estimate.T_world_imu[:3, :3])  # in the world
    P = estimate.covariance
    G = np.zeros((4, 15))
    G[0, :3], G[1:, 3:6] = R[2], np.eye(3)
    tilt = R @ P[:3, :3] @ R.T
    return [
        _squared(np.append(turn[2], estimate.T_world_imu[:3, 3] - p), G @ P @ G.T),
        _squared(turn[:2], tilt[:2, :2]),
        _squared(estimate.accel_bias - flight.bias_accel[k], P[12:, 12:]),
    ]


def _squared(error: NDArray[np.float64], covariance: NDArray[np.float64]) -> float:
    return float(error @ np.linalg.solve(covariance, error))


def fly(seed: int, options: argparse.Namespace) -> dict[str, Any]:
    """One flight: NEES (frames, states), and what the odometry said of itself."""
    flight = Flight(seed, options.seconds)
    more = np.random.default_rng(seed).normal(size=3) * options.bias
    flight.bias_accel, flight.accel = flight.bias_accel + more, flight.accel + more
    vio, estimates = run(flight, rig(options.cameras), VioConfig(pixel_sigma=PIXEL_SIGMA))  # type: ignore[call-arg]
    known = [estimate for estimate in estimates if estimate.status != "starting"]
    nees = [errors(flight, vio.start, estimate) for estimate in known[EVERY::EVERY]] if vio.start else []
    return {"seed": seed, "kind": vio.start.kind if vio.start else None, "contradiction": vio.contradiction, "nees": nees}


def measure(options: argparse.Namespace) -> list[Metric]:
    """Means over the flights: over all seconds, and at the end."""
    first, end = (int(part) for part in options.seeds.split(":"))
    lines = []
    if options.out and options.out.is_file():
        lines = [json.loads(line) for line in options.out.read_text(encoding="utf-8").splitlines()]
    lines = [line for line in lines if first <= line["seed"] < end]
    for seed in sorted(set(range(first, end)) - {line["seed"] for line in lines}):
        lines.append(fly(seed, options))
        print(f"vio_nees: {json.dumps(lines[-1])[:160]}", file=sys.stderr, flush=True)
        if options.out:
            with options.out.open("a", encoding="utf-8") as file:
                file.write(json.dumps(lines[-1]) + "\n")
    started = [line for line in lines if line["nees"]]
    over_time = np.array([np.mean(line["nees"], axis=0) for line in started])
    at_end = np.array([line["nees"][-1] for line in started])
    metrics = []
    for k, (name, dof) in enumerate(STATES.items()):
        # Seconds of one flight are not independent; the flights are.
        bar = float(chi2.ppf(0.975, dof * len(started))) / len(started)
        title = f"vio_nees/{name}, {dof} degrees of freedom"
        metrics.append(Metric(f"{title}: at the end", float(at_end[:, k].mean()), "NEES", bar=bar, tolerance=0.3))
        metrics.append(Metric(f"{title}: all seconds", float(over_time[:, k].mean()), "NEES", tolerance=0.3))
    contradictions = sum(line["contradiction"] is not None for line in lines)
    metrics.append(Metric("vio_nees/false contradictions", contradictions, "flights", bar=0.0, tolerance=0.0))
    metrics.append(Metric("vio_nees/flights without a start", len(lines) - len(started), "flights", tolerance=0.0))
    return metrics


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", default="500:550", help="first:last+1")
    parser.add_argument("--seconds", type=float, default=8.0, help="of a flight")
    parser.add_argument("--bias", type=float, default=0.2, help="of the accelerometer, beside that of the flight [m/s²]")
    parser.add_argument("--cameras", type=int, default=2, choices=(1, 2))
    parser.add_argument("--out", type=Path, help="lines of JSON, a flight each")


if __name__ == "__main__":
    run_as_script(__doc__, measure, _arguments)
