"""A sparse reconstruction as COLMAP keeps it: cameras, images, points, and which image saw which point where."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError

CAMERA_MODELS = {
    "SIMPLE_PINHOLE": 3,  # f, cx, cy
    "PINHOLE": 4,  # fx, fy, cx, cy
    "SIMPLE_RADIAL": 4,  # f, cx, cy, k
    "RADIAL": 5,  # f, cx, cy, k1, k2
    "OPENCV": 8,  # fx, fy, cx, cy, k1, k2, p1, p2
    "OPENCV_FISHEYE": 8,  # fx, fy, cx, cy, k1, k2, k3, k4
    "FULL_OPENCV": 12,  # fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6
    "FOV": 5,  # fx, fy, cx, cy, omega
    "SIMPLE_RADIAL_FISHEYE": 4,  # f, cx, cy, k
    "RADIAL_FISHEYE": 5,  # f, cx, cy, k1, k2
    "THIN_PRISM_FISHEYE": 12,  # fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, sx1, sy1
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,  # fx, fy, cx, cy, k0 … k5, p0, p1, s0 … s3
}
"""How many parameters each camera model has; the position in the list is the number of the model in binary files."""

QUATERNION_TOLERANCE = 1e-2
"""Largest |‖q‖ − 1| that is taken for rounding and normalised away."""

_UNIT = 8e-16


@dataclass(frozen=True, slots=True, eq=False)
class ColmapModel:
    """c cameras, m images, n points and k observations.

    Pixels are COLMAP's: the centre of the upper left pixel is at (0.5, 0.5), x to the right, y downwards.

    Attributes:
        camera_ids: (c,) int64, different names of the cameras.
        camera_models: c words out of `CAMERA_MODELS`.
        camera_sizes: (c, 2) int64, width and height [px].
        camera_params: c arrays, the parameters of each model in COLMAP's order [px, 1].
        image_ids: (m,) int64, different names of the images.
        image_names: m file names.
        camera_of: (m,) int64, index of the camera of each image.
        T_camera_world: (m, 7) float64, [qw, qx, qy, qz, x, y, z]; quaternions are normalised.
        point_ids: (n,) int64, different names of the points.
        points: (n, 3) float64, p_world.
        colors: (n, 3) uint8, red, green, blue.
        errors: (n,) float64, mean reprojection error as the file has it [px]; −1 where it was not computed.
        image_of: (k,) int64, index of the image of each observation, not decreasing: observations are kept image by image,
            in the order that gives COLMAP's POINT2D_IDX.
        point_of: (k,) int64, index of the point, −1 where the observation belongs to none.
        pixels: (k, 2) float64 [px].
        format: how the files it came from were written.
        source: the folder; error messages begin with it.

    Raises:
        InputError: on construction, where shapes do not match, names repeat, an index is out of range, a value is not
            finite, or a camera has the wrong number of parameters.

    Example:
        >>> model = bp.formats.read_colmap("colmap")
        >>> model.camera_models, model.image_names[:2], model.points.shape
        (('SIMPLE_RADIAL',), ('000.png', '001.png'), (40, 3))
    """

    camera_ids: NDArray[np.int64]
    camera_models: tuple[str, ...]
    camera_sizes: NDArray[np.int64]
    camera_params: tuple[NDArray[np.float64], ...]
    image_ids: NDArray[np.int64]
    image_names: tuple[str, ...]
    camera_of: NDArray[np.int64]
    T_camera_world: NDArray[np.float64]
    point_ids: NDArray[np.int64]
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]
    errors: NDArray[np.float64]
    image_of: NDArray[np.int64]
    point_of: NDArray[np.int64]
    pixels: NDArray[np.float64]
    format: Literal["text", "binary"] = "binary"
    source: str = "COLMAP model"

    def __post_init__(self) -> None:
        cameras, images, points, seen = len(self.camera_ids), len(self.image_ids), len(self.point_ids), len(self.image_of)
        for name, shape in (
            ("camera_sizes", (cameras, 2)),
            ("T_camera_world", (images, 7)),
            ("camera_of", (images,)),
            ("points", (points, 3)),
            ("colors", (points, 3)),
            ("errors", (points,)),
            ("point_of", (seen,)),
            ("pixels", (seen, 2)),
        ):
            if getattr(self, name).shape != shape:
                self._refuse(f"{name} of shape {shape}", f"{getattr(self, name).shape}", "give matching arrays")
        for name, count in (("camera_models", cameras), ("camera_params", cameras), ("image_names", images)):
            if len(getattr(self, name)) != count:
                self._refuse(f"{count} {name}", f"{len(getattr(self, name))}", "give one for each")
        self._check_cameras()
        for kind, ids in (("camera", self.camera_ids), ("image", self.image_ids), ("point", self.point_ids)):
            names, times = np.unique(ids, return_counts=True)
            if (times > 1).any():
                self._refuse(f"each {kind} once", f"{kind} {names[np.argmax(times)]} again", "remove one of the two")
            largest = (1 << 63) - 1 if kind == "point" else (1 << 32) - 1
            if len(names) and not 0 <= names[0] <= names[-1] <= largest:
                self._refuse(f"{kind} ids from 0 to {largest}", f"{names[0]} to {names[-1]}", "number them anew")
        for name, index, lowest, count in (
            ("camera", self.camera_of, 0, cameras),
            ("image", self.image_of, 0, images),
            ("point", self.point_of, -1, points),
        ):
            bad = np.flatnonzero((index < lowest) | (index >= count))
            if bad.size:
                self._refuse(
                    f"{name} indices from {lowest} to {count - 1}", f"{index[bad[0]]} at {bad[0]}", "give indices, not names"
                )
        if (np.diff(self.image_of) < 0).any():
            self._refuse("observations image by image", "image_of that decreases", "sort them, stably")
        self._check_values()

    def _check_cameras(self) -> None:
        bad = np.flatnonzero((self.camera_sizes < 0).any(axis=1))
        if bad.size:
            got = f"{self.camera_sizes[bad[0]].tolist()}, camera {self.camera_ids[bad[0]]}"
            self._refuse("widths and heights that are not negative", got, "check the order of the columns")
        for name, params, camera in zip(self.camera_models, self.camera_params, self.camera_ids, strict=True):
            if name not in CAMERA_MODELS:
                self._refuse("a camera model out of " + ", ".join(CAMERA_MODELS), f"{name!r}, camera {camera}", "use one of them")
            size = CAMERA_MODELS[name]
            if params.shape != (size,):
                self._refuse(f"{size} parameters of {name}", f"shape {params.shape}, camera {camera}", "check the model")
            if not np.isfinite(params).all():
                self._refuse(f"finite parameters of {name}", f"{params.tolist()}, camera {camera}", "check the model")

    def _check_values(self) -> None:
        for name, what, values, names in (
            ("pose", "image", self.T_camera_world, self.image_ids),
            ("position", "point", self.points, self.point_ids),
            ("pixel", "observation", self.pixels, np.arange(len(self.pixels))),
        ):
            bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
            if bad.size:
                self._refuse(f"a finite {name}", f"{values[bad[0]].tolist()}, {what} {names[bad[0]]}", f"remove the {what}")
        with np.errstate(over="ignore"):
            length = np.linalg.norm(self.T_camera_world[:, :4], axis=1)
        bad = np.flatnonzero(np.abs(length - 1.0) > QUATERNION_TOLERANCE)
        if bad.size:
            got = f"length {length[bad[0]]:.6g}, image {self.image_ids[bad[0]]}"
            self._refuse("a unit quaternion in each pose", got, "check the order of the columns")
        off = np.abs(length - 1.0) > _UNIT  # a unit quaternion keeps its digits
        poses = self.T_camera_world.copy()
        poses[off, :4] /= length[off, None]
        object.__setattr__(self, "T_camera_world", poses)

    def _refuse(self, expected: str, got: str, advice: str) -> None:
        raise InputError(expected, f"{got} ({self.source})", advice)

    def observation_starts(self) -> NDArray[np.int64]:
        """(m + 1,) int64: the observations of image i are those from `starts[i]` to `starts[i + 1]`."""
        return np.searchsorted(self.image_of, np.arange(len(self.image_ids) + 1)).astype(np.int64)

    def tracks(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The observations of each point, as COLMAP's point files list them.

        Returns:
            (n + 1,) int64 and (t,) int64: the observations of point j are `track[starts[j]:starts[j + 1]]`.
        """
        order = np.argsort(self.point_of, kind="stable")
        starts = np.searchsorted(self.point_of, np.arange(len(self.point_ids) + 1), sorter=order)
        track = order[starts[0] :]
        return (starts - starts[0]).astype(np.int64), track.astype(np.int64)
