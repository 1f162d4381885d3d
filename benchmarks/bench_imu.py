"""Preintegration of one IMU sample with Jacobians and covariance: GTSAM's PreintegratedCombinedMeasurements and ours.

    python benchmarks/bench_imu.py [--file ../shared/data/imu/V1_03_difficult.imu.csv] [--rounds 15]

A recording at 200 Hz is cut into keyframe intervals of 1 s, and of 0.1 s; without one, samples are simulated. GTSAM takes its
samples one by one through Python, which costs it a call each: that cost is measured as that of another bound call that
converts the same arguments and computes nothing, `imuBias.ConstantBias`, and taken off. Both ratios are reported and the
one without it is judged. The two take turns; each one's fastest round counts. Processor time, one thread.
GTSAM is left out, with a message, where it is not installed.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from metrics import Metric, run_as_script
from numpy.typing import NDArray

from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.residuals.inertial.imu_preintegration import Preintegration

HERE = Path(__file__).resolve().parent
NOISE = ImuNoise(gyro=1.6968e-4, accel=2.0e-3, gyro_walk=1.9393e-5, accel_walk=3.0e-3)
BAR = 0.3

Samples = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]


def samples_of(file: Path) -> Samples:
    """Times, gyro and accel of a EuRoC file, or simulated ones in its place."""
    if file.is_file():
        table = np.loadtxt(file, delimiter=",")
        return np.loadtxt(file, delimiter=",", usecols=0, dtype=np.int64), table[:, 1:4].copy(), table[:, 4:7].copy()
    print(f"{file} is not there: simulated samples", file=sys.stderr)
    rng = np.random.default_rng(0)
    return np.arange(20_000) * 5_000_000, rng.normal(size=(20_000, 3)), rng.normal((0.0, 0.0, 9.81), size=(20_000, 3))


def gtsam_rounds(samples: Samples, steps: int) -> tuple[Callable[[], object], Callable[[], object]] | None:
    """GTSAM over the samples, an integration every `steps`; and the calls alone. None where it is not installed."""
    try:
        import gtsam
    except ImportError:
        return None
    time_ns, gyro, accel = samples
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.81)
    identity = np.eye(3)
    params.setAccelerometerCovariance(NOISE.accel**2 * identity)
    params.setGyroscopeCovariance(NOISE.gyro**2 * identity)
    params.setIntegrationCovariance(1e-10 * identity)
    params.setBiasAccCovariance(NOISE.accel_walk**2 * identity)
    params.setBiasOmegaCovariance(NOISE.gyro_walk**2 * identity)
    bias = gtsam.imuBias.ConstantBias()
    dt = (np.diff(time_ns) * 1e-9).tolist()
    rows = list(zip(accel[:-1], gyro[:-1], dt, strict=True))
    blocks = [rows[k : k + steps] for k in range(0, len(rows) - steps + 1, steps)]

    def integrate() -> object:
        for block in blocks:
            preintegrated = gtsam.PreintegratedCombinedMeasurements(params, bias)
            for a, w, seconds in block:
                preintegrated.integrateMeasurement(a, w, seconds)
            covariance = preintegrated.preintMeasCov()
        return covariance

    def call_only() -> object:
        call = gtsam.imuBias.ConstantBias
        for block in blocks:
            for a, w, _ in block:
                result = call(a, w)
        return result

    return integrate, call_only


def ours(samples: Samples, steps: int) -> Callable[[], object]:
    """Ours over the same intervals, one call."""
    time_ns = samples[0]
    ends = time_ns[: (len(time_ns) - 1) // steps * steps + 1 : steps]
    intervals = np.stack([ends[:-1], ends[1:]], axis=1)
    return lambda: Preintegration.integrate(*samples, noise=NOISE, intervals_ns=intervals)


def fastest(tasks: list[Callable[[], object]], rounds: int) -> list[float]:
    """Seconds of the fastest of `rounds` runs of every task, taking turns."""
    best = [np.inf] * len(tasks)
    for _ in range(rounds):
        for k, task in enumerate(tasks):
            began = time.process_time()
            task()
            best[k] = min(best[k], time.process_time() - began)
    return best


def measure(options: argparse.Namespace) -> list[Metric]:
    """All intervals."""
    samples = samples_of(options.file)
    metrics = []
    for seconds, steps in (("1 s", 200), ("0.1 s", 20)):
        count = (len(samples[0]) - 1) // steps * steps
        mine = ours(samples, steps)
        mine()  # compiles
        opponent = gtsam_rounds(samples, steps)
        name = f"imu/sample, intervals of {seconds}"
        if opponent is None:
            print("gtsam is not installed: left out", file=sys.stderr)
            (best,) = fastest([mine], options.rounds)
            metrics.append(Metric(name, best / count * 1e9, "ns", gated=False))
            continue
        best, raw, calls = (seconds / count * 1e9 for seconds in fastest([mine, *opponent], options.rounds))
        metrics.append(Metric(name, best, "ns", bar=BAR, opponent="GTSAM, calls taken off", opponent_value=raw - calls))
        metrics.append(Metric(f"{name}, calls included", best, "ns", opponent="GTSAM", opponent_value=raw, gated=False))
    return metrics


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--file", type=Path, default=HERE.parent.parent / "shared" / "data" / "imu" / "V1_03_difficult.imu.csv")
    parser.add_argument("--rounds", type=int, default=15)


if __name__ == "__main__":
    run_as_script(__doc__, measure, _arguments)
