"""Whether the grey values contradict the intrinsics: a wrong focal length or principal point bends the images of a turn.

At a frame that was tracked, e = I₁(p₁) − (eᵃ I₂(p₂) + b) is linearised by what was estimated (ξ, a, b) and by q = [κ, c_x, c_y],
fx and fy growing by the factor 1 + κ:

    ∂p₂/∂κ = (p₂ − c) − P_Y R [m_x, m_y, 0]ᵀ,     ∂p₂/∂c_x = [1, 0]ᵀ − P_Y R [1/fx, 0, 0]ᵀ,     ∂e/∂q ≈ −∇I₁ ∂p₂/∂q

with Y = R m + ρ t and P_Y = ∂π/∂Y. The pose takes what it can; what is left says q, with the covariance of the
scatter between cells of the image (see `tracking.py`). Frames are combined by their information, and the standard deviation
grows by how much they disagree. Depths are held: those of a stereo pair would change with the intrinsics, which is not looked at.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion
from boxplus.residuals.camera.photometric_sampling import sample
from boxplus.systems.direct_alignment.tracking import Alignment
from boxplus.systems.direct_odometry.window_system import WindowKeyframe

Matrix = NDArray[np.float64]
_NAMES = ("the focal length", "the principal point along u", "the principal point along v")
_CUT = 4.685  # of Tukey's weights, in σ
_CELLS = 6  # across and down
_FEWEST, _LEAST_SIGMAS = 5, 5.0  # frames, and standard deviations, for a contradiction
_LEAST_SHARE = 0.02  # by the focal length; smaller errors than that do not need to be told
_OWN_ERROR = 0.003  # standard deviation of one frame that its scatter does not show: interpolation, vignetting


class CalibrationWatch:
    """What the frames so far say of the intrinsics."""

    def __init__(self) -> None:
        self._information, self._vector, self._square, self._frames = np.zeros((3, 3)), np.zeros(3), 0.0, 0

    def add(self, keyframe: WindowKeyframe, image: NDArray[np.float32], alignment: Alignment) -> None:
        """A frame that was aligned to a keyframe."""
        found = _intrinsics_error(keyframe, image, alignment)
        if found is None:
            return
        q, covariance = found
        information = np.linalg.inv(covariance + np.eye(3) * _OWN_ERROR**2)
        self._information += information
        self._vector += information @ q
        self._square += float(q @ information @ q)
        self._frames += 1

    @property
    def contradiction(self) -> str:
        """Which intrinsics must be wrong, in a sentence; empty where none."""
        if self._frames < _FEWEST:
            return ""
        covariance = np.linalg.inv(self._information)
        q = covariance @ self._vector
        disagreement = (self._square - float(q @ self._information @ q)) / (3.0 * (self._frames - 1))
        sigma = np.sqrt(np.diag(covariance) * max(disagreement, 1.0))
        wrong = (np.abs(q) > _LEAST_SHARE) & (np.abs(q) > _LEAST_SIGMAS * sigma)
        if not wrong.any():
            return ""
        k = int(np.argmax(np.where(wrong, np.abs(q) / sigma, 0.0)))
        kind = "" if k == 0 else " of the focal length"
        return (
            f"grey values contradict {_NAMES[k]}: they ask for {100.0 * q[k]:+.1f} %{kind}, with a standard deviation of "
            f"{100.0 * sigma[k]:.1f} %; check the calibration, and whether the images were scaled or cropped"
        )


def _intrinsics_error(keyframe: WindowKeyframe, image: NDArray[np.float32], alignment: Alignment) -> tuple[Matrix, Matrix] | None:
    """q (3,) by the focal length, and its covariance; None where the image does not say it."""
    level, camera = keyframe.tracker.levels[-1], keyframe.tracker.camera
    if level.octave > 0 or camera.distortion is not None:
        return None
    R, t = quaternion.to_matrix(alignment.T_21[:4]), alignment.T_21[4:]
    m = np.column_stack([level.rays, np.ones(len(level.rays))])
    Y = m @ R.T + level.inverse_depth[:, None] * t
    Y[:, 2] = np.maximum(Y[:, 2], 1e-6)
    a, b, z = Y[:, 0] / Y[:, 2], Y[:, 1] / Y[:, 2], Y[:, 2]
    f = np.array([camera.fx, camera.fy])
    value, _, seen = sample(image, np.column_stack([f[0] * a + camera.cx, f[1] * b + camera.cy]))
    gain, offset = np.exp(alignment.brightness[0]), alignment.brightness[1]
    e = np.where(seen, level.grey - gain * value - offset, 0.0)
    weight = np.where(seen, np.clip(1.0 - (e / (_CUT * alignment.sigma)) ** 2, 0.0, 1.0) ** 2, 0.0)
    u, v = level.pixels.astype(np.int64).T
    grey = keyframe.grey.astype(np.float64)
    inside = (u > 0) & (v > 0) & (u < grey.shape[1] - 1) & (v < grey.shape[0] - 1)
    u, v = np.clip(u, 1, grey.shape[1] - 2), np.clip(v, 1, grey.shape[0] - 2)
    slope = 0.5 * np.stack([grey[v, u + 1] - grey[v, u - 1], grey[v + 1, u] - grey[v - 1, u]], axis=1)

    def moved(d: Matrix) -> Matrix:
        """P_Y R d (n, 2) for d (n, 3)."""
        D = d @ R.T
        return f * np.stack([(D[:, 0] - a * D[:, 2]) / z, (D[:, 1] - b * D[:, 2]) / z], axis=1)

    zero, one = np.zeros(len(m)), np.ones(len(m))
    columns = [
        f * np.stack([a, b], axis=1) - moved(np.column_stack([level.rays, zero])),
        np.column_stack([f[0] * one, zero]) - moved(np.column_stack([one, zero, zero])),
        np.column_stack([zero, f[1] * one]) - moved(np.column_stack([zero, one, zero])),
    ]
    C = np.stack([-(slope * column).sum(axis=1) for column in columns], axis=1)
    J = np.column_stack([level.J, level.grey, one, C])
    scale = 1.0 / np.sqrt(np.maximum(((weight * inside)[:, None] * J**2).sum(axis=0), 1e-300))
    J = J * scale
    rows = (weight * inside)[:, None] * J
    H, g = rows.T @ J, rows.T @ e
    if np.linalg.cond(H) > 1e10:
        return None
    inverse = np.linalg.inv(H)
    x = -inverse @ g
    left = e + J @ x
    height, width = grey.shape
    cell = (level.pixels[:, 1] * _CELLS / height).astype(np.int64) * _CELLS + (level.pixels[:, 0] * _CELLS / width).astype(
        np.int64
    )
    scores = np.zeros((_CELLS * _CELLS, J.shape[1]))
    np.add.at(scores, cell, rows * left[:, None])
    factor = _CELLS**2 / (_CELLS**2 - J.shape[1])
    covariance = factor * (inverse @ (scores.T @ scores) @ inverse) * scale[:, None] * scale
    return (x * scale)[-3:], covariance[-3:, -3:]
