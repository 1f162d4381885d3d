"""Bundle adjustment: cameras and points that explain best where the points were seen (SPEC.md 3)."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from boxplus.cameras.distortion import Radial, RadialTangential
from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import InputError
from boxplus.formats.bal import BalProblem
from boxplus.formats.colmap_model import ColmapModel
from boxplus.formats.gbp import GbpProblem
from boxplus.manifolds import quaternion, so3
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.se3 import SE3Left
from boxplus.optimization.losses import Loss
from boxplus.optimization.minimize import Callback
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.optimization.solver_options import SolverOptions
from boxplus.optimization.variables import Variables
from boxplus.residuals.bal_reprojection import BalCamera, BalReprojection
from boxplus.residuals.reprojection import Reprojection
from boxplus.residuals.reprojection_intrinsics import ReprojectionIntrinsics

Reconstruction = BalProblem | GbpProblem | ColmapModel


class BundleAdjustmentConfig(BaseModel):
    """Options of `adjust_bundle`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    sigma_px: float = Field(1.0, gt=0, description="[px] standard deviation of a pixel measurement")
    intrinsics: Literal["held", "refined"] = Field(
        "held", description="of COLMAP's cameras; those of a BAL file are always refined, as its cameras carry them"
    )
    solver: SolverOptions = Field(SolverOptions(), description="see SolverOptions")


@dataclass(frozen=True, slots=True)
class BundleAdjustmentResult:
    """An adjusted reconstruction.

    Attributes:
        reconstruction: of the same kind as the input, with adjusted cameras and points.
        errors_start, errors: (k,) distance of every observation from its projection [px], NaN where it cannot be projected.
        solution: with history, covariance, and why it stopped.
        cameras, points: the variables of `solution`.
        time_s: seconds, set-up included.
    """

    reconstruction: Reconstruction
    errors_start: NDArray[np.float64]
    errors: NDArray[np.float64]
    solution: Solution
    cameras: Variables
    points: Variables
    time_s: float


def adjust_bundle(
    reconstruction: Reconstruction,
    config: BundleAdjustmentConfig | None = None,
    *,
    loss: Loss | None = None,
    callback: Callback | None = None,
) -> BundleAdjustmentResult:
    """Minimise ½ Σ ρ(‖e/σ‖²) over cameras and points, with the reprojection errors e.

    Nothing is held: Levenberg-Marquardt stays near the start along the seven directions that move the whole scene.

    Raises:
        InputError: a camera model without a counterpart here; intrinsics that cannot be refined.
    """
    config = config if config is not None else BundleAdjustmentConfig()
    begin = time.perf_counter()
    problem = Problem()
    if isinstance(reconstruction, BalProblem):
        blocks = _add_bal(problem, reconstruction, config, loss)
    elif isinstance(reconstruction, GbpProblem):
        blocks = _add_gbp(problem, reconstruction, config, loss)
    else:
        blocks = _add_colmap(problem, reconstruction, config, loss)
    cameras, points = blocks
    start = [block.values for block in problem.blocks]
    errors_start = _errors(problem, start)
    solution = problem.solve(config.solver, callback=callback)
    return BundleAdjustmentResult(
        reconstruction=_with_values(reconstruction, problem, solution, cameras, points),
        errors_start=errors_start,
        errors=_errors(problem, list(solution.values)),
        solution=solution,
        cameras=cameras,
        points=points,
        time_s=time.perf_counter() - begin,
    )


def _add_bal(problem: Problem, bal: BalProblem, config: BundleAdjustmentConfig, loss: Loss | None) -> tuple[Variables, Variables]:
    rotation = quaternion.from_matrix(so3.exp(bal.cameras[:, :3]))
    cameras = problem.add_variables(BalCamera, np.hstack([rotation, bal.cameras[:, 3:]]), name="cameras")
    points = problem.add_variables(Euclidean(3), bal.points, name="points")
    residual = BalReprojection(bal.pixels, sigma=config.sigma_px)
    problem.add_residuals(residual, cameras[bal.camera_of], points[bal.point_of], loss=loss, name="pixels")
    return cameras, points


def _add_gbp(problem: Problem, gbp: GbpProblem, config: BundleAdjustmentConfig, loss: Loss | None) -> tuple[Variables, Variables]:
    cameras = problem.add_variables(SE3Left, gbp.T_camera_world, name="cameras")
    points = problem.add_variables(Euclidean(3), gbp.points, name="points")
    fx, fy, cx, cy = (float(v) for v in gbp.intrinsics)
    residual = Reprojection(Pinhole(fx, fy, cx, cy), gbp.pixels, sigma=config.sigma_px)
    problem.add_residuals(residual, cameras[gbp.camera_of], points[gbp.point_of], loss=loss, name="pixels")
    return cameras, points


def _add_colmap(
    problem: Problem, model: ColmapModel, config: BundleAdjustmentConfig, loss: Loss | None
) -> tuple[Variables, Variables]:
    images = problem.add_variables(SE3Left, model.T_camera_world, name="cameras")
    points = problem.add_variables(Euclidean(3), model.points, name="points")
    seen = model.point_of >= 0
    for number, name in enumerate(model.camera_ids):
        chosen = np.flatnonzero(seen & (model.camera_of[model.image_of] == number))
        if not len(chosen):
            continue
        camera = _pinhole(model, number)
        connections = [images[model.image_of[chosen]], points[model.point_of[chosen]]]
        label = f"pixels of camera {name}"
        if config.intrinsics == "held":
            held = Reprojection(camera, model.pixels[chosen], sigma=config.sigma_px)
            problem.add_residuals(held, *connections, loss=loss, name=label)
            continue
        if model.camera_models[number].startswith("SIMPLE") or model.camera_models[number] == "RADIAL":
            raise InputError(
                "cameras with two focal lengths (PINHOLE, OPENCV) to refine intrinsics",
                f"camera {name} of model {model.camera_models[number]} ({model.source})",
                "convert the camera, or hold the intrinsics",
            )
        refined = ReprojectionIntrinsics(camera, model.pixels[chosen], sigma=config.sigma_px)
        intrinsics = problem.add_variables(refined.manifolds[2], camera.parameters, name=f"intrinsics of camera {name}")
        problem.add_residuals(refined, *connections, intrinsics, loss=loss, name=label)
    return images, points


def _pinhole(model: ColmapModel, number: int) -> Pinhole:
    """The camera, in pixels of COLMAP: its centres at half pixels only shift cx and cy."""
    name, p = model.camera_models[number], [float(v) for v in model.camera_params[number]]
    if name == "SIMPLE_PINHOLE":
        return Pinhole(p[0], p[0], p[1], p[2])
    if name == "PINHOLE":
        return Pinhole(p[0], p[1], p[2], p[3])
    if name == "SIMPLE_RADIAL":
        return Pinhole(p[0], p[0], p[1], p[2], Radial(p[3], 0.0))
    if name == "RADIAL":
        return Pinhole(p[0], p[0], p[1], p[2], Radial(p[3], p[4]))
    if name == "OPENCV":
        return Pinhole(p[0], p[1], p[2], p[3], RadialTangential(p[4], p[5], p[6], p[7]))
    raise InputError(
        "a camera of model SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL or OPENCV",
        f"{name}, camera {model.camera_ids[number]} ({model.source})",
        "undistort the images, or convert the camera",
    )


def _errors(problem: Problem, values: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Distances in pixels of all groups, one after the other."""
    distances = []
    for group in problem.groups:
        r, valid = np.zeros_like(group.r), np.ones(group.residual.count, dtype=np.bool_)
        x = tuple(values[c.block.number] for c in group.connections)
        group.residual.evaluate_into(0, group.residual.count, x, tuple(c.rows for c in group.connections), r, valid)
        distances.append(np.where(valid, np.linalg.norm(r, axis=1), np.nan))
    return np.concatenate(distances)


def _with_values(
    reconstruction: Reconstruction, problem: Problem, solution: Solution, cameras: Variables, points: Variables
) -> Reconstruction:
    T, p_world = solution[cameras], solution[points]
    if isinstance(reconstruction, BalProblem):
        vectors = so3.log(quaternion.to_matrix(T[:, :4]))
        return replace(reconstruction, cameras=np.hstack([vectors, T[:, 4:]]), points=p_world)
    if isinstance(reconstruction, GbpProblem):
        return replace(reconstruction, T_camera_world=T, points=p_world)
    params = list(reconstruction.camera_params)
    names = {f"intrinsics of camera {name}": number for number, name in enumerate(reconstruction.camera_ids)}
    for block in problem.blocks:
        if block.name in names:
            params[names[block.name]] = solution[block][0]
    return replace(reconstruction, T_camera_world=T, points=p_world, camera_params=tuple(params))
