"""The pinhole camera with lens distortion: projection, its derivatives, and the way back.

Derivation: docs/cameras.md and docs/residuals/line_reprojection.md.
The intrinsics are one vector, [fx, fy, cx, cy], followed by the coefficients of the distortion model in the order
k1, k2, p1, p2, k3. A shorter model is the longer one with zeros, so that one kernel serves all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._arguments import require, shown
from boxplus._jit import kernel
from boxplus._numbers import is_finite
from boxplus.cameras.distortion import Distortion, Radial, RadialTangential, distort, undistort
from boxplus.errors import InputError
from boxplus.manifolds._batch import as_batch

INTRINSICS = 9  # numbers of the longest model
PINHOLE = 0
"""Code of this model; those of others are in `projection`."""
PARAMETER_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


@kernel(inline=True)
def project_point(
    x: float,
    y: float,
    z: float,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    k1: float,
    k2: float,
    p1: float,
    p2: float,
    k3: float,
) -> tuple[float, float, float, float, float, float, float, float]:
    """u, v and the entries of P = ∂(u, v)/∂(x, y, z), row by row (docs/cameras.md); the caller checks the depth."""
    inverse_z = 1.0 / z
    a, b = x * inverse_z, y * inverse_z
    xd, yd, jxx, jxy, jyy = distort(a, b, k1, k2, p1, p2, k3)
    sx, sy = fx * inverse_z, fy * inverse_z
    p00, p01, p10, p11 = sx * jxx, sx * jxy, sy * jxy, sy * jyy
    return fx * xd + cx, fy * yd + cy, p00, p01, -(p00 * a + p01 * b), p10, p11, -(p10 * a + p11 * b)


@kernel(inline=True)
def intrinsics_jacobian(
    a: float,
    b: float,
    fx: float,
    fy: float,
    xd: float,
    yd: float,
    sign: float,
    J: NDArray[np.float64],
) -> None:
    """J = sign · ∂(u, v)/∂ intrinsics, (2, 4, 6, 8 or 9), at the normalised point (a, b), distorted (xd, yd)."""
    count = J.shape[1]
    J[0, 0] = sign * xd
    J[1, 0] = 0.0
    J[0, 1] = 0.0
    J[1, 1] = sign * yd
    J[0, 2] = sign
    J[1, 2] = 0.0
    J[0, 3] = 0.0
    J[1, 3] = sign
    if count < 6:
        return
    r2 = a * a + b * b
    gx, gy = sign * fx, sign * fy
    J[0, 4] = gx * a * r2
    J[1, 4] = gy * b * r2
    J[0, 5] = gx * a * r2 * r2
    J[1, 5] = gy * b * r2 * r2
    if count < 8:
        return
    J[0, 6] = gx * 2.0 * a * b
    J[1, 6] = gy * (r2 + 2.0 * b * b)
    J[0, 7] = gx * (r2 + 2.0 * a * a)
    J[1, 7] = gy * 2.0 * a * b
    if count < 9:
        return
    J[0, 8] = gx * a * r2 * r2 * r2
    J[1, 8] = gy * b * r2 * r2 * r2


@kernel
def _project_batch(
    points: NDArray[np.float64],
    c: NDArray[np.float64],
    z_min: float,
    pixels: NDArray[np.float64],
    J_point: NDArray[np.float64],
    J_intrinsics: NDArray[np.float64],
    valid: NDArray[np.bool_],
) -> None:
    for n in range(np.uint64(points.shape[0])):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        if not z > z_min:
            continue
        u, v, p00, p01, p02, p10, p11, p12 = project_point(x, y, z, c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8])
        a, b = x / z, y / z
        xd, yd, jxx, jxy, jyy = distort(a, b, c[4], c[5], c[6], c[7], c[8])
        if not (jxx > 0.0 and jxx * jyy - jxy * jxy > 0.0):
            continue
        valid[n] = True
        pixels[n, 0], pixels[n, 1] = u, v
        J_point[n, 0, 0], J_point[n, 0, 1], J_point[n, 0, 2] = p00, p01, p02
        J_point[n, 1, 0], J_point[n, 1, 1], J_point[n, 1, 2] = p10, p11, p12
        intrinsics_jacobian(a, b, c[0], c[1], xd, yd, 1.0, J_intrinsics[n])


@kernel
def _unproject_batch(
    pixels: NDArray[np.float64], c: NDArray[np.float64], rays: NDArray[np.float64], valid: NDArray[np.bool_]
) -> None:
    for n in range(np.uint64(pixels.shape[0])):
        a, b, found = undistort((pixels[n, 0] - c[2]) / c[0], (pixels[n, 1] - c[3]) / c[1], c[4], c[5], c[6], c[7], c[8])
        if found:
            rays[n, 0], rays[n, 1], valid[n] = a, b, True


@dataclass(frozen=True, slots=True)
class Pinhole:
    """A pinhole camera, z forward, u to the right, v down, pixel centres at integers.

    Attributes:
        fx, fy: focal lengths [px].
        cx, cy: principal point [px].
        distortion: `Radial`, `RadialTangential` or None.
        z_min: depth up to which a point counts as at or behind the camera, and is not projected [m].

    Raises:
        InputError: a number is not finite, a focal length not positive, `z_min` negative.

    Example:
        >>> camera = bp.Pinhole(500.0, 500.0, 320.0, 240.0, bp.Radial(-0.1, 0.01))
        >>> pixels, seen = camera.project([[0.2, 0.0, 2.0], [0.0, 0.0, -1.0]])  # ahead, and behind
        >>> pixels[0].round(2), seen
        (array([369.95, 240.  ]), array([ True, False]))
        >>> rays, found = camera.unproject(pixels[:1], depth=2.0)
        >>> rays.round(6)
        array([[0.2, 0. , 2. ]])
    """

    code: ClassVar[int] = PINHOLE

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Distortion | None = None
    z_min: float = 0.05

    def __post_init__(self) -> None:
        require(
            self.distortion,
            (Radial, RadialTangential, type(None)),
            "distortion Radial, RadialTangential or None",
            "give one of them",
        )
        for name in ("fx", "fy"):
            value = getattr(self, name)
            if not (is_finite(value) and value > 0.0):
                raise InputError(
                    f"{name} positive and finite [px]", shown(value), "a camera that looks along −z: turn its frame first"
                )
        for name in ("cx", "cy"):
            if not is_finite(getattr(self, name)):
                raise InputError(f"{name} finite [px]", shown(getattr(self, name)), "give the principal point in pixels")
        if not (is_finite(self.z_min) and self.z_min >= 0.0):
            raise InputError("z_min finite and not negative [m]", shown(self.z_min), "leave it out for 0.05 m")

    @property
    def parameters(self) -> NDArray[np.float64]:
        """The intrinsics as a vector: [fx, fy, cx, cy] and the coefficients of the distortion, (4,), (6,), (8,) or (9,)."""
        coefficients = () if self.distortion is None else self.distortion.coefficients
        return np.array([self.fx, self.fy, self.cx, self.cy, *coefficients])

    @property
    def nearest(self) -> float:
        """`z_min`: how near a point may be; other models measure it by distance [m]."""
        return self.z_min

    @property
    def padded_parameters(self) -> NDArray[np.float64]:
        """`parameters` with zeros for the coefficients that the model does not have, (9,); what kernels take."""
        padded = np.zeros(INTRINSICS)
        parameters = self.parameters
        padded[: len(parameters)] = parameters
        return padded

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """What `parameters` holds, such as `("fx", "fy", "cx", "cy", "k1", "k2")`."""
        return PARAMETER_NAMES[: len(self.parameters)]

    @property
    def K(self) -> NDArray[np.float64]:
        """Calibration matrix (3, 3): homogeneous pixels of points, distortion left aside."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def K_line(self) -> NDArray[np.float64]:
        """det(K) K⁻ᵀ (3, 3): the image line l of a line's moment m in the camera frame, l = K_line m."""
        fx, fy, cx, cy = self.fx, self.fy, self.cx, self.cy
        return np.array([[fy, 0.0, 0.0], [0.0, fx, 0.0], [-fy * cx, -fx * cy, fx * fy]])

    def project(self, p_camera: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Pixels (..., 2) of points (..., 3) in the camera frame [m], and whether each is seen (...).

        A point is not seen, and its pixel NaN, at a depth up to `z_min` and where the distortion model folds back on
        itself, far outside of the image it was calibrated on.

        Raises:
            InputError: the last axis is not 3.
        """
        pixels, _, _, valid = self.project_with_jacobians(p_camera)
        return pixels, valid

    def project_with_jacobians(
        self, p_camera: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Pixels (..., 2), ∂pixel/∂point (..., 2, 3) [px/m], ∂pixel/∂parameters (..., 2, n), and validity (...).

        As `project`; the Jacobians of a point that is not seen are NaN (docs/cameras.md).
        """
        points, lead = as_batch("p_camera", p_camera, (3,))
        count = len(self.parameters)
        pixels = np.full((len(points), 2), np.nan)
        J_point = np.full((len(points), 2, 3), np.nan)
        J_intrinsics = np.full((len(points), 2, count), np.nan)
        valid = np.zeros(len(points), dtype=np.bool_)
        _project_batch(points, self.padded_parameters, self.z_min, pixels, J_point, J_intrinsics, valid)
        return (
            pixels.reshape((*lead, 2)),
            J_point.reshape((*lead, 2, 3)),
            J_intrinsics.reshape((*lead, 2, count)),
            valid.reshape(lead),
        )

    def unproject(self, pixels: ArrayLike, depth: ArrayLike = 1.0) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Points (..., 3) in the camera frame [m] that are seen at pixels (..., 2), and whether each was found (...).

        The distortion is inverted by Newton's method. A pixel that no point is moved to, or that is not finite, is
        not found; its point is NaN.

        Args:
            depth: z of the points [m], a number or (...).

        Raises:
            InputError: the last axis is not 2.
        """
        batch, lead = as_batch("pixels", pixels, (2,))
        rays = np.full((len(batch), 3), np.nan)
        valid = np.zeros(len(batch), dtype=np.bool_)
        _unproject_batch(batch, self.padded_parameters, rays, valid)
        rays[valid, 2] = 1.0
        points = rays.reshape((*lead, 3)) * np.asarray(depth, dtype=np.float64)[..., None]
        return points, valid.reshape(lead)

    def bearings(self, pixels: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Unit vectors (..., 3) in the camera frame that are seen at pixels (..., 2), and whether each was found (...).

        As `unproject`.
        """
        rays, valid = self.unproject(pixels)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True), valid

    def undistort(self, pixels: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Pixels (..., 2) as the same camera without distortion sees them, and whether each was found, as `unproject`."""
        rays, valid = self.unproject(pixels)
        undistorted = rays[..., :2] * np.array([self.fx, self.fy]) + np.array([self.cx, self.cy])
        return undistorted, valid
