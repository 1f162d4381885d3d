"""A trajectory from odometry, satellite positions and loop closures, some of them wrong; with covariances.

    python least_squares_problem.py

A vehicle drives eight times round a circle. Odometry drifts; every twentieth pose has a position good to 1 m and no attitude;
loops are closed from lap to lap, and every fifth closure is wrong.
"""

import numpy as np

import boxplus as bp
from boxplus.manifolds import se3

rng = np.random.default_rng(0)
count, lap = 800, 100
half = np.pi * np.arange(count) / lap  # half the heading; the circle has a radius of 20 m
zero = np.zeros(count)
position = [20.0 * np.sin(2.0 * half), 20.0 * (1.0 - np.cos(2.0 * half)), 0.02 * np.arange(count)]
true = bp.SE3.check("true", np.column_stack([np.cos(half), zero, zero, np.sin(half), *position]))


def measure(i, j, sigma):
    """Relative poses `T_i⁻¹ T_j` with noise."""
    return bp.SE3.boxplus(se3.compose(se3.inverse(true[i]), true[j]), sigma * rng.normal(size=(len(i), 6)))


steps = np.arange(count - 1)
sigma_odometry, sigma_loop = np.repeat([0.005, 0.05], 3), np.repeat([0.01, 0.1], 3)  # rotation [rad], translation [m]
odometry = measure(steps, steps + 1, sigma_odometry)
start = true.copy()
for k in steps:
    start[k + 1] = se3.compose(start[k], odometry[k])

first = rng.integers(0, count - lap, 60)
second = first + lap
closures = measure(first, second, sigma_loop)
closures[::5] = bp.SE3.random(rng, 12)

located = np.arange(0, count, 20)
satellites = true[located] + np.hstack([np.zeros((40, 4)), rng.normal(size=(40, 3))])
# A prior in which positions are the world's, and which knows nothing of the rotation.
located_by = bp.residuals.Prior(bp.BodyPose, satellites, information=np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]))

problem = bp.Problem()
poses = problem.add_variables(bp.SE3, start, name="poses")
problem.add_residuals(bp.residuals.RelativePose(odometry, sigma=sigma_odometry), poses[:-1], poses[1:], name="odometry")
problem.add_residuals(located_by, poses[located], carry_over=True)  # onto SE3
edges = bp.residuals.RelativePose(closures, sigma=sigma_loop)
problem.add_residuals(edges, poses[first], poses[second], loss=bp.losses.GemanMcClure(6.0), name="loops")

solution = problem.solve()
print(solution.summary())
for name, estimate in (("odometry alone", start), ("all", solution[poses])):
    print(f"{name}: {np.sqrt(((estimate - true)[:, 4:] ** 2).sum(axis=1).mean()):.2f} m (rms)")
whitened = edges.evaluate(solution[poses[first]], solution[poses[second]]) / sigma_loop
far = np.flatnonzero(np.linalg.norm(whitened, axis=1) > 6.0)
print(f"loops beyond 6 standard deviations, every fifth is wrong: {far.tolist()}")
std = solution.standard_deviations(poses[[0, 410, 799]])[:, 3:]
print(f"standard deviations of poses 0, 410 and 799 [m]:\n{std.round(2)}")
