"""Projection by whichever camera model, in kernels: the pinhole of `pinhole`, and the lenses of wide angle.

Every model has a code and up to nine numbers, fx, fy, cx, cy and its coefficients c4 … c8. With ρ² = x² + y² and d² = ρ² + z²:

Equidistant (Kannala and Brandt, 2006, eq. 6; OpenCV's `fisheye`, Kalibr's `equidistant`), with θ = atan2(ρ, z) and
θ_d = θ + k1 θ³ + k2 θ⁵ + k3 θ⁷ + k4 θ⁹

    u = fx θ_d x/ρ + cx,    v = fy θ_d y/ρ + cy

Double sphere (Usenko, Demmel and Cremers, 2018, eq. 40 to 45), with k = ξ d + z, d₂² = ρ² + k² and D = α d₂ + (1 − α) k

    u = fx x/D + cx,    v = fy y/D + cy,    where z > −w₂ d
    w₁ = α/(1 − α) for α ≤ ½, else (1 − α)/α;   w₂ = (w₁ + ξ)/√(2 w₁ ξ + ξ² + 1)
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.cameras.distortion import distort
from boxplus.cameras.pinhole import PINHOLE, intrinsics_jacobian, project_point

EQUIDISTANT, DOUBLE_SPHERE = 1, 2

_CLOSE_TO_AXIS = 1e-3  # ρ/z below which the series replaces what cancels
_ITERATIONS = 60
_RELATIVE_ERROR = 1e-14

Projected = tuple[bool, float, float, float, float, float, float, float, float]
"""Whether the formula holds, u, v, and ∂(u, v)/∂(x, y, z) row by row."""


@kernel(inline=True)
def distorted_angle(theta: float, k1: float, k2: float, k3: float, k4: float) -> tuple[float, float]:
    """θ_d and dθ_d/dθ."""
    t = theta * theta
    value = theta * (1.0 + t * (k1 + t * (k2 + t * (k3 + t * k4))))
    slope = 1.0 + t * (3.0 * k1 + t * (5.0 * k2 + t * (7.0 * k3 + t * 9.0 * k4)))
    return value, slope


@kernel
def project_equidistant(
    x: float, y: float, z: float, nearest: float,
    fx: float, fy: float, cx: float, cy: float, k1: float, k2: float, k3: float, k4: float,
) -> Projected:  # fmt: skip
    """Nearer than `nearest`, and straight behind, where all directions meet in one circle, there is no projection."""
    rho2 = x * x + y * y
    d2 = rho2 + z * z
    rho = math.sqrt(rho2)
    if d2 <= nearest * nearest or (z <= 0.0 and rho <= -1e-9 * z):
        return False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    # s = θ_d/ρ, q = (∂s/∂ρ)/ρ
    if rho < _CLOSE_TO_AXIS * z:
        t2 = rho2 / (z * z)
        a, b = k1 - 1.0 / 3.0, k2 - k1 + 0.2
        s = (1.0 + t2 * (a + t2 * b)) / z
        q = (2.0 * a + 4.0 * b * t2) / (z * z * z)
        slope = distorted_angle(rho / z, k1, k2, k3, k4)[1]
    else:
        angle, slope = distorted_angle(math.atan2(rho, z), k1, k2, k3, k4)
        s = angle / rho
        q = (slope * z / d2 - s) / rho2
    h = -slope / d2
    xy = x * y * q
    return (
        True, fx * x * s + cx, fy * y * s + cy,
        fx * (s + x * x * q), fx * xy, fx * x * h, fy * xy, fy * (s + y * y * q), fy * y * h,
    )  # fmt: skip


@kernel(inline=True)
def _sphere_terms(x: float, y: float, z: float, xi: float, alpha: float) -> tuple[float, float, float, float]:
    """d, k, d₂ and D."""
    d = math.sqrt(x * x + y * y + z * z)
    k = xi * d + z
    d2 = math.sqrt(x * x + y * y + k * k)
    return d, k, d2, alpha * d2 + (1.0 - alpha) * k


@kernel
def project_double_sphere(
    x: float, y: float, z: float, nearest: float, fx: float, fy: float, cx: float, cy: float, xi: float, alpha: float
) -> Projected:
    """Nearer than `nearest`, outside of the half space of the model, and for ξ ≤ −1 or α outside of [0, 1] there is none."""
    d, k, d2, D = _sphere_terms(x, y, z, xi, alpha)
    outside = d <= nearest or alpha < 0.0 or alpha > 1.0 or xi <= -1.0
    if not outside:
        w1 = alpha / (1.0 - alpha) if alpha <= 0.5 else (1.0 - alpha) / alpha
        w2 = (w1 + xi) / math.sqrt(2.0 * w1 * xi + xi * xi + 1.0)
        outside = z <= -w2 * d or 1e-12 * d >= D
    if outside:
        return False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    slope = alpha * k / d2 + 1.0 - alpha  # ∂D/∂k
    g = alpha / d2 + slope * xi / d  # ∂D/∂x = g x, ∂D/∂y = g y
    h = slope * (xi * z / d + 1.0)  # ∂D/∂z
    i = 1.0 / D
    a, b = x * i, y * i
    return (
        True, fx * a + cx, fy * b + cy,
        fx * (i - a * a * g), -fx * a * b * g, -fx * a * i * h, -fy * a * b * g, fy * (i - b * b * g), -fy * b * i * h,
    )  # fmt: skip


@kernel(inline=True)
def project_any(
    code: int, with_jacobian: bool, x: float, y: float, z: float, nearest: float,
    c0: float, c1: float, c2: float, c3: float, c4: float, c5: float, c6: float, c7: float, c8: float,
) -> Projected:  # fmt: skip
    """Projection by the model of this code; the Jacobian may be zeros when it is not asked for. NaN passes on into u and v."""
    if code == PINHOLE:
        if z <= nearest:
            return False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        u, v, p00, p01, p02, p10, p11, p12 = project_point(x, y, z, c0, c1, c2, c3, c4, c5, c6, c7, c8)
        # Said here, so that the compiler moves the computation of the Jacobian behind the question.
        if with_jacobian:
            return True, u, v, p00, p01, p02, p10, p11, p12
        return True, u, v, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if code == EQUIDISTANT:
        wide: Projected = project_equidistant(x, y, z, nearest, c0, c1, c2, c3, c4, c5, c6, c7)
    else:
        wide = project_double_sphere(x, y, z, nearest, c0, c1, c2, c3, c4, c5)
    return wide


@kernel(inline=True)
def intrinsics_jacobian_any(
    code: int, x: float, y: float, z: float,
    c0: float, c1: float, c2: float, c3: float, c4: float, c5: float, c6: float, c7: float, c8: float,
    sign: float, J: NDArray[np.float64],
) -> None:  # fmt: skip
    """J = sign · ∂(u, v)/∂ intrinsics, (2, as many as the model has), at a point where `project_any` holds."""
    if code == PINHOLE:
        a, b = x / z, y / z
        xd, yd, _, _, _ = distort(a, b, c4, c5, c6, c7, c8)
        intrinsics_jacobian(a, b, c0, c1, xd, yd, sign, J)
    elif code == EQUIDISTANT:
        _intrinsics_equidistant(x, y, z, c0, c1, c4, c5, c6, c7, sign, J)
    else:
        _intrinsics_double_sphere(x, y, z, c0, c1, c4, c5, sign, J)


@kernel
def _intrinsics_equidistant(
    x: float, y: float, z: float, fx: float, fy: float, k1: float, k2: float, k3: float, k4: float,
    sign: float, J: NDArray[np.float64],
) -> None:  # fmt: skip
    J[:] = 0.0
    J[0, 2] = sign
    J[1, 3] = sign
    rho = math.sqrt(x * x + y * y)
    if rho <= 0.0:
        return
    theta = math.atan2(rho, z)
    angle, _ = distorted_angle(theta, k1, k2, k3, k4)
    a, b = x / rho, y / rho
    J[0, 0] = sign * angle * a
    J[1, 1] = sign * angle * b
    power = theta * theta * theta
    for k in range(4):
        J[0, 4 + k] = sign * fx * a * power
        J[1, 4 + k] = sign * fy * b * power
        power *= theta * theta


@kernel
def _intrinsics_double_sphere(
    x: float, y: float, z: float, fx: float, fy: float, xi: float, alpha: float, sign: float, J: NDArray[np.float64]
) -> None:
    d, k, d2, D = _sphere_terms(x, y, z, xi, alpha)
    i = 1.0 / D
    by_xi = -(alpha * k / d2 + 1.0 - alpha) * d * i * i
    by_alpha = -(d2 - k) * i * i
    J[:] = 0.0
    J[0, 2] = sign
    J[1, 3] = sign
    J[0, 0] = sign * x * i
    J[1, 1] = sign * y * i
    J[0, 4] = sign * fx * x * by_xi
    J[1, 4] = sign * fy * y * by_xi
    J[0, 5] = sign * fx * x * by_alpha
    J[1, 5] = sign * fy * y * by_alpha


@kernel
def bearing_equidistant(
    mx: float, my: float, k1: float, k2: float, k3: float, k4: float, theta_max: float
) -> tuple[float, float, float, bool]:
    """Unit vector seen at the normalised point (mx, my), by Newton's method inside of a bracket, and whether there is one.

    θ_d rises up to `theta_max`, so that the bracket [0, θ_max] holds exactly one root, or none.
    """
    wanted = math.sqrt(mx * mx + my * my)
    low, high = 0.0, theta_max
    if not wanted <= distorted_angle(theta_max, k1, k2, k3, k4)[0]:
        return 0.0, 0.0, 0.0, False
    if wanted <= 0.0:
        return 0.0, 0.0, 1.0, True
    theta = min(wanted, theta_max)
    for _ in range(_ITERATIONS):
        value, slope = distorted_angle(theta, k1, k2, k3, k4)
        error = value - wanted
        if abs(error) <= _RELATIVE_ERROR * wanted:
            break
        if error > 0.0:
            high = theta
        else:
            low = theta
        theta = theta - error / slope if slope > 0.0 else low
        if not low < theta < high:
            theta = 0.5 * (low + high)
    value, _ = distorted_angle(theta, k1, k2, k3, k4)
    s = math.sin(theta) / wanted
    return mx * s, my * s, math.cos(theta), abs(value - wanted) <= 1e-12 * (1.0 + wanted)


@kernel
def bearing_double_sphere(mx: float, my: float, xi: float, alpha: float) -> tuple[float, float, float, bool]:
    """Unit vector seen at the normalised point (mx, my), and whether there is one (eq. 46 to 51)."""
    r2 = mx * mx + my * my
    inside = 1.0 - (2.0 * alpha - 1.0) * r2
    if not inside >= 0.0:
        return 0.0, 0.0, 0.0, False
    mz = (1.0 - alpha * alpha * r2) / (alpha * math.sqrt(inside) + 1.0 - alpha)
    under = mz * mz + (1.0 - xi * xi) * r2
    if not under >= 0.0:
        return 0.0, 0.0, 0.0, False
    factor = (mz * xi + math.sqrt(under)) / (mz * mz + r2)
    x, y, z = factor * mx, factor * my, factor * mz - xi
    # What the formula gives beyond the image of the model is not projected back to where it came from.
    valid, u, v, _, _, _, _, _, _ = project_double_sphere(x, y, z, 0.0, 1.0, 1.0, 0.0, 0.0, xi, alpha)
    error = math.sqrt((u - mx) * (u - mx) + (v - my) * (v - my))
    return x, y, z, valid and error <= 1e-9 * (1.0 + math.sqrt(r2))


@kernel
def project_batch(
    code: int,
    points: NDArray[np.float64],
    c: NDArray[np.float64],
    nearest: float,
    theta_max: float,
    pixels: NDArray[np.float64],
    J_point: NDArray[np.float64],
    J_intrinsics: NDArray[np.float64],
    seen: NDArray[np.bool_],
) -> None:
    """Points (N, 3) in a camera of wide angle; what is not seen is left as it is."""
    for n in range(np.uint64(points.shape[0])):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        if not math.isfinite(x + y + z):
            continue
        valid, u, v, p00, p01, p02, p10, p11, p12 = project_any(
            code, True, x, y, z, nearest, c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8]
        )
        if not valid or (code == EQUIDISTANT and math.atan2(math.sqrt(x * x + y * y), z) >= theta_max):
            continue
        seen[n] = True
        pixels[n, 0], pixels[n, 1] = u, v
        J_point[n, 0, 0], J_point[n, 0, 1], J_point[n, 0, 2] = p00, p01, p02
        J_point[n, 1, 0], J_point[n, 1, 1], J_point[n, 1, 2] = p10, p11, p12
        intrinsics_jacobian_any(code, x, y, z, c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8], 1.0, J_intrinsics[n])


@kernel
def bearing_batch(
    code: int,
    pixels: NDArray[np.float64],
    c: NDArray[np.float64],
    theta_max: float,
    bearings: NDArray[np.float64],
    found: NDArray[np.bool_],
) -> None:
    """Unit vectors (N, 3) seen at pixels (N, 2) of a camera of wide angle; what is not found is left as it is."""
    for n in range(np.uint64(pixels.shape[0])):
        mx, my = (pixels[n, 0] - c[2]) / c[0], (pixels[n, 1] - c[3]) / c[1]
        if code == EQUIDISTANT:
            x, y, z, there = bearing_equidistant(mx, my, c[4], c[5], c[6], c[7], theta_max)
        else:
            x, y, z, there = bearing_double_sphere(mx, my, c[4], c[5])
        if there:
            bearings[n, 0], bearings[n, 1], bearings[n, 2], found[n] = x, y, z, True
