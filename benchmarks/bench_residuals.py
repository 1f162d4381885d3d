"""Residuals of one's own against the built-in one, and what manifolds cost: all ours, on one thread.

    python benchmarks/bench_residuals.py [--edges 10000] [--rounds 7]

The graph is a sphere of poses with noisy edges, solved from a noisy start by the default solver: with the built-in relative
pose, with the same written by a user as a Python function: with its Jacobian, differentiated automatically, and by differences.
Rotations written by a user as a manifold stand beside the shipped ones. They take turns, the fastest
of all rounds counts, by processor time, as the machine is shared. Compilation comes before and is reported apart.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from metrics import Metric, run_as_script
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.manifolds.quaternion import UnitQuaternion, exp_scalars, multiply_scalars, normalized_scalars, rotate
from boxplus.manifolds.se3 import SE3, adjoint_into, between_into, between_scalars, log_scalars
from boxplus.manifolds.se3_jacobians import right_jacobian_inverse_into
from boxplus.manifolds.so3 import log_quaternion
from boxplus.manifolds.user_manifold import UserManifold
from boxplus.optimization.problem import Problem
from boxplus.residuals.relative_pose import RelativePose
from boxplus.residuals.residual import Residual
from boxplus.residuals.user.residual import UserResidual

BAR_SOLVE = 2.0
BAR_EDGE_NS = 250.0
BAR_BOXPLUS_NS = 50.0
SIGMA = np.repeat([0.02, 0.1], 3)
RING = 50  # poses in one turn around the sphere


def relative_pose(T_i, T_j, z):  # type: ignore[no-untyped-def]
    """Log(Z⁻¹ T_i⁻¹ T_j), as a user would write it."""
    qw, qx, qy, qz, x, y, t = between_scalars(T_i, T_j)
    qw, qx, qy, qz = multiply_scalars(z[0], -z[1], -z[2], -z[3], qw, qx, qy, qz)
    x, y, t = rotate(z[0], -z[1], -z[2], -z[3], x - z[4], y - z[5], t - z[6])
    return log_scalars(qw, qx, qy, qz, x, y, t)


def relative_pose_jacobian(T_i, T_j, z, J_i, J_j):  # type: ignore[no-untyped-def]
    """J_r⁻¹(e) and −J_r⁻¹(e) Ad(T_j⁻¹ T_i), without care for speed."""
    T, xi, Ad = np.empty(7), np.empty(6), np.empty((6, 6))
    between_into(T_i, T_j, T)
    between_into(z, T, T)
    se3.log_into(T, xi)
    right_jacobian_inverse_into(xi[0], xi[1], xi[2], xi[3], xi[4], xi[5], J_j)
    between_into(T_j, T_i, T)
    adjoint_into(T, Ad)
    for row in range(6):
        for column in range(6):
            for k in range(6):
                J_i[row, column] -= J_j[row, k] * Ad[k, column]


def turned(x, delta):  # type: ignore[no-untyped-def]
    """⊞ of unit quaternions, as a user would write it."""
    w, a, b, c = exp_scalars(delta[0], delta[1], delta[2])
    w, a, b, c = multiply_scalars(x[0], x[1], x[2], x[3], w, a, b, c)
    return normalized_scalars(w, a, b, c)


def turn(x, base):  # type: ignore[no-untyped-def]
    """⊟ of unit quaternions."""
    w, a, b, c = multiply_scalars(base[0], -base[1], -base[2], -base[3], x[0], x[1], x[2], x[3])
    return log_quaternion(w, a, b, c)


def sphere(edges: int) -> tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """Start (n, 7), edges from i to j and what they measured: along the spiral and across to the next turn."""
    rng = np.random.default_rng(0)
    n = (edges + 1 + RING) // 2
    turn, step = np.divmod(np.arange(n), RING)
    azimuth, polar = 2.0 * np.pi * step / RING, np.pi * (turn + 1.0) / (n // RING + 2.0)
    p = 50.0 * np.column_stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
    T = np.hstack([SE3.random(rng, n)[:, :4], p])
    i = np.concatenate([np.arange(n - 1), np.arange(n - RING)])
    j = np.concatenate([np.arange(1, n), np.arange(RING, n)])
    Z = SE3.boxplus(se3.compose(se3.inverse(T[i]), T[j]), SIGMA * rng.normal(size=(len(i), 6)))
    return SE3.boxplus(T, 3.0 * SIGMA * rng.normal(size=(n, 6))), i, j, Z


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
    """Edges alone, whole solves, and ⊞."""
    start, i, j, Z = sphere(options.edges)
    residuals: list[Residual] = [
        RelativePose(Z, sigma=SIGMA),
        UserResidual(relative_pose, dim=6, manifolds=(SE3, SE3), data=(Z,), sigma=SIGMA, jacobian=relative_pose_jacobian),
        UserResidual(relative_pose, dim=6, manifolds=(SE3, SE3), data=(Z,), sigma=SIGMA, jacobian="automatic"),
        UserResidual(relative_pose, dim=6, manifolds=(SE3, SE3), data=(Z,), sigma=SIGMA, jacobian="differences"),
    ]
    names = ("built in", "a user's, with Jacobian", "a user's, automatic", "a user's, by differences")

    def linearized(residual: Residual) -> Callable[[], object]:
        count = residual.count
        r, J, valid = np.zeros((count, 6)), (np.zeros((count, 6, 6)), np.zeros((count, 6, 6))), np.ones(count, dtype=np.bool_)
        index = i.astype(np.uint32), j.astype(np.uint32)
        return lambda: residual.linearize_into(0, count, (start, start), index, r, J, valid)

    def solved(residual: Residual) -> Callable[[], object]:
        def task() -> object:
            problem = Problem()
            poses = problem.add_variables(SE3, start)
            problem.add_residuals(residual, poses[i], poses[j])
            problem.fix(poses[0])
            return problem.solve()

        return task

    metrics = []
    edges = [linearized(residual) for residual in residuals]
    solves = [solved(residual) for residual in residuals]
    for name, edge, solve in zip(names, edges, solves, strict=True):
        began = time.perf_counter()
        edge(), solve()
        metrics.append(Metric(f"residuals/first use, {name}", time.perf_counter() - began, "s", gated=False))
    per_edge = [seconds / len(i) * 1e9 for seconds in fastest(edges, 5 * options.rounds)]
    metrics.append(Metric("residuals/edge with Jacobians, built in", per_edge[0], "ns", bar=BAR_EDGE_NS, gated=False))
    for name, value in zip(names[1:], per_edge[1:], strict=True):
        metrics.append(
            Metric(f"residuals/edge with Jacobians, {name}", value, "ns", opponent=names[0], opponent_value=per_edge[0])
        )
    whole = [1e3 * seconds for seconds in fastest(solves, options.rounds)]
    for name, value in zip(names[1:], whole[1:], strict=True):
        title = f"residuals/graph of {len(i)} edges, {name}"
        metrics.append(Metric(title, value, "ms", bar=BAR_SOLVE, opponent=names[0], opponent_value=whole[0]))
    x, delta = SE3.random(np.random.default_rng(1), 100_000), np.random.default_rng(2).normal(size=(100_000, 6))
    mine = UserManifold("Rotations", size=4, dof=3, plus=turned, minus=turn, identity=[1.0, 0.0, 0.0, 0.0])
    q, base, w = x[:, :4].copy(), x[::-1, :4].copy(), delta[:, :3].copy()
    for title, tasks in (
        ("⊞", [lambda: UnitQuaternion.boxplus(q, w), lambda: mine.boxplus(q, w)]),
        ("⊟ and its Jacobian", [lambda: UnitQuaternion.boxminus_jacobian(q, base), lambda: mine.boxminus_jacobian(q, base)]),
    ):
        shipped, user = (seconds / len(q) * 1e9 for seconds in fastest(tasks, 5 * options.rounds))
        metrics.append(
            Metric(f"residuals/{title} on a user's manifold", user, "ns", opponent="UnitQuaternion", opponent_value=shipped)
        )
    (seconds,) = fastest([lambda: SE3.boxplus(x, delta)], 5 * options.rounds)
    metrics.append(Metric("residuals/SE3 ⊞, each of 100,000", seconds / len(x) * 1e9, "ns", bar=BAR_BOXPLUS_NS, gated=False))
    return metrics


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--edges", type=int, default=10_000)
    parser.add_argument("--rounds", type=int, default=7)


if __name__ == "__main__":
    run_as_script(__doc__, measure, _arguments)
