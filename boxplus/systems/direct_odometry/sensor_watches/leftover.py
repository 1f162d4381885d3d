"""What is left of the residuals of an aligned frame after the pose took what it can, and what would explain it.

At a frame that was tracked, e = I₁(p₁) − (eᵃ I₂(p₂) + b) with p₂ = π(Y), Y = R m + ρ t, is linearised by what was estimated
(ξ, a, b) and by causes q that were not, each of which moves p₂ by ∂p₂/∂q (`calibration_causes.py`, `depth_watch.py`):

    ∂e/∂q ≈ −∇I₁ ∂p₂/∂q

The pose takes what it can; what is left says q, with the covariance of the scatter between cells of the image (see
`tracking.py`). With weights w it is a single step, and one that is too short, as weights are small where q leaves residuals: w e
grows with e by its slope, in the mean Σ (w e)'/Σ w, by which x is divided. Frames are combined by their information, and
the standard deviation grows by how much they disagree.

Where inverse depths err pixel by pixel, x = −(JᵀWJ)⁻¹ JᵀWe is biased however many pixels there are: errors of ρ are in e and in J
alike, so that lengths come out too short by the share of the errors in how much ρ varies, and a cause that moves all pixels alike
takes the rest. Instruments Z, the columns of J by a smooth surface through the ρ of all pixels, vary with them and know no single
one: x = −(ZᵀWJ)⁻¹ ZᵀWe.

Source: Carroll, Ruppert, Stefanski and Crainiceanu, Measurement Error in Nonlinear Models, 2006, chapter 6; single steps: Huber
and Ronchetti, Robust Statistics, 2009, chapter 7.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr, stdtrit

from boxplus.manifolds import quaternion
from boxplus.residuals.camera.photometric_sampling import sample
from boxplus.systems.direct_alignment.tracking import Alignment
from boxplus.systems.direct_odometry.window_system import WindowKeyframe

Matrix = NDArray[np.float64]
_FEWEST, _MANY = 3, 5  # frames for a contradiction; from the latter on how much they disagree is known well enough
_CUT = 4.685  # of Tukey's weights, in σ
_LEAST_GROWTH = 0.1  # of weighted residuals, by the weights
_CELLS = 6  # across and down
_NOTHING = 1e-6  # information of what no frame was asked for
_CONDITION = 1e10  # of the normal equations, from which on a frame says nothing
_DEGREE, _LEAST_SMOOTH = 3, 0.05  # of the polynomial that smooths inverse depths; by their median, which it stays above


class Leftover:
    """Residuals of a frame at the keyframe's pixels, at full resolution.

    Args:
        keyframe: that the frame was aligned to, with a level of full resolution.
        image: grey values (H, W) of the frame.
        alignment: of the frame to the keyframe.

    Attributes:
        pixels: (n, 2) p₁; m: (n, 3) their rays of z = 1; inverse_depth: (n,) [1/m].
        Y: (n, 3) by inverse depth where they are in the frame's camera; seen_at: (n, 2) p₂.
    """

    @classmethod
    def of(cls, keyframe: WindowKeyframe, image: NDArray[np.float32], alignment: Alignment) -> Leftover | None:
        """None where the keyframe has no level of full resolution."""
        return cls(keyframe, image, alignment) if keyframe.tracker.levels[-1].octave == 0 else None

    def __init__(self, keyframe: WindowKeyframe, image: NDArray[np.float32], alignment: Alignment) -> None:
        level, camera = keyframe.tracker.levels[-1], keyframe.tracker.camera
        self.pixels, self._camera, self._sigma = level.pixels, camera, alignment.sigma
        self._R, self._t = quaternion.to_matrix(alignment.T_21[:4]), alignment.T_21[4:]
        self.m = np.column_stack([level.rays, np.ones(len(level.rays))])
        self._place(level.inverse_depth)
        value, _, seen = sample(image, self.seen_at)
        gain, offset = np.exp(alignment.brightness[0]), alignment.brightness[1]
        self._e = np.where(seen, level.grey - gain * value - offset, 0.0)
        share = np.where(seen, (self._e / (_CUT * alignment.sigma)) ** 2, 1.0)
        weight = np.where(share < 1.0, (1.0 - share) ** 2, 0.0)
        growth = np.where(share < 1.0, (1.0 - share) * (1.0 - 5.0 * share), 0.0)  # (w e)'
        grey = keyframe.grey.astype(np.float64)
        height, width = grey.shape
        u, v = level.pixels.astype(np.int64).T
        inside = (u > 0) & (v > 0) & (u < width - 1) & (v < height - 1)
        self._weight = weight * inside
        self._growth = growth * inside
        u, v = np.clip(u, 1, width - 2), np.clip(v, 1, height - 2)
        self._slope = 0.5 * np.stack([grey[v, u + 1] - grey[v, u - 1], grey[v + 1, u] - grey[v - 1, u]], axis=1)
        self._by_motion, self._by_light = level.J, np.column_stack([level.grey, np.ones(len(level.rays))])
        self._cell = (level.pixels[:, 1] * _CELLS / height).astype(np.int64) * _CELLS
        self._cell += (level.pixels[:, 0] * _CELLS / width).astype(np.int64)

    def _place(self, inverse_depth: Matrix) -> None:
        """Where pixels with these inverse depths (n,) are in the frame."""
        self.inverse_depth = inverse_depth
        self.Y = self.m @ self._R.T + inverse_depth[:, None] * self._t
        projected, by_point, _, is_ahead = self._camera.project_with_jacobians(self.Y)
        self.seen_at = np.where(is_ahead[:, None], projected, -1.0)
        self._P = np.nan_to_num(by_point)

    def smoothed(self) -> Leftover:
        """The same with inverse depths of a smooth surface through all of them, which the error of a single one hardly moves."""
        low, high = self.pixels.min(axis=0), self.pixels.max(axis=0)
        u, v = (2.0 * (self.pixels - low) / np.maximum(high - low, 1.0) - 1.0).T
        powers = np.stack([u**i * v**j for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)], axis=1)
        root = np.sqrt(self._weight)
        coefficients = np.linalg.lstsq(powers * root[:, None], self.inverse_depth * root, rcond=None)[0]
        smooth = np.maximum(powers @ coefficients, _LEAST_SMOOTH * float(np.median(self.inverse_depth)))
        other = copy.copy(self)
        other._place(smooth)
        other._by_motion = self._by_motion.copy()
        other._by_motion[:, 3:] *= (smooth / self.inverse_depth)[:, None]
        return other

    def turned(self, d: Matrix) -> Matrix:
        """P_Y R d (n, 2) [pixels], P_Y = ∂π/∂Y, for d (n, 3)."""
        return self.projected(d @ self._R.T)

    @property
    def by_inverse_depth(self) -> Matrix:
        """∂p₂/∂ρ = P_Y t (n, 2) [pixels · m]."""
        return self.projected(np.broadcast_to(self._t, (len(self.m), 3)))

    def projected(self, D: Matrix) -> Matrix:
        """P_Y D (n, 2) [pixels] for D (n, 3) in the frame's camera."""
        return np.asarray(np.einsum("nij,nj->ni", self._P, D))

    def share_without(self, error: float) -> Matrix:
        """(n,) by which pixels count whose inverse depths err by a share of their own: σ²/(σ² + (∇I₁ · P_Y t ρ · error)²)."""
        by_depth = (self._slope * self.by_inverse_depth).sum(axis=1) * self.inverse_depth * error
        return np.asarray(self._sigma**2 / (self._sigma**2 + by_depth**2))

    def columns(self, motions: list[Matrix]) -> Matrix:
        """J (n, 8 + k) of e by ξ, light and k causes that move pixels by `motions`, ∂p₂/∂q, (n, 2) for each of q [pixels]."""
        causes = np.stack([-(self._slope * motion).sum(axis=1) for motion in motions], axis=1)
        return np.column_stack([self._by_motion, self._by_light, causes])

    def explained_by(
        self, motions: list[Matrix], share: Matrix | None = None, instruments: Matrix | None = None
    ) -> tuple[Matrix, Matrix] | None:
        """q (k,) and its covariance (k, k); None where the frame does not say it.

        Args:
            motions: as in `columns`.
            share: (n,) of each pixel that counts; all by default.
            instruments: Z (n, 8 + k), `columns` that errors of the inverse depths are not in; J by default.
        """
        shares = np.ones(len(self._e)) if share is None else share
        weight, growth = self._weight * shares, float(self._growth @ shares)
        J = self.columns(motions)
        scale = 1.0 / np.sqrt(np.maximum((weight[:, None] * J**2).sum(axis=0), 1e-300))
        Z = (J if instruments is None else instruments) * scale
        J = J * scale
        rows = weight[:, None] * Z
        H, g = rows.T @ J, rows.T @ self._e
        if not np.linalg.cond(H) <= _CONDITION:
            return None
        inverse = np.linalg.inv(H)
        x = -inverse @ g
        left = self._e + J @ x
        scale = scale / max(growth / float(weight.sum()), _LEAST_GROWTH)  # of a step that is not too short
        scores = np.zeros((_CELLS * _CELLS, J.shape[1]))
        np.add.at(scores, self._cell, rows * left[:, None])
        factor = _CELLS**2 / (_CELLS**2 - J.shape[1])
        covariance = factor * (inverse @ (scores.T @ scores) @ inverse.T) * scale[:, None] * scale
        k = len(motions)
        return (x * scale)[-k:], covariance[-k:, -k:]


class Combined:
    """What all frames say of q together.

    Args:
        count: of q.
        own_error: standard deviation of one frame that its scatter does not show, of all or of each.
    """

    def __init__(self, count: int, own_error: ArrayLike) -> None:
        self._information, self._vector, self._square = np.zeros((count, count)), np.zeros(count), 0.0
        self._own, self.frames, self._values = np.diag(np.full(count, own_error) ** 2), 0, 0

    def add(self, q: Matrix, covariance: Matrix, which: Sequence[int] | None = None) -> None:
        """What one frame says, of all or of `which`."""
        asked = np.arange(len(self._vector)) if which is None else np.asarray(which)
        block = np.ix_(asked, asked)
        information = np.linalg.inv(covariance + self._own[block])
        self._information[block] += information
        self._vector[asked] += information @ q
        self._square += float(q @ information @ q)
        self.frames, self._values = self.frames + 1, self._values + len(q)

    def strongest(self, least: ArrayLike, least_sigmas: float) -> tuple[int, float, float] | None:
        """The cause that stands out most: its number, how much of it there is, and how well that is known; None where none does.

        Args:
            least: of every cause, or of all, what is worth a word; least_sigmas: standard deviations for a contradiction.
        """
        if self.frames < _FEWEST:
            return None
        if self.frames < _MANY:  # as unlikely by chance, where the deviation itself is told by few frames (Student's t)
            freedom = max(self._values - len(self._vector), 1)
            least_sigmas = -float(stdtrit(freedom, ndtr(-least_sigmas)))
        q, sigma = self.estimate()
        wrong = np.abs(q) > np.maximum(least_sigmas * sigma, least)
        if not wrong.any():
            return None
        k = int(np.argmax(np.where(wrong, np.abs(q) / sigma, 0.0)))
        return k, float(q[k]), float(sigma[k])

    def estimate(self) -> tuple[Matrix, Matrix]:
        """q (k,), and standard deviations (k,) that hold how much at least two frames disagree."""
        covariance = np.linalg.inv(self._information + _NOTHING * np.eye(len(self._vector)))
        q = covariance @ self._vector
        disagreement = (self._square - float(q @ self._information @ q)) / max(self._values - len(q), 1)
        return q, np.sqrt(np.diag(covariance) * max(disagreement, 1.0))
