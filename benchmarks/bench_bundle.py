"""Bundle adjustment: Ceres and boxplus to the same cost; kernels, threads, growth and memory.

    python benchmarks/bench_bundle.py [--bal ../shared/data/bal] [--rounds 5] [--large]

Ceres is compiled from ceres_bal.cpp against the headers of the system (Debian: libceres-dev) and left out with a message where
that fails. Both build the problem untimed and get one core; timed is the solver, analysis included, until the cost is within
1e-5 of the known optimum. The faster of Ceres' dense and sparse Schur complement counts. They take turns, and the
fastest round counts, as the machine is shared. `--large` adds synthetic problems of 50, 200 and 1000 cameras, each run in a
process of its own for its peak memory, and compares ten iterations.
"""

from __future__ import annotations

import argparse
import bz2
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from metrics import Metric, run_as_script

from boxplus.formats.reconstructions.bal import BalProblem, read_bal, write_bal
from boxplus.manifolds import quaternion, so3
from boxplus.manifolds.euclidean import Euclidean
from boxplus.optimization.problem import Problem
from boxplus.residuals.camera.bal_reprojection import BalCamera, BalReprojection

# Known optima, ½ Σ r² without robust loss.
OPTIMA = {
    "ladybug-49-7776-pre": 1.33442404e4,
    "trafalgar-21-11315-pre": 3.03786358e4,
    "dubrovnik-16-22106-pre": 1.80339e4,
}
_CLOSE = 1e-5
_LARGE = ((50, 20_000, 5), (200, 200_000, 5), (1000, 150_000, 7))  # cameras, points, observations of a point
_ITERATIONS = 10


def build(bal: BalProblem) -> Problem:
    """The problem in boxplus' form."""
    problem = Problem()
    rotation = quaternion.from_matrix(so3.exp(bal.cameras[:, :3]))
    cameras = problem.add_variables(BalCamera, np.hstack([rotation, bal.cameras[:, 3:]]), name="cameras")
    points = problem.add_variables(Euclidean(3), bal.points, name="points")
    problem.add_residuals(BalReprojection(bal.pixels), cameras[bal.camera_of], points[bal.point_of])
    return problem


def seconds_to(history: list[tuple[float, float]], cost: float) -> float:
    """When the cost was first reached; infinite if never."""
    return next((seconds for seconds, reached in history if reached <= cost), float("inf"))


def ours(bal: BalProblem, threads: int, iterations: int) -> list[tuple[float, float]]:
    """(seconds, cost) of every iteration, from a problem built anew."""
    solution = build(bal).solve(threads=threads, max_iterations=iterations, cost_tolerance=1e-12, linear_solver="schur")
    return [(step.time_s, step.cost) for step in solution.history]


def compile_ceres(folder: Path) -> Path | None:
    """The program, or None with a message."""
    source = Path(__file__).resolve().with_name("ceres_bal.cpp")
    program = folder / "ceres_bal"
    command = ["g++", "-O3", "-march=native", "-I/usr/include/eigen3", str(source), "-o", str(program), "-lceres", "-lglog"]
    try:
        subprocess.run(command, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        print("Ceres left out: it does not compile here (Debian: apt-get install g++ libceres-dev)", file=sys.stderr)
        return None
    return program


def ceres(program: Path, file: Path, threads: int, solver: str, iterations: int) -> tuple[list[tuple[float, float]], float]:
    """(seconds, cost) of every iteration, and the peak memory of the process [MB]."""
    command = [str(program), str(file), str(threads), solver, str(iterations)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    lines = process.stdout.read().splitlines()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise RuntimeError(f"Ceres ended with exit code {process.returncode}")
    pairs = [line.split() for line in lines]
    return [(float(seconds), float(cost)) for seconds, cost in pairs], usage.ru_maxrss / 1024.0


def compare(name: str, bal: BalProblem, program: Path | None, file: Path, rounds: int) -> list[Metric]:
    """Seconds to the optimum on one core, and on two."""
    target = OPTIMA[name] * (1.0 + _CLOSE)
    ours(bal, 1, 3)
    runs: dict[str, Callable[[], float]] = {"ours": lambda: seconds_to(ours(bal, 1, 60), target)}
    if program is not None:
        for solver in ("dense", "sparse"):
            runs[f"Ceres, {solver}"] = lambda solver=solver: seconds_to(ceres(program, file, 1, solver, 60)[0], target)
    best = least(runs, rounds)
    own = best.pop("ours")
    fastest = min(best, key=lambda solver: best[solver], default=None)
    opponent = None if fastest is None else best[fastest]
    label = f"bundle/{name.split('-pre')[0]}: to the optimum"
    return [Metric(label, own, "s", "lower", 0.5, fastest or "", opponent, gated=opponent is not None)]


def least(runs: dict[str, Callable[[], float]], rounds: int) -> dict[str, float]:
    """Fastest round of each, in turns."""
    best = dict.fromkeys(runs, float("inf"))
    for _ in range(rounds):
        for name, run in runs.items():
            best[name] = min(best[name], run())
    return best


def kernels(bal: BalProblem, rounds: int) -> list[Metric]:
    """Jacobians an observation, speed of the Schur complement, and what a second thread brings to an iteration."""
    model = build(bal).solve(max_iterations=1)._problem
    group, system = model.groups[0], model.system
    x = tuple(model.values[c.block.number] for c in group.connections)
    index = tuple(c.rows for c in group.connections)
    count = group.residual.count
    products = system._products
    flops = sum(2.0 * len(k.entry_a) * k.a.dof * k.b.dof * k.a.Z.shape[1] for k in products)

    def timed(work: Callable[[], object]) -> Callable[[], float]:
        def run() -> float:
            begin = time.perf_counter()
            work()
            return time.perf_counter() - begin

        return run

    def jacobians() -> None:
        for begin in range(0, count, 1024):
            end = min(begin + 1024, count)
            group.residual.linearize_into(begin, end, x, index, group.r, group.jacobians, group.valid)

    best = least({"jacobians": timed(jacobians), "schur": timed(system._reduce)}, 5 * rounds)
    return [
        Metric(
            "bundle/ladybug-49: residual and Jacobians of an observation",
            best["jacobians"] / count * 1e9,
            "ns",
            bar=40.0,
            gated=False,
        ),
        Metric("bundle/ladybug-49: Schur complement", flops / best["schur"] / 1e9, "GFLOP/s", "higher", 15.0, gated=False),
    ]


def threads(bal: BalProblem, problem: str, rounds: int) -> Metric:
    """To the optimum on two threads against one."""
    target = OPTIMA[problem] * (1.0 + _CLOSE)
    runs = {str(t): lambda t=t: seconds_to(ours(bal, t, 60), target) for t in (1, 2)}
    best = least(runs, rounds)
    return Metric(
        f"bundle/{problem.split('-pre')[0]}: two threads", best["2"], "s", "lower", 0.6, "one thread", best["1"], gated=False
    )


def synthetic(cameras: int, points: int, seen: int, seed: int = 0) -> BalProblem:
    """Cameras on a long arc, each point seen by `seen` neighbouring ones; half a pixel of noise and a start a little off."""
    rng = np.random.default_rng(seed)
    along = np.linspace(0.0, 0.5 * cameras, cameras)
    C = np.stack([along, np.sin(0.1 * along), np.zeros(cameras)], 1)
    vectors = 0.05 * rng.standard_normal((cameras, 3))
    R = so3.exp(vectors)
    first = rng.integers(0, cameras - seen + 1, points)
    camera_of = (first[:, None] + np.arange(seen)).reshape(-1)
    point_of = np.repeat(np.arange(points), seen)
    middle = C[first + seen // 2]
    p_world = middle + np.stack([rng.uniform(-2, 2, points), rng.uniform(-2, 2, points), rng.uniform(-12, -6, points)], 1)
    t = -np.einsum("nij,nj->ni", R, C)
    P = np.einsum("nij,nj->ni", R[camera_of], p_world[point_of]) + t[camera_of]
    p = -P[:, :2] / P[:, 2:]
    f, k1, k2 = 500.0, -0.02, 0.001
    r2 = (p * p).sum(1, keepdims=True)
    pixels = f * (1.0 + k1 * r2 + k2 * r2 * r2) * p + 0.5 * rng.standard_normal(p.shape)
    table = np.hstack([vectors, t, np.tile([f, k1, k2], (cameras, 1))])
    table[:, :6] += 0.002 * rng.standard_normal((cameras, 6))
    return BalProblem(table, p_world + 0.02 * rng.standard_normal(p_world.shape), camera_of, point_of, pixels)


def large(program: Path | None, folder: Path) -> list[Metric]:
    """Ten iterations of synthetic problems, with peak memory, against Ceres."""
    metrics = []
    for cameras, points, seen in _LARGE:
        file = folder / f"synthetic-{cameras}.txt"
        write_bal(file, synthetic(cameras, points, seen))
        own = subprocess.run([sys.executable, __file__, "--worker", str(file)], check=True, capture_output=True, text=True)
        figures = json.loads(next(line for line in own.stdout.splitlines() if line.startswith("{")))
        name = f"bundle/{cameras} cameras, {points * seen:,} observations"
        label = f"{name}: {_ITERATIONS} iterations"
        if program is None:
            metrics.append(Metric(label, figures["seconds"], "s", gated=False))
            metrics.append(Metric(f"{name}: peak memory", figures["memory_mb"], "MB", gated=False))
            continue
        history, memory = ceres(program, file, 1, "sparse", _ITERATIONS)
        metrics.append(Metric(label, figures["seconds"], "s", "lower", 0.5, "Ceres, sparse", history[-1][0]))
        metrics.append(
            Metric(f"{name}: cost", figures["cost"], "½ Σ r²", opponent="Ceres", opponent_value=history[-1][1], tolerance=0.01)
        )
        metrics.append(Metric(f"{name}: peak memory", figures["memory_mb"], "MB", "lower", 1.5, "Ceres", memory))
    return metrics


def worker(file: str) -> None:
    """Solve one file in this process and print seconds, cost and the peak memory of the process."""
    import resource

    ours(synthetic(8, 200, 4), 1, 2)
    bal = read_bal(file)
    history = ours(bal, 1, _ITERATIONS)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(json.dumps({"seconds": history[-1][0], "cost": history[-1][1], "memory_mb": peak}))


def measure(options: argparse.Namespace) -> list[Metric]:
    """All figures."""
    if options.worker:
        worker(options.worker)
        return []
    metrics: list[Metric] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        program = compile_ceres(folder)
        cores = os.sched_getaffinity(0)
        for problem in OPTIMA:
            packed = options.bal / f"{problem}.txt.bz2"
            if not packed.is_file():
                print(f"{problem} left out: no {packed}", file=sys.stderr)
                continue
            bal = read_bal(packed)
            plain = folder / f"{problem}.txt"
            plain.write_bytes(bz2.decompress(packed.read_bytes()))
            os.sched_setaffinity(0, {max(cores)})
            metrics += compare(problem, bal, program, plain, options.rounds)
            if problem.startswith("ladybug"):
                metrics += kernels(bal, options.rounds)
            os.sched_setaffinity(0, cores)
            metrics.append(threads(bal, problem, options.rounds))
        if options.large:
            metrics += large(program, folder)
    return metrics


def _arguments(parser: argparse.ArgumentParser) -> None:
    shared = Path(__file__).resolve().parents[2] / "shared" / "data" / "bal"
    parser.add_argument("--bal", type=Path, default=shared, help="folder of BAL files")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--large", action="store_true", help="add the synthetic problems")
    parser.add_argument("--worker", help=argparse.SUPPRESS)


if __name__ == "__main__":
    run_as_script(__doc__ or "", measure, _arguments)
