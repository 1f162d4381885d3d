"""Reconstructions from one format to another: cameras that look along −z and along +z, and what each format does not hold."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.reconstructions.bal import BalProblem
from boxplus.formats.reconstructions.colmap_model import ColmapModel
from boxplus.formats.reconstructions.gbp import GbpProblem
from boxplus.manifolds import quaternion, so3

_TURNED = np.array([0.0, 1.0, 0.0, 0.0])
"""Half a turn about x: between a camera that looks along −z with y up, and one that looks along +z with y down."""
_FLIP = np.array([1.0, -1.0, -1.0])
_LIKE_BAL = "SIMPLE_PINHOLE, SIMPLE_RADIAL or RADIAL, or PINHOLE and OPENCV with one focal length and no tangential distortion"
_GREY = 160


def colmap_of(problem: BalProblem | GbpProblem) -> ColmapModel:
    """The same cameras, points and observations as a COLMAP model; every reprojection error stays what it is.

    Each camera of a BAL file becomes a `RADIAL` camera of one image; those of a `GbpProblem` share one `PINHOLE`.
    What COLMAP wants to know beside is made up: images named by their numbers, the smallest size that holds all their
    observations (of a BAL camera with its principal point in the middle), points in grey.

    Args:
        problem: what was read.
    """
    order = np.argsort(problem.camera_of, kind="stable")
    image_of, seen = problem.camera_of[order], problem.pixels[order]
    if isinstance(problem, BalProblem):
        images = len(problem.cameras)
        q = quaternion.from_matrix(so3.exp(problem.cameras[:, :3]))
        T = np.hstack([quaternion.multiply(np.broadcast_to(_TURNED, q.shape).copy(), q), problem.cameras[:, 3:6] * _FLIP])
        half = np.ones((images, 2))
        np.maximum.at(half, image_of, np.ceil(np.abs(seen)))
        params = np.hstack([problem.cameras[:, 6:7], half, problem.cameras[:, 7:9]])
        sizes, pixels, camera_of = 2.0 * half, half[image_of] + seen * [1.0, -1.0], np.arange(images)
    else:
        images, T = len(problem.T_camera_world), problem.T_camera_world
        params, pixels, camera_of = problem.intrinsics[None], seen, np.zeros(images, np.int64)
        sizes = np.ceil(np.maximum(seen.max(axis=0, initial=1.0), 2.0 * problem.intrinsics[2:]))[None]
    return ColmapModel(
        camera_ids=np.arange(1, len(params) + 1),
        camera_models=("RADIAL" if isinstance(problem, BalProblem) else "PINHOLE",) * len(params),
        camera_sizes=sizes.astype(np.int64),
        camera_params=tuple(params),
        image_ids=np.arange(1, images + 1),
        image_names=tuple(f"{number:06}" for number in range(images)),
        camera_of=camera_of,
        T_camera_world=np.ascontiguousarray(T),
        point_ids=np.arange(1, len(problem.points) + 1),
        points=problem.points,
        colors=np.full((len(problem.points), 3), _GREY, np.uint8),
        errors=np.full(len(problem.points), -1.0),
        image_of=image_of,
        point_of=problem.point_of[order],
        pixels=np.ascontiguousarray(pixels),
    )


def bal_of(model: ColmapModel) -> tuple[BalProblem, list[str]]:
    """The same as a BAL problem, and what of the model that does not hold; every reprojection error stays what it is.

    Raises:
        InputError: a camera with a lens that BAL does not know.
    """
    lenses = np.array([_lens(model, number) for number in range(len(model.camera_ids))]).reshape(-1, 5)
    seen = model.point_of >= 0
    image_of = model.image_of[seen]
    pixels = (model.pixels[seen] - lenses[model.camera_of[image_of], 1:3]) * [1.0, -1.0]
    q = quaternion.multiply(np.tile(_TURNED, (len(model.image_ids), 1)), model.T_camera_world[:, :4])
    lens_of_image = lenses[model.camera_of][:, [0, 3, 4]]
    cameras = np.hstack([so3.log(quaternion.to_matrix(q)), model.T_camera_world[:, 4:] * _FLIP, lens_of_image])
    lost = ["image names", "image sizes", "colours", "ids"]
    if len(model.camera_ids) < len(model.image_ids):
        lost.append("cameras that images share (each image has its own now)")
    if not seen.all():
        lost.append(f"{(~seen).sum():,} observations of no point")
    return BalProblem(cameras, model.points, image_of, model.point_of[seen], pixels, model.source), lost


def _lens(model: ColmapModel, number: int) -> NDArray[np.float64]:
    """f, cx, cy, k1, k2 of a camera."""
    name, given = model.camera_models[number], model.camera_params[number]
    if name in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        return np.pad(given, (0, 5 - len(given)))
    if name in ("PINHOLE", "OPENCV") and given[0] == given[1] and not given[6:8].any():
        return np.pad(given[1:6], (0, 6 - len(given[:6])))
    raise InputError(
        f"cameras that BAL can hold: {_LIKE_BAL}",
        f"camera {model.camera_ids[number]} of the model {name}, {np.array2string(given, precision=6)} ({model.source})",
        "keep COLMAP's format, or undistort the images first",
    )
