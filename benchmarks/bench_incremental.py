"""Pose graphs as they grow, pose by pose: GTSAM's iSAM2 and boxplus' IncrementalProblem side by side.

    python benchmarks/bench_incremental.py [--graphs ../shared/data/graphs] [--only manhattan world] [--poses 10000] [--seeds 0]

Every pose comes with the edges to earlier poses, and starts from the estimate of the one before it. `world` is a generated walk
through a city of square blocks. Timed is the update alone, in its mean over all poses, by processor time. Both see the same
steps in the same order and take turns, step by step, on one core, so that what else runs on the machine meets both. iSAM2 runs
with its standard parameters (relinearizeThreshold 0.1, relinearizeSkip 10), by Cholesky; where that gives up it begins again by
QR. χ² of each is compared with the optimum of the whole problem at quarters of the way and at the end. `--more` adds iSAM2 with
relinearizeSkip 1, and with a threshold of 0.01 too.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from metrics import Metric, run_as_script

from boxplus.formats.graphs.g2o import read_g2o
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.manifolds import se2, se3
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3
from boxplus.optimization.incremental.problem import IncrementalProblem
from boxplus.residuals import RelativePose, RelativePose2D
from boxplus.simulation.pose_graphs import simulate_pose_graph

BAR = 0.5  # of iSAM2's mean time
_SAME_OPTIMUM = 1e-3  # relative
_CHECKS = (0.25, 0.5, 0.75, 1.0)


class Steps:
    """A graph pose by pose: for each, its edges to earlier ones, and which of these its start value comes from."""

    def __init__(self, graph: PoseGraph, count: int) -> None:
        self.graph, self.count = graph, min(count, len(graph.ids))
        self.manifold, self.group = (SE3, se3) if graph.dimension == 3 else (SE2, se2)
        self.first = self.manifold.identity() if graph.poses is None else graph.poses[0]
        newest = graph.edges.max(axis=1)
        order = np.argsort(newest, kind="stable")
        self.edges = np.split(order, np.searchsorted(newest[order], np.arange(1, len(graph.ids))))
        self.chain = [int(own[np.argmax(graph.edges[own].min(axis=1))]) for own in self.edges[1:]]

    def start(self, k: int, estimate: Callable[[int], np.ndarray]) -> np.ndarray:
        """Where pose k starts."""
        i, j = self.graph.edges[self.chain[k - 1]]
        z = self.graph.measurements[self.chain[k - 1]]
        return np.asarray(
            self.group.compose(estimate(i), z) if j == k else self.group.compose(estimate(j), self.group.inverse(z))
        )


class Own:
    """boxplus."""

    def __init__(self, steps: Steps) -> None:
        self.steps, self.problem, self.seconds = steps, IncrementalProblem(), 0.0
        self.poses = self.problem.add_variables(steps.manifold, steps.first, fixed=True, name="poses")
        self.kind = RelativePose if steps.graph.dimension == 3 else RelativePose2D

    def step(self, k: int) -> float:
        graph, own = self.steps.graph, self.steps.edges[k]
        self.problem.extend(self.poses, self.steps.start(k, lambda i: self.problem.estimate(self.poses[i])[0]))
        i, j = graph.edges[own].T
        residual = self.kind(graph.measurements[own], information=graph.information[own])
        self.problem.add_residuals(residual, self.poses[i], self.poses[j])
        begin = time.process_time()
        self.problem.update()
        return time.process_time() - begin

    def estimates(self) -> np.ndarray:
        return self.problem.estimate(self.poses)


class Isam2:
    """GTSAM's iSAM2."""

    def __init__(self, steps: Steps, skip: int, threshold: float, factorization: str) -> None:
        import gtsam

        self.gtsam, self.steps = gtsam, steps
        parameters = gtsam.ISAM2Params()
        parameters.relinearizeSkip = skip
        parameters.setRelinearizeThreshold(threshold)
        parameters.setFactorization(factorization)
        if threshold < 0.1:
            wildfire = gtsam.ISAM2GaussNewtonParams()
            wildfire.setWildfireThreshold(1e-2 * threshold)
            parameters.setOptimizationParams(wildfire)
        self.isam = gtsam.ISAM2(parameters)
        self.is_3d = steps.graph.dimension == 3
        self.order = list(range(6)) if self.is_3d else [1, 2, 0]  # GTSAM's plane has translation first
        self.between = gtsam.BetweenFactorPose3 if self.is_3d else gtsam.BetweenFactorPose2
        prior = gtsam.PriorFactorPose3 if self.is_3d else gtsam.PriorFactorPose2
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        noise = gtsam.noiseModel.Isotropic.Sigma(len(self.order), 1e-4)
        graph.add(prior(0, self.pose(steps.first), noise))
        values.insert(0, self.pose(steps.first))
        self.isam.update(graph, values)

    def pose(self, row: np.ndarray) -> Any:
        if self.is_3d:
            return self.gtsam.Pose3(self.gtsam.Rot3.Quaternion(*row[:4]), row[4:])
        return self.gtsam.Pose2(row[1], row[2], row[0])

    def row(self, pose: Any) -> np.ndarray:
        if self.is_3d:
            q = pose.rotation().toQuaternion()
            return np.array([q.w(), q.x(), q.y(), q.z(), *pose.translation()])
        return np.array([pose.theta(), pose.x(), pose.y()])

    def estimate(self, k: int) -> np.ndarray:
        return self.row(self.isam.calculateEstimatePose3(k) if self.is_3d else self.isam.calculateEstimatePose2(k))

    def step(self, k: int) -> float:
        graph, source, values = self.gtsam.NonlinearFactorGraph(), self.steps.graph, self.gtsam.Values()
        values.insert(k, self.pose(self.steps.start(k, self.estimate)))
        for e in self.steps.edges[k]:
            i, j = (int(number) for number in source.edges[e])
            noise = self.gtsam.noiseModel.Gaussian.Information(source.information[e][np.ix_(self.order, self.order)])
            graph.add(self.between(i, j, self.pose(source.measurements[e]), noise))
        begin = time.process_time()
        self.isam.update(graph, values)
        return time.process_time() - begin

    def estimates(self) -> np.ndarray:
        values = self.isam.calculateEstimate()
        get = values.atPose3 if self.is_3d else values.atPose2
        return np.array([self.row(get(k)) for k in range(values.size())])


def run(name: str, steps: Steps, contestants: dict[str, list[Callable[[], Any]]]) -> dict[str, tuple[float, float, float]]:
    """Mean and largest time of an update [ms], and the largest χ² above the optimum, relative, at the checks.

    Args:
        contestants: what each is made by, and made by again where it gives up; it then makes up for the steps so far.
    """
    alive = {label: makers.pop(0)() for label, makers in contestants.items()}
    times: dict[str, list[float]] = {label: [] for label in alive}
    worst = dict.fromkeys(alive, 0.0)
    checks = {round(share * (steps.count - 1)) for share in _CHECKS}
    for k in range(1, steps.count):
        for label in list(alive):
            try:
                times[label].append(alive[label].step(k))
            except RuntimeError as problem:
                print(f"{name}: {label} gave up at pose {k}: {' '.join(str(problem).split())[:80]}", file=sys.stderr)
                del alive[label]
                if contestants[label]:
                    alive[label] = contestants[label].pop(0)()
                    times[label] = [alive[label].step(again) for again in range(1, k + 1)]
        if k in checks:
            whole = alive["ours"].problem.as_problem()
            best = whole.solve().cost
            for label, one in alive.items():
                excess = whole.cost([one.estimates()]) / best - 1.0
                worst[label] = max(worst[label], excess)
                where = f"χ² {2 * best * (1 + excess):.6g}, {excess:.1e} above the optimum"
                print(f"{name}: {label} at pose {k}: {1e3 * np.mean(times[label]):.3f} ms so far, {where}", file=sys.stderr)
    return {label: (1e3 * float(np.mean(times[label])), 1e3 * max(times[label]), worst[label]) for label in alive}


def measure(options: argparse.Namespace) -> list[Metric]:
    """Figures of every graph."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    metrics = []
    for name, graph in _graphs(options):
        steps = Steps(graph, options.poses)
        warm = Own(Steps(graph, 200))
        for k in range(1, warm.steps.count):
            warm.step(k)  # compiles
        contestants: dict[str, list[Callable[[], Any]]] = {"ours": [lambda steps=steps: Own(steps)]}
        try:
            import gtsam  # noqa: F401
        except ImportError:
            print("GTSAM left out: it is not installed", file=sys.stderr)
        else:
            more = [("iSAM2, skip 1", 1, 0.1), ("iSAM2, skip 1, threshold 0.01", 1, 0.01)] if options.more else []
            for label, skip, threshold in [("iSAM2", 10, 0.1), *more]:
                contestants[label] = [lambda a=(steps, skip, threshold, by): Isam2(*a) for by in ("CHOLESKY", "QR")]
        metrics += _judge(name, run(name, steps, contestants))
    return metrics


def _graphs(options: argparse.Namespace) -> list[tuple[str, PoseGraph]]:
    found = []
    for name in options.only:
        if name == "world":
            worlds = [simulate_pose_graph(dimension=2, poses=max(options.poses, 30), seed=seed).graph for seed in options.seeds]
            found += [(f"world of {len(w.ids):,} poses, seed {seed}", w) for w, seed in zip(worlds, options.seeds, strict=True)]
            continue
        file = options.graphs / f"{name}.g2o"
        if file.is_file():
            found.append((name, read_g2o(file)))
        else:
            print(f"{name} left out: no {file}", file=sys.stderr)
    return found


def _judge(name: str, results: dict[str, tuple[float, float, float]]) -> list[Metric]:
    for label, (mean, largest, excess) in results.items():
        print(f"{name}: {label} {mean:.3f} ms, largest {largest:.1f} ms, χ² at most {excess:.1e} above", file=sys.stderr)
    mean, largest, excess = results["ours"]
    # The fastest iSAM2 that lives to the end, wherever it arrives.
    fastest = min((label for label in results if label != "ours"), key=lambda label: results[label][0], default="")
    opponent = results[fastest][0] if fastest else None
    bar = BAR if fastest else None
    figures = [Metric(f"incremental/{name}: update, mean", mean, "ms", "lower", bar, fastest, opponent, gated=bool(fastest))]
    figures.append(Metric(f"incremental/{name}: update, largest", largest, "ms", gated=False))
    figures.append(
        Metric(f"incremental/{name}: χ² above the optimum, at most", excess, "share", "lower", _SAME_OPTIMUM, gated=False)
    )
    for other, (its, _, its_excess) in results.items():
        if other not in ("ours", fastest):
            note = f"{label}: beside {other} ({its_excess:.0e} above)"
            figures.append(Metric(note, mean, "ms", "lower", None, other, its, gated=False))
    return figures


def _arguments(parser: argparse.ArgumentParser) -> None:
    shared = Path(__file__).resolve().parents[2] / "shared" / "data" / "graphs"
    parser.add_argument("--graphs", type=Path, default=shared, help="folder of g2o files")
    parser.add_argument("--only", nargs="*", default=["manhattan", "sphere2500", "world"], help="names of graphs, or world")
    parser.add_argument("--poses", type=int, default=10000, help="of the generated world, and at most of each graph")
    parser.add_argument("--seeds", type=int, nargs="*", default=[0], help="of the generated worlds")
    parser.add_argument("--more", action="store_true", help="add iSAM2 with sharper thresholds")


if __name__ == "__main__":
    run_as_script(__doc__ or "", measure, _arguments)
