"""Reprojection error of a point in a camera whose intrinsics are a variable too.

Derivation: docs/residuals/reprojection.md and docs/cameras.md.
Residual [px], with X' = T_camera_world p_world and c = [fx, fy, cx, cy, then k1, k2, p1, p2, k3 as far as the model goes]:

    e = pixel − π(X'; c)

Jacobians: those of `reprojection` by pose and point, and with the distorted normalised point (ũ, ṽ)

    ∂e/∂[fx, fy, cx, cy] = −[[ũ, 0, 1, 0], [0, ṽ, 0, 1]]

and −∂π/∂k likewise, as `boxplus.cameras.projection.intrinsics_jacobian_any` writes them out, for cameras of wide angle too.

Singular: as `reprojection`.

Source: docs/cameras.md and docs/residuals/reprojection.md.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.cameras.model import CameraModel
from boxplus.cameras.projection import intrinsics_jacobian_any, project_any
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.quaternion import rotation_entries
from boxplus.manifolds.se3 import SE3Left
from boxplus.residuals.camera.image_residual import PixelResidual
from boxplus.residuals.camera.reprojection import check_pixels, write_pose_point
from boxplus.residuals.residual import Array, Arrays, Mask, Rows
from boxplus.residuals.whitening import Whitening


@kernel
def _reprojection_intrinsics(
    begin: int,
    end: int,
    poses: NDArray[np.float64],
    pose_of: NDArray[np.uint32],
    points: NDArray[np.float64],
    point_of: NDArray[np.uint32],
    intrinsics: NDArray[np.float64],
    intrinsics_of: NDArray[np.uint32],
    pixels: NDArray[np.float64],
    code: int,
    nearest: float,
    r: NDArray[np.float64],
    J_pose: NDArray[np.float64],
    J_point: NDArray[np.float64],
    J_intrinsics: NDArray[np.float64],
    valid: NDArray[np.bool_],
    with_jacobians: bool,
) -> None:
    count = intrinsics.shape[1]
    for n in range(np.uint64(begin), np.uint64(end)):
        i, j, c = pose_of[n], point_of[n], intrinsics_of[n]
        R = rotation_entries(poses[i, 0], poses[i, 1], poses[i, 2], poses[i, 3])
        px, py, pz = points[j, 0], points[j, 1], points[j, 2]
        x = R[0] * px + R[1] * py + R[2] * pz + poses[i, 4]
        y = R[3] * px + R[4] * py + R[5] * pz + poses[i, 5]
        z = R[6] * px + R[7] * py + R[8] * pz + poses[i, 6]
        c4 = intrinsics[c, 4] if count > 4 else 0.0
        c5 = intrinsics[c, 5] if count > 4 else 0.0
        c6 = intrinsics[c, 6] if count > 6 else 0.0
        c7 = intrinsics[c, 7] if count > 6 else 0.0
        c8 = intrinsics[c, 8] if count > 8 else 0.0
        c0, c1, c2, c3 = intrinsics[c, 0], intrinsics[c, 1], intrinsics[c, 2], intrinsics[c, 3]
        # A NaN passes on into the residual, where it is seen and named.
        seen, u, v, p00, p01, p02, p10, p11, p12 = project_any(
            code, with_jacobians, x, y, z, nearest, c0, c1, c2, c3, c4, c5, c6, c7, c8
        )
        valid[n] = seen
        if not seen:
            r[n, 0] = 0.0
            r[n, 1] = 0.0
            if with_jacobians:
                J_pose[n] = 0.0
                J_point[n] = 0.0
                J_intrinsics[n] = 0.0
            continue
        r[n, 0] = pixels[n, 0] - u
        r[n, 1] = pixels[n, 1] - v
        if with_jacobians:
            write_pose_point(n, x, y, z, (p00, p01, p02, p10, p11, p12), R, J_pose, J_point)
            intrinsics_jacobian_any(code, x, y, z, c0, c1, c2, c3, c4, c5, c6, c7, c8, -1.0, J_intrinsics[n])


class ReprojectionIntrinsics(PixelResidual):
    """Points seen in a camera that is calibrated along: pixel − π(T_camera_world p_world; intrinsics), as derived above.

    Variables: `T_camera_world` on `SE3Left` (7,), `p_world` on `Euclidean(3)` [m], `intrinsics` on `Euclidean(4)`, 6, 8
    or 9, laid out as `camera.parameters`.

    Args:
        camera: its model and `nearest` (`z_min` of a pinhole) are used; its numbers, `camera.parameters`, are a start value.
        pixels: (N, 2) measured, distorted as the camera distorts [px].
        sigma, covariance, information: of a pixel measurement, as in `Whitening.of`; none of them stands for 1 px.

    Raises:
        InputError: `pixels` of another shape or not finite, or noise that `Whitening.of` refuses.

    Example:
        >>> camera = bp.Pinhole(500.0, 500.0, 320.0, 240.0)
        >>> seen = bp.residuals.ReprojectionIntrinsics(camera, [[320.0, 240.0]])
        >>> np.abs(seen.evaluate(bp.SE3Left.identity(), [0.0, 0.0, 4.0], [500.0, 500.0, 322.0, 240.0]))
        array([[2., 0.]])
    """

    no_jacobians = (np.zeros((0, 2, 6)), np.zeros((0, 2, 3)), np.zeros((0, 2, 4)))

    def __init__(
        self,
        camera: CameraModel,
        pixels: ArrayLike,
        *,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        information: ArrayLike | None = None,
    ) -> None:
        self.code, self.nearest, self.pixels = camera.code, camera.nearest, check_pixels("pixels", pixels)
        count = len(self.pixels)
        super().__init__(
            dim=2,
            count=count,
            manifolds=(SE3Left, Euclidean(3), Euclidean(len(camera.parameters))),
            roles=("T_camera_world", "p_world", "intrinsics"),
            whitening=Whitening.of(2, count, sigma=sigma, covariance=covariance, information=information),
        )

    def _run(
        self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask, with_jacobians: bool
    ) -> None:
        _reprojection_intrinsics(
            begin, end, x[0], index[0], x[1], index[1], x[2], index[2], self.pixels, self.code,
            self.nearest, r, jacobians[0], jacobians[1], jacobians[2], valid, with_jacobians,
        )  # fmt: skip
