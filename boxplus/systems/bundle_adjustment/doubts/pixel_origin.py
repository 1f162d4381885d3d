"""Are the pixels of a BAL file counted from a corner of the image? The format counts them from its middle, and has no other.

Where they lie on one side of it in both directions, that is asked; where cameras and points explain them far better once they are
moved to the middle of their range, it is answered: the scene is bent by the shift.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_exceeded
from boxplus.errors import BoxplusError
from boxplus.formats.reconstructions.bal import BalProblem
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.optimization.losses import Loss
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.systems.bundle_adjustment.cheirality import make_sound
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig
from boxplus.systems.bundle_adjustment.doubts.plausibility import typical_error
from boxplus.systems.bundle_adjustment.examination import Watch, examination_options
from boxplus.systems.bundle_adjustment.reconstruction_problem import add_reconstruction, pixel_errors, start_values

_SIDE = 0.97  # share of the pixels on one side of the principal point that asks where they are counted from
_FALLS = 0.6  # of the cost, that is left once they are moved, for an answer
_CHANCE = 1e-6  # of noise to lower the cost by as much
_RANGE = (0.025, 0.975)  # quantiles between which the pixels lie; a wild one does not move their middle
_GROSS = 5.5  # typical errors, beyond which is no noise
_SHIFTS = 2  # numbers that are moved by
_LEFT_OUT = 0.01  # share of the observations, without which a cost is none of the same images


@dataclass(frozen=True, slots=True)
class PixelOrigin:
    """What is to be said of where pixels are counted from; nothing where both are None.

    Attributes:
        note: a question. doubt: the answer, why the result is not to be trusted.
    """

    note: str | None = None
    doubt: str | None = None


def pixel_origin(
    start: Reconstruction,
    config: BundleAdjustmentConfig,
    loss: Loss | None,
    errors: NDArray[np.float64],
    solved: Solution,
    left: int,
    watch: Watch,
) -> PixelOrigin:
    """Whether pixels seem to be counted from a corner, and whether the images confirm it.

    Args:
        start: the input. errors: (k,) at the end [px]. solved: what bundle adjustment made of it.
        left: measurements less unknowns.
    """
    if not isinstance(start, BalProblem) or not all(
        max(share, 1.0 - share) > _SIDE for share in ((x > 0.0).mean() for x in start.pixels.T)
    ):
        return PixelOrigin()
    asked = PixelOrigin(
        "the pixels lie on one side of the principal point in both directions: are they counted from a corner of the image? "
        "BAL counts them from its middle"
    )
    middle = np.quantile(start.pixels, _RANGE, axis=0).mean(axis=0)
    # Those of wrong matches are as large from wherever pixels are counted.
    largest = _GROSS * typical_error(errors) / config.sigma_px
    before = _cost_up_to(largest, errors / config.sigma_px)
    costs = {}
    for flip, said in ((1.0, ""), (-1.0, " and with y upwards")):
        moved = replace(start, pixels=np.ascontiguousarray((start.pixels - middle) * [1.0, flip]))
        cost = _cost(moved, config, loss, solved, largest, watch)
        if cost is not None:
            costs[said] = cost
    if not costs or left <= 0:
        return asked
    chance = 0.5 * chi_square_exceeded(_CHANCE, _SHIFTS) / left
    (said, cost), *upwards = costs.items()  # which way y goes, cameras around a scene hardly tell
    for other, least in upwards:
        if cost - least > chance * least:
            said, cost = other, least
    if not (cost < _FALLS * before and before - cost > chance * cost):
        return asked
    return PixelOrigin(
        doubt="the pixels are counted from a corner of the image, which bends the scene: from the middle of their range, "
        f"({middle[0]:.4g}, {middle[1]:.4g}) px,{said} the cost is {cost:.6g} and not {before:.6g}; BAL counts them from "
        "the image's middle, x to the right and y upwards"
    )


def _cost(
    moved: BalProblem,
    config: BundleAdjustmentConfig,
    loss: Loss | None,
    solved: Solution,
    largest: float,
    watch: Watch,
) -> float | None:
    """What other pixels cost from the same start; None where they cannot be explained, or there is no time to try."""
    problem = Problem()
    try:
        sound = make_sound(moved)
        cameras, points = add_reconstruction(problem, moved, sound.used, config, loss)
        problem.fix(points[sound.cheirality.dropped])
        options = examination_options(problem, len(cameras), solved, config, watch)
        if options is None:
            return None
        start: list[NDArray[np.float64]] = [block.values for block in problem.blocks]
        start[cameras.number], start[points.number] = start_values(sound.reconstruction)
        used = np.count_nonzero(sound.used)
        solution = problem.solve(options, start=start, callback=watch.of("pixels from a corner?"))
    except BoxplusError:
        return None
    if watch.is_stopped or used < len(moved.pixels) * (1.0 - _LEFT_OUT):
        return None
    return _cost_up_to(largest, pixel_errors(problem, list(solution.values)) / config.sigma_px)


def _cost_up_to(largest: float, errors: NDArray[np.float64]) -> float:
    """½ Σ e² of errors in standard deviations, none counted as more than the largest."""
    return 0.5 * float((np.minimum(np.nan_to_num(errors, nan=np.inf), largest) ** 2).sum())
