"""An image aligned to a keyframe, from coarse to fine, with a verdict on whether to believe it.

    T* = argmin_T Σ s ρ(e(T)/σ),   e = I₁(p₁) − (eᵃ I₂(π(T X₁)) + b)

by Levenberg-Marquardt, inverse compositional (see `keyframe.py`). σ is estimated anew by the median of the residuals, so that ρ
sees occlusions and reflections as outliers at every stage. A loss that turns outliers off altogether is for the finest level
only: far from the solution it would turn off what has to move, so that the levels above have `Huber(1.345)`. At the coarsest
levels the brightness stands still, as otherwise it takes a share of what motion has to explain; it is either none or that which
makes medians and spreads of the two images the same, whichever leaves less. Steep pixels count less, s = c²/(c² + |∇I|²): a
thing of high contrast that moves on its own would outweigh the rest of the image.

Source: Kerl, Sturm and Cremers, Robust Odometry Estimation for RGB-D Cameras, ICRA 2013; Baker and Matthews, Lucas-Kanade 20
Years On, IJCV 2004; the covariance: Liang and Zeger, Longitudinal Data Analysis using Generalized Linear Models, Biometrika 1986.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError
from boxplus.manifolds import se3
from boxplus.manifolds.se3 import SE3Left
from boxplus.optimization.losses import Huber, Loss, Tukey
from boxplus.sensors.images.image import Image, as_image
from boxplus.systems.direct_alignment.alignment_kernel import (
    CONVERGED,
    ITERATION_LIMIT,
    LITTLE_OVERLAP,
    NO_GRADIENT,
    align_level,
    cell_scores,
)
from boxplus.systems.direct_alignment.keyframe import FEWEST_PIXELS, Keyframe, Level
from boxplus.systems.direct_alignment.keyframe_kernel import motion_of_seen
from boxplus.systems.direct_alignment.starts import is_elsewhere, lights_to_try

_FAR_LOSS = Huber(1.345)
_BRIGHTNESS_BELOW = 3  # octaves that estimate it
_LEAST_SIGMA = 1e-3  # of the range of grey values of the keyframe; identical images have residuals of zero
_LEAST_OVERLAP = 0.2  # share of the keyframe's pixels that land in the image
_LEAST_CURVATURE = 1e-9  # smallest over largest eigenvalue of H, translations measured in units of the median depth
# Signal over noise of gradients, see `_signal`. On the recorded pairs that this was chosen on, wrong poses had 1.0 and less in
# their weakest direction, right ones 13 in the median, and below 2 only where much of the image was saturated. A mean of 4 is a
# standard deviation of the residuals worth one pixel.
_LEAST_SIGNAL, _LEAST_MEAN_SIGNAL = 2.0, 4.0
_FEWEST_ABOVE = 40  # pixels at levels above the finest, which only bring the pose closer; with fewer it stays
_CELLS = 48  # of the image, whose errors are taken for independent of each other
_LEAST_SLOPE = 0.1  # of the influence, by the weights
_NOISE_ALONE = 1.3  # signal up to which next to nothing is left of H without noise
_RECONSIDERED = 2  # octave from which on they are
_FAR_MORE, _CLEARLY_LESS = 3.0, 0.8  # of σ: a start that leaves more is not followed, an end that leaves less is taken
_SEARCH_STEP_DEG, _SEARCH_ITERATIONS, _SEARCH_TOLERANCE = 10.0, 15, 1e-3

Status = Literal["converged", "iteration limit", "little overlap", "unobservable", "large residual"]
Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """What `track` and `align_rgbd` found; figures are those at the pose returned, at the last level that was reached.

    Attributes:
        T_21: (7,) wxyz and xyz, maps points in camera 1, of the keyframe, to camera 2.
        covariance: (6, 6) of ξ = [w, v] in Exp(ξ) T_21 [rad², rad·m, m²], from how differently 48 parts of the image pull, so
            that errors of neighbouring pixels and of depth may be alike; errors that all parts share (wrong intrinsics, a wrong
            scale of the depth) are not in it. NaN where a direction of the pose is not above noise, whatever the status.
        brightness: (a, b) of image 2 [-, grey values], I₁ = eᵃ I₂ + b.
        cost: mean of ρ over the pixels that count, in units of σ².
        sigma: robust standard deviation of the residuals [grey values of image 1].
        mean_error: mean |e| [grey values of image 1].
        pixels: of image 1 that count at the finest level; overlap: their share of those compared.
        iterations: linearisations at every level, coarsest first; levels with fewer than 100 pixels with depth are left out.
        status: `converged`; `iteration limit` at the finest level; `little overlap`, fewer than 100 pixels or a fifth of
            them land in image 2; `large residual`, grey values differ by as much as a pixel's shift makes them differ, so that
            this is another place or a wrong pose; `unobservable`, a direction of motion about which grey values say
            no more than their noise.
        reason: why the pose must not be believed, in a sentence with figures; empty when `converged`.
        shift_px: of the image that makes grey values differ by as much as they do [px]; from one on it is another place.

    Example:
        >>> camera, v = bp.Pinhole(100.0, 100.0, 63.5, 47.5), np.linspace(0.0, 20.0, 128)
        >>> image = 100.0 + 40.0 * np.sin(v[None, :]) + 40.0 * np.cos(v[:96, None])
        >>> found = bp.align_rgbd(image, np.full(image.shape, 2.0), image, camera)
        >>> found.status, np.allclose(found.T_21, bp.SE3.identity(), atol=1e-3), found.covariance.shape
        ('converged', True, (6, 6))
    """

    T_21: Matrix
    covariance: Matrix
    brightness: tuple[float, float]
    cost: float
    sigma: float
    mean_error: float
    pixels: int
    overlap: float
    iterations: tuple[int, ...]
    status: Status
    reason: str
    shift_px: float = 0.0


def track(
    keyframe: Keyframe,
    image: Image | ArrayLike,
    *,
    T_21: ArrayLike = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    loss: Loss | None = None,
    brightness: bool = True,
    light: tuple[float, float] | None = None,
    max_iterations: int = 50,
    tolerance: float = 1e-4,
    search_deg: float = 0.0,
) -> Alignment:
    """Align an image to a keyframe.

    Args:
        keyframe: camera 1.
        image: grey values (H, W), or colours, of the keyframe's camera: camera 2.
        T_21: (7,) start, by default no motion; or (n, 7), of which that is followed which fits best at the coarsest level.
        loss: of e/σ at the finest level; by default `Tukey(4.685)`. Levels above have `Huber(1.345)` where the loss given turns
            outliers off.
        brightness: whether image 2 may be brighter, affinely, than image 1.
        light: (a, b) of image 2 to start from as well, as in `Alignment.brightness`, such as that of the image before.
        max_iterations: linearisations at each level.
        tolerance: the finest level ends with a step below this [rad; the translation in units of the median depth], others with
            one below what is the same in their pixels.
        search_deg: start at the coarsest level from rotations up to this far from `T_21`, 10 degrees apart, and go on with the
            best; for turns beyond about 10 degrees. The number of starts grows with its cube.

    Returns:
        Pose, covariance, brightness; and a status other than `converged`, with the reason, when they must not be believed.

    Raises:
        InputError: an image of another shape or not finite, a start that is no pose, a loss of a user's own.

    Example:
        >>> v, u = np.mgrid[:120, :160]
        >>> grey = 100.0 + 40.0 * np.sin(0.2 * u) * np.cos(0.15 * v)
        >>> keyframe = bp.Keyframe.prepare(grey, np.full((120, 160), 2.0), bp.Pinhole(150.0, 150.0, 79.5, 59.5), levels=3)
        >>> found = bp.track(keyframe, 0.8 * grey + 5.0)
        >>> found.status, round(float(np.exp(found.brightness[0])), 3)
        ('converged', 1.25)
    """
    second = as_image(image)
    if second.shape != keyframe.shape:
        raise InputError(
            "two images of the same shape", f"{keyframe.shape} and {second.shape}", "resize one of them and its camera"
        )
    if max_iterations < 1:
        raise InputError("max_iterations at least 1", f"{max_iterations}", "leave it out for 50")
    if loss is not None and loss.function is not None:
        raise InputError("a loss that the kernels of direct alignment know", f"{loss!r}", "take one of `losses` but `UserLoss`")
    starts = SE3Left.check("T_21", T_21)
    if not len(starts):
        raise InputError("at least one start T_21", "none", "leave it out to begin without motion")
    pyramid = second.pyramid(keyframe.halvings + 1)
    descent = _Descent(keyframe, Tukey(4.685) if loss is None else loss, brightness, starts[0].copy())
    if len(keyframe.levels) > 1 or len(starts) > 1 or search_deg > 0.0:
        coarsest = keyframe.levels[0]
        descent.search(coarsest, pyramid[coarsest.octave], starts, light, search_deg, min(max_iterations, _SEARCH_ITERATIONS))
    iterations: list[int] = []
    for level in keyframe.levels:
        is_free = brightness and (level.octave < _BRIGHTNESS_BELOW or level is keyframe.levels[-1])
        code = descent.refine(level, pyramid[level.octave], max_iterations, tolerance * 2.0**level.octave, is_free)
        iterations.append(int(descent.figures[5]))
    if level.octave == 0 and len(keyframe.levels) > 1 and is_elsewhere(descent.T_21, starts, keyframe):
        code, iterations[-1] = descent.reconsider(keyframe.levels, pyramid, starts, light, max_iterations, tolerance, code)
    return _judged(descent, level, pyramid[level.octave], code, tuple(iterations), tolerance)


class _Descent:
    """Pose and brightness on their way through the levels, and what the last linearisation saw."""

    def __init__(self, keyframe: Keyframe, loss: Loss, brightness: bool, T_21: Matrix) -> None:
        self.loss, self.brightness = loss, brightness
        self.z_min, self.reach = keyframe.camera.z_min, keyframe.median_depth
        self.least_sigma = max(_LEAST_SIGMA * keyframe.contrast, 1e-30)
        self.T_21, self.light = T_21, np.array([1.0, 0.0])
        self.H, self.figures = np.zeros((8, 8)), np.zeros(6)

    def refine(self, level: Level, image: Image, max_iterations: int, tolerance: float, is_free: bool) -> int:
        """Align at one level; returns the code of `align_level`."""
        is_far = level.octave > 0 and self.loss.is_redescending
        loss = _FAR_LOSS if is_far else self.loss
        fewest = int(np.ceil(max(FEWEST_PIXELS if level.octave == 0 else _FEWEST_ABOVE, _LEAST_OVERLAP * len(level.grey))))
        code: int = align_level(
            self.T_21, self.light, level.rays, level.inverse_depth, level.grey, level.J, level.share, image.grey,
            level.intrinsics, self.z_min, loss.code, loss.scale, is_free, max_iterations, tolerance, self.reach,
            self.least_sigma, fewest, self.H, self.figures,
        )  # fmt: skip
        return code

    def reconsider(
        self,
        levels: Sequence[Level],
        pyramid: Sequence[Image],
        starts: Matrix,
        light: tuple[float, float] | None,
        max_iterations: int,
        tolerance: float,
        code: int,
    ) -> tuple[int, int]:
        """Go back to a start from which the fine levels alone leave clearly less; returns the code, and the iterations.

        A small thing of high contrast that moves on its own leads the coarse levels astray, where it is much of the texture; at
        full resolution most of the image knows better, if it is asked from close by.
        """
        best = self.T_21, self.light, self.H.copy(), self.figures.copy(), code
        fine = [level for level in levels if level.octave <= _RECONSIDERED]
        for start in starts:
            self.T_21 = start.copy()
            self.light = best[1].copy() if light is None else np.array([np.exp(light[0]), light[1]])
            found = self.refine(fine[-1], pyramid[0], 0, tolerance, False)
            if found == LITTLE_OVERLAP or self.figures[4] > _FAR_MORE * best[3][4]:
                continue
            for level in fine:
                found = self.refine(level, pyramid[level.octave], max_iterations, tolerance * 2.0**level.octave, self.brightness)
            if found in (CONVERGED, ITERATION_LIMIT) and self.figures[4] < _CLEARLY_LESS * best[3][4]:
                best = self.T_21, self.light, self.H.copy(), self.figures.copy(), found
        self.T_21, self.light = best[:2]
        self.H[:], self.figures[:] = best[2:4]
        return best[4], int(self.figures[5])

    def motion_of_seen(self, level: Level, image: Image) -> Matrix:
        """(6, 6), see the kernel."""
        N = np.empty((6, 6))
        motion_of_seen(self.T_21, level.rays, level.inverse_depth, level.intrinsics, self.z_min, *image.shape, N)
        return N

    def with_equal_shares(self, level: Level, image: Image) -> tuple[Matrix, float]:
        """(8, 8) H and Σ ρ' were steep pixels to count like others: what the image has to say, not what is made of it."""
        H, figures = np.zeros((8, 8)), np.zeros(6)
        align_level(
            self.T_21.copy(), self.light.copy(), level.rays, level.inverse_depth, level.grey, level.J, np.ones(len(level.grey)),
            image.grey, level.intrinsics, self.z_min, self.loss.code, self.loss.scale, False, 0, 0.0, self.reach,
            self.least_sigma, 1, H, figures,
        )  # fmt: skip
        return H, float(figures[3])

    def spread_of_score(self, level: Level, image: Image) -> Matrix:
        """(8, 8) covariance of Jᵀe/σ² as the cells of the keyframe scatter it, in units in which H is that of its mean slope."""
        height, width = image.shape
        cell = float(np.sqrt(height * width / _CELLS))
        across, down = int(np.ceil(width / cell)), int(np.ceil(height / cell))
        scores = np.empty((across * down, 8))
        weights, slopes = cell_scores(
            self.T_21, *self.light, level.pixels, level.rays, level.inverse_depth, level.grey, level.J, level.share, image.grey,
            level.intrinsics, self.z_min, self.loss.code, self.loss.scale, self.figures[4], cell, across, scores,
        )  # fmt: skip
        seen = int(scores.any(axis=1).sum())
        missing = seen / max(seen - 8, 1)  # the eight unknowns follow the cells they are found from
        spread: Matrix = scores.T @ scores * (missing * (weights / max(slopes, _LEAST_SLOPE * weights)) ** 2)
        return spread

    def search(
        self,
        level: Level,
        image: Image,
        starts: Matrix,
        light: tuple[float, float] | None,
        search_deg: float,
        max_iterations: int,
    ) -> None:
        """Go on from that of several starts which leads to the smallest mean of |e|, where enough of the image is seen."""
        most = search_deg // _SEARCH_STEP_DEG
        steps = np.radians(_SEARCH_STEP_DEG * np.arange(-most, most + 1.0))
        grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
        grid = grid[np.linalg.norm(grid, axis=1) <= np.radians(search_deg) + 1e-12]
        turns = se3.exp(np.concatenate([grid, np.zeros_like(grid)], axis=1))
        best, least = (self.T_21, self.light), np.inf
        lights = lights_to_try(level.grey, image.grey, light) if self.brightness else [self.light]
        for gain_and_offset in lights:
            for start in (se3.compose(turn, start) for start in starts for turn in turns):
                self.T_21, self.light = start, gain_and_offset.copy()
                code = self.refine(level, image, max_iterations, _SEARCH_TOLERANCE, False)
                count, total = self.figures[0], self.figures[2]
                if code in (CONVERGED, ITERATION_LIMIT) and total < least * count:
                    best, least = (self.T_21, self.light), total / count
        self.T_21, self.light = best


def _without_brightness(H: Matrix) -> Matrix:
    """(6, 6) information of the pose when gain and offset are unknown as well."""
    return H[:6, :6] - H[:6, 6:] @ np.linalg.pinv(H[6:, 6:], hermitian=True) @ H[6:, :6]


def _signal(information: Matrix, noise: Matrix) -> Matrix:
    """How much more the grey values say about motions than noise would, (6,), weakest direction first.

    Noise of residuals of variance σ², half of it from image 1, is noise of variance σ²/4 in its central differences, and
    has a Hessian as well: σ²/4 Σ ρ' PᵀP/σ², taken here with the mean of ρ'. These are the generalised eigenvalues of the two,
    which do not depend on where the pixels lie or how far they are away. The noise of image 1 alone is less, but it also made
    pixels steep that were chosen for it: both are asked.
    """
    L = np.linalg.cholesky(noise)
    half = np.linalg.solve(L, information)
    signal: Matrix = np.linalg.eigvalsh(np.linalg.solve(L, half.T))
    return signal


def _judged(descent: _Descent, level: Level, image: Image, code: int, iterations: tuple[int, ...], tolerance: float) -> Alignment:
    """The alignment with its status."""
    pixels, (_, cost, total, weights, sigma, _) = int(descent.figures[0]), descent.figures
    overlap, count = pixels / len(level.grey), max(pixels, 1)
    covariance = np.full((6, 6), np.nan)
    status: Status = "converged"
    reason, shift_px = "", 0.0
    unit = np.array([1.0, 1.0, 1.0, descent.reach, descent.reach, descent.reach])
    H, all_weights = descent.with_equal_shares(level, image)
    information = (_without_brightness(H) if descent.brightness else H[:6, :6]) * unit[:, None] * unit
    seen = descent.motion_of_seen(level, image) * unit[:, None] * unit / count
    motion, of_image = all_weights * seen, level.gradient_noise / sigma**2
    noise, image_noise = 0.25 * motion, of_image * motion
    if code == LITTLE_OVERLAP:
        status = "little overlap"
        reason = (
            f"{pixels} of {len(level.grey)} pixels of the keyframe land in the image, at 1/{2**level.octave} of its resolution; "
            f"a fifth and {FEWEST_PIXELS} are needed: start closer, or take a keyframe that sees more of the same"
        )
    elif code == NO_GRADIENT or not _is_definite(information) or not _is_definite(noise):
        status = "unobservable"
        reason = "a direction of motion changes no grey value: the image has no texture along it"
    else:
        signal = _signal(information, noise)
        above_image = np.inf if level.gradient_noise == 0.0 else float(_signal(information, image_noise)[0])
        is_right_place = signal.mean() >= _LEAST_MEAN_SIGNAL
        shift_px = float(np.sqrt(_LEAST_MEAN_SIGNAL / signal.mean()))
        is_known = signal[0] >= _LEAST_SIGNAL and above_image >= _LEAST_SIGNAL
        if code == ITERATION_LIMIT:
            status = "iteration limit"
            reason = f"after {iterations[-1]} linearisations a step was still larger than the tolerance, {tolerance:g}"
        elif not is_right_place:
            status = "large residual"
            reason = (
                f"grey values differ by {sigma:.3g}, as much as a shift of {shift_px:.2g} pixels makes them "
                "differ (1 at most): the image shows something else, or the start was too far away"
            )
        elif not is_known:
            status = "unobservable"
            reason = (
                f"along one direction of motion grey values say {min(signal[0], above_image):.2g} times what noise would "
                f"({_LEAST_SIGNAL:g} at least): the image has no texture along it, or the residuals are too large"
            )
        if is_right_place and signal[0] > 1.0 and above_image > _NOISE_ALONE:
            covariance = _covariance(descent, level, image, unit, of_image * weights * seen)
    return Alignment(
        T_21=descent.T_21,
        covariance=covariance,
        brightness=(float(np.log(descent.light[0])), float(descent.light[1])),
        cost=cost / count,
        sigma=sigma,
        mean_error=total / count,
        pixels=pixels,
        overlap=overlap,
        iterations=iterations,
        status=status,
        reason=reason,
        shift_px=shift_px,
    )


def _covariance(descent: _Descent, level: Level, image: Image, unit: Matrix, noise: Matrix) -> Matrix:
    """(6, 6) of ξ in Exp(ξ) T_21: (H − N)⁻¹ S (H − N)⁻¹, S the scatter between cells, N what noise adds to H."""
    dof = 8 if descent.brightness else 6
    scale = np.concatenate([unit, 1.0 / np.sqrt(np.maximum(np.diag(descent.H)[6:], 1e-300))])[:dof]
    H = descent.H[:dof, :dof] * scale[:, None] * scale
    H[:6, :6] -= noise
    inverse = np.linalg.inv(H)
    spread = descent.spread_of_score(level, image)[:dof, :dof] * scale[:, None] * scale
    of_keyframe = (inverse @ spread @ inverse)[:6, :6]
    Ad = se3.adjoint(descent.T_21) * unit
    covariance: Matrix = Ad @ of_keyframe @ Ad.T
    return 0.5 * (covariance + covariance.T)


def _is_definite(matrix: Matrix) -> bool:
    eigenvalues = np.linalg.eigvalsh(matrix)
    return bool(eigenvalues[0] > _LEAST_CURVATURE * eigenvalues[-1])
