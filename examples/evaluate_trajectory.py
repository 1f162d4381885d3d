"""How good is a trajectory: association, alignment, absolute and relative error.

    python evaluate_trajectory.py [ESTIMATE GROUND_TRUTH]

Files may be TUM, KITTI, EuRoC or boxplus CSV. Without arguments two trajectories are made up: a circle, and the same circle in
another frame with 1 cm of noise.
"""

import sys

import numpy as np

from boxplus import Trajectory, evaluate, read_trajectory

if len(sys.argv) == 3:
    estimate, ground_truth = read_trajectory(sys.argv[1]), read_trajectory(sys.argv[2])
else:
    seconds = np.arange(0.0, 60.0, 0.1)
    angle = 0.1 * seconds
    zero = np.zeros_like(angle)
    p = 5.0 * np.column_stack([np.cos(angle), np.sin(angle), 0.1 * np.sin(5.0 * angle)])
    q_wxyz = np.column_stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)])
    time_ns = np.round(seconds * 1e9).astype(np.int64)
    ground_truth = Trajectory(time_ns, p, q_wxyz, source="circle")
    noise = np.random.default_rng(0).normal(0.0, 0.01, p.shape)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # 90 degrees about z, and a shift
    q_turned = np.column_stack([np.cos(angle / 2 + np.pi / 4), zero, zero, np.sin(angle / 2 + np.pi / 4)])
    estimate = Trajectory(time_ns, (p + noise) @ turn.T + [3.0, -1.0, 2.0], q_turned, source="noisy circle")

result = evaluate(estimate, ground_truth, alignment="se3")
print(result.summary())
print(f"ATE rmse: {100.0 * result.ate.rmse:.2f} cm over {len(result.association)} poses")
