"""Reprojection error through a warp, with the intrinsics as a variable: a pixel at an inverse depth seen again.

Derivation: docs/residuals/photometric.md.
Both views share c = [fx, fy, cx, cy], no distortion. The point is one variable, [u₁, v₁, ρ]: its pixel in the anchor and one over
its depth there. With m = [(u₁ − cx)/fx, (v₁ − cy)/fy, 1], T = T_observer_world T_anchor_world⁻¹ = (R, t) and Y = R m + ρ t, the
residual is [px]

    e = pixel − [fx Y_x/Y_z + cx, fy Y_y/Y_z + cy]

The anchor's own measurement is the same residual with the anchor as its observer, pixel − [u₁, v₁]; see `inverse_depth`.

Jacobians: those of `inverse_depth` by both poses and ρ, and with ũ = Y_x/Y_z, ṽ = Y_y/Y_z, κ = 1/Y_z

    ∂e/∂[u₁, v₁] = −P [r₁/fx  r₂/fy]    P = ∂pixel/∂Y, r₁ and r₂ columns of R
    ∂e/∂fx = −[ũ + κ (r₃₁ ũ − r₁₁) m₁,  κ fy/fx (r₃₁ ṽ − r₂₁) m₁]
    ∂e/∂fy = −[κ fx/fy (r₃₂ ũ − r₁₂) m₂,  ṽ + κ (r₃₂ ṽ − r₂₂) m₂]
    ∂e/∂cx = −[1 + κ (r₃₁ ũ − r₁₁),  κ fy/fx (r₃₁ ṽ − r₂₁)]
    ∂e/∂cy = −[κ fx/fy (r₃₂ ũ − r₁₂),  1 + κ (r₃₂ ṽ − r₂₂)]

Singular: as `inverse_depth`; and fx or fy that is not positive is invalid.

Source: docs/residuals/photometric.md and docs/residuals/inverse_depth.md.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.se3 import SE3Left
from boxplus.residuals.camera.image_residual import PixelResidual
from boxplus.residuals.camera.inverse_depth import RHO_MIN, relative_pose, write_anchor_observer_point
from boxplus.residuals.camera.reprojection import check_pixels
from boxplus.residuals.residual import Array, Arrays, Mask, Rows
from boxplus.residuals.whitening import Whitening


@kernel
def _inverse_depth_intrinsics(
    begin: int,
    end: int,
    anchors: NDArray[np.float64],
    anchor_of: NDArray[np.uint32],
    observers: NDArray[np.float64],
    observer_of: NDArray[np.uint32],
    points: NDArray[np.float64],
    point_of: NDArray[np.uint32],
    intrinsics: NDArray[np.float64],
    intrinsics_of: NDArray[np.uint32],
    pixels: NDArray[np.float64],
    z_min: float,
    r: NDArray[np.float64],
    J_anchor: NDArray[np.float64],
    J_observer: NDArray[np.float64],
    J_point: NDArray[np.float64],
    J_intrinsics: NDArray[np.float64],
    valid: NDArray[np.bool_],
    with_jacobians: bool,
) -> None:
    for n in range(np.uint64(begin), np.uint64(end)):
        R, tx, ty, tz = relative_pose(anchors, anchor_of[n], observers, observer_of[n])
        p = point_of[n]
        rho = points[p, 2]
        if rho < RHO_MIN:
            rho = 0.0
        k = intrinsics_of[n]
        fx, fy, cx, cy = intrinsics[k, 0], intrinsics[k, 1], intrinsics[k, 2], intrinsics[k, 3]
        m1, m2 = (points[p, 0] - cx) / fx, (points[p, 1] - cy) / fy
        x = R[0] * m1 + R[1] * m2 + R[2] + rho * tx
        y = R[3] * m1 + R[4] * m2 + R[5] + rho * ty
        z = R[6] * m1 + R[7] * m2 + R[8] + rho * tz
        # Written so that a NaN passes on into the residual, where it is seen and named.
        invalid = z <= z_min * rho or fx <= 0.0 or fy <= 0.0
        valid[n] = not invalid
        if invalid:
            r[n, 0] = 0.0
            r[n, 1] = 0.0
            if with_jacobians:
                J_anchor[n] = 0.0
                J_observer[n] = 0.0
                J_point[n] = 0.0
                J_intrinsics[n] = 0.0
            continue
        kappa = 1.0 / z
        u, v = x * kappa, y * kappa
        r[n, 0] = pixels[n, 0] - (fx * u + cx)
        r[n, 1] = pixels[n, 1] - (fy * v + cy)
        if not with_jacobians:
            continue
        sx, sy = fx * kappa, fy * kappa
        P = (sx, 0.0, -sx * u, 0.0, sy, -sy * v)
        write_anchor_observer_point(
            n, (m1, m2, 1.0), (x, y, z), rho, R, (tx, ty, tz), P, 1.0 / fx, 1.0 / fy, J_anchor, J_observer, J_point
        )
        a11, a12 = kappa * (R[6] * u - R[0]), kappa * fx / fy * (R[7] * u - R[1])
        a21, a22 = kappa * fy / fx * (R[6] * v - R[3]), kappa * (R[7] * v - R[4])
        J_intrinsics[n, 0, 0] = -u - a11 * m1
        J_intrinsics[n, 0, 1] = -a12 * m2
        J_intrinsics[n, 0, 2] = -1.0 - a11
        J_intrinsics[n, 0, 3] = -a12
        J_intrinsics[n, 1, 0] = -a21 * m1
        J_intrinsics[n, 1, 1] = -v - a22 * m2
        J_intrinsics[n, 1, 2] = -a21
        J_intrinsics[n, 1, 3] = -1.0 - a22


class InverseDepthIntrinsics(PixelResidual):
    """As `InverseDepthReprojection`, with the pinhole intrinsics of both views as a variable, as derived above.

    Variables: `T_anchor_world` and `T_observer_world` on `SE3Left` (7,); `pixel_rho` on `Euclidean(3)`, the point's pixel in the
    anchor, undistorted, and one over its depth there [px, px, 1/m]; `intrinsics` on `Euclidean(4)` = [fx, fy, cx, cy] [px].

    Every point wants the measured pixel in its anchor as well, as an observation in which both poses are the anchor's.

    Args:
        pixels: (N, 2) where the observer sees the points, undistorted [px].
        z_min: depth in the observer up to which a residual is invalid [m].
        sigma, covariance, information: of a pixel measurement, as in `Whitening.of`; none of them stands for 1 px.

    Raises:
        InputError: pixels of another shape or not finite, `z_min` negative or not finite, or noise that `Whitening.of`
            refuses.

    Example:
        >>> seen = bp.residuals.InverseDepthIntrinsics([[330.0, 240.0]])
        >>> anchor, observer = bp.SE3Left.identity(), [1.0, 0, 0, 0, 0.04, 0, 0]
        >>> seen.evaluate(anchor, observer, [320.0, 240.0, 0.5], [500.0, 500.0, 320.0, 240.0])
        array([[0., 0.]])
    """

    no_jacobians = (np.zeros((0, 2, 6)), np.zeros((0, 2, 6)), np.zeros((0, 2, 3)), np.zeros((0, 2, 4)))

    def __init__(
        self,
        pixels: ArrayLike,
        *,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        information: ArrayLike | None = None,
        z_min: float = 0.05,
    ) -> None:
        if not (math.isfinite(z_min) and z_min >= 0.0):
            raise InputError("z_min finite and not negative [m]", f"{z_min}", "leave it out for 0.05 m")
        self.pixels, self.z_min = check_pixels("pixels", pixels), float(z_min)
        count = len(self.pixels)
        super().__init__(
            dim=2,
            count=count,
            manifolds=(SE3Left, SE3Left, Euclidean(3), Euclidean(4)),
            roles=("T_anchor_world", "T_observer_world", "pixel_rho", "intrinsics"),
            whitening=Whitening.of(2, count, sigma=sigma, covariance=covariance, information=information),
        )

    def _run(
        self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask, with_jacobians: bool
    ) -> None:
        _inverse_depth_intrinsics(
            begin, end, x[0], index[0], x[1], index[1], x[2], index[2], x[3], index[3], self.pixels, self.z_min,
            r, jacobians[0], jacobians[1], jacobians[2], jacobians[3], valid, with_jacobians,
        )  # fmt: skip
