"""IkdTree in place of scipy's cKDTree: the same nearest neighbours, in a set of points that changes all the time."""

import numpy as np
from scipy.spatial import cKDTree

from boxplus import IkdTree

rng = np.random.default_rng(0)
points = rng.uniform(-20.0, 20.0, (20_000, 3)).astype(np.float32).astype(np.float64)
queries = rng.uniform(-20.0, 20.0, (1_000, 3)).astype(np.float32).astype(np.float64)

# The same question as to cKDTree(points).query(queries, k=5, distance_upper_bound=2.0).
tree = IkdTree(points)
found = tree.nearest(queries, k=5, max_distance=2.0)
expected, _ = cKDTree(points).query(queries, k=5, distance_upper_bound=2.0)
near = np.isfinite(expected)  # both give infinity where there are fewer than five
assert (near == np.isfinite(found.distances)).all()
largest = np.abs(found.distances[near] - expected[near]).max()
print(f"five neighbours within 2 m: largest difference from scipy {largest:.1e} m (coordinates are kept in float32)")

# What cKDTree cannot do: grow, shrink and forget a region without being built anew.
tree.insert(rng.uniform(20.0, 30.0, (5_000, 3)))
print("after insert:", len(tree))
removed = tree.delete_box([-5.0, -5.0, -5.0], [5.0, 5.0, 5.0])
print(f"after delete_box: {len(tree)} ({removed} removed)")
revived = tree.reinsert_box([-5.0, -5.0, -5.0], [5.0, 5.0, 0.0])
print(f"after reinsert_box of the lower half: {len(tree)} ({revived} revived)")
print("within 2 m of the origin:", len(tree.radius_search([0.0, 0.0, 0.0], 2.0)))

# A map that keeps one point per cell of 0.5 m, the first one that came.
sparse = IkdTree(cell_size=0.5)
for batch in np.array_split(points, 20):
    report = sparse.insert(batch, downsample=True)
print(f"one point per 0.5 m cell: {len(sparse)} of {len(points)}; last batch: {report}")
