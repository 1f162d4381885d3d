"""Whether intrinsics that are held are those of the images: what freeing them would gain.

All of them are held, or, where intrinsics are refined, the principal point and what the camera model does not have.

A wrong lens bends a scene and its cameras by as much as it is wrong, and leaves errors that look like those of noise. Where the
images tell it, they tell it at once: the cost falls by more than chance when the intrinsics may move. One step shows whether it
does; only where it does others follow, to where it falls.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import BoxplusError
from boxplus.formats.reconstructions.bal import BalProblem
from boxplus.formats.reconstructions.between_formats import colmap_of
from boxplus.formats.reconstructions.colmap_model import ColmapModel
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.optimization.losses import Huber, Loss
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Iteration, Solution
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig
from boxplus.systems.bundle_adjustment.doubts.lens_advice import NAMES, PARTS, free_already, lens_advice
from boxplus.systems.bundle_adjustment.examination import Watch, examination_options
from boxplus.systems.bundle_adjustment.reconstruction_problem import add_reconstruction, adjusted_reconstruction
from boxplus.systems.bundle_adjustment.sightings import Sightings, colmap_layout, colmap_pinhole

_CHANCE = 1e-4  # of noise to lower the cost by as much
_MANY, _MOST_F = 100, 20.0  # measurements, of which the quantile of F at that chance stays below (16.5 for a single number)
_HINT = 0.3  # of the fall of the cost that counts, which the first step that is taken has to show
_CHANGED = 0.01  # of the pixels' distance from the principal point, by which they move; less is what calibrations differ by
_MORE_STEPS = 0.2  # of the cost, which no further steps gain after as many as were allowed
_BENT, _FALLS = 0.03, 0.6  # the same, and what is left of the cost, for a scene that is bent by more than the noise of its points
_ROUGH_PX, _OF_START, _STEPS = 2.0, 0.5, 10  # [px] median error of a start; share of it that another lens leaves; steps
# Of what is left, by which the cost of a BAL file has to fall, within two steps; real lenses gain a quarter to a third.
_HALF = 1.0
_RADIAL = frozenset({"k1", "k2"})
_FEW = tuple(  # of all parts, asked whether they say as much as more of them
    frozenset(parts)
    for parts in (
        ("f",),
        ("k1",),
        ("f", "k1"),
        ("f", "cx, cy"),
        ("f", "k1", "k2"),
        ("f", "cx, cy", "k1"),
        ("f", "cx, cy", "k1", "k2"),
    )
)


@dataclass(frozen=True, slots=True)
class LensFinding:
    """Another lens than the one that was held.

    Attributes:
        sentence: which.
        is_grave: whether it moves its pixels so far that the scene is bent beyond what its standard deviations claim.
    """

    sentence: str
    is_grave: bool


def lens_finding(
    adjusted: Reconstruction,
    used: NDArray[np.bool_],
    dropped: NDArray[np.int64],
    config: BundleAdjustmentConfig,
    loss: Loss | None,
    solved: Solution,
    left: int,
    watch: Watch,
) -> LensFinding | None:
    """Whether another lens than the one that was held explains the images clearly better.

    BAL's lenses are never held, but have no principal point and square pixels: where others halve the cost, that is told.

    Args:
        adjusted: where bundle adjustment ended, as `solved` tells; at a minimum, or after the steps that were allowed.
        used: (k,) observations that were adjusted. dropped: points that were not.
        left: measurements less unknowns.
    """
    cost = solved.cost
    if left <= 0 or not cost > 0.0 or not (solved.status == "converged" or solved.limit == "steps"):
        return None
    given = adjusted
    free, count = free_already(adjusted, used, config)
    used, adjusted = _with_any_lens(adjusted, used)
    ask = partial(_freed, adjusted, used, dropped, config, loss, solved, left, count, watch)
    if isinstance(given, BalProblem):
        if solved.status != "converged":  # steps that were not taken may halve the cost as well
            return None
        return _finding_of_bal(adjusted, ask(free | {"cx, cy"}, least=_HALF, looks=2, hint=1.0), cost)
    # Distortion alone first: few images tell it well, and focal lengths and principal point, beside which it gets lost, hardly.
    wanted = (free | _RADIAL, frozenset(PARTS))
    found = min(filter(None, map(ask, wanted)), key=lambda freed: freed.cost, default=None)
    if found is None:
        return None
    for parts in _FEW:
        fewer = ask(parts) if free <= parts < found.parts else None
        if fewer is not None and fewer.cost <= found.cost * (
            1.0 + _by_chance(found.numbers - fewer.numbers, left - found.numbers)
        ):
            found = fewer
            break
    changes, most = _changes(adjusted, found.lenses)
    if not changes:
        return None
    told = "; ".join(changes[:5]) + (" …" if len(changes) > 5 else "")
    return LensFinding(
        f"other intrinsics than those held explain the images better: {told}; the cost falls from {cost:.6g} to "
        f"{found.cost:.6g} and below, and the scene is bent by what they are wrong "
        f"({lens_advice(given, found.parts, adjusted, found.lenses)})",
        most > _BENT and found.cost < _FALLS * cost,
    )


def _finding_of_bal(adjusted: ColmapModel, found: _Freed | None, cost: float) -> LensFinding | None:
    """The format has no principal point and square pixels: nothing to be done about it but in the pixels."""
    if found is None or not _changes(adjusted, found.lenses)[1] > _CHANGED:
        return None
    old, new = (np.array(model.camera_params) for model in (adjusted, found.lenses))
    x, y = np.median(new[:, 2:4] - old[:, 2:4], axis=0) * [1.0, -1.0]
    stretch = float(np.median(new[:, 1] / new[:, 0]))
    return LensFinding(
        f"another lens than the format has explains the images better: with the principal point at ({x:.3g}, {y:.3g}) px and y "
        f"stretched {stretch:.3g} times, in the median of the cameras, the cost falls from {cost:.6g} to {found.cost:.6g} and "
        "below, and the scene is bent by that; BAL counts pixels from the principal point, x to the right and y upwards, and "
        "they are square: correct the pixels",
        True,
    )


@dataclass(frozen=True, slots=True)
class _Freed:
    """Lenses that explain the images better than chance, and the cost with them: `parts` moved, by `numbers` more than before."""

    lenses: ColmapModel
    cost: float
    parts: frozenset[str]
    numbers: int


def _by_chance(numbers: int, left: int, least: float = 0.0) -> float:
    """Share by which noise lowers a cost where `numbers` more may move and `left` measurements are left over then: an F-test.

    The noise is that of the errors, not what sigma says. Of few measurements these know it badly, which counts.

    Args:
        least: what matters of it; a share that is surely below need not be known.
    """
    if left >= _MANY and numbers / left * _MOST_F < least:
        return 0.0
    from scipy.special import fdtri  # here, as most runs never ask, and it takes longer to import than they to adjust

    return numbers / left * float(fdtri(numbers, left, 1.0 - _CHANCE))


def _freed(
    adjusted: ColmapModel,
    used: NDArray[np.bool_],
    dropped: NDArray[np.int64],
    config: BundleAdjustmentConfig,
    loss: Loss | None,
    solved: Solution,
    left: int,
    count: int,
    watch: Watch,
    parts: frozenset[str],
    *,
    least: float = 0.0,
    looks: int = 1,
    hint: float = _HINT,
) -> _Freed | None:
    """What comes of it where these parts of every lens may move; None where that is no better than chance, or was stopped.

    Args:
        count: numbers of the lenses that moved already.
        least: by how much the cost has to fall at least, as a share of what is left of it.
        looks: steps that are taken before it is asked whether it does. hint: share of that fall that it has to show then.
    """
    held = tuple(place for part, places in PARTS.items() if part not in parts for place in places)
    cost = solved.cost
    free = config.model_copy(update={"intrinsics": "refined", "principal_point": "refined"})
    problem = Problem()
    cameras, points = add_reconstruction(problem, adjusted, used, free, loss)
    problem.fix(points[dropped])
    lenses = [block for block in problem.blocks if block is not cameras and block is not points]
    if held:
        for block in lenses:
            problem.fix(block, components=held)
    options = examination_options(problem, len(cameras), solved, config, watch)
    if options is None:
        return None
    numbers = sum(block.values.size - len(block) * len(held) for block in lenses) - count
    if not 0 < numbers < left:
        return None
    share = _by_chance(numbers, left - numbers, least)
    if solved.limit == "steps":  # more steps would lower the cost without another lens, too
        share = max(share, _MORE_STEPS)
    share = max(share, least)

    shown, taken = watch.of("another lens?"), 0

    def is_settled(step: Iteration) -> bool:
        nonlocal taken
        if shown(step):
            return True
        taken += step.number > 0 and step.accepted
        return taken >= looks and step.accepted and not cost - step.cost > hint * share * step.cost

    try:
        solution = problem.solve(options, callback=is_settled)
    except BoxplusError:
        return None
    if watch.is_stopped or not cost - solution.cost > share * solution.cost:
        return None
    none = np.zeros(0)
    other = adjusted_reconstruction(adjusted, free, problem, solution, cameras, points, none, np.zeros(0, dtype=np.int64))
    return _Freed(other, solution.cost, parts, numbers) if isinstance(other, ColmapModel) else None


def lens_of_start(
    start: Reconstruction, used: NDArray[np.bool_], config: BundleAdjustmentConfig, solved: Solution, watch: Watch
) -> str | None:
    """A sentence where the cameras and points of the start were made with another lens than the one that is held.

    Few images hardly tell a lens: that one of two views is wrong shows in nothing that comes out.

    Args:
        used: (k,) observations that are adjusted.
        solved: where bundle adjustment ended: who stopped it does not wait for this.
    """
    if isinstance(start, BalProblem) or config.intrinsics != "held":
        return None
    used, start = _with_any_lens(start, used)
    free = config.model_copy(update={"intrinsics": "refined", "principal_point": "refined"})
    seen, rows = Sightings.of(start), np.flatnonzero(used)
    off = _median_error(seen, rows)
    if not off > _ROUGH_PX:
        return None
    problem = Problem()
    cameras, points = add_reconstruction(problem, start, used, free, Huber(off / config.sigma_px))
    problem.fix(cameras)
    problem.fix(points)
    options = examination_options(problem, len(cameras), solved, config, watch)
    if options is None:
        return None
    options = options.model_copy(update={"max_iterations": _STEPS})  # few, of the lens alone
    none = np.zeros(0)
    try:
        solution = problem.solve(options, callback=watch.of("the lens of the start?"))
        other = adjusted_reconstruction(start, free, problem, solution, cameras, points, none, np.zeros(0, dtype=np.int64))
        left = _median_error(Sightings.of(other), rows)
    except BoxplusError:  # a start that no lens explains
        return None
    if watch.is_stopped or not isinstance(other, ColmapModel) or not left < _OF_START * off:
        return None
    changes, most = _changes(start, other)
    if not most > _BENT:
        return None
    told = "; ".join(changes[:5]) + (" …" if len(changes) > 5 else "")
    return (
        f"cameras and points of the input were made with another lens than the one that is held: {told}; half of the points lie "
        f"within {left:.3g} px of where they were seen by that, and within {off:.3g} px as it is: is the lens wrong?"
    )


def _median_error(seen: Sightings, rows: NDArray[np.intp]) -> float:
    """Of the points before their cameras [px]; NaN where there are none."""
    errors = seen.errors(rows, seen.points[seen.point_of[rows]])
    errors = errors[~np.isnan(errors)]
    return float(np.median(errors)) if len(errors) else np.nan


def _with_any_lens(held: Reconstruction, used: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], ColmapModel]:
    """The same with cameras that may have any distortion, whatever their models have, and `used` (k,) in its order."""
    if not isinstance(held, ColmapModel):
        used, held = used[np.argsort(held.camera_of, kind="stable")], colmap_of(held)
    params = [colmap_layout(held, number) @ held.camera_params[number] for number in range(len(held.camera_ids))]
    wide = tuple(np.pad(known, (0, len(NAMES) - len(known))) for known in params)
    return used, replace(held, camera_models=("OPENCV",) * len(params), camera_params=wide)


def _changes(before: ColmapModel, after: ColmapModel) -> tuple[list[str], float]:
    """What became of each lens that moves its pixels by more than calibrations differ, and the largest such share."""
    seen = Sightings.of(after)
    rays, found = seen.bearings(np.arange(len(seen.pixels)))
    lens_of = seen.lens_of[seen.camera_of]
    changes, most = [], 0.0
    for number, name in enumerate(before.camera_ids):
        own = np.flatnonzero((lens_of == number) & found)
        if not len(own):
            continue
        pixels = seen.pixels[own]
        moved = colmap_pinhole(before, number).project(rays[own])[0] - pixels
        old, new = (colmap_layout(model, number) @ model.camera_params[number] for model in (before, after))
        size, radius = (float(np.sqrt(np.nanmean((x * x).sum(axis=1)))) for x in (moved, pixels - old[2:4]))
        if not size > _CHANGED * radius:
            continue
        most = max(most, size / radius)
        differ = [k for k in range(len(old)) if abs(new[k] - old[k]) > 1e-3 * max(abs(old[k]), 1e-3)]
        names = list(NAMES)
        if new[0] == new[1] and old[0] == old[1]:  # one focal length
            names[0], differ = "f", [k for k in differ if k != 1]
        told = ", ".join(f"{names[k]} = {new[k]:.5g} instead of {old[k]:.5g}" for k in differ)
        changes.append(f"for camera {name} {told}, which moves its pixels by {size:.2g} px")
    return changes, most
