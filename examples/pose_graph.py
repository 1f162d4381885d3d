"""A pose graph: where a robot went, from odometry and loop closures, one of which is false.

    python pose_graph.py [FILE]

FILE is a g2o or TORO file. Without it the robot drives five times around a square of 10 m, with an edge to the same place
one round before at every metre.
"""

import sys

import numpy as np

import boxplus as bp
from boxplus.formats.graphs.pose_graph_file import read_pose_graph
from boxplus.manifolds import se2
from boxplus.optimization.losses import GemanMcClure

rng = np.random.default_rng(0)
truth = None
if len(sys.argv) == 2:
    graph = read_pose_graph(sys.argv[1])
else:
    truth = [np.zeros(3)]  # theta, x, y
    for k in range(1, 200):
        turn = np.pi / 2 if k % 10 == 0 else 0.0
        truth.append(se2.compose(truth[-1], np.array([turn, 1.0, 0.0])))
    truth = np.array(truth)
    i = np.concatenate([np.arange(199), np.arange(160)])
    j = np.concatenate([np.arange(1, 200), np.arange(40, 200)])
    sigma = np.array([0.01, 0.03, 0.03])  # of theta, x, y
    measured = bp.SE2.boxplus(se2.compose(se2.inverse(truth[i]), truth[j]), sigma * rng.standard_normal((len(i), 3)))
    measured[250] = [1.0, 4.0, -3.0]
    information = np.tile(np.diag(1.0 / sigma**2), (len(i), 1, 1))
    graph = bp.PoseGraph(2, np.arange(200), None, np.stack([i, j], axis=1), measured, information, np.array([0]))

for name, loss in (("least squares", None), ("Geman-McClure", GemanMcClure(3.0))):
    result = bp.optimize_pose_graph(graph, loss=loss)
    print(f"{name}: χ² {result.chi2_start:.1f} → {result.chi2:.1f}; start: {result.start_reason}")
    worst = int(np.argmax(result.errors))
    print(f"  largest error: edge {worst}, {result.errors[worst]:.1f} σ; median {np.median(result.errors):.2f} σ")
    if truth is not None:
        off = np.linalg.norm(bp.SE2.boxminus(result.graph.poses, truth)[:, 1:], axis=1)
        print(f"  off the truth by {100 * np.sqrt((off**2).mean()):.1f} cm (rms)")
