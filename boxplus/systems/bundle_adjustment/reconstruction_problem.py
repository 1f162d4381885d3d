"""A reconstruction as a least-squares problem, and the solution back as a reconstruction of the same format."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.reconstructions.bal import BalProblem
from boxplus.formats.reconstructions.colmap_model import ColmapModel
from boxplus.formats.reconstructions.gbp import GbpProblem
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.manifolds import quaternion, so3
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.se3 import SE3Left
from boxplus.optimization.losses import Loss
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.optimization.terms.variables import Variables
from boxplus.residuals.camera.bal_reprojection import BalCamera, BalReprojection
from boxplus.residuals.camera.reprojection import Reprojection
from boxplus.residuals.camera.reprojection_tied_intrinsics import ReprojectionTiedIntrinsics
from boxplus.systems.bundle_adjustment.config import BundleAdjustmentConfig
from boxplus.systems.bundle_adjustment.sightings import COLMAP_LAYOUT, colmap_layout, colmap_pinhole, gbp_pinhole

Mask = NDArray[np.bool_]

_FOCAL = 7  # column of a camera of BAL as a variable: rotation, translation, f, k1, k2


def add_reconstruction(
    problem: Problem, reconstruction: Reconstruction, used: Mask, config: BundleAdjustmentConfig, loss: Loss | None
) -> tuple[Variables, Variables]:
    """Add cameras, points and the used observations (k,) to a problem; returns cameras and points.

    Raises:
        InputError: a camera model without a counterpart here; a focal length that is not positive.
    """
    if isinstance(reconstruction, BalProblem):
        return _add_bal(problem, reconstruction, used, config, loss)
    if isinstance(reconstruction, GbpProblem):
        return _add_gbp(problem, reconstruction, used, config, loss)
    return _add_colmap(problem, reconstruction, used, config, loss)


def refuse_focal_lengths(reconstruction: Reconstruction) -> None:
    """Refuse cameras of BAL that no lens is: the format does not say what they may be.

    Raises:
        InputError: a focal length that is not positive; the message names the first camera.
    """
    if not isinstance(reconstruction, BalProblem):
        return
    bad = np.flatnonzero(~(reconstruction.cameras[:, 6] > 0.0))
    if bad.size:
        raise InputError(
            "positive focal lengths [px]",
            f"{reconstruction.cameras[bad[0], 6]:g}, camera {bad[0]} ({reconstruction.source})",
            "a camera of BAL looks along −z of its frame: turn the frame, not the sign of the focal length",
        )


def start_values(reconstruction: Reconstruction) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Values of the variables of cameras and of points."""
    if isinstance(reconstruction, BalProblem):
        rotation = quaternion.from_matrix(so3.exp(reconstruction.cameras[:, :3]))
        return np.hstack([rotation, reconstruction.cameras[:, 3:]]), reconstruction.points
    return reconstruction.T_camera_world, reconstruction.points


def _add_bal(
    problem: Problem, bal: BalProblem, used: Mask, config: BundleAdjustmentConfig, loss: Loss | None
) -> tuple[Variables, Variables]:
    poses, p_world = start_values(bal)
    cameras = problem.add_variables(BalCamera, poses, name="cameras")
    points = problem.add_variables(Euclidean(3), p_world, name="points")
    residual = BalReprojection(bal.pixels[used], sigma=config.sigma_px)
    problem.add_residuals(residual, cameras[bal.camera_of[used]], points[bal.point_of[used]], loss=loss, name="pixels")
    return cameras, points


def _add_gbp(
    problem: Problem, gbp: GbpProblem, used: Mask, config: BundleAdjustmentConfig, loss: Loss | None
) -> tuple[Variables, Variables]:
    cameras = problem.add_variables(SE3Left, gbp.T_camera_world, name="cameras")
    points = problem.add_variables(Euclidean(3), gbp.points, name="points")
    residual = Reprojection(gbp_pinhole(gbp), gbp.pixels[used], sigma=config.sigma_px)
    problem.add_residuals(residual, cameras[gbp.camera_of[used]], points[gbp.point_of[used]], loss=loss, name="pixels")
    return cameras, points


def _add_colmap(
    problem: Problem, model: ColmapModel, used: Mask, config: BundleAdjustmentConfig, loss: Loss | None
) -> tuple[Variables, Variables]:
    images = problem.add_variables(SE3Left, model.T_camera_world, name="cameras")
    points = problem.add_variables(Euclidean(3), model.points, name="points")
    seen = model.point_of >= 0
    seen[seen] = used
    for number, name in enumerate(model.camera_ids):
        chosen = np.flatnonzero(seen & (model.camera_of[model.image_of] == number))
        if not len(chosen):
            continue
        camera = colmap_pinhole(model, number)
        connections = [images[model.image_of[chosen]], points[model.point_of[chosen]]]
        label = f"pixels of camera {name}"
        if config.intrinsics == "held":
            held = Reprojection(camera, model.pixels[chosen], sigma=config.sigma_px)
            problem.add_residuals(held, *connections, loss=loss, name=label)
            continue
        free, offset, basis = free_parameters(model, number, config)
        refined = ReprojectionTiedIntrinsics(camera, model.pixels[chosen], offset, basis, sigma=config.sigma_px)
        start = model.camera_params[number][free]
        intrinsics = problem.add_variables(refined.manifolds[2], start, name=_intrinsics_name(name))
        problem.add_residuals(refined, *connections, intrinsics, loss=loss, name=label)
    return images, points


def _intrinsics_name(camera_id: int) -> str:
    return f"intrinsics of camera {camera_id}"


def free_parameters(
    model: ColmapModel, number: int, config: BundleAdjustmentConfig
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]:
    """Which of COLMAP's parameters are refined, and offset and basis of `ReprojectionTiedIntrinsics` for them."""
    layout = colmap_layout(model, number)
    free = np.ones(layout.shape[1], dtype=np.bool_)
    if config.principal_point == "held":
        free[list(COLMAP_LAYOUT[model.camera_models[number]][2:4])] = False
    return free, layout[:, ~free] @ model.camera_params[number][~free], layout[:, free]


def lens_blocks(model: ColmapModel, problem: Problem) -> dict[int, Variables]:
    """The intrinsics that are refined as variables, by the number of their camera."""
    numbers = {_intrinsics_name(name): number for number, name in enumerate(model.camera_ids)}
    return {numbers[block.name]: block for block in problem.blocks if block.name in numbers}


def _refined_intrinsics(model: ColmapModel, problem: Problem, solution: Solution) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Which camera, and what came out of its parameters that were refined, of those that have any."""
    for number, block in lens_blocks(model, problem).items():
        yield number, solution[block][0]


def turned_lenses(
    reconstruction: Reconstruction, config: BundleAdjustmentConfig, problem: Problem, solution: Solution, cameras: Variables
) -> tuple[list[tuple[int, float]], int]:
    """Names and focal lengths [px] of cameras of which it came out negative, and of how many it was refined."""
    if isinstance(reconstruction, BalProblem):
        lengths = dict(enumerate(solution[cameras][:, _FOCAL]))
    elif isinstance(reconstruction, ColmapModel) and config.intrinsics == "refined":
        lengths = {}
        for number, intrinsics in _refined_intrinsics(reconstruction, problem, solution):
            _, offset, basis = free_parameters(reconstruction, number, config)
            lengths[int(reconstruction.camera_ids[number])] = float((offset + basis @ intrinsics)[:2].min())
    else:
        lengths = {}
    return [(name, float(f)) for name, f in lengths.items() if not f > 0.0], len(lengths)


def mean_error_of_points(count: int, errors: NDArray[np.float64], point_of: NDArray[np.int64]) -> NDArray[np.float64]:
    """(count,) mean distance of every point's observations from its projections [px]; NaN where none can be projected."""
    seen = np.isfinite(errors)
    total = np.bincount(point_of[seen], errors[seen], count)
    times = np.bincount(point_of[seen], minlength=count)
    return np.where(times > 0, total / np.maximum(times, 1), np.nan)


def adjusted_reconstruction(
    reconstruction: Reconstruction,
    config: BundleAdjustmentConfig,
    problem: Problem,
    solution: Solution,
    cameras: Variables,
    points: Variables,
    errors: NDArray[np.float64],
    point_of: NDArray[np.int64],
) -> Reconstruction:
    """The reconstruction with the solution's values; of COLMAP also the mean error of each point [px], −1 where it has none."""
    T, p_world = solution[cameras], solution[points]
    if isinstance(reconstruction, BalProblem):
        vectors = so3.log(quaternion.to_matrix(T[:, :4]))
        return replace(reconstruction, cameras=np.hstack([vectors, T[:, 4:]]), points=p_world)
    if isinstance(reconstruction, GbpProblem):
        return replace(reconstruction, T_camera_world=T, points=p_world)
    params = [array.copy() for array in reconstruction.camera_params]
    for number, intrinsics in _refined_intrinsics(reconstruction, problem, solution):
        params[number][free_parameters(reconstruction, number, config)[0]] = intrinsics
    mean = mean_error_of_points(len(p_world), errors, point_of)
    known = np.where(np.isfinite(mean), mean, -1.0)
    return replace(reconstruction, T_camera_world=T, points=p_world, camera_params=tuple(params), errors=known)


def pixel_errors(problem: Problem, values: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Distances in pixels of all groups, one after the other."""
    distances = []
    for group in problem.groups:
        r, valid = np.zeros_like(group.r), np.ones(group.residual.count, dtype=np.bool_)
        x = tuple(values[c.block.number] for c in group.connections)
        group.residual.evaluate_into(0, group.residual.count, x, tuple(c.rows for c in group.connections), r, valid)
        distances.append(np.where(valid, np.linalg.norm(r, axis=1), np.nan))
    return np.concatenate(distances)
