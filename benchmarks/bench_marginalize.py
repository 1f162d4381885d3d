"""Marginalising the oldest frame of a window with landmarks, landmark by landmark, against one dense QR over all of them.

    python benchmarks/bench_marginalize.py [--landmarks 50 100 150 200 400 1500] [--rounds 7]

Ten frames of pose, velocity and biases (15 degrees of freedom), landmarks of 3 degrees of freedom with 19 observations each
under a Huber loss, a preintegration-like residual between neighbouring frames, a prior on the oldest. What leaves is the oldest
frame and every landmark. Timed is the whole call, by processor time, its linearisation and the changes to the problem included;
the problem is built anew before each. The dense QR, NumPy's, is given the same rows ready and timed alike; its threads count all,
so that OPENBLAS_NUM_THREADS=1 is fair to it. It is left out beyond `--dense` landmarks, where it takes seconds and gigabytes.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from metrics import Metric, run_as_script
from numpy.typing import NDArray

from boxplus import Euclidean, Pinhole, Problem, SE3Left, losses, marginalize
from boxplus.manifolds import se3
from boxplus.optimization.terms.variables import Variables
from boxplus.residuals import Prior, Reprojection, UserResidual

FRAMES, SEEN = 10, 19
BAR_MS = 3.0  # for 150 landmarks
MOTION = Euclidean(9)


def preintegrated(T_i, x_i, T_j, x_j, m):  # type: ignore[no-untyped-def]
    """Fifteen numbers of two frames, each of which depends on several of theirs."""
    r = np.empty(15)
    for k in range(6):
        r[k] = T_j[1 + k] - T_i[1 + k] - 0.1 * x_i[k] - m
    for k in range(9):
        r[6 + k] = x_j[k] - x_i[k] - 0.1 * T_i[4 + k % 3]
    return r


def window(landmarks: int, seed: int = 0) -> tuple[Problem, Variables, Variables, Variables]:
    """Problem, poses, velocities with biases, points."""
    rng = np.random.default_rng(seed)
    camera = Pinhole(450.0, 450.0, 320.0, 240.0)
    tangent = np.column_stack([0.05 * rng.standard_normal((FRAMES, 3)), 0.3 * rng.standard_normal((FRAMES, 3))])
    T = SE3Left.boxplus(SE3Left.identity(), tangent)
    p = rng.uniform([-2.0, -2.0, 4.0], [2.0, 2.0, 8.0], (landmarks, 3))
    # A stereo pair in every frame, one image missing.
    frame = np.concatenate([np.sort(rng.permutation(2 * FRAMES)[:SEEN]) // 2 for _ in range(landmarks)])
    point = np.repeat(np.arange(landmarks), SEEN)
    pixels, _ = camera.project(se3.act(T[frame], p[point]))
    problem = Problem()
    poses = problem.add_variables(SE3Left, T, name="poses")
    motions = problem.add_variables(MOTION, np.zeros((FRAMES, 9)), name="motions")
    points = problem.add_variables(Euclidean(3), p, name="points")
    seen = Reprojection(camera, pixels + rng.standard_normal(pixels.shape))
    problem.add_residuals(seen, poses[frame], points[point], loss=losses.Huber(1.5), name="pixels")
    link = UserResidual(preintegrated, dim=15, manifolds=(SE3Left, MOTION) * 2, data=(np.zeros(FRAMES - 1),), sigma=0.1)
    problem.add_residuals(link, poses[:-1], motions[:-1], poses[1:], motions[1:], name="links")
    problem.add_residuals(Prior(SE3Left, T[0], sigma=0.1), poses[0], name="beginning")
    problem.add_residuals(Prior(MOTION, np.zeros(9), sigma=0.1), motions[0], name="beginning of motion")
    return problem, poses, motions, points


def dense_rows(landmarks: int) -> NDArray[np.float64]:
    """[J r] of the leaving residuals with a column for every tangent of every landmark and frame."""
    problem, poses, motions, points = window(landmarks)
    values = [block.values for block in problem.blocks]
    first = {points.number: 0, poses.number: 3 * landmarks, motions.number: 3 * landmarks + 6 * FRAMES}
    end = 3 * landmarks + 15 * FRAMES
    parts = []
    for group in problem.groups:
        group.linearize(values, 1)
        rows = np.zeros((group.residual.count, group.residual.dim, end + 1))
        for c, J in zip(group.connections, group.jacobians, strict=True):
            at = first[c.block.number] + c.rows.astype(np.int64) * J.shape[2]
            for k in range(J.shape[2]):
                rows[np.arange(len(at)), :, at + k] = J[:, :, k]
        rows[:, :, -1] = group.r
        parts.append(rows[:1] if group.name == "links" else rows)
    return np.concatenate([part.reshape(-1, end + 1) for part in parts])


def measure(options: argparse.Namespace) -> list[Metric]:
    """The whole call for every number of landmarks, and its growth."""
    metrics, best = [], {}
    for count in options.landmarks:
        best[count] = np.inf
        for _ in range(options.rounds):
            problem, poses, motions, points = window(count)
            began = time.process_time()
            marginalize(problem, [poses[0], motions[0], points], at=None)
            best[count] = min(best[count], 1e3 * (time.process_time() - began))
        dense = None
        if count <= options.dense:
            rows = dense_rows(count)
            began = time.process_time()
            np.linalg.qr(rows, mode="r")
            dense = 1e3 * (time.process_time() - began)
        opponent = "" if dense is None else "dense QR"
        title = f"marginalize/{count} landmarks"
        gated = dense is not None
        metrics.append(Metric(title, best[count], "ms", opponent=opponent, opponent_value=dense, tolerance=1.0, gated=gated))
    if 150 in best:
        metrics.append(Metric("marginalize/bar of 150 landmarks", best[150], "ms", bar=BAR_MS, gated=False))
    few, many = min(best), max(best)
    if few < many:
        growth = best[many] / best[few] / (many / few)
        metrics.append(Metric(f"marginalize/time per landmark, {many} over {few}", growth, "ratio", bar=1.1, tolerance=0.5))
    return metrics


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--landmarks", type=int, nargs="+", default=[50, 100, 150, 200, 400, 1500])
    parser.add_argument("--dense", type=int, default=200, help="largest number of landmarks that the dense QR gets")
    parser.add_argument("--rounds", type=int, default=7)


if __name__ == "__main__":
    run_as_script(__doc__, measure, _arguments)
