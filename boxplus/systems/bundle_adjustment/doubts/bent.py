"""Is a scene bent by wrong matches, which least squares spreads over all that is around them?

Few gross errors may move everything by many times its own standard deviations. What tells is the typical error: it falls once
their pull is limited, where it does not if they are a matter of their own points.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import BoxplusError
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.optimization.losses import Huber
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig
from boxplus.systems.bundle_adjustment.examination import Watch, examination_options
from boxplus.systems.bundle_adjustment.reconstruction_problem import add_reconstruction, pixel_errors

_HUBER = 1.345  # of the typical error: 95 % of the efficiency of least squares
_RAYLEIGH = 1.1774  # median of a distance in two dimensions, in standard deviations
_BENT = 0.7  # of the typical error: what bends adds as much to it as the noise


def bent_doubt(
    adjusted: Reconstruction,
    used: NDArray[np.bool_],
    dropped: NDArray[np.int64],
    config: BundleAdjustmentConfig,
    errors: NDArray[np.float64],
    solved: Solution,
    watch: Watch,
) -> str | None:
    """A sentence where the typical error falls as soon as gross errors pull less; to be asked where there are such.

    Args:
        adjusted: where least squares ended, as `solved` tells; at a minimum, or after the steps that were allowed.
        used: (k,) observations that were adjusted. dropped: points that were not.
        errors: (k,) at the end [px]; NaN where there is none.
    """
    before = float(np.nanmedian(errors))
    if not before > 0.0:
        return None
    problem = Problem()
    loss = Huber(_HUBER * before / _RAYLEIGH / config.sigma_px)
    cameras, points = add_reconstruction(problem, adjusted, used, config, loss)
    problem.fix(points[dropped])
    options = examination_options(problem, len(cameras), solved, config, watch)
    if options is None:
        return None
    try:
        solution = problem.solve(options, callback=watch.of("bent by wrong matches?"))
    except BoxplusError:
        return None
    if watch.is_stopped:
        return None
    after = float(np.nanmedian(pixel_errors(problem, list(solution.values))))
    if not after < _BENT * before:
        return None
    return (
        f"few gross errors bend all the rest: half of the errors are above {before:.3g} px, and above {after:.3g} px where such "
        "are limited in their pull: wrong matches, or a wrong start; use a robust loss (--loss huber)"
    )
