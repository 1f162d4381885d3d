"""The lenses that can be calibrated, by Kalibr's names."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras import CameraModel, DoubleSphere, Equidistant, Pinhole, RadialTangential

LensKind = Literal["pinhole-radtan", "pinhole-equi", "ds-none"]
LENSES: tuple[LensKind, ...] = ("pinhole-radtan", "pinhole-equi", "ds-none")

_NEAREST_M = 1e-3


def lens(kind: LensKind, parameters: NDArray[np.float64]) -> CameraModel:
    """A camera of this kind with these parameters, in the order of its `parameter_names`.

    Raises:
        InputError: parameters outside of the model's range.
    """
    if kind == "pinhole-radtan":
        fx, fy, cx, cy, k1, k2, p1, p2 = map(float, parameters)
        return Pinhole(fx, fy, cx, cy, RadialTangential(k1, k2, p1, p2), z_min=_NEAREST_M)
    if kind == "pinhole-equi":
        fx, fy, cx, cy, k1, k2, k3, k4 = map(float, parameters)
        return Equidistant(fx, fy, cx, cy, k1, k2, k3, k4, _NEAREST_M)
    fx, fy, cx, cy, xi, alpha = map(float, parameters)
    return DoubleSphere(fx, fy, cx, cy, xi, alpha, _NEAREST_M)


def plain_lens(kind: LensKind, focal: float, size: tuple[int, int]) -> CameraModel:
    """Where the search starts: this focal length [px] on the axis, the middle of the image, no distortion."""
    cx, cy = 0.5 * (size[0] - 1), 0.5 * (size[1] - 1)
    if kind == "pinhole-radtan":
        return lens(kind, np.array([focal, focal, cx, cy, 0.0, 0.0, 0.0, 0.0]))
    if kind == "pinhole-equi":
        return lens(kind, np.array([focal, focal, cx, cy, 0.0, 0.0, 0.0, 0.0]))
    # ξ = 0 and α = ½ is the unified model of a stereographic lens, between pinhole and fisheye.
    return lens(kind, np.array([focal, focal, cx, cy, 0.0, 0.5]))
