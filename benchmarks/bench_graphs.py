"""Pose graphs to their optimum: GTSAM and boxplus side by side.

    python benchmarks/bench_graphs.py [--graphs ../shared/data/graphs] [--only torus3D intel] [--rounds 5] [--large]

Each system gets the graph in its own form; reading it and building the problem is set-up, reported apart. Timed is everything
from there to the optimum, initialisation, ordering and symbolic analysis included. Both run from the same poses, given to them:
the file's, or those along a spanning tree where it has none; and from the chordal relaxation, GTSAM in space only. Whoever
does not arrive at the known optimum has lost, boxplus included; the faster of each one's runs that do counts. They take turns on
one core, and the fastest round counts, as the machine is shared. GTSAM is left out with a message where it is not installed. g2o
does not take part: its wheels crash when an information matrix is set (g2o-python 0.0.11 and 0.0.12).
`--large` adds cubic grids of 1,000 to 8,000 poses, each joined to its neighbours, to show how the cost grows.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from metrics import Metric, run_as_script

from boxplus.formats.graphs.g2o import read_g2o
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.manifolds import se3
from boxplus.manifolds.se3 import SE3
from boxplus.systems.pose_graph.pose_graph import PoseGraphConfig, optimize_pose_graph
from boxplus.systems.pose_graph.start import spanning_tree_start

# Bar, and the optimum of χ² = Σ eᵀ Ω e with e = Log(Z⁻¹ T_i⁻¹ T_j); cubicle as `read_g2o` reads it by default.
BARS = {
    "sphere2500": (0.2, 1351.4019),
    "parking-garage": (0.2, 1.268385),
    "manhattan": (0.2, 3549.0411),
    "torus3D": (0.2, 24235.274),
    "cubicle": (0.2, 2712.9687),
    "intel": (0.2, 45.004233),
    "CSAIL": (0.2, 40.550883),
    "MIT": (0.2, 41.206947),
}
_SAME_OPTIMUM = 1e-4  # relative


@dataclass(frozen=True, slots=True)
class Outcome:
    """Seconds to the end, and χ² there."""

    seconds: float
    chi2: float


def own_contestants(graph: PoseGraph, start: np.ndarray) -> dict[str, Callable[[], Outcome]]:
    """boxplus from the graph in memory, from the poses given and from the chordal relaxation."""
    given = replace(graph, poses=start)

    def run(graph: PoseGraph, start: Literal["file", "chordal"]) -> Outcome:
        result = optimize_pose_graph(graph, PoseGraphConfig(start=start, examine=False))
        return Outcome(result.timing_s["start"] + result.timing_s["optimisation"], result.chi2)

    return {"ours, chordal": lambda: run(graph, "chordal"), "ours": lambda: run(given, "file")}


def gtsam_contestants(graph: PoseGraph, start: np.ndarray) -> dict[str, Callable[[], Outcome]]:
    """GTSAM's Gauss-Newton from the poses given and, in space, from its chordal initialisation; none without GTSAM."""
    try:
        import gtsam
    except ImportError:
        print("GTSAM left out: it is not installed", file=sys.stderr)
        return {}
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    is_3d = graph.dimension == 3

    def pose(row: np.ndarray) -> Any:
        if is_3d:
            return gtsam.Pose3(gtsam.Rot3.Quaternion(*row[:4]), row[4:])
        return gtsam.Pose2(row[1], row[2], row[0])

    order = list(range(6)) if is_3d else [1, 2, 0]  # GTSAM's plane has translation first
    factor = gtsam.BetweenFactorPose3 if is_3d else gtsam.BetweenFactorPose2
    for (i, j), z, information in zip(graph.edges, graph.measurements, graph.information, strict=True):
        noise = gtsam.noiseModel.Gaussian.Information(information[np.ix_(order, order)])
        factors.add(factor(int(i), int(j), pose(z), noise))
    for k, row in enumerate(start):
        values.insert(k, pose(row))
    prior = gtsam.PriorFactorPose3 if is_3d else gtsam.PriorFactorPose2
    factors.add(prior(0, pose(start[0]), gtsam.noiseModel.Isotropic.Sigma(len(order), 1e-4)))

    def run(is_chordal: bool) -> Outcome:
        begin = time.perf_counter()
        first = gtsam.InitializePose3.initialize(factors) if is_chordal else values
        result = gtsam.GaussNewtonOptimizer(factors, first, gtsam.GaussNewtonParams()).optimize()
        return Outcome(time.perf_counter() - begin, 2.0 * factors.error(result))

    contestants = {"GTSAM": lambda: run(False)}
    if is_3d:
        contestants["GTSAM, chordal"] = lambda: run(True)
    return contestants


def measure(options: argparse.Namespace) -> list[Metric]:
    """Figures of every graph."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    metrics = []
    for name in options.only or BARS:
        file = options.graphs / f"{name}.g2o"
        if not file.is_file():
            print(f"{name} left out: no {file}", file=sys.stderr)
            continue
        graph = read_g2o(file)
        begin = time.perf_counter()
        optimize_pose_graph(graph, PoseGraphConfig(examine=False))
        metrics.append(Metric(f"graphs/{name}: first run, compilation included", time.perf_counter() - begin, "s", gated=False))
        set_up = min(optimize_pose_graph(graph, PoseGraphConfig(examine=False)).timing_s["set-up"] for _ in range(options.rounds))
        metrics.append(Metric(f"graphs/{name}: set-up", set_up, "s", gated=False))
        # Without a counterpart in the opponents, and so not in the ratio; on unless it is left out.
        examination = min(optimize_pose_graph(graph).timing_s["examination"] for _ in range(options.rounds))
        metrics.append(Metric(f"graphs/{name}: examination", examination, "s", gated=False))
        start = graph.poses if graph.poses is not None else spanning_tree_start(graph)
        runs = {**own_contestants(graph, start), **gtsam_contestants(graph, start)}
        best: dict[str, Outcome] = {}
        for _ in range(options.rounds):
            for contestant, run in runs.items():
                try:
                    outcome = run()
                except RuntimeError as problem:
                    print(f"{name}: {contestant} failed: {str(problem).strip().splitlines()[0]}", file=sys.stderr)
                    continue
                if contestant not in best or outcome.seconds < best[contestant].seconds:
                    best[contestant] = outcome
        metrics += _judge(name, best)
    return metrics + (growth(options.rounds) if options.large else [])


def grid(side: int) -> PoseGraph:
    """side³ poses a metre apart, each measured from its neighbours along the three axes, 1 cm and 0.01 rad of noise."""
    rng = np.random.default_rng(0)
    number = np.arange(side**3).reshape(side, side, side)
    pairs = [(number[:-1], number[1:]), (number[:, :-1], number[:, 1:]), (number[:, :, :-1], number[:, :, 1:])]
    edges = np.concatenate([np.stack([a.ravel(), b.ravel()], 1) for a, b in pairs])
    rotation = SE3.random(rng, side**3)[:, :4]
    poses = np.hstack([rotation, np.stack(np.unravel_index(np.arange(side**3), number.shape), 1)])
    exact = se3.compose(se3.inverse(poses[edges[:, 0]]), poses[edges[:, 1]])
    measured = SE3.boxplus(exact, 0.01 * rng.standard_normal((len(edges), 6)))
    information = np.tile(1e4 * np.eye(6), (len(edges), 1, 1))
    return PoseGraph(3, number.ravel(), None, edges, measured, information, np.zeros(0, dtype=np.int64))


def growth(rounds: int) -> list[Metric]:
    """Seconds to the optimum of grids of growing size, from the chordal start."""
    metrics = []
    for side in (10, 13, 16, 20):
        graph = grid(side)
        results = [optimize_pose_graph(graph, PoseGraphConfig(examine=False)) for _ in range(rounds)]
        seconds = min(result.timing_s["start"] + result.timing_s["optimisation"] for result in results)
        name = f"graphs/grid of {side**3:,} poses, {len(graph.edges):,} edges"
        metrics.append(Metric(f"{name}: to the optimum", seconds, "s", gated=False))
        solve = min(result.solution.timing_s["linear solve"] / result.solution.iterations for result in results)
        metrics.append(Metric(f"{name}: a linear solve", solve, "s", gated=False))
    return metrics


def _judge(name: str, best: dict[str, Outcome]) -> list[Metric]:
    bar, optimum = BARS[name]
    arrived = {}
    for contestant, outcome in best.items():
        is_there = abs(outcome.chi2 - optimum) <= _SAME_OPTIMUM * optimum
        where = "" if is_there else f" (not the optimum, {optimum:.6g})"
        print(f"{name}: {contestant} {outcome.seconds:.4f} s, chi2 {outcome.chi2:.6g}{where}", file=sys.stderr)
        if is_there:
            arrived[contestant] = outcome.seconds
    own = {name: seconds for name, seconds in arrived.items() if name.startswith("ours")}
    others = {name: seconds for name, seconds in arrived.items() if name not in own}
    fastest = min(others, key=lambda contestant: others[contestant], default="")
    opponent = others.get(fastest)
    label, value = f"graphs/{name}: to the optimum", min(own.values(), default=float("inf"))
    return [Metric(label, value, "s", "lower", bar if opponent else None, fastest, opponent, gated=opponent is not None)]


def _arguments(parser: argparse.ArgumentParser) -> None:
    shared = Path(__file__).resolve().parents[2] / "shared" / "data" / "graphs"
    parser.add_argument("--graphs", type=Path, default=shared, help="folder of g2o files")
    parser.add_argument("--only", nargs="*", help="names of graphs")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--large", action="store_true", help="add grids of growing size")


if __name__ == "__main__":
    run_as_script(__doc__ or "", measure, _arguments)
