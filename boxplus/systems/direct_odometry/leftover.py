"""What is left of the residuals of an aligned frame after the pose took what it can, and what would explain it.

At a frame that was tracked, e = I₁(p₁) − (eᵃ I₂(p₂) + b) with p₂ = π(Y), Y = R m + ρ t, is linearised by what was estimated
(ξ, a, b) and by causes q that were not, each of which moves p₂ by ∂p₂/∂q:

    ∂e/∂q ≈ −∇I₁ ∂p₂/∂q

The pose takes what it can; what is left says q, with the covariance of the scatter between cells of the image (see
`tracking.py`). Frames are combined by their information, and the standard deviation grows by how much they disagree.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.manifolds import quaternion
from boxplus.residuals.camera.photometric_sampling import sample
from boxplus.systems.direct_alignment.tracking import Alignment
from boxplus.systems.direct_odometry.window_system import WindowKeyframe

Matrix = NDArray[np.float64]
_FEWEST = 5  # frames for a contradiction
_CUT = 4.685  # of Tukey's weights, in σ
_CELLS = 6  # across and down
_CONDITION = 1e10  # of the normal equations, from which on a frame says nothing


class Leftover:
    """Residuals of a frame at the keyframe's pixels, at full resolution.

    Args:
        keyframe: that the frame was aligned to, with a level of full resolution and a camera without distortion.
        image: grey values (H, W) of the frame.
        alignment: of the frame to the keyframe.

    Attributes:
        m: (n, 3) rays of z = 1; inverse_depth: (n,) [1/m], of the keyframe's pixels.
        y: (n, 2) x/z and y/z in the frame.
    """

    @classmethod
    def of(cls, keyframe: WindowKeyframe, image: NDArray[np.float32], alignment: Alignment) -> Leftover | None:
        """None where the keyframe has no level of full resolution, or its camera a lens with distortion."""
        tracker = keyframe.tracker
        is_simple = tracker.levels[-1].octave == 0 and tracker.camera.distortion is None
        return cls(keyframe, image, alignment) if is_simple else None

    def __init__(self, keyframe: WindowKeyframe, image: NDArray[np.float32], alignment: Alignment) -> None:
        level, camera = keyframe.tracker.levels[-1], keyframe.tracker.camera
        self.inverse_depth = level.inverse_depth
        self._f = np.array([camera.fx, camera.fy])
        self._R, self._t = quaternion.to_matrix(alignment.T_21[:4]), alignment.T_21[4:]
        self.m = np.column_stack([level.rays, np.ones(len(level.rays))])
        Y = self.m @ self._R.T + level.inverse_depth[:, None] * self._t
        Y[:, 2] = np.maximum(Y[:, 2], 1e-6)
        self.y, self._z = Y[:, :2] / Y[:, 2:], Y[:, 2]
        value, _, seen = sample(image, self._f * self.y + np.array([camera.cx, camera.cy]))
        gain, offset = np.exp(alignment.brightness[0]), alignment.brightness[1]
        self._e = np.where(seen, level.grey - gain * value - offset, 0.0)
        weight = np.where(seen, np.clip(1.0 - (self._e / (_CUT * alignment.sigma)) ** 2, 0.0, 1.0) ** 2, 0.0)
        grey = keyframe.grey.astype(np.float64)
        height, width = grey.shape
        u, v = level.pixels.astype(np.int64).T
        inside = (u > 0) & (v > 0) & (u < width - 1) & (v < height - 1)
        self._weight = weight * inside
        u, v = np.clip(u, 1, width - 2), np.clip(v, 1, height - 2)
        self._slope = 0.5 * np.stack([grey[v, u + 1] - grey[v, u - 1], grey[v + 1, u] - grey[v - 1, u]], axis=1)
        self._estimated = np.column_stack([level.J, level.grey, np.ones(len(level.rays))])
        self._cell = (level.pixels[:, 1] * _CELLS / height).astype(np.int64) * _CELLS
        self._cell += (level.pixels[:, 0] * _CELLS / width).astype(np.int64)

    def turned(self, d: Matrix) -> Matrix:
        """P_Y R d (n, 2) [pixels], P_Y = ∂π/∂Y, for d (n, 3)."""
        return self._projected(d @ self._R.T)

    @property
    def by_inverse_depth(self) -> Matrix:
        """∂p₂/∂ρ = P_Y t (n, 2) [pixels · m]."""
        return self._projected(np.broadcast_to(self._t, (len(self.m), 3)))

    def _projected(self, D: Matrix) -> Matrix:
        return self._f * np.stack([(D[:, k] - self.y[:, k] * D[:, 2]) / self._z for k in (0, 1)], axis=1)

    def explained_by(self, motions: list[Matrix], share: Matrix | None = None) -> tuple[Matrix, Matrix] | None:
        """q (k,) and its covariance (k, k); None where the frame does not say it.

        Args:
            motions: ∂p₂/∂q, (n, 2) for each of q [pixels].
            share: (n,) of each pixel that counts; all by default.
        """
        weight = self._weight if share is None else self._weight * share
        causes = np.stack([-(self._slope * motion).sum(axis=1) for motion in motions], axis=1)
        J = np.column_stack([self._estimated, causes])
        scale = 1.0 / np.sqrt(np.maximum((weight[:, None] * J**2).sum(axis=0), 1e-300))
        J = J * scale
        rows = weight[:, None] * J
        H, g = rows.T @ J, rows.T @ self._e
        if np.linalg.cond(H) > _CONDITION:
            return None
        inverse = np.linalg.inv(H)
        x = -inverse @ g
        left = self._e + J @ x
        scores = np.zeros((_CELLS * _CELLS, J.shape[1]))
        np.add.at(scores, self._cell, rows * left[:, None])
        factor = _CELLS**2 / (_CELLS**2 - J.shape[1])
        covariance = factor * (inverse @ (scores.T @ scores) @ inverse) * scale[:, None] * scale
        k = len(motions)
        return (x * scale)[-k:], covariance[-k:, -k:]


class Combined:
    """What all frames say of q together.

    Args:
        count: of q.
        own_error: standard deviation of one frame that its scatter does not show.
    """

    def __init__(self, count: int, own_error: float) -> None:
        self._information, self._vector, self._square = np.zeros((count, count)), np.zeros(count), 0.0
        self._own_error, self.frames = own_error, 0

    def add(self, q: Matrix, covariance: Matrix) -> None:
        """What one frame says."""
        information = np.linalg.inv(covariance + np.eye(len(q)) * self._own_error**2)
        self._information += information
        self._vector += information @ q
        self._square += float(q @ information @ q)
        self.frames += 1

    def strongest(self, least: ArrayLike, least_sigmas: float) -> tuple[int, float, float] | None:
        """The cause that stands out most: its number, how much of it there is, and how well that is known; None where none does.

        Args:
            least: of every cause, or of all, what is worth a word; least_sigmas: standard deviations for a contradiction.
        """
        if self.frames < _FEWEST:
            return None
        q, sigma = self.estimate()
        wrong = np.abs(q) > np.maximum(least_sigmas * sigma, least)
        if not wrong.any():
            return None
        k = int(np.argmax(np.where(wrong, np.abs(q) / sigma, 0.0)))
        return k, float(q[k]), float(sigma[k])

    def estimate(self) -> tuple[Matrix, Matrix]:
        """q (k,), and standard deviations (k,) that hold how much at least two frames disagree."""
        covariance = np.linalg.inv(self._information)
        q = covariance @ self._vector
        disagreement = (self._square - float(q @ self._information @ q)) / (len(q) * (self.frames - 1))
        return q, np.sqrt(np.diag(covariance) * max(disagreement, 1.0))
