"""One pixel warped from one image into another, and the rows of the photometric error.

Derivation: docs/residuals/photometric.md and docs/residuals/inverse_depth.md.
The point X' = R m/ρ + t is used as Y = ρ X' = R m + ρ t, which projects to the same pixel and is regular at ρ = 0, a point at
infinity. With P_Y = ∂π/∂Y the derivatives of the page become

    ∂p₂/∂[w, v] = P_Y [−[Y]x  ρ I],   ∂p₂/∂ρ = P_Y t,   ∂p₂/∂c = ∂π/∂c + P_Y R ∂m/∂c
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.cameras.pinhole import project_point
from boxplus.manifolds.quaternion import rotation_entries
from boxplus.residuals.camera.photometric_sampling import sample_bilinear, sample_smoothed

LEAST_INVERSE_DEPTH = 1e-6  # 1/m; below it a point is at infinity (docs/residuals/inverse_depth.md)
_LEAST_Y_Z = 1e-6  # of a ray with z = 1: a point at infinity 90° off the optical axis

Matrix3 = tuple[float, float, float, float, float, float, float, float, float]
Intrinsics = tuple[float, float, float, float, float, float, float, float, float]


@kernel(inline=True)
def warped_pixel(
    image_2: NDArray[np.float32],
    R: Matrix3,
    t: tuple[float, float, float],
    mx: float,
    my: float,
    rho: float,
    c: Intrinsics,
    z_min: float,
    smoothed: bool,
) -> tuple[bool, float, float, float, float, float, float, float, float, float]:
    """Where the ray (mx, my, 1) at inverse depth rho of view 1 lands in image 2.

    Returns:
        valid; the grey value there, its gradient (2); Y (3); the gradient by Y (3).
    """
    if rho < LEAST_INVERSE_DEPTH:
        rho = 0.0
    x = R[0] * mx + R[1] * my + R[2] + rho * t[0]
    y = R[3] * mx + R[4] * my + R[5] + rho * t[1]
    z = R[6] * mx + R[7] * my + R[8] + rho * t[2]
    if not (z > z_min * rho and z > _LEAST_Y_Z):
        return False, 0.0, 0.0, 0.0, x, y, z, 0.0, 0.0, 0.0
    u, v, p00, p01, p02, p10, p11, p12 = project_point(x, y, z, c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8])
    if smoothed:
        valid, value, along_u, along_v = sample_smoothed(image_2, u, v)
    else:
        valid, value, along_u, along_v = sample_bilinear(image_2, u, v)
    return (
        valid,
        value,
        along_u,
        along_v,
        x,
        y,
        z,
        along_u * p00 + along_v * p10,
        along_u * p01 + along_v * p11,
        along_u * p02 + along_v * p12,
    )


@kernel
def photometric(
    begin: int,
    end: int,
    poses: NDArray[np.float64],
    inverse_depths: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    brightness: NDArray[np.float64],
    pose_of: NDArray[np.uint32],
    inverse_depth_of: NDArray[np.uint32],
    intrinsics_of: NDArray[np.uint32],
    brightness_of: NDArray[np.uint32],
    image_2: NDArray[np.float32],
    grey_1: NDArray[np.float64],
    pixels_1: NDArray[np.float64],
    rays_1: NDArray[np.float64],
    distortion: NDArray[np.float64],
    z_min: float,
    rays_move: bool,
    smoothed: bool,
    r: NDArray[np.float64],
    J_pose: NDArray[np.float64],
    J_inverse_depth: NDArray[np.float64],
    J_intrinsics: NDArray[np.float64],
    J_brightness: NDArray[np.float64],
    valid: NDArray[np.bool_],
    with_jacobians: bool,
) -> None:
    """Rows of the residuals [begin, end); what is no variable comes as a constant with a Jacobian of no rows.

    Args:
        poses: (·, 7), inverse_depths: (·, 1), intrinsics: (·, 4), brightness: (·, 2), each gathered by its index (N,).
        grey_1: (N, K); pixels_1: (N, K, 2); rays_1: (N, K, 2), used unless `rays_move` with the intrinsics.
        distortion: (5,), after the four intrinsics.
        smoothed: the gradient of image 2, over two pixels.
        r: (N, K); the Jacobians (N, K, 6), (N, K, 1), (N, K, 4), (N, K, 2).
    """
    has_depth, has_intrinsics = J_inverse_depth.shape[0] > 0, J_intrinsics.shape[0] > 0
    has_brightness = J_brightness.shape[0] > 0
    for n in range(np.uint64(begin), np.uint64(end)):
        pose, rho = poses[pose_of[n]], inverse_depths[inverse_depth_of[n], 0]
        camera, light = intrinsics[intrinsics_of[n]], brightness[brightness_of[n]]
        fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
        c = (fx, fy, cx, cy, distortion[0], distortion[1], distortion[2], distortion[3], distortion[4])
        R = rotation_entries(pose[0], pose[1], pose[2], pose[3])
        t = (pose[4], pose[5], pose[6])
        gain = math.exp(light[0])
        is_valid = True
        for k in range(np.uint64(grey_1.shape[1])):
            if rays_move:
                mx, my = (pixels_1[n, k, 0] - cx) / fx, (pixels_1[n, k, 1] - cy) / fy
            else:
                mx, my = rays_1[n, k, 0], rays_1[n, k, 1]
            found, value, along_u, along_v, x, y, z, gx, gy, gz = warped_pixel(image_2, R, t, mx, my, rho, c, z_min, smoothed)
            if not found:
                is_valid = False
                break
            r[n, k] = grey_1[n, k] - gain * value - light[1]
            if not with_jacobians:
                continue
            gx, gy, gz = gain * gx, gain * gy, gain * gz
            scale = -rho if rho >= LEAST_INVERSE_DEPTH else 0.0
            J_pose[n, k, 0] = gy * z - gz * y
            J_pose[n, k, 1] = gz * x - gx * z
            J_pose[n, k, 2] = gx * y - gy * x
            J_pose[n, k, 3] = scale * gx
            J_pose[n, k, 4] = scale * gy
            J_pose[n, k, 5] = scale * gz
            if has_depth:
                J_inverse_depth[n, k, 0] = -(gx * t[0] + gy * t[1] + gz * t[2])
            if has_intrinsics:
                along_x = (gx * R[0] + gy * R[3] + gz * R[6]) / fx
                along_y = (gx * R[1] + gy * R[4] + gz * R[7]) / fy
                J_intrinsics[n, k, 0] = along_x * mx - gain * along_u * x / z
                J_intrinsics[n, k, 1] = along_y * my - gain * along_v * y / z
                J_intrinsics[n, k, 2] = along_x - gain * along_u
                J_intrinsics[n, k, 3] = along_y - gain * along_v
            if has_brightness:
                J_brightness[n, k, 0] = -gain * value
                J_brightness[n, k, 1] = -1.0
        valid[n] = is_valid
        if not is_valid:
            r[n] = 0.0
            if with_jacobians:
                J_pose[n] = 0.0
                if has_depth:
                    J_inverse_depth[n] = 0.0
                if has_intrinsics:
                    J_intrinsics[n] = 0.0
                if has_brightness:
                    J_brightness[n] = 0.0
