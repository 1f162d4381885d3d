"""A robot's path that is known at every step: poses are added as they come, and a loop closure corrects all that came before.

    python incremental_slam.py

The robot drives five times around a square of 10 m. Its odometry drifts; from the second round on it recognises every place.
"""

import numpy as np

import boxplus as bp
from boxplus.manifolds import se2

rng = np.random.default_rng(0)
sigma = np.array([0.01, 0.03, 0.03])  # of theta, x, y


def measure(a, b):
    """Pose of b in a, with noise."""
    return bp.SE2.boxplus(se2.compose(se2.inverse(a), b), sigma * rng.standard_normal(3))


problem = bp.IncrementalProblem()
truth = [np.zeros(3)]
poses = problem.add_variables(bp.SE2, truth[0], fixed=True, name="poses")  # the world is where the robot starts
for k in range(1, 200):
    turn = np.pi / 2 if k % 10 == 0 else 0.0
    truth.append(se2.compose(truth[-1], np.array([turn, 1.0, 0.0])))
    step = measure(truth[k - 1], truth[k])
    new = problem.extend(poses, se2.compose(problem.estimate(poses[k - 1])[0], step))
    problem.add_residuals(bp.residuals.RelativePose2D(step, sigma=sigma), poses[k - 1], new)
    if k >= 40:
        seen = measure(truth[k - 40], truth[k])
        problem.add_residuals(bp.residuals.RelativePose2D(seen, sigma=sigma), poses[k - 40], new)
    update = problem.update()
    if k in (39, 40, 120, 199):
        off = np.linalg.norm(problem.estimate(new)[0, 1:] - truth[k][1:])
        std = np.sqrt(np.trace(problem.covariance(new)[0, 1:, 1:]))
        print(f"pose {k}: off by {off:.2f} m, standard deviation {std:.2f} m; {update.eliminated} poses eliminated")

best = problem.as_problem().solve()
print(f"cost {problem.solution().cost:.3f}, of the whole problem solved anew {best.cost:.3f}")
