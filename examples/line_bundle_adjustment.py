"""Bundle adjustment on straight lines: cameras and 3D lines from nothing but line segments in images.

    python line_bundle_adjustment.py [FOLDER]

FOLDER is a set of the Oxford multi-view line data (Corridor, Model-House, Merton-College-I). Without it the edges of random
triangles are seen by eight cameras with 0.3 px of noise. The cameras are perturbed, the lines are found from the segments alone,
and everything is adjusted. `boxplus ba FOLDER` does the same with a report.
"""

import sys
from dataclasses import replace

import numpy as np

import boxplus as bp
from boxplus.formats.reconstructions.vgg_lines import VggLines, read_vgg_lines
from boxplus.manifolds import quaternion
from boxplus.systems.bundle_adjustment import LineAdjustmentConfig, adjust_lines

rng = np.random.default_rng(0)
if len(sys.argv) == 2:
    data = read_vgg_lines(sys.argv[1])
else:
    corners = rng.uniform(-3.0, 3.0, (6, 3, 3))
    ends = np.hstack([corners.reshape(-1, 3), corners[:, [1, 2, 0]].reshape(-1, 3)])
    half = np.linspace(-1.2, 1.2, 8) / 2.0  # half the angle by which a camera has gone round the scene, 12 m away
    zero = np.zeros(8)
    T_camera_world = np.column_stack([np.cos(half), zero, np.sin(half), zero, zero, zero, zero + 12.0])
    view_of, line_of = (grid.ravel() for grid in np.mgrid[:8, : len(ends)])
    R, t = quaternion.to_matrix(T_camera_world[view_of, :4]), T_camera_world[view_of, 4:]
    camera = bp.Pinhole(600.0, 600.0, 320.0, 240.0)
    pixels = [camera.project(np.einsum("nij,nj->ni", R, p[line_of]) + t)[0] for p in (ends[:, :3], ends[:, 3:])]
    K = np.tile([[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]], (8, 1, 1))
    segments = np.hstack(pixels) + rng.normal(0.0, 0.3, (len(line_of), 4))
    names = tuple(map(str, range(8)))
    data = VggLines(names, K, T_camera_world, ends, view_of.astype(np.uint32), line_of.astype(np.uint32), segments)

depth = np.median(np.linalg.norm(data.end_points_world[:, :3], axis=1))
off = rng.normal(0.0, 0.0005, (len(data.names), 6)) * [1.0, 1.0, 1.0, depth, depth, depth]
start = replace(data, T_camera_world=bp.SE3Left.boxplus(data.T_camera_world, off))
result = adjust_lines(start, LineAdjustmentConfig(triangulate=True, use_points=False))

found = result.triangulation.found
print(f"{found.sum()} of {len(found)} lines found from {len(data.segments)} segments")
for note in result.notes:
    print(note)
for when, errors in (("before", result.errors_start), ("after", result.errors)):
    print(f"{when:6}: end points are {np.nanmedian(errors):.3f} px from their lines (median)")
used = int(np.isfinite(result.errors).sum())
unknown = 6 * (len(data.names) - 1) + 4 * int(found.sum()) - 1
noise = np.sqrt(2.0 * np.nansum(result.errors**2) / (2 * used - unknown))
print(f"noise estimated from {2 * used} distances: {noise:.2f} px")
print(f"{result.solution.status} after {result.solution.iterations} iterations; {result.solution.linear_solver}")
