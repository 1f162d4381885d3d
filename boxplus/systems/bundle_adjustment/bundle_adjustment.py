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
from boxplus.formats.reconstruction import Reconstruction
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
from boxplus.residuals.reprojection_tied_intrinsics import ReprojectionTiedIntrinsics

# Points far away creep on for many steps that change nothing but their distance.
_COST_TOLERANCE = 1e-8
# The scale of a COLMAP model is arbitrary: only what lies behind a camera is behind it.
_Z_MIN = 1e-9
# Which of COLMAP's parameters stands where in `Pinhole.parameters`; −1: a coefficient that is zero.
_COLMAP_LAYOUT = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3, -1),
    "RADIAL": (0, 0, 1, 2, 3, 4),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
}


class BundleAdjustmentConfig(BaseModel):
    """Options of `adjust_bundle`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    sigma_px: float = Field(1.0, gt=0, description="[px] standard deviation of a pixel measurement")
    intrinsics: Literal["held", "refined"] = Field(
        "held", description="of COLMAP's cameras; those of a BAL file are always refined, as its cameras carry them"
    )
    principal_point: Literal["held", "refined"] = Field(
        "held", description="of COLMAP's cameras where the intrinsics are refined; few scenes determine it well"
    )
    solver: SolverOptions = Field(
        SolverOptions(cost_tolerance=_COST_TOLERANCE), description="see SolverOptions; stops once the cost settles to 8 digits"
    )


@dataclass(frozen=True, slots=True)
class BundleAdjustmentResult:
    """An adjusted reconstruction.

    Attributes:
        reconstruction: of the same kind as the input, with adjusted cameras and points.
        errors_start, errors: (k,) distance of every observation from its projection [px], NaN where it cannot be projected.
            k leaves out those of COLMAP's observations that belong to no point.
        camera_of, point_of: (k,) the camera (of COLMAP the image) and the point of each.
        notes: what a user should know of the structure, one sentence each.
        solution: with history, covariance, and why it stopped.
        cameras, points: the variables of `solution`.
        time_s: seconds, set-up included.
    """

    reconstruction: Reconstruction
    errors_start: NDArray[np.float64]
    errors: NDArray[np.float64]
    camera_of: NDArray[np.int64]
    point_of: NDArray[np.int64]
    notes: tuple[str, ...]
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
        InputError: a camera model without a counterpart here; no observation; a method without damping.
    """
    config = config if config is not None else BundleAdjustmentConfig()
    if config.solver.method == "gauss_newton":
        raise InputError(
            "a method that damps its steps",
            "gauss_newton, though images do not tell where the whole scene lies, how it is turned and how large it is",
            "use levenberg_marquardt or dogleg",
        )
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
    errors = _errors(problem, list(solution.values))
    camera_of, point_of = (
        np.concatenate([group.connections[slot].rows for group in problem.groups]).astype(np.int64) for slot in (0, 1)
    )
    return BundleAdjustmentResult(
        reconstruction=_with_values(reconstruction, config, problem, solution, cameras, points, errors, point_of),
        errors_start=errors_start,
        errors=errors,
        camera_of=camera_of,
        point_of=point_of,
        notes=_notes(len(points), camera_of, point_of, solution),
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
        free, offset, basis = _free_parameters(model, number, config)
        refined = ReprojectionTiedIntrinsics(camera, model.pixels[chosen], offset, basis, sigma=config.sigma_px)
        start = model.camera_params[number][free]
        intrinsics = problem.add_variables(refined.manifolds[2], start, name=_intrinsics_name(name))
        problem.add_residuals(refined, *connections, intrinsics, loss=loss, name=label)
    if not problem.groups:
        raise InputError("images that see points", f"not a single observation of a point ({model.source})", "triangulate first")
    return images, points


def _intrinsics_name(camera_id: int) -> str:
    return f"intrinsics of camera {camera_id}"


def _layout(model: ColmapModel, number: int) -> NDArray[np.float64]:
    """(n, m) matrix that turns COLMAP's parameters of a camera into those of `Pinhole`."""
    name = model.camera_models[number]
    if name not in _COLMAP_LAYOUT:
        raise InputError(
            f"a camera of model {', '.join(_COLMAP_LAYOUT)}",
            f"{name}, camera {model.camera_ids[number]} ({model.source})",
            "undistort the images, or convert the camera",
        )
    layout = np.zeros((len(_COLMAP_LAYOUT[name]), len(model.camera_params[number])))
    for row, column in enumerate(_COLMAP_LAYOUT[name]):
        if column >= 0:
            layout[row, column] = 1.0
    return layout


def _pinhole(model: ColmapModel, number: int) -> Pinhole:
    """The camera, in pixels of COLMAP: its centres at half pixels only shift cx and cy."""
    c = [float(value) for value in _layout(model, number) @ model.camera_params[number]]
    distortion = None if len(c) == 4 else Radial(c[4], c[5]) if len(c) == 6 else RadialTangential(c[4], c[5], c[6], c[7])
    return Pinhole(c[0], c[1], c[2], c[3], distortion, _Z_MIN)


def _free_parameters(
    model: ColmapModel, number: int, config: BundleAdjustmentConfig
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Which of COLMAP's parameters are refined, and offset and basis of `ReprojectionTiedIntrinsics` for them."""
    layout = _layout(model, number)
    free = np.ones(layout.shape[1], dtype=np.bool_)
    if config.principal_point == "held":
        free[list(_COLMAP_LAYOUT[model.camera_models[number]][2:4])] = False
    return free, layout[:, ~free] @ model.camera_params[number][~free], layout[:, free]


def _errors(problem: Problem, values: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Distances in pixels of all groups, one after the other."""
    distances = []
    for group in problem.groups:
        r, valid = np.zeros_like(group.r), np.ones(group.residual.count, dtype=np.bool_)
        x = tuple(values[c.block.number] for c in group.connections)
        group.residual.evaluate_into(0, group.residual.count, x, tuple(c.rows for c in group.connections), r, valid)
        distances.append(np.where(valid, np.linalg.norm(r, axis=1), np.nan))
    return np.concatenate(distances)


def _notes(point_count: int, camera_of: NDArray[np.int64], point_of: NDArray[np.int64], solution: Solution) -> tuple[str, ...]:
    """Sentences on the structure; that images alone do not tell where the whole scene lies is no news."""
    gauge = [note for note in solution.notes if note.startswith("nothing ties ")]
    notes = [note for note in solution.notes if note not in gauge]
    if len(gauge) > 1:
        notes.append(
            f"the reconstruction falls into {len(gauge)} pieces that share no point: how they lie to each other, and their "
            "relative scale, are not determined"
        )
    times = np.bincount(point_of, minlength=point_count)
    once = int(np.count_nonzero(times == 1))
    if once:
        notes.append(f"{once} points are seen only once: their depth is not determined and stays near the start")
    few = np.bincount(camera_of)
    few_cameras = int(np.count_nonzero((few > 0) & (few < 4)))
    if few_cameras:
        notes.append(f"{few_cameras} cameras see fewer than 4 points: their pose is not determined and stays near the start")
    return tuple(notes)


def mean_error_of_points(count: int, errors: NDArray[np.float64], point_of: NDArray[np.int64]) -> NDArray[np.float64]:
    """(count,) mean distance of every point's observations from its projections [px]; NaN where none can be projected."""
    seen = np.isfinite(errors)
    total = np.bincount(point_of[seen], errors[seen], count)
    times = np.bincount(point_of[seen], minlength=count)
    return np.where(times > 0, total / np.maximum(times, 1), np.nan)


def _with_values(
    reconstruction: Reconstruction,
    config: BundleAdjustmentConfig,
    problem: Problem,
    solution: Solution,
    cameras: Variables,
    points: Variables,
    errors: NDArray[np.float64],
    point_of: NDArray[np.int64],
) -> Reconstruction:
    T, p_world = solution[cameras], solution[points]
    if isinstance(reconstruction, BalProblem):
        vectors = so3.log(quaternion.to_matrix(T[:, :4]))
        return replace(reconstruction, cameras=np.hstack([vectors, T[:, 4:]]), points=p_world)
    if isinstance(reconstruction, GbpProblem):
        return replace(reconstruction, T_camera_world=T, points=p_world)
    params = [array.copy() for array in reconstruction.camera_params]
    names = {_intrinsics_name(name): number for number, name in enumerate(reconstruction.camera_ids)}
    for block in problem.blocks:
        if block.name in names:
            number = names[block.name]
            params[number][_free_parameters(reconstruction, number, config)[0]] = solution[block][0]
    mean = mean_error_of_points(len(p_world), errors, point_of)
    known = np.where(np.isfinite(mean), mean, -1.0)
    return replace(reconstruction, T_camera_world=T, points=p_world, camera_params=tuple(params), errors=known)
