"""Whether intrinsics that are held are those of the images: what freeing them for a few steps would gain.

A wrong focal length bends a scene and its cameras by as much as it is wrong, and leaves errors that look like those of noise.
Where the images tell it, they tell it at once: the cost falls by far more than chance when the focal lengths may move.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import BoxplusError
from boxplus.formats.reconstructions.colmap_model import ColmapModel
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.optimization.losses import Loss
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig
from boxplus.systems.bundle_adjustment.reconstruction_problem import add_reconstruction, adjusted_reconstruction

_STEPS, _LEAST_S = 5, 1.0
_CHANCE = 15.0  # of the cost of a number that explains noise, by which chance does not lower it
_CHANGED = 0.01  # of the focal length; less is what calibrations differ by


def lens_notes(
    adjusted: Reconstruction,
    used: NDArray[np.bool_],
    dropped: NDArray[np.int64],
    config: BundleAdjustmentConfig,
    loss: Loss | None,
    solved: Solution,
    left: int,
) -> list[str]:
    """A sentence where other focal lengths than those that were held explain the images clearly better.

    Args:
        adjusted: where bundle adjustment ended, as `solved` tells; only a minimum is examined.
        used: (k,) observations that were adjusted. dropped: points that were not.
        left: measurements less unknowns.
    """
    cost, time_s = solved.cost, solved.history[-1].time_s
    if not isinstance(adjusted, ColmapModel) or config.intrinsics != "held" or left <= 0 or not cost > 0.0:
        return []
    # Who stopped the adjustment does not wait for more of it, and an examination takes no longer than what is examined.
    limit_s = max(time_s, _LEAST_S) if config.solver.time_limit_s is None else config.solver.time_limit_s - time_s
    if solved.status != "converged" or not limit_s > 0.0:
        return []
    free = config.model_copy(update={"intrinsics": "refined"})
    problem = Problem()
    cameras, points = add_reconstruction(problem, adjusted, used, free, loss)
    problem.fix(points[dropped])
    try:
        solution = problem.solve(config.solver.model_copy(update={"max_iterations": _STEPS, "time_limit_s": limit_s}))
    except BoxplusError:
        return []
    # As in an F-test; the noise as the errors have it, not as sigma says.
    numbers = sum(block.values.size for block in problem.blocks if block is not cameras and block is not points)
    if not cost - solution.cost > _CHANCE * max(numbers, 1) * solution.cost / left:
        return []
    none = np.zeros(0)
    other = adjusted_reconstruction(adjusted, free, problem, solution, cameras, points, none, np.zeros(0, dtype=np.int64))
    after_params = other.camera_params if isinstance(other, ColmapModel) else ()
    changes = []
    for name, before, after in zip(adjusted.camera_ids, adjusted.camera_params, after_params, strict=True):
        if abs(after[0] / before[0] - 1.0) > _CHANGED:
            changes.append(f"{after[0]:.5g} px instead of {before[0]:.5g} px for camera {name}")
    if not changes:
        return []
    told = ", ".join(changes[:5]) + (" …" if len(changes) > 5 else "")
    return [
        f"other intrinsics than those held explain the images better, with a focal length of {told}: the cost falls from "
        f"{cost:.6g} to {solution.cost:.6g} and below; the scene is bent by what they are wrong (--refine-intrinsics)"
    ]
