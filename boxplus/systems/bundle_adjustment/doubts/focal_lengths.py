"""Do the images tell the focal lengths that they were to find?

A plane seen from above, cameras that go straight ahead, two views alone: there a longer lens farther away explains pixels nearly
as well, errors stay small, and noise decides. The covariance of the focal lengths says so. That of a whole scene does not exist,
as nothing tells where it lies, how it is turned and how large it is; focal lengths do not change with any of these, so that
cameras and points are held loosely in their place, by far less than images hold them against each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._words import counted, either
from boxplus.errors import BoxplusError
from boxplus.formats.reconstructions.bal import BalProblem
from boxplus.formats.reconstructions.colmap_model import ColmapModel
from boxplus.formats.reconstructions.gbp import GbpProblem
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.optimization.losses import Loss
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.optimization.terms.variables import Variables
from boxplus.residuals.prior import Prior
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig
from boxplus.systems.bundle_adjustment.doubts.plausibility import pixel_noise
from boxplus.systems.bundle_adjustment.reconstruction_problem import add_reconstruction, lens_blocks
from boxplus.systems.bundle_adjustment.sightings import COLMAP_LAYOUT, Sightings, names_text

_VAGUE = 0.03  # of a focal length, that its standard deviation may be: a held lens that is off by more bends a scene, too
_UNKNOWN = 0.1  # the same of half of them, from which on nothing is to be trusted: one scene in three is off by as much
_LOOSE = 10.0  # [rad], and [1] of the distance of what is seen: standard deviation that holds a camera
_FAR = 1e3  # of that distance: the same of a point
_ANY = 100.0  # standard deviation of intrinsics that nothing tells; of a focal length, itself
_LEAST_SCALE = 1e-6  # of the noise found, as a share of sigma: less is none
_LEAST_HOLD = 1e-2  # the same for what is held: more loosely, rounding would decide
_OPEN = 0.3  # of the deviation at which a focal length is held: as large a one is that of the hold
_F = 6  # of a camera of BAL in its tangent: rotation, translation, f, k1, k2


@dataclass(frozen=True, slots=True)
class FocalLengths:
    """What the images tell of the focal lengths that were adjusted.

    Attributes:
        names: (m,) cameras, as the file calls them.
        deviations: (m,) standard deviations, as shares of the focal lengths; about 1 where nothing tells.
        is_bal: of a BAL file.
        problem: why they could not be computed; empty where they were.
    """

    names: NDArray[np.int64]
    deviations: NDArray[np.float64]
    is_bal: bool
    problem: str = ""

    @property
    def is_grave(self) -> bool:
        """Whether half of them are not known."""
        return bool(len(self.names)) and float(np.median(self.deviations)) > _UNKNOWN

    @property
    def sentence(self) -> str | None:
        """Which are not known, the worst first, or why nobody knows; None where all are."""
        if self.problem:
            return f"whether the images tell the focal lengths could not be computed ({self.problem})"
        vague = np.flatnonzero(self.deviations > _VAGUE)
        if not len(vague):
            return None
        vague = vague[np.argsort(-self.deviations[vague], kind="stable")]
        many = len(self.names)
        worst, half = (f"{100.0 * min(share, 1.0):.3g} %" for share in (self.deviations[vague[0]], np.median(self.deviations)))
        known = f"up to {worst}" if len(vague) > 1 else worst
        known += f", and in half of all of {half} and more" if self.is_grave and many > 1 else ""
        hold = "hold those of calibrated cameras (" + (
            "a file with one line fx fy cx cy, or a COLMAP model)" if self.is_bal else "without --refine-intrinsics)"
        )
        share = "" if self.is_bal or many == 1 else ", let images of one camera share one"
        return (
            f"the images do not tell the focal {either(len(vague), 'length', 'lengths')} of {len(vague)} of "
            f"{counted(many, 'camera')} ({names_text(self.names[vague], None)}): standard deviations of {known}, and depths and "
            f"places of the cameras are as uncertain, however small the errors; {hold}{share}, or add images from other sides"
        )


def focal_lengths(
    adjusted: Reconstruction,
    used: NDArray[np.bool_],
    dropped: NDArray[np.int64],
    config: BundleAdjustmentConfig,
    loss: Loss | None,
    errors: NDArray[np.float64],
    solved: Solution,
    left: int,
) -> FocalLengths | None:
    """From the covariance at the solution, with the noise that the errors have.

    Args:
        adjusted: where the adjustment ended, as `solved` tells.
        used: (k,) observations that were adjusted. dropped: points that were not.
        errors: (k,) at the end [px].
        left: measurements less unknowns.

    Returns:
        None where focal lengths were held, somebody broke it off, or no measurement is left over to tell the noise from.
    """
    noise = pixel_noise(errors, left)
    if isinstance(adjusted, GbpProblem) or (isinstance(adjusted, ColmapModel) and config.intrinsics == "held"):
        return None
    if noise is None or solved.is_broken_off:
        return None
    seen = Sightings.of(adjusted)
    distance = float(np.median(np.linalg.norm(seen.points[seen.point_of] - seen.centers[seen.camera_of], axis=1)))
    if not (np.isfinite(distance) and distance > 0.0):
        return None
    scale = max(noise / config.sigma_px, _LEAST_SCALE)
    loose = max(scale, _LEAST_HOLD)
    problem = Problem()
    cameras, points = add_reconstruction(problem, adjusted, used, config, loss)
    problem.fix(points[dropped])
    pose = np.tile([_LOOSE] * 3 + [_LOOSE * distance] * 3, (len(cameras), 1))
    if isinstance(adjusted, BalProblem):
        pose = np.hstack([pose, adjusted.cameras[:, 6:7], np.full((len(pose), 2), _ANY)])
    _hold(problem, cameras, pose / loose)
    _hold(problem, points, np.full((len(points), 3), _FAR * distance / loose))
    lenses = [] if isinstance(adjusted, BalProblem) else _held_lenses(problem, adjusted, loose)
    try:
        solution = problem.solve(config.solver.model_copy(update={"max_iterations": 0, "time_limit_s": None}))
        if isinstance(adjusted, BalProblem):
            names = np.unique(seen.camera_of[used])
            C = solution.covariance(cameras[names], is_determined=True)
            shares = np.sqrt(C[:, _F, _F]) / adjusted.cameras[names, 6]
        else:
            names = adjusted.camera_ids[[lens.number for lens in lenses]]
            shares = np.array([lens.share(solution) for lens in lenses])
    except BoxplusError as problem_met:  # no covariance, as where residuals cannot be evaluated
        return FocalLengths(np.zeros(0, np.int64), np.zeros(0), isinstance(adjusted, BalProblem), str(problem_met))
    # Exact data of a plane show no focal length, however small their errors: what is held is then known as well as it is held.
    is_open = (shares > _OPEN / loose) & (scale < loose)
    return FocalLengths(names, np.where(is_open, 1.0, scale * shares), isinstance(adjusted, BalProblem))


@dataclass(frozen=True, slots=True)
class _Lens:
    """Intrinsics of a camera of COLMAP that are refined; its `count` focal lengths are the first of them."""

    number: int
    block: Variables
    count: int

    def share(self, solution: Solution) -> float:
        """Standard deviation of the focal length, as a share of it; of two the larger one."""
        C = solution.covariance(self.block, is_determined=True)[0]
        return float((np.sqrt(np.diag(C)[: self.count]) / self.block.values[0, : self.count]).max())


def _held_lenses(problem: Problem, model: ColmapModel, loose: float) -> list[_Lens]:
    """Lenses that are refined, held loosely."""
    lenses = []
    for number, block in lens_blocks(model, problem).items():
        count = len(set(COLMAP_LAYOUT[model.camera_models[number]][:2]))
        sigma = np.full((1, block.manifold.dof), _ANY)
        sigma[0, :count] = block.values[0, :count]
        _hold(problem, block, sigma / loose)
        lenses.append(_Lens(number, block, count))
    return lenses


def _hold(problem: Problem, block: Variables, sigma: NDArray[np.float64]) -> None:
    """Hold every variable of a block loosely where it is, by standard deviations (n, dof) in its tangent."""
    problem.add_residuals(Prior(block.manifold, block.values, sigma=sigma), block, name=f"{block.name} held loosely")
