"""Reprojection error of the camera of "Bundle Adjustment in the Large" (Agarwal et al., ECCV 2010).

The camera looks along −z and is one variable of nine degrees of freedom, its pose with f, k1, k2. With
P = R p_world + t in the camera frame, p = −P / P_z and s = 1 + k1 |p|² + k2 |p|⁴, the residual is [px]

    e = pixel − f s p

Jacobians, with Π = ∂(f s p)/∂P, which is the P of docs/cameras.md for this camera:

    ∂e/∂[w, v]      = −Π [−[P]× I]              T_camera_world on the left, T ← Exp([w, v]) T
    ∂e/∂[f, k1, k2] = −[s p, f |p|² p, f |p|⁴ p]
    ∂e/∂p_world     = −Π R

Singular: |P_z| ≤ z_min (|P_x| + |P_y|), a point in the plane of the camera, is invalid. The scale of these problems is arbitrary,
so that z_min is a share. Their files hold points behind cameras, which the model projects all the same, mirrored; the sign of P_z
is not asked for here. `adjust_bundle` does ask, counts them and repairs them.

Source: docs/cameras.md and docs/residuals/reprojection.md; https://grail.cs.washington.edu/projects/bal.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import rotation_entries
from boxplus.manifolds.se3 import SE3Left
from boxplus.residuals.camera.reprojection import check_pixels
from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows
from boxplus.residuals.whitening import Whitening


class _BalCamera(Product):
    """`Product(SE3Left, Euclidean(3))`, and equal to it, with names for f, k1 and k2.

    Example:
        >>> camera = bp.residuals.BalCamera
        >>> camera.size, camera.dof, camera.tangent_names[-3:]
        (10, 9, ('focal length [px]', 'k1', 'k2'))
    """

    def __init__(self) -> None:
        super().__init__(SE3Left, Euclidean(3))
        self.name = "BalCamera"
        self.tangent_names = (*SE3Left.tangent_names, "focal length [px]", "k1", "k2")


BalCamera = _BalCamera()  # (10,) wxyz, xyz of T_camera_world, then f [px], k1, k2
_NO_JACOBIANS = (np.zeros((0, 2, 9)), np.zeros((0, 2, 3)))


@kernel
def _bal_reprojection(
    begin: int,
    end: int,
    cameras: NDArray[np.float64],
    camera_of: NDArray[np.uint32],
    points: NDArray[np.float64],
    point_of: NDArray[np.uint32],
    pixels: NDArray[np.float64],
    z_min: float,
    r: NDArray[np.float64],
    J_camera: NDArray[np.float64],
    J_point: NDArray[np.float64],
    valid: NDArray[np.bool_],
    with_jacobians: bool,
) -> None:
    for n in range(np.uint64(begin), np.uint64(end)):
        i, j = camera_of[n], point_of[n]
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_entries(cameras[i, 0], cameras[i, 1], cameras[i, 2], cameras[i, 3])
        px, py, pz = points[j, 0], points[j, 1], points[j, 2]
        x = r00 * px + r01 * py + r02 * pz + cameras[i, 4]
        y = r10 * px + r11 * py + r12 * pz + cameras[i, 5]
        z = r20 * px + r21 * py + r22 * pz + cameras[i, 6]
        # Written so that a NaN passes on into the residual, where it is seen and named.
        in_plane = abs(z) <= z_min * (abs(x) + abs(y))
        valid[n] = not in_plane
        if in_plane:
            r[n, 0] = 0.0
            r[n, 1] = 0.0
            if with_jacobians:
                J_camera[n] = 0.0
                J_point[n] = 0.0
            continue
        f, k1, k2 = cameras[i, 7], cameras[i, 8], cameras[i, 9]
        w = -1.0 / z
        a, b = x * w, y * w
        r2 = a * a + b * b
        s = 1.0 + r2 * (k1 + r2 * k2)
        r[n, 0] = pixels[n, 0] - f * s * a
        r[n, 1] = pixels[n, 1] - f * s * b
        if with_jacobians:
            fw = f * w
            slope = 2.0 * (k1 + 2.0 * r2 * k2)
            p00, p01, p11 = fw * (s + slope * a * a), fw * (slope * a * b), fw * (s + slope * b * b)
            p02, p12 = p00 * a + p01 * b, p01 * a + p11 * b
            fr2 = f * r2
            J_camera[n, 0, 0] = p01 * z - p02 * y
            J_camera[n, 0, 1] = p02 * x - p00 * z
            J_camera[n, 0, 2] = p00 * y - p01 * x
            J_camera[n, 0, 3] = -p00
            J_camera[n, 0, 4] = -p01
            J_camera[n, 0, 5] = -p02
            J_camera[n, 0, 6] = -s * a
            J_camera[n, 0, 7] = -fr2 * a
            J_camera[n, 0, 8] = -fr2 * r2 * a
            J_camera[n, 1, 0] = p11 * z - p12 * y
            J_camera[n, 1, 1] = p12 * x - p01 * z
            J_camera[n, 1, 2] = p01 * y - p11 * x
            J_camera[n, 1, 3] = -p01
            J_camera[n, 1, 4] = -p11
            J_camera[n, 1, 5] = -p12
            J_camera[n, 1, 6] = -s * b
            J_camera[n, 1, 7] = -fr2 * b
            J_camera[n, 1, 8] = -fr2 * r2 * b
            J_point[n, 0, 0] = -(p00 * r00 + p01 * r10 + p02 * r20)
            J_point[n, 0, 1] = -(p00 * r01 + p01 * r11 + p02 * r21)
            J_point[n, 0, 2] = -(p00 * r02 + p01 * r12 + p02 * r22)
            J_point[n, 1, 0] = -(p01 * r00 + p11 * r10 + p12 * r20)
            J_point[n, 1, 1] = -(p01 * r01 + p11 * r11 + p12 * r21)
            J_point[n, 1, 2] = -(p01 * r02 + p11 * r12 + p12 * r22)


class BalReprojection(Residual):
    """Points seen in cameras of Bundle Adjustment in the Large: pixel − f s p, as derived in the head of this file.

    Variables: `camera` on `BalCamera` = `Product(SE3Left, Euclidean(3))` (10,), wxyz and xyz of T_camera_world, then f [px],
    k1, k2; `p_world` on `Euclidean(3)`.

    Args:
        pixels: (N, 2) measured, relative to the principal point, u to the right and v upwards [px].
        sigma, covariance, information: of a pixel measurement, as in `Whitening.of`; none of them stands for 1 px.
        z_min: |depth| up to which a residual is invalid, as a share of |P_x| + |P_y|.

    Raises:
        InputError: `pixels` of another shape or not finite, `z_min` negative or not finite, or noise that `Whitening.of`
            refuses.

    Example:
        >>> seen = bp.residuals.BalReprojection([[0.0, 50.0]])
        >>> camera = [1.0, 0, 0, 0, 0, 0, 0, 500.0, 0, 0]  # wxyz, t, f, k1, k2; it looks along -z
        >>> seen.evaluate(camera, [0.0, 0.4, -4.0])
        array([[0., 0.]])
    """

    def __init__(
        self,
        pixels: ArrayLike,
        *,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        information: ArrayLike | None = None,
        z_min: float = 1e-9,
    ) -> None:
        if not (math.isfinite(z_min) and z_min >= 0.0):
            raise InputError("z_min finite and not negative", f"{z_min}", "leave it out for 1e-9")
        self.pixels, self.z_min = check_pixels("pixels", pixels), float(z_min)
        count = len(self.pixels)
        super().__init__(
            dim=2,
            count=count,
            manifolds=(BalCamera, Euclidean(3)),
            roles=("camera", "p_world"),
            whitening=Whitening.of(2, count, sigma=sigma, covariance=covariance, information=information),
        )

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        """See `Residual.linearize_into`."""
        _bal_reprojection(
            begin, end, x[0], index[0], x[1], index[1], self.pixels, self.z_min, r, jacobians[0], jacobians[1], valid, True
        )

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        """See `Residual.evaluate_into`."""
        _bal_reprojection(begin, end, x[0], index[0], x[1], index[1], self.pixels, self.z_min, r, *_NO_JACOBIANS, valid, False)
