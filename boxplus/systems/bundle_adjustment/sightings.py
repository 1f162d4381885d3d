"""Reconstructions of all formats seen alike: cameras that look along +z, lenses, and who saw which point where."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.distortion import Radial, RadialTangential
from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import InputError
from boxplus.formats.reconstructions.bal import BalProblem
from boxplus.formats.reconstructions.colmap_model import ColmapModel
from boxplus.formats.reconstructions.gbp import GbpProblem
from boxplus.formats.reconstructions.reconstruction import Reconstruction
from boxplus.manifolds import quaternion, so3

# Which of COLMAP's parameters stands where in `Pinhole.parameters`; −1: a coefficient that is zero.
COLMAP_LAYOUT = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2),
    "PINHOLE": (0, 1, 2, 3),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3, -1),
    "RADIAL": (0, 0, 1, 2, 3, 4),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
}
_NAMED = 8  # before the rest is counted
_HALF_TURN = np.array([1.0, -1.0, -1.0])  # about x: between a camera that looks along −z and one that looks along +z


@dataclass(frozen=True, slots=True)
class Sightings:
    """Who sees what.

    Attributes:
        reconstruction: where this comes from.
        R_camera_world: (m, 3, 3), z forward.
        t: (m, 3) of T_camera_world.
        points: (n, 3) p_world.
        camera_of, point_of: (k,) the camera and the point of each observation; of COLMAP's only those that belong to a point.
        pixels: (k, 2) [px], y downwards.
        lens_of: (m,) which of the reconstruction's lenses each camera has.
    """

    reconstruction: Reconstruction
    R_camera_world: NDArray[np.float64]
    t: NDArray[np.float64]
    points: NDArray[np.float64]
    camera_of: NDArray[np.int64]
    point_of: NDArray[np.int64]
    pixels: NDArray[np.float64]
    lens_of: NDArray[np.int64]

    @classmethod
    def of(cls, reconstruction: Reconstruction) -> Sightings:
        """Of a reconstruction of any format."""
        if isinstance(reconstruction, BalProblem):
            R = so3.exp(reconstruction.cameras[:, :3]) * _HALF_TURN[:, None]
            t = reconstruction.cameras[:, 3:6] * _HALF_TURN
            pixels = reconstruction.pixels * [1.0, -1.0]
            of = reconstruction.camera_of, reconstruction.point_of
            return cls(reconstruction, R, t, reconstruction.points, *of, pixels, np.arange(len(t)))
        T = reconstruction.T_camera_world
        R, t = quaternion.to_matrix(np.ascontiguousarray(T[:, :4])), T[:, 4:]
        if isinstance(reconstruction, GbpProblem):
            of = reconstruction.camera_of, reconstruction.point_of
            one = np.zeros(len(t), dtype=np.int64)
            return cls(reconstruction, R, t, reconstruction.points, *of, reconstruction.pixels, one)
        used = reconstruction.point_of >= 0
        of = reconstruction.image_of[used], reconstruction.point_of[used]
        return cls(reconstruction, R, t, reconstruction.points, *of, reconstruction.pixels[used], reconstruction.camera_of)

    @property
    def centers(self) -> NDArray[np.float64]:
        """(m, 3) where the cameras are in the world."""
        return np.asarray(-np.einsum("nji,nj->ni", self.R_camera_world, self.t))

    @property
    def focal_length(self) -> float:
        """Of the first camera [px]."""
        return self._lens(int(self.lens_of[0])).fx

    def depths(self) -> NDArray[np.float64]:
        """(k,) z of every observed point in its camera; behind it where not positive."""
        forward = self.R_camera_world[self.camera_of, 2]
        return np.asarray(np.einsum("ni,ni->n", forward, self.points[self.point_of]) + self.t[self.camera_of, 2])

    def bearings(self, rows: NDArray[np.intp]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Directions (r, 3) in the cameras' frames, z = 1, of chosen observations, and which the lens does reach."""
        rays, found = np.full((len(rows), 3), np.nan), np.zeros(len(rows), dtype=np.bool_)
        lens_of = self.lens_of[self.camera_of[rows]]
        for lens in np.unique(lens_of):
            own = np.flatnonzero(lens_of == lens)
            rays[own], found[own] = self._lens(int(lens)).unproject(self.pixels[rows[own]])
        return rays, found

    def errors(self, rows: NDArray[np.intp], p_world: NDArray[np.float64], *, mirrored: bool = False) -> NDArray[np.float64]:
        """(r,) distance of chosen observations from the projections of points (r, 3) [px].

        NaN behind a camera, unless those points are to be mirrored at its centre: the same line, as if it were a ray.
        """
        off = self.projections(rows, p_world, mirrored=mirrored) - self.pixels[rows]
        return np.asarray(np.linalg.norm(off, axis=1))

    def projections(self, rows: NDArray[np.intp], p_world: NDArray[np.float64], *, mirrored: bool = False) -> NDArray[np.float64]:
        """(r, 2) where the cameras of chosen observations have points (r, 3) [px]; NaN as in `errors`."""
        camera = self.camera_of[rows]
        p_camera = np.einsum("nij,nj->ni", self.R_camera_world[camera], p_world) + self.t[camera]
        if mirrored:
            p_camera *= np.sign(p_camera[:, 2:])
        pixels = np.full((len(rows), 2), np.nan)
        lens_of = self.lens_of[camera]
        for lens in np.unique(lens_of):
            own = np.flatnonzero(lens_of == lens)
            pixels[own] = self._lens(int(lens)).project(p_camera[own])[0]
        return pixels

    def _lens(self, number: int) -> Pinhole:
        own = self.reconstruction
        if isinstance(own, BalProblem):
            f, k1, k2 = (float(v) for v in own.cameras[number, 6:])
            return Pinhole(f, f, 0.0, 0.0, Radial(k1, k2), 0.0)
        return gbp_pinhole(own) if isinstance(own, GbpProblem) else colmap_pinhole(own, number)


def gbp_pinhole(gbp: GbpProblem) -> Pinhole:
    """The one camera of such a file."""
    fx, fy, cx, cy = (float(v) for v in gbp.intrinsics)
    return Pinhole(fx, fy, cx, cy, z_min=0.0)


def colmap_layout(model: ColmapModel, number: int) -> NDArray[np.float64]:
    """(n, m) matrix that turns COLMAP's parameters of a camera into those of `Pinhole`.

    Raises:
        InputError: a camera model that `Pinhole` does not have.
    """
    name = model.camera_models[number]
    if name not in COLMAP_LAYOUT:
        raise InputError(
            f"a camera of model {', '.join(COLMAP_LAYOUT)}",
            f"{name}, camera {model.camera_ids[number]} ({model.source})",
            "undistort the images, or convert the camera",
        )
    layout = np.zeros((len(COLMAP_LAYOUT[name]), len(model.camera_params[number])))
    for row, column in enumerate(COLMAP_LAYOUT[name]):
        if column >= 0:
            layout[row, column] = 1.0
    return layout


def colmap_pinhole(model: ColmapModel, number: int) -> Pinhole:
    """The camera, in pixels of COLMAP: its centres at half pixels only shift cx and cy.

    The scale of a model is arbitrary: only what lies behind a camera is behind it.
    """
    c = [float(value) for value in colmap_layout(model, number) @ model.camera_params[number]]
    distortion = None if len(c) == 4 else Radial(c[4], c[5]) if len(c) == 6 else RadialTangential(c[4], c[5], c[6], c[7])
    return Pinhole(c[0], c[1], c[2], c[3], distortion, 0.0)


def names_text(numbers: NDArray[np.int64], ids: NDArray[np.int64] | None) -> str:
    """`3, 17, 40 and 12 more`, by the file's names where it has some."""
    named = numbers if ids is None else ids[numbers]
    rest = f" and {len(named) - _NAMED} more" if len(named) > _NAMED else ""
    return ", ".join(str(int(k)) for k in named[:_NAMED]) + rest
