"""Reprojection error of a point given by its bearing and inverse depth in an anchor camera (docs/residuals/inverse_depth.md).

The point is one variable, b = [x, y, ρ] = [X/Z, Y/Z, 1/Z] in the anchor. Residual [px], with the ray m = [x, y, 1],
T = T_observer_world T_anchor_world⁻¹ = (R, t) and Y = R m + ρ t, which is the point in the observer times ρ and is projected
alike:

    e = pixel − π(Y)

The anchor's own pixel is a measurement like any other: the same residual with the anchor as its observer (R = I, t = 0), which
is pixel − π(m) and does not move with the pose. Taking m from that pixel as exact instead would count its noise nowhere: it
enters all residuals of the point alike, so that no covariance of single residuals could make up for it.

Jacobians, with P = ∂π/∂Y, both poses moved on the left, T ← Exp([w, v]) T:

    ∂e/∂[w, v] of the observer = −P [−[Y]×  ρ I]
    ∂e/∂[w, v] of the anchor   = −P [R [m]×  −ρ R]
    ∂e/∂[x, y]                 = −P [r₁ r₂]      columns of R
    ∂e/∂ρ                      = −P t            (without distortion −f (t_x − ũ t_z)/(ρ Z') etc.)

Singular: ρ < 10⁻⁶ 1/m, also negative, stands for a point at infinity: Y = R m, and ∂e/∂ρ is the limit above, so that a
solver finds its way back. No parallax (t = 0) leaves a zero derivative: unobservable. A depth up to z_min of the camera
(0.05 m) in the observer, for a point at infinity a direction that does not point forward, is invalid.

Source: docs/residuals/inverse_depth.md; Civera et al., Inverse depth parametrization for monocular SLAM, 2008.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus._numbers import as_numbers
from boxplus.cameras.model import CameraModel
from boxplus.cameras.projection import project_any
from boxplus.errors import InputError
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.quaternion import multiply_scalars, rotate, rotation_entries
from boxplus.manifolds.se3 import SE3Left
from boxplus.residuals.camera.image_residual import PixelResidual
from boxplus.residuals.camera.reprojection import check_pixels
from boxplus.residuals.residual import Array, Arrays, Mask, Rows
from boxplus.residuals.whitening import Whitening

RHO_MIN = 1e-6  # inverse depth below which a point counts as at infinity [1/m]


@kernel(inline=True)
def relative_pose(
    poses_a: NDArray[np.float64], i: np.uint32, poses_b: NDArray[np.float64], j: np.uint32
) -> tuple[tuple[float, float, float, float, float, float, float, float, float], float, float, float]:
    """R, row by row, and t of T_b_world T_a_world⁻¹."""
    aw, ax, ay, az = poses_a[i, 0], -poses_a[i, 1], -poses_a[i, 2], -poses_a[i, 3]
    qw, qx, qy, qz = multiply_scalars(poses_b[j, 0], poses_b[j, 1], poses_b[j, 2], poses_b[j, 3], aw, ax, ay, az)
    sx, sy, sz = rotate(qw, qx, qy, qz, poses_a[i, 4], poses_a[i, 5], poses_a[i, 6])
    return rotation_entries(qw, qx, qy, qz), poses_b[j, 4] - sx, poses_b[j, 5] - sy, poses_b[j, 6] - sz


@kernel(inline=True)
def write_anchor_observer_point(
    n: np.uint64,
    m: tuple[float, float, float],
    Y: tuple[float, float, float],
    rho: float,
    R: tuple[float, float, float, float, float, float, float, float, float],
    t: tuple[float, float, float],
    P: tuple[float, float, float, float, float, float],
    unit_x: float,
    unit_y: float,
    J_anchor: NDArray[np.float64],
    J_observer: NDArray[np.float64],
    J_point: NDArray[np.float64],
) -> None:
    """The rows of residual n of all three Jacobians, as in the head of this file; by x/unit_x and y/unit_y."""
    for row in range(2):
        a, b, c = (P[0], P[1], P[2]) if row == 0 else (P[3], P[4], P[5])
        # −P (w × Y) = w · (row × Y) up to sign: rows of −P times −[Y]×.
        J_observer[n, row, 0] = b * Y[2] - c * Y[1]
        J_observer[n, row, 1] = c * Y[0] - a * Y[2]
        J_observer[n, row, 2] = a * Y[1] - b * Y[0]
        J_observer[n, row, 3] = -rho * a
        J_observer[n, row, 4] = -rho * b
        J_observer[n, row, 5] = -rho * c
        g0 = a * R[0] + b * R[3] + c * R[6]
        g1 = a * R[1] + b * R[4] + c * R[7]
        g2 = a * R[2] + b * R[5] + c * R[8]
        J_anchor[n, row, 0] = g2 * m[1] - g1 * m[2]
        J_anchor[n, row, 1] = g0 * m[2] - g2 * m[0]
        J_anchor[n, row, 2] = g1 * m[0] - g0 * m[1]
        J_anchor[n, row, 3] = rho * g0
        J_anchor[n, row, 4] = rho * g1
        J_anchor[n, row, 5] = rho * g2
        J_point[n, row, 0] = -g0 * unit_x
        J_point[n, row, 1] = -g1 * unit_y
        J_point[n, row, 2] = -(a * t[0] + b * t[1] + c * t[2])


@kernel
def _inverse_depth(
    begin: int,
    end: int,
    anchors: NDArray[np.float64],
    anchor_of: NDArray[np.uint32],
    observers: NDArray[np.float64],
    observer_of: NDArray[np.uint32],
    points: NDArray[np.float64],
    point_of: NDArray[np.uint32],
    pixels: NDArray[np.float64],
    camera_of: NDArray[np.uint32],
    codes: NDArray[np.int64],
    parameters: NDArray[np.float64],
    nearest: NDArray[np.float64],
    r: NDArray[np.float64],
    J_anchor: NDArray[np.float64],
    J_observer: NDArray[np.float64],
    J_point: NDArray[np.float64],
    valid: NDArray[np.bool_],
    with_jacobians: bool,
) -> None:
    for n in range(np.uint64(begin), np.uint64(end)):
        R, tx, ty, tz = relative_pose(anchors, anchor_of[n], observers, observer_of[n])
        k = point_of[n]
        m0, m1, rho = points[k, 0], points[k, 1], points[k, 2]
        if rho < RHO_MIN:
            rho = 0.0
        x = R[0] * m0 + R[1] * m1 + R[2] + rho * tx
        y = R[3] * m0 + R[4] * m1 + R[5] + rho * ty
        z = R[6] * m0 + R[7] * m1 + R[8] + rho * tz
        # A NaN passes on into the residual, where it is seen and named.
        of = camera_of[n]
        c = parameters[of]
        seen, u, v, p00, p01, p02, p10, p11, p12 = project_any(
            codes[of], with_jacobians, x, y, z, nearest[of] * rho, c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8]
        )
        valid[n] = seen
        if not seen:
            r[n, 0] = 0.0
            r[n, 1] = 0.0
            if with_jacobians:
                J_anchor[n] = 0.0
                J_observer[n] = 0.0
                J_point[n] = 0.0
            continue
        r[n, 0] = pixels[n, 0] - u
        r[n, 1] = pixels[n, 1] - v
        if with_jacobians:
            P = (p00, p01, p02, p10, p11, p12)
            write_anchor_observer_point(
                n, (m0, m1, 1.0), (x, y, z), rho, R, (tx, ty, tz), P, 1.0, 1.0, J_anchor, J_observer, J_point
            )


class InverseDepthReprojection(PixelResidual):
    """Points by bearing and inverse depth in an anchor camera, seen in cameras, as derived in the head of this file.

    Variables: `T_anchor_world` and `T_observer_world` on `SE3Left` (7,), both world to camera; `bearing_rho` on `Euclidean(3)`,
    [X/Z, Y/Z, 1/Z] of the point in the anchor [1, 1, 1/m], which `camera.unproject` gives from the anchor's pixel.

    Every point wants the pixel in its anchor as well, as an observation in which both poses are the anchor's: without it
    nothing ties the bearing to what the anchor saw.

    Args:
        camera: the observer; a sequence where several take part, which `camera_of` then tells apart.
        pixels: (N, 2) where the observer sees them [px].
        camera_of: (N,) number of the observer among several cameras.
        sigma, covariance, information: of a pixel measurement, as in `Whitening.of`; none of them stands for 1 px.

    Raises:
        InputError: pixels of another shape or not finite, a camera that is not there, or noise that `Whitening.of` refuses.

    Example:
        >>> camera = bp.Pinhole(500.0, 500.0, 320.0, 240.0)
        >>> seen = bp.residuals.InverseDepthReprojection(camera, [[320.0, 240.0]], sigma=1.0)
        >>> anchor, observer = bp.SE3Left.identity(), bp.SE3Left.identity()
        >>> np.abs(seen.evaluate(anchor, observer, [0.01, 0.0, 0.5]))  # a direction, and one over the depth
        array([[5., 0.]])
    """

    no_jacobians = (np.zeros((0, 2, 6)), np.zeros((0, 2, 6)), np.zeros((0, 2, 3)))

    def __init__(
        self,
        camera: CameraModel | Sequence[CameraModel],
        pixels: ArrayLike,
        *,
        camera_of: ArrayLike | None = None,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        information: ArrayLike | None = None,
    ) -> None:
        self.cameras = (camera,) if isinstance(camera, CameraModel) else tuple(camera)
        self.pixels = check_pixels("pixels", pixels)
        count = len(self.pixels)
        self.camera_of = _checked_numbers(camera_of, len(self.cameras), count)
        super().__init__(
            dim=2,
            count=count,
            manifolds=(SE3Left, SE3Left, Euclidean(3)),
            roles=("T_anchor_world", "T_observer_world", "bearing_rho"),
            whitening=Whitening.of(2, count, sigma=sigma, covariance=covariance, information=information),
        )
        self._models = (
            np.array([c.code for c in self.cameras], dtype=np.int64),
            np.array([c.padded_parameters for c in self.cameras]),
            np.array([c.nearest for c in self.cameras], dtype=np.float64),
        )

    def _run(
        self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask, with_jacobians: bool
    ) -> None:
        _inverse_depth(
            begin, end, x[0], index[0], x[1], index[1], x[2], index[2], self.pixels, self.camera_of,
            *self._models, r, jacobians[0], jacobians[1], jacobians[2], valid, with_jacobians,
        )  # fmt: skip


def _checked_numbers(camera_of: ArrayLike | None, cameras: int, count: int) -> NDArray[np.uint32]:
    """(count,) which camera saw each row; all of them the only one where it is left out."""
    if camera_of is None and cameras == 1:
        return np.zeros(count, dtype=np.uint32)
    of = as_numbers([] if camera_of is None else camera_of, "camera_of")
    if of.shape != (count,) or of.dtype.kind not in "iu" or (count and not 0 <= of.min() <= of.max() < cameras):
        got = "none" if camera_of is None else f"{of.dtype} of shape {of.shape}" + (f" up to {of.max()}" if of.size else "")
        raise InputError(f"camera_of ({count},), integers from 0 to {cameras - 1}", got, "give the camera of every pixel")
    return np.ascontiguousarray(of, dtype=np.uint32)
