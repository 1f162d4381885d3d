"""Lenses, mountings and poses of a rig in one least-squares problem, from the corners of a target.

Variables: T_target_body of every frame, T_body_camera of every camera but the first, which is the body, and every camera's
intrinsics c. Known: the places of the corners on the target. Residual of a corner, at pixel z [px],

    e = z − π((T_target_body T_body_camera)⁻¹ p_target; c)

(`residuals.camera.ReprojectionIntrinsics` on `OnBody`). Noise of the corners: one σ for all, not known beforehand,
σ̂² = Σ‖e‖²/(2N − dof). Corners beyond 5 σ̂ are left out; σ̂ comes from the median first, for which they do not matter. The
covariance is σ̂² H⁻¹ of what is left.

A prior on the intrinsics, at their estimate and as wide as the focal length itself, is added for the covariance alone: it leaves
the estimate where it is, changes nothing that the corners determine, and gives what they do not determine a standard deviation
that says so, instead of none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.model import CameraModel
from boxplus.errors import InputError
from boxplus.manifolds import se3
from boxplus.manifolds.body_pose import BodyPose
from boxplus.manifolds.euclidean import Euclidean
from boxplus.optimization import losses
from boxplus.optimization.losses import Loss
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.optimization.terms.variables import Variables
from boxplus.residuals.camera.on_body import OnBody
from boxplus.residuals.camera.reprojection_intrinsics import ReprojectionIntrinsics
from boxplus.residuals.prior import Prior
from boxplus.systems.camera_calibration.corners import TargetCorners
from boxplus.systems.camera_calibration.lens import LensKind, lens

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

OUTLIER_SIGMAS = 5.0
_MEDIAN_OF_TWO = 1.1774  # of the length of a vector of two normal numbers, in standard deviations
_LOST_VIEW = 0.4
_SMALLEST_SIGMA_PX = 1e-4
_OPEN = 10.0  # standard deviation of the prior on numbers without unit


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Cameras, where they are, and where the body was.

    Attributes:
        kinds: of the lenses.
        models: the cameras.
        T_body_camera: (C, 7); the first is the identity.
        T_target_body: (F, 7) of every frame, NaN where it is not known.
    """

    kinds: tuple[LensKind, ...]
    models: tuple[CameraModel, ...]
    T_body_camera: Floats
    T_target_body: Floats

    def residuals(self, corners: TargetCorners, places: Floats) -> Floats:
        """z − π (N, 2) of corners [px]; NaN where the pose is not known or the corner not seen."""
        errors = np.full(corners.pixels.shape, np.nan)
        for camera, model in enumerate(self.models):
            rows = np.flatnonzero((corners.camera_of == camera) & np.isfinite(self.T_target_body[corners.frame_of, 0]))
            if len(rows):
                T_target_camera = se3.compose(self.T_target_body[corners.frame_of[rows]], self.T_body_camera[camera])
                p_camera = se3.act(se3.inverse(T_target_camera), places[corners.corner_of[rows]])
                errors[rows] = corners.pixels[rows] - model.project(p_camera)[0]
        return errors


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """What the corners say about a rig.

    Attributes:
        rig: the estimate.
        corners: all that were given.
        residuals: (N, 2) z − π [px], of those left out too; NaN where there is none.
        kept: (N,) which corners count.
        lost_views: (frame, camera) of images that were left out as a whole.
        sigma_px: of a coordinate of a corner, estimated.
        covariance: (D, D) of the intrinsics of every camera, one after the other, and of the tangents [θ, p] of the mountings of
            all cameras but the first.
        other_minimum: by how much χ² of a second minimum far away is larger; infinite where none is known.
        unconverged: a sentence where the search ended before its minimum.
    """

    rig: Rig
    corners: TargetCorners
    residuals: Floats
    kept: Mask
    lost_views: tuple[tuple[int, int], ...]
    sigma_px: float
    covariance: Floats
    other_minimum: float = math.inf
    unconverged: str | None = None

    def intrinsics(self, camera: int) -> slice:
        """Where a camera's intrinsics are in `covariance`."""
        counts = [len(model.parameters) for model in self.rig.models]
        return slice(sum(counts[:camera]), sum(counts[: camera + 1]))

    def mounting(self, camera: int) -> slice:
        """Where the mounting of a camera, 1 or more, is in `covariance`."""
        begin = sum(len(model.parameters) for model in self.rig.models) + 6 * (camera - 1)
        return slice(begin, begin + 6)

    @property
    def chi2(self) -> float:
        """Σ‖e‖²/σ̂² of the corners that count."""
        return float(np.sum(self.residuals[self.kept] ** 2)) / self.sigma_px**2

    def rms_px(self, chosen: Mask | None = None) -> float:
        """Root mean square distance of the kept corners, or of those chosen among them [px]; NaN without any."""
        rows = self.kept if chosen is None else self.kept & chosen
        return float(np.sqrt(np.mean(np.sum(self.residuals[rows] ** 2, axis=1)))) if rows.any() else math.nan


@dataclass(frozen=True, slots=True, eq=False)
class _Blocks:
    problem: Problem
    bodies: Variables
    mountings: Variables
    intrinsics: tuple[Variables, ...]
    frames: NDArray[np.intp]


def adjust(corners: TargetCorners, places: Floats, start: Rig, max_iterations: int = 60) -> Adjustment:
    """Estimate a rig from where it is near; corners and images that do not fit are left out.

    Args:
        places: (n, 3) of the target's corners [m].
        start: frames with a NaN pose are not used.

    Raises:
        InputError: the search does not end where all corners can be seen.
    """
    rig, usable = start, np.isfinite(start.T_target_body[corners.frame_of, 0])
    kept = usable
    for _ in range(2):
        scale = 3.0 * _sigma_of_median(rig.residuals(corners, places), usable)
        rig = _solve(corners.rows(kept), places, rig, losses.Cauchy(max(scale, 0.05)), max_iterations)[0]
    lost: tuple[tuple[int, int], ...] = ()
    for _ in range(3):
        errors = rig.residuals(corners, places)
        sigma = _sigma_of_median(errors, kept)
        inside = usable & (np.linalg.norm(np.nan_to_num(errors, nan=np.inf), axis=1) <= OUTLIER_SIGMAS * sigma)
        lost = _lost_views(corners, usable, inside)
        for frame, camera in lost:
            inside &= ~((corners.frame_of == frame) & (corners.camera_of == camera))
        if inside.sum() < 0.3 * usable.sum():
            raise InputError(
                "corners that one rig of cameras explains",
                f"{int(usable.sum() - inside.sum())} of {int(usable.sum())} beyond {OUTLIER_SIGMAS:g} σ of the others",
                "check the target (rows, columns, numbering) and that the file is of these cameras",
            )
        settled = np.array_equal(inside, kept)
        kept = inside
        seen = np.isin(np.arange(len(rig.T_target_body)), corners.frame_of[kept])
        rig = replace(rig, T_target_body=np.where(seen[:, None], rig.T_target_body, np.nan))
        rig, blocks, solution = _solve(corners.rows(kept), places, rig, losses.Squared(), max_iterations)
        if settled:
            break
    errors = rig.residuals(corners, places)
    squares = float(np.sum(errors[kept] ** 2))
    free = 2 * int(kept.sum()) - _dof(rig, blocks)
    sigma = max(math.sqrt(squares / max(free, 1)), _SMALLEST_SIGMA_PX)
    unconverged = solution.unconverged("use more views, of a target that fills the image")
    covariance = _covariance(rig, blocks, solution, sigma)
    return Adjustment(rig, corners, errors, kept, lost, sigma, covariance, unconverged=unconverged)


def _dof(rig: Rig, blocks: _Blocks) -> int:
    return 6 * len(blocks.frames) + 6 * (len(rig.models) - 1) + sum(len(model.parameters) for model in rig.models)


def _sigma_of_median(errors: Floats, rows: Mask) -> float:
    lengths = np.linalg.norm(errors[rows], axis=1)
    lengths = lengths[np.isfinite(lengths)]
    return max(float(np.median(lengths)) / _MEDIAN_OF_TWO, _SMALLEST_SIGMA_PX) if len(lengths) else math.inf


def _lost_views(corners: TargetCorners, usable: Mask, inside: Mask) -> tuple[tuple[int, int], ...]:
    views, of = np.unique(np.stack([corners.frame_of, corners.camera_of], axis=1), axis=0, return_inverse=True)
    of = of.reshape(-1)
    given = np.bincount(of[usable], minlength=len(views))
    out = np.bincount(of[usable & ~inside], minlength=len(views))
    return tuple((int(frame), int(camera)) for frame, camera in views[(given > 0) & (out > _LOST_VIEW * given)])


def _solve(corners: TargetCorners, places: Floats, rig: Rig, loss: Loss, max_iterations: int) -> tuple[Rig, _Blocks, Solution]:
    problem = Problem()
    frames = np.flatnonzero(np.isfinite(rig.T_target_body[:, 0]))
    row_of = np.full(len(rig.T_target_body), -1)
    row_of[frames] = np.arange(len(frames))
    bodies = problem.add_variables(BodyPose, rig.T_target_body[frames], name="T_target_body")
    mountings = problem.add_variables(BodyPose, rig.T_body_camera, name="T_body_camera")
    points = problem.add_variables(Euclidean(3), places, name="corners of the target")
    problem.fix(points)
    problem.fix(mountings[:1])
    intrinsics = []
    for camera, model in enumerate(rig.models):
        rows = np.flatnonzero((corners.camera_of == camera) & (row_of[corners.frame_of] >= 0))
        block = problem.add_variables(Euclidean(len(model.parameters)), model.parameters, name=f"intrinsics of cam{camera}")
        intrinsics.append(block)
        if not len(rows):
            continue
        problem.add_residuals(
            OnBody(ReprojectionIntrinsics(model, corners.pixels[rows], sigma=1.0)),
            bodies[row_of[corners.frame_of[rows]]],
            mountings[np.full(len(rows), camera)],
            points[corners.corner_of[rows]],
            block[np.zeros(len(rows), dtype=np.intp)],
            loss=loss,
            name=f"cam{camera}",
        )
    solution = problem.solve(max_iterations=max_iterations, examine=False)
    if sum(solution.invalid.values()):
        raise InputError(
            "a lens that sees all corners", f"{sum(solution.invalid.values())} that it does not", "try another --lens"
        )
    models = tuple(lens(kind, solution[block][0]) for kind, block in zip(rig.kinds, intrinsics, strict=True))
    poses = rig.T_target_body.copy()
    poses[frames] = solution[bodies]
    solved = Rig(rig.kinds, models, solution[mountings].copy(), poses)
    return solved, _Blocks(problem, bodies, mountings, tuple(intrinsics), frames), solution


def _covariance(rig: Rig, blocks: _Blocks, solution: Solution, sigma: float) -> Floats:
    problem = blocks.problem
    for camera, (model, block) in enumerate(zip(rig.models, blocks.intrinsics, strict=True)):
        wide = np.full(len(model.parameters), _OPEN)
        wide[:4] = model.parameters[0]
        # Whitened like the corners, by 1 px instead of σ̂, by which all is multiplied below.
        prior = Prior(Euclidean(len(wide)), solution[block], sigma=wide / sigma)
        problem.add_residuals(prior, block, name=f"open prior of cam{camera}")
    posterior = problem.solve(start=solution, max_iterations=0, examine=False)
    selected = [*blocks.intrinsics] + ([blocks.mountings[1:]] if len(rig.models) > 1 else [])
    return sigma**2 * posterior.joint_covariance(*selected, is_determined=True)
