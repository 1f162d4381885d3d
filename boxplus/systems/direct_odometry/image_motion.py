"""How far pixels of a keyframe move in the image for a motion of the camera: what asks for the next keyframe."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.cameras.pinhole import project_point
from boxplus.manifolds.quaternion import rotation_entries
from boxplus.systems.direct_alignment.keyframe import Keyframe
from boxplus.systems.direct_alignment.keyframe_kernel import LEAST_Y_Z
from boxplus.systems.direct_odometry.config import DirectOdometryConfig

_OCTAVE = 2  # of the pixels that are followed


class ImageMotion(NamedTuple):
    """Root mean squares over the keyframe's pixels, by the sum of the image's width and height.

    Attributes:
        flow: of the whole motion; by_translation: without its rotation; overlap: share of the pixels that stay in the image.
    """

    flow: float
    by_translation: float
    overlap: float


@kernel
def _sums(
    T: NDArray[np.float64],
    pixels: NDArray[np.float64],
    rays: NDArray[np.float64],
    inverse_depth: NDArray[np.float64],
    c: NDArray[np.float64],
    width: float,
    height: float,
) -> tuple[float, float, float]:
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation_entries(T[0], T[1], T[2], T[3])
    whole, shifted, seen = 0.0, 0.0, 0.0
    for n in range(np.uint64(len(inverse_depth))):
        mx, my, rho = rays[n, 0], rays[n, 1], inverse_depth[n]
        x = r00 * mx + r01 * my + r02 + rho * T[4]
        y = r10 * mx + r11 * my + r12 + rho * T[5]
        z = r20 * mx + r21 * my + r22 + rho * T[6]
        if not z > LEAST_Y_Z:
            continue
        u, v, _, _, _, _, _, _ = project_point(x, y, z, c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8])
        if not (u >= 0.0 and v >= 0.0 and u < width - 1.0 and v < height - 1.0):
            continue
        seen += 1.0
        whole += (u - pixels[n, 0]) ** 2 + (v - pixels[n, 1]) ** 2
        z = 1.0 + rho * T[6]
        if z > LEAST_Y_Z:
            u, v, _, _, _, _, _, _ = project_point(
                mx + rho * T[4], my + rho * T[5], z, c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8]
            )
            shifted += (u - pixels[n, 0]) ** 2 + (v - pixels[n, 1]) ** 2
    return whole, shifted, seen


def image_motion(keyframe: Keyframe, T_camera_keyframe: NDArray[np.float64]) -> ImageMotion:
    """How far the keyframe's pixels lie from where they were, for a camera at T_camera_keyframe (7,)."""
    level = next((level for level in keyframe.levels if level.octave <= _OCTAVE), keyframe.levels[-1])
    height, width = (length >> level.octave for length in keyframe.shape)
    whole, shifted, seen = _sums(
        T_camera_keyframe, level.pixels, level.rays, level.inverse_depth, level.intrinsics, float(width), float(height)
    )
    if not seen:
        return ImageMotion(1.0, 1.0, 0.0)
    size = float(width + height)
    return ImageMotion(np.sqrt(whole / seen) / size, np.sqrt(shifted / seen) / size, seen / len(level.inverse_depth))


def keyframe_distance(keyframe: Keyframe, T_camera_keyframe: NDArray[np.float64], config: DirectOdometryConfig) -> float:
    """How far a camera at T_camera_keyframe (7,) has moved the image; from 1 on a keyframe is asked for."""
    motion = image_motion(keyframe, T_camera_keyframe)
    by_flow = motion.flow / config.keyframe_flow + motion.by_translation / config.keyframe_flow_translation
    missing = (1.0 - motion.overlap) / (1.0 - config.keyframe_overlap)
    return max(0.5 * by_flow, missing)
