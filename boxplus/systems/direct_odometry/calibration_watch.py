"""Whether the grey values contradict the intrinsics: a wrong focal length or principal point bends the images of a turn.

With fx and fy growing by the factor 1 + κ, q = [κ, c_x, c_y] moves the pixels p₂ of a frame (see `leftover.py`) by

    ∂p₂/∂κ = (p₂ − c) − P_Y R [m_x, m_y, 0]ᵀ,     ∂p₂/∂c_x = [1, 0]ᵀ − P_Y R [1/fx, 0, 0]ᵀ

Depths are held: those of a stereo pair would change with the intrinsics, which is not looked at.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.pinhole import Pinhole
from boxplus.systems.direct_odometry.leftover import Combined, Leftover

Matrix = NDArray[np.float64]
_NAMES = ("the focal length", "the principal point along u", "the principal point along v")
_LEAST_SIGMAS = 5.0  # for a contradiction
_LEAST_SHARE = 0.02  # by the focal length; smaller errors than that do not need to be told
_OWN_ERROR = 0.003  # standard deviation of one frame that its scatter does not show: interpolation, vignetting


class CalibrationWatch:
    """What the frames so far say of the intrinsics."""

    def __init__(self) -> None:
        self._found = Combined(3, _OWN_ERROR)

    def add(self, leftover: Leftover, camera: Pinhole) -> None:
        """A frame that was aligned to a keyframe."""
        f, m, y = np.array([camera.fx, camera.fy]), leftover.m, leftover.y
        zero, one = np.zeros(len(m)), np.ones(len(m))
        motions = [
            f * y - leftover.turned(np.column_stack([m[:, :2], zero])),
            np.column_stack([f[0] * one, zero]) - leftover.turned(np.column_stack([one, zero, zero])),
            np.column_stack([zero, f[1] * one]) - leftover.turned(np.column_stack([zero, one, zero])),
        ]
        found = leftover.explained_by(motions)
        if found is not None:
            self._found.add(*found)

    @property
    def contradiction(self) -> str:
        """Which intrinsics must be wrong, in a sentence; empty where none."""
        found = self._found.strongest(_LEAST_SHARE, _LEAST_SIGMAS)
        if found is None:
            return ""
        k, q, sigma = found
        kind = "" if k == 0 else " of the focal length"
        return (
            f"grey values contradict {_NAMES[k]}: they ask for {100.0 * q:+.1f} %{kind}, with a standard deviation of "
            f"{100.0 * sigma:.1f} %; check the calibration, and whether the images were scaled or cropped"
        )
