"""Reprojection error of a point in a calibrated camera (docs/residuals/reprojection.md).

Residual [px], with X' = T_camera_world p_world and the projection π of the camera, its distortion included:

    e = pixel − π(X')

Jacobians, with P = ∂π/∂X' and R = R_camera_world:

    ∂e/∂[w, v] = −P [−[X']× I]   T_camera_world on the left, T ← Exp([w, v]) T
    ∂e/∂p_world = −P R

Singular: a depth X'_z ≤ z_min of the camera (0.05 m) is invalid and never projected; in a camera of wide angle, a distance up
to `nearest` and a direction in which its formula does not hold.

Source: docs/cameras.md and docs/residuals/reprojection.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._arguments import require
from boxplus._jit import kernel
from boxplus._numbers import as_floats
from boxplus.cameras.model import CAMERA_MODELS, CameraModel
from boxplus.cameras.projection import project_any
from boxplus.errors import InputError
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.quaternion import rotation_entries
from boxplus.manifolds.se3 import SE3Left
from boxplus.residuals.camera.image_residual import PixelResidual
from boxplus.residuals.residual import Array, Arrays, Mask, Rows
from boxplus.residuals.whitening import Whitening


@kernel(inline=True)
def write_pose_point(
    n: np.uint64,
    x: float,
    y: float,
    z: float,
    P: tuple[float, float, float, float, float, float],
    R: tuple[float, float, float, float, float, float, float, float, float],
    J_pose: NDArray[np.float64],
    J_point: NDArray[np.float64],
) -> None:
    """−P [−[X']× I] and −P R for the rows of residual n, at X' = (x, y, z); P and R row by row."""
    p00, p01, p02, p10, p11, p12 = P
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = R
    J_pose[n, 0, 0] = p01 * z - p02 * y
    J_pose[n, 0, 1] = p02 * x - p00 * z
    J_pose[n, 0, 2] = p00 * y - p01 * x
    J_pose[n, 0, 3] = -p00
    J_pose[n, 0, 4] = -p01
    J_pose[n, 0, 5] = -p02
    J_pose[n, 1, 0] = p11 * z - p12 * y
    J_pose[n, 1, 1] = p12 * x - p10 * z
    J_pose[n, 1, 2] = p10 * y - p11 * x
    J_pose[n, 1, 3] = -p10
    J_pose[n, 1, 4] = -p11
    J_pose[n, 1, 5] = -p12
    J_point[n, 0, 0] = -(p00 * r00 + p01 * r10 + p02 * r20)
    J_point[n, 0, 1] = -(p00 * r01 + p01 * r11 + p02 * r21)
    J_point[n, 0, 2] = -(p00 * r02 + p01 * r12 + p02 * r22)
    J_point[n, 1, 0] = -(p10 * r00 + p11 * r10 + p12 * r20)
    J_point[n, 1, 1] = -(p10 * r01 + p11 * r11 + p12 * r21)
    J_point[n, 1, 2] = -(p10 * r02 + p11 * r12 + p12 * r22)


@kernel
def _reprojection(
    begin: int,
    end: int,
    poses: NDArray[np.float64],
    pose_of: NDArray[np.uint32],
    points: NDArray[np.float64],
    point_of: NDArray[np.uint32],
    pixels: NDArray[np.float64],
    code: int,
    c: NDArray[np.float64],
    nearest: float,
    r: NDArray[np.float64],
    J_pose: NDArray[np.float64],
    J_point: NDArray[np.float64],
    valid: NDArray[np.bool_],
    with_jacobians: bool,
) -> None:
    for n in range(np.uint64(begin), np.uint64(end)):
        i, j = pose_of[n], point_of[n]
        R = rotation_entries(poses[i, 0], poses[i, 1], poses[i, 2], poses[i, 3])
        px, py, pz = points[j, 0], points[j, 1], points[j, 2]
        x = R[0] * px + R[1] * py + R[2] * pz + poses[i, 4]
        y = R[3] * px + R[4] * py + R[5] * pz + poses[i, 5]
        z = R[6] * px + R[7] * py + R[8] * pz + poses[i, 6]
        # A NaN passes on into the residual, where it is seen and named.
        seen, u, v, p00, p01, p02, p10, p11, p12 = project_any(
            code, with_jacobians, x, y, z, nearest, c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8]
        )
        valid[n] = seen
        if not seen:
            r[n, 0] = 0.0
            r[n, 1] = 0.0
            if with_jacobians:
                J_pose[n] = 0.0
                J_point[n] = 0.0
            continue
        r[n, 0] = pixels[n, 0] - u
        r[n, 1] = pixels[n, 1] - v
        if with_jacobians:
            write_pose_point(n, x, y, z, (p00, p01, p02, p10, p11, p12), R, J_pose, J_point)


def check_pixels(name: str, pixels: ArrayLike, columns: int = 2) -> NDArray[np.float64]:
    """Measured image coordinates as a new (N, columns) array.

    Raises:
        InputError: another shape, or not finite; the message names the first row concerned.
    """
    array = np.array(as_floats(pixels, "pixels"), order="C")
    if array.ndim != 2 or array.shape[1] != columns:
        raise InputError(f"{name} of shape (N, {columns}) [px]", f"shape {array.shape}", "give one row for each observation")
    finite = np.isfinite(array)
    if not finite.all():
        row = int(np.argmin(finite.all(axis=1)))
        raise InputError(f"{name} finite [px]", f"NaN or infinity in row {row}", "leave out what was not observed")
    return array


class Reprojection(PixelResidual):
    """Points seen in a calibrated camera: pixel − π(T_camera_world p_world), as derived in the head of this file.

    Variables: `T_camera_world` on `SE3Left` (7,), `p_world` on `Euclidean(3)` [m].

    Args:
        camera: the camera that saw all of them.
        pixels: (N, 2) measured, distorted as the camera distorts [px].
        sigma, covariance, information: of a pixel measurement, as in `Whitening.of`; none of them stands for 1 px.

    Raises:
        InputError: `pixels` of another shape or not finite, or noise that `Whitening.of` refuses.

    Example:
        >>> camera = bp.Pinhole(500.0, 500.0, 320.0, 240.0)
        >>> seen = bp.residuals.Reprojection(camera, [[320.0, 241.0]], sigma=1.0)
        >>> np.abs(seen.evaluate(bp.SE3Left.identity(), [0.0, 0.0, 4.0]))
        array([[0., 1.]])
    """

    no_jacobians = (np.zeros((0, 2, 6)), np.zeros((0, 2, 3)))

    def __init__(
        self,
        camera: CameraModel,
        pixels: ArrayLike,
        *,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        information: ArrayLike | None = None,
    ) -> None:
        require(camera, CAMERA_MODELS, "a camera", "give boxplus.Pinhole, Equidistant or DoubleSphere")
        self.camera, self.pixels = camera, check_pixels("pixels", pixels)
        count = len(self.pixels)
        super().__init__(
            dim=2,
            count=count,
            manifolds=(SE3Left, Euclidean(3)),
            roles=("T_camera_world", "p_world"),
            whitening=Whitening.of(2, count, sigma=sigma, covariance=covariance, information=information),
        )
        self._parameters = camera.padded_parameters

    def _run(
        self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask, with_jacobians: bool
    ) -> None:
        _reprojection(
            begin, end, x[0], index[0], x[1], index[1], self.pixels, self.camera.code,
            self._parameters, self.camera.nearest, r, jacobians[0], jacobians[1], valid, with_jacobians,
        )  # fmt: skip
