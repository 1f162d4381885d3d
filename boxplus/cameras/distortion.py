"""Lens distortion in OpenCV's order of coefficients: k1, k2, p1, p2, k3 (docs/cameras.md; Brown, 1971).

With x, y on the normalised image plane, r² = x² + y² and s = 1 + k1 r² + k2 r⁴ + k3 r⁶ the lens moves (x, y) to

    x s + 2 p1 x y + p2 (r² + 2 x²),    y s + p1 (r² + 2 y²) + 2 p2 x y.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from boxplus._arguments import shown
from boxplus._jit import kernel
from boxplus._numbers import is_finite
from boxplus.errors import InputError

_ITERATIONS = 50
_RELATIVE_ERROR = 1e-13  # of the distorted point, at which the inverse has converged


@dataclass(frozen=True, slots=True)
class Radial:
    """Radial distortion of two terms.

    Raises:
        InputError: a coefficient is not finite.

    Example:
        >>> bp.Radial(-0.1, 0.01).coefficients
        (-0.1, 0.01)
    """

    k1: float
    k2: float

    def __post_init__(self) -> None:
        _check_finite(self)

    @property
    def coefficients(self) -> tuple[float, ...]:
        """(k1, k2)."""
        return (self.k1, self.k2)


@dataclass(frozen=True, slots=True)
class RadialTangential:
    """Radial and tangential distortion, OpenCV's and Kalibr's `radtan`; k3 is left out of the model where None.

    Raises:
        InputError: a coefficient is not finite.

    Example:
        >>> bp.RadialTangential(-0.283, 0.0739, 1.9e-4, 1.8e-5).coefficients
        (-0.283, 0.0739, 0.00019, 1.8e-05)
    """

    k1: float
    k2: float
    p1: float
    p2: float
    k3: float | None = None

    def __post_init__(self) -> None:
        _check_finite(self)

    @property
    def coefficients(self) -> tuple[float, ...]:
        """(k1, k2, p1, p2) or (k1, k2, p1, p2, k3)."""
        return (self.k1, self.k2, self.p1, self.p2) + (() if self.k3 is None else (self.k3,))


Distortion = Radial | RadialTangential


def _check_finite(model: Distortion) -> None:
    for field in fields(model):
        value = getattr(model, field.name)
        if value is not None and not is_finite(value):
            raise InputError(f"{field.name} finite", shown(value), "take the coefficients from a calibration")


@kernel(inline=True)
def distort(
    x: float, y: float, k1: float, k2: float, p1: float, p2: float, k3: float
) -> tuple[float, float, float, float, float]:
    """The distorted point and the entries xx, xy = yx, yy of its derivative by (x, y), which is symmetric."""
    r2 = x * x + y * y
    s = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))  # 2 ∂s/∂r²
    xy = x * y
    return (
        x * s + 2.0 * p1 * xy + p2 * (r2 + 2.0 * x * x),
        y * s + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * xy,
        s + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        slope * xy + 2.0 * (p1 * x + p2 * y),
        s + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
    )


@kernel
def undistort(xd: float, yd: float, k1: float, k2: float, p1: float, p2: float, k3: float) -> tuple[float, float, bool]:
    """The point that the lens moves to (xd, yd), by Newton's method with step halving, and whether it was found.

    Not found: no point is moved there, or only one beyond the radius at which the model folds back on itself.
    """
    x, y = xd, yd
    tolerance = _RELATIVE_ERROR * (1.0 + math.sqrt(xd * xd + yd * yd))
    fx, fy, jxx, jxy, jyy = distort(x, y, k1, k2, p1, p2, k3)
    ex, ey = xd - fx, yd - fy
    error = ex * ex + ey * ey
    for _ in range(_ITERATIONS):
        determinant = jxx * jyy - jxy * jxy
        if not (determinant > 0.0 and jxx > 0.0):
            return x, y, False
        if error <= tolerance * tolerance:
            return x, y, True
        dx, dy = (jyy * ex - jxy * ey) / determinant, (jxx * ey - jxy * ex) / determinant
        step = 1.0
        while step > 1e-4:
            nx, ny = x + step * dx, y + step * dy
            fx, fy, nxx, nxy, nyy = distort(nx, ny, k1, k2, p1, p2, k3)
            ex, ey = xd - fx, yd - fy
            new_error = ex * ex + ey * ey
            # A step across a fold may lessen the error and still leads away from the solution.
            if new_error < error and nxx > 0.0 and nxx * nyy - nxy * nxy > 0.0:
                break
            step *= 0.5
        else:
            return x, y, False
        x, y, error, jxx, jxy, jyy = nx, ny, new_error, nxx, nxy, nyy
    return x, y, False
