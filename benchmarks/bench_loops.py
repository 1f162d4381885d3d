"""False loop closures: precision, recall and time of `--robust gnc`, and of GTSAM's GNC beside it.

    python benchmarks/bench_loops.py [--poses 1000] [--seeds 1 3] [--dimensions 2 3] [--without-gtsam]

Simulated walks with 30 and 60 % false loop closures, random ones and ones that agree with each other. Both get the same edges,
dead reckoning as the start, odometry as known inliers, truncated least squares and the same threshold (99 %), and run on one
core, one after the other. GTSAM takes minutes from 3,000 poses on. Settings were chosen on even seeds; report on odd ones.
"""

from __future__ import annotations

import argparse
import os
import sys
import time

import numpy as np
from metrics import Metric, run_as_script

from boxplus.simulation.pose_graphs import SimulatedPoseGraph, simulate_pose_graph
from boxplus.systems.pose_graph.pose_graph import PoseGraphConfig, optimize_pose_graph

SHARES, KINDS = (0.3, 0.6), ("random", "clustered")


def score(simulated: SimulatedPoseGraph, kept: np.ndarray) -> tuple[float, float]:
    """Precision and recall of the loops that were kept."""
    true = simulated.is_loop & ~simulated.is_false
    right = np.count_nonzero(kept & true)
    return right / max(np.count_nonzero(kept), 1), right / np.count_nonzero(true)


def own(simulated: SimulatedPoseGraph) -> tuple[np.ndarray, float]:
    """Loops that boxplus keeps, and the seconds from the graph in memory to the end."""
    begin = time.perf_counter()
    result = optimize_pose_graph(simulated.graph, PoseGraphConfig(robust="gnc", examine=False))
    seconds = time.perf_counter() - begin
    assert result.loops is not None
    return result.loops.is_kept & simulated.is_loop, seconds


def gtsam_gnc(simulated: SimulatedPoseGraph) -> tuple[np.ndarray, float] | None:
    """The same of GTSAM, without building its graph; None without GTSAM."""
    try:
        import gtsam
    except ImportError:
        print("GTSAM left out: it is not installed", file=sys.stderr)
        return None
    graph, spatial = simulated.graph, simulated.graph.dimension == 3
    assert graph.poses is not None
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def pose(row):
        if spatial:
            return gtsam.Pose3(gtsam.Rot3.Quaternion(*row[:4]), row[4:])
        return gtsam.Pose2(row[1], row[2], row[0])

    order = list(range(6)) if spatial else [1, 2, 0]  # GTSAM's plane has translation first
    factor = gtsam.BetweenFactorPose3 if spatial else gtsam.BetweenFactorPose2
    for (i, j), z, information in zip(graph.edges, graph.measurements, graph.information, strict=True):
        noise = gtsam.noiseModel.Gaussian.Information(information[np.ix_(order, order)])
        factors.add(factor(int(i), int(j), pose(z), noise))
    for k, row in enumerate(graph.poses):
        values.insert(k, pose(row))
    prior = gtsam.PriorFactorPose3 if spatial else gtsam.PriorFactorPose2
    factors.add(prior(0, pose(graph.poses[0]), gtsam.noiseModel.Isotropic.Sigma(len(order), 1e-4)))
    settings = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    settings.setLossType(gtsam.GncLossType.TLS)
    settings.setKnownInliers([int(k) for k in np.flatnonzero(~simulated.is_loop)] + [len(graph.edges)])
    begin = time.perf_counter()
    optimizer = gtsam.GncLMOptimizer(factors, values, settings)
    optimizer.setInlierCostThresholdsAtProbability(0.99)
    optimizer.optimize()
    seconds = time.perf_counter() - begin
    return (np.array(optimizer.getWeights())[:-1] > 0.5) & simulated.is_loop, seconds


def measure(options: argparse.Namespace) -> list[Metric]:
    """Worst precision and recall over the seeds, and the median ratio of the times, for every kind of walk."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    metrics = []
    for dimension in options.dimensions:
        own(simulate_pose_graph(dimension=dimension, poses=200, loops=50, block=2, false_share=0.3))  # compile
        for share in SHARES:
            for kind in KINDS:
                runs = [
                    simulate_pose_graph(dimension=dimension, poses=options.poses, seed=seed, false_share=share, false_kind=kind)
                    for seed in options.seeds
                ]
                ours = [(score(s, kept), seconds) for s in runs for kept, seconds in [own(s)]]
                name = f"loops/{dimension}D, {options.poses:,} poses, {share:.0%} false, {kind}: "
                for k, what in enumerate(("precision", "recall")):
                    worst = min(found[k] for found, _ in ours)
                    metrics.append(Metric(name + what, worst, "share", "higher", 0.98, tolerance=0.01))
                theirs = [] if options.without_gtsam else [found for s in runs if (found := gtsam_gnc(s)) is not None]
                seconds = float(np.median([seconds for _, seconds in ours]))
                if not theirs:
                    metrics.append(Metric(name + "time", seconds, "s", gated=False))
                    continue
                for s, (kept, _) in zip(runs, theirs, strict=True):
                    print(f"{name}GTSAM precision, recall {score(s, kept)}", file=sys.stderr)
                opponent = float(np.median([seconds for _, seconds in theirs]))
                metrics.append(Metric(name + "time", seconds, "s", "lower", 0.5, "GTSAM GNC", opponent, tolerance=0.5))
    return metrics


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--poses", type=int, default=1000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 3])
    parser.add_argument("--dimensions", type=int, nargs="+", default=[2, 3], choices=(2, 3))
    parser.add_argument("--without-gtsam", action="store_true")


if __name__ == "__main__":
    run_as_script(__doc__ or "", measure, _arguments)
