"""Bundle adjustment of a scene with false matches, with and without a robust loss.

    python bundle_adjustment.py [FILE]

FILE is a BAL file (plain or .bz2) or the folder of a COLMAP model. Without it eight cameras go half around a cloud of points, and
every twentieth match is false.
"""

import sys

import numpy as np

from boxplus.formats.reconstructions.bal import BalProblem
from boxplus.formats.reconstructions.reconstruction import read_reconstruction
from boxplus.manifolds import so3
from boxplus.optimization.losses import Cauchy
from boxplus.systems.bundle_adjustment import adjust_bundle

rng = np.random.default_rng(0)
if len(sys.argv) == 2:
    start = read_reconstruction(sys.argv[1])
    false = np.zeros(len(start.pixels), dtype=bool)
else:
    p_world = rng.uniform(-2.0, 2.0, (300, 3))
    zero = np.zeros(8)
    vectors = np.stack([zero, np.linspace(-1.2, 1.2, 8), zero], axis=1)  # rotation vectors of R_camera_world
    camera_of, point_of = (grid.ravel() for grid in np.mgrid[:8, :300])
    p_camera = np.einsum("nij,nj->ni", so3.exp(vectors)[camera_of], p_world[point_of]) - np.array([0.0, 0.0, 9.0])
    pixels = -500.0 * p_camera[:, :2] / p_camera[:, 2:] + rng.normal(0.0, 0.5, (len(p_camera), 2))
    false = np.arange(len(pixels)) % 20 == 0
    pixels[false] += rng.normal(0.0, 60.0, (false.sum(), 2))
    cameras = np.column_stack([vectors, zero, zero, zero - 9.0, zero + 500.0, zero, zero])  # BAL: f, k1, k2 at the end
    cameras[:, :6] += rng.normal(0.0, 0.02, (8, 6))
    start = BalProblem(cameras, p_world + rng.normal(0.0, 0.05, p_world.shape), camera_of, point_of, pixels)

for name, loss in (("least squares", None), ("Cauchy loss", Cauchy(1.0))):
    result = adjust_bundle(start, loss=loss)
    before, after = np.nanmedian(result.errors_start[~false]), np.nanmedian(result.errors[~false])
    print(f"{name:14} true matches: median {before:.2f} px before, {after:.2f} px after; {result.solution.iterations} steps")
    print(f"{'':14} {result.solution.status}: {result.solution.reason}")
print(result.solution.linear_solver)
