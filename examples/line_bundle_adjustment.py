"""Bundle adjustment on straight lines: cameras and 3D lines from nothing but line segments in images.

    python line_bundle_adjustment.py [FOLDER]

FOLDER is a set of the Oxford multi-view line data (Corridor, Model-House, Merton-College-I). Without it the edges of random
triangles are seen by eight cameras with 0.3 px of noise. Cameras and lines are perturbed and then estimated anew.
"""

import sys

import numpy as np

import boxplus as bp
from boxplus.formats.vgg_lines import read_vgg_lines
from boxplus.manifolds import lines, quaternion

rng = np.random.default_rng(0)
if len(sys.argv) == 2:
    data = read_vgg_lines(sys.argv[1])
    K, T_camera_world, segments = data.K[data.view_of], data.T_camera_world, data.segments
    start, end = data.end_points_world[:, :3], data.end_points_world[:, 3:]
    view_of, line_of = data.view_of, data.line_of
else:
    corners = rng.uniform(-3.0, 3.0, (6, 3, 3))
    start, end = corners.reshape(-1, 3), corners[:, [1, 2, 0]].reshape(-1, 3)
    half = np.linspace(-1.2, 1.2, 8) / 2.0  # half the angle by which a camera has gone round the scene, 12 m away
    zero = np.zeros(8)
    T_camera_world = np.column_stack([np.cos(half), zero, np.sin(half), zero, zero, zero, zero + 12.0])
    view_of, line_of = (grid.ravel() for grid in np.mgrid[:8, : len(start)])
    R, t = quaternion.to_matrix(T_camera_world[view_of, :4]), T_camera_world[view_of, 4:]
    K = bp.Pinhole(600.0, 600.0, 320.0, 240.0)
    pixels = [K.project(np.einsum("nij,nj->ni", R, p[line_of]) + t)[0] for p in (start, end)]
    segments = np.hstack(pixels) + rng.normal(0.0, 0.3, (len(line_of), 4))

depth = np.median(np.linalg.norm(start, axis=1))
off = rng.normal(0.0, 0.005, (len(T_camera_world), 6)) * [1.0, 1.0, 1.0, depth, depth, depth]
cameras_start = bp.SE3Left.boxplus(T_camera_world, off)
lines_start = bp.Line3D.boxplus(lines.from_points(start, end), rng.normal(0.0, 0.01, (len(start), 4)))

problem = bp.Problem()
cameras = problem.add_variables(bp.SE3Left, cameras_start, name="cameras")
world = problem.add_variables(bp.Line3D, lines_start, name="lines")
distances = bp.residuals.LineReprojection(K, segments)
problem.add_residuals(distances, cameras[view_of], world[line_of])
problem.fix(cameras[0])  # where the world is; its scale stays free, and the damping of the steps holds it
solution = problem.solve(max_iterations=1000)

for when, T, L in (("before", cameras_start, lines_start), ("after", solution[cameras], solution[world])):
    r = distances.evaluate(T[view_of], L[line_of])
    print(f"{when:6}: end points are {np.median(np.sqrt((r**2).mean(axis=1))):.3f} px from their lines (median)")
unknown = 6 * (len(cameras_start) - 1) + 4 * len(lines_start) - 1
print(f"noise estimated from {2 * len(segments)} distances: {np.sqrt(2 * solution.cost / (2 * len(segments) - unknown)):.2f} px")
print(f"{solution.status} after {solution.iterations} iterations; {solution.linear_solver}")
