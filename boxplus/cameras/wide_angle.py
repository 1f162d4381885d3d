"""Cameras of wide angle: the equidistant (Kannala-Brandt) and the double-sphere model; equations in `projection`.

Both see beyond 90° from the axis, where z ≤ 0, which no pinhole does.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._arguments import shown
from boxplus._numbers import is_finite
from boxplus.cameras.pinhole import INTRINSICS
from boxplus.cameras.projection import DOUBLE_SPHERE, EQUIDISTANT, bearing_batch, project_batch
from boxplus.errors import InputError
from boxplus.manifolds._batch import as_batch

_LARGEST_ANGLE = math.pi - 1e-6  # straight behind, all directions meet


class _WideAngle(ABC):
    """What both models share; `code`, the fields and `theta_max` make the difference."""

    __slots__ = ()

    code: ClassVar[int]
    fx: float
    fy: float
    cx: float
    cy: float
    nearest: float

    def _check(self) -> None:
        for name in ("fx", "fy"):
            value = getattr(self, name)
            if not (is_finite(value) and value > 0.0):
                raise InputError(f"{name} positive and finite [px]", shown(value), "take it from a calibration")
        for name in self.parameter_names[2:]:
            if not is_finite(getattr(self, name)):
                raise InputError(f"{name} finite", shown(getattr(self, name)), "take it from a calibration")
        if not (is_finite(self.nearest) and self.nearest >= 0.0):
            raise InputError("nearest finite and not negative [m]", shown(self.nearest), "leave it out for 0.05 m")

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """What `parameters` holds."""
        return tuple(field.name for field in fields(self) if field.name != "nearest")  # type: ignore[arg-type]

    @property
    def parameters(self) -> NDArray[np.float64]:
        """The intrinsics as a vector, in the order of `parameter_names`."""
        return np.array([getattr(self, name) for name in self.parameter_names])

    @property
    def padded_parameters(self) -> NDArray[np.float64]:
        """`parameters` followed by zeros, (9,); what kernels take."""
        padded = np.zeros(INTRINSICS)
        parameters = self.parameters
        padded[: len(parameters)] = parameters
        return padded

    @property
    @abstractmethod
    def theta_max(self) -> float:
        """Angle from the axis up to which points are seen [rad]."""

    def project(self, p_camera: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Pixels (..., 2) of points (..., 3) in the camera frame [m], and whether each is seen (...).

        A point is not seen, and its pixel NaN, nearer than `nearest` and outside of the directions that the model covers.

        Raises:
            InputError: the last axis is not 3.
        """
        pixels, _, _, seen = self.project_with_jacobians(p_camera)
        return pixels, seen

    def project_with_jacobians(
        self, p_camera: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Pixels (..., 2), ∂pixel/∂point (..., 2, 3) [px/m], ∂pixel/∂parameters (..., 2, n), and whether seen (...).

        As `project`; the Jacobians of a point that is not seen are NaN.
        """
        points, lead = as_batch("p_camera", p_camera, (3,))
        count = len(self.parameters)
        pixels = np.full((len(points), 2), np.nan)
        J_point = np.full((len(points), 2, 3), np.nan)
        J_intrinsics = np.full((len(points), 2, count), np.nan)
        seen = np.zeros(len(points), dtype=np.bool_)
        project_batch(
            self.code, points, self.padded_parameters, self.nearest, self.theta_max, pixels, J_point, J_intrinsics, seen
        )
        return (
            pixels.reshape((*lead, 2)),
            J_point.reshape((*lead, 2, 3)),
            J_intrinsics.reshape((*lead, 2, count)),
            seen.reshape(lead),
        )

    def bearings(self, pixels: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Unit vectors (..., 3) in the camera frame that are seen at pixels (..., 2), and whether each was found (...).

        A pixel outside of the image of the model, or not finite, is not found; its vector is NaN.

        Raises:
            InputError: the last axis is not 2.
        """
        batch, lead = as_batch("pixels", pixels, (2,))
        bearings = np.full((len(batch), 3), np.nan)
        found = np.zeros(len(batch), dtype=np.bool_)
        bearing_batch(self.code, batch, self.padded_parameters, self.theta_max, bearings, found)
        return bearings.reshape((*lead, 3)), found.reshape(lead)

    def unproject(self, pixels: ArrayLike, depth: ArrayLike = 1.0) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Points (..., 3) in the camera frame [m] at depth z that are seen at pixels (..., 2), and whether each was found (...).

        As `bearings`; a pixel that looks sideways or backwards (z ≤ 0) has no point at a depth and is not found.
        """
        bearings, found = self.bearings(pixels)
        found = found & (bearings[..., 2] > 1e-9)
        z = np.where(found, bearings[..., 2], np.nan)
        points = bearings / z[..., None] * np.asarray(depth, dtype=np.float64)[..., None]
        return points, found

    def undistort(self, pixels: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Pixels (..., 2) as the pinhole of the same fx, fy, cx, cy sees them, and whether each was found, as `unproject`."""
        rays, found = self.unproject(pixels)
        return rays[..., :2] * np.array([self.fx, self.fy]) + np.array([self.cx, self.cy]), found


@dataclass(frozen=True, slots=True)
class Equidistant(_WideAngle):
    """A fisheye camera after Kannala and Brandt with four coefficients: OpenCV's `fisheye`, Kalibr's `pinhole-equi`.

    z forward, u to the right, v down, pixel centres at integers. The angle from the axis θ appears at the radius
    θ + k1 θ³ + k2 θ⁵ + k3 θ⁷ + k4 θ⁹ of the image with f = 1.

    Attributes:
        fx, fy: focal lengths [px].
        cx, cy: principal point [px].
        k1, k2, k3, k4: coefficients of the angle.
        nearest: distance up to which a point counts as at the camera, and is not projected [m].

    Raises:
        InputError: a number is not finite, a focal length not positive, `nearest` negative.

    Example:
        >>> camera = bp.Equidistant(190.98, 190.97, 254.93, 256.90, 3.48e-3, 7.15e-4, -2.05e-3, 2.03e-4)
        >>> pixels, seen = camera.project([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])     # sideways, and straight behind
        >>> seen.tolist()
        [True, False]
    """

    code: ClassVar[int] = EQUIDISTANT

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    nearest: float = 0.05

    def __post_init__(self) -> None:
        self._check()

    @property
    def theta_max(self) -> float:
        """Angle from the axis up to which θ_d rises [rad]: beyond, the polynomial folds back on itself."""
        roots = np.roots([9.0 * self.k4, 7.0 * self.k3, 5.0 * self.k2, 3.0 * self.k1, 1.0])
        real = roots.real[(np.abs(roots.imag) < 1e-9 * np.maximum(np.abs(roots), 1e-300)) & (roots.real > 0.0)]
        return min(float(np.sqrt(real.min())) if len(real) else _LARGEST_ANGLE, _LARGEST_ANGLE)


@dataclass(frozen=True, slots=True)
class DoubleSphere(_WideAngle):
    """A camera of wide angle after Usenko, Demmel and Cremers (3DV 2018): Kalibr's `ds`, with the inverse in closed form.

    z forward, u to the right, v down, pixel centres at integers.

    Attributes:
        fx, fy: focal lengths [px].
        cx, cy: principal point [px].
        xi: distance of both spheres, above −1.
        alpha: weight of both projections, in [0, 1].
        nearest: distance up to which a point counts as at the camera, and is not projected [m].

    Raises:
        InputError: a number is not finite or outside of its range, a focal length not positive, `nearest` negative.

    Example:
        >>> camera = bp.DoubleSphere(349.56, 349.53, 365.89, 249.31, xi=-0.2409, alpha=0.5658)
        >>> bearings, found = camera.bearings([[365.89, 249.31]])
        >>> bearings.tolist(), found.tolist()
        ([[0.0, 0.0, 1.0]], [True])
    """

    code: ClassVar[int] = DOUBLE_SPHERE

    fx: float
    fy: float
    cx: float
    cy: float
    xi: float
    alpha: float
    nearest: float = 0.05

    def __post_init__(self) -> None:
        self._check()
        if not 0.0 <= self.alpha <= 1.0:
            raise InputError("alpha in [0, 1]", f"{self.alpha}", "Kalibr writes xi before alpha: are they swapped?")
        if not self.xi > -1.0:
            raise InputError("xi above −1", f"{self.xi}", "Kalibr writes xi before alpha: are they swapped?")

    @property
    def theta_max(self) -> float:
        """Angle from the axis up to which points are seen [rad]: z > −w₂ d, and in front of the second projection."""
        w1 = self.alpha / (1.0 - self.alpha) if self.alpha <= 0.5 else (1.0 - self.alpha) / self.alpha
        w2 = (w1 + self.xi) / math.sqrt(2.0 * w1 * self.xi + self.xi**2 + 1.0)
        return math.acos(min(max(-w2, -1.0), 1.0))
