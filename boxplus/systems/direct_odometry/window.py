"""Windowed photometric adjustment: poses, brightness and inverse depths of the last keyframes, together.

A patch of keyframe h (host), eight pixels p with rays m and one inverse depth ρ, seen by keyframe t:

    e = I_t(p') − λ I_h(p) − o,   p' = π(R m + s ρ t),   (R, t) = T_th = T_wt⁻¹ T_wh,   λ = e^(a_t − a_h)

s is the tilt of the surface, 1 at the patch's centre; o an offset of its own for every patch in every keyframe, eliminated at
once: light that changes across the image (vignetting, reflections) would else pull the poses. The eight rows are linearised by
ξ, which moves T_th on the left, and by a_t. With poses moved on the right, ξ = Ad(T_th) ξ_h − ξ_t and ∂e/∂a_h = −∂e/∂a_t, so
that a pair (h, t) of keyframes has one 7x7 system, mapped to the window's by two 7x7 matrices. Inverse depths are eliminated
point by point (Schur complement). What the sensor measured of a depth, z ± σ_z, is a residual (ρ − 1/z) z²/σ_z.

A keyframe that leaves takes its patches with it: their normal equations, reduced by the inverse depths and then by the leaving
pose, stay as a prior ½ δᵀH_p δ + g_pᵀδ, δ = x ⊟ x₀. Of every keyframe that the prior knows, Jacobians are taken at its first
estimate x₀ from then on (docs/marginalization.md). What other keyframes' patches saw in the one that leaves is dropped.

Information is divided by f, how much more the pulls of the images' cells scatter than independent pixels would: neighbouring
pixels err together. f is estimated with every adjustment.

Source: Engel, Koltun and Cremers, Direct Sparse Odometry, TPAMI 2018, 2.2 and 2.3; Huang, Mourikis and Roumeliotis,
Observability-based rules for designing consistent EKF SLAM estimators, IJRR 2010 (first estimates).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.pinhole import Pinhole
from boxplus.manifolds import quaternion, se3
from boxplus.systems.direct_odometry.window_system import DOF, Matrix, System, WindowKeyframe, linearize

_SIGMA_GAIN = 1e-3  # standard deviation of the first keyframe's a: it is the unit
_ANY_GAIN = 1.0  # of the others', where nothing else says it
_SIGMA_SCALE = 1e-3  # standard deviation of the distance that is the unit of length, by itself
_MEAN_TO_SIGMA = 1.2533  # of normal errors
_LEAST_SIGMA = 1e-3  # of the range of grey values
_DAMPING, _LARGEST_DAMPING = 1e-5, 1e3
_FIRST_SPREAD, _LARGEST_SPREAD = 4.0, 100.0
_LEAST_VISIBLE = 0.05  # share of a keyframe's patches that the newest one sees; with less it leaves first


@dataclass(frozen=True, slots=True)
class Adjustment:
    """What an adjustment of the window did.

    Attributes:
        iterations: steps tried; cost_before, cost: ½ Σ of residuals and prior.
        sigma: robust standard deviation of the residuals [grey values]; spread: f, see the head of this file.
        residuals: patches in other keyframes that count; outliers: those that do not.
    """

    iterations: int
    cost_before: float
    cost: float
    sigma: float
    spread: float
    residuals: int
    outliers: int


class Window:
    """The last keyframes, and what those before them left.

    Args:
        camera: of all keyframes.
        size: keyframes that stay.

    Attributes:
        keyframes: oldest first.
        taken: how many keyframes there were so far.
        H_prior, g_prior: (7n, 7n), (7n,) of what left, at the first estimates.
    """

    def __init__(self, camera: Pinhole, size: int) -> None:
        self.camera, self.size = camera, size
        self.keyframes: list[WindowKeyframe] = []
        self.taken = 0
        self.sigma, self.spread = 0.0, _FIRST_SPREAD
        self.H_prior: Matrix = np.zeros((0, 0))
        self.g_prior: Matrix = np.zeros(0)
        self._covariance: Matrix = np.zeros((0, 0))
        self._visible: dict[int, float] = {}
        self._finished: list[NDArray[np.float32]] = [np.zeros((0, 3), np.float32)]  # the first one stays

    def covariance(self, keyframe: WindowKeyframe) -> Matrix:
        """(6, 6) of ξ in T_world_camera Exp(ξ), as of the last adjustment."""
        first = DOF * self.keyframes.index(keyframe)
        return self._covariance[first : first + 6, first : first + 6]

    def points(self) -> NDArray[np.float32]:
        """(k, 3) of all keyframes' patches, in the world [m]."""
        return np.concatenate([self._finished[0], *(keyframe.points() for keyframe in self.keyframes)])

    def take_finished(self) -> NDArray[np.float32]:
        """(k, 3) those of keyframes that left since this was asked."""
        finished, self._finished = np.concatenate(self._finished), self._finished[:1]
        return finished

    def begin(self, keyframe: WindowKeyframe, covariance: Matrix) -> None:
        """Forget all others: this one's pose is known with a covariance (6, 6), as that of ξ in T_world_camera Exp(ξ)."""
        keyframe.freeze()
        self._finished += [each.points() for each in self.keyframes]
        self.keyframes = [keyframe]
        self.taken += 1
        self._covariance = np.zeros((DOF, DOF))
        self._covariance[:6, :6], self._covariance[6, 6] = covariance, _SIGMA_GAIN**2
        self.H_prior = np.asarray(np.linalg.inv(self._covariance), dtype=np.float64)
        self.g_prior = np.zeros(DOF)
        self._visible = {}

    def add(self, keyframe: WindowKeyframe, covariance: Matrix, *, holds_scale: bool = False) -> None:
        """A new keyframe, with pose and covariance by tracking until the window is adjusted; one leaves if there are too many.

        Args:
            holds_scale: its distance from the keyframe before is the unit of length: no depth was measured.
        """
        if len(self.keyframes) >= self.size:
            self._marginalize(self._leaving(keyframe))
        self.keyframes.append(keyframe)
        self.taken += 1
        size = DOF * len(self.keyframes)
        H, g, C = np.zeros((size, size)), np.zeros(size), np.zeros((size, size))
        H[:-DOF, :-DOF], g[:-DOF], C[:-DOF, :-DOF] = self.H_prior, self.g_prior, self._covariance
        H[-1, -1] = _ANY_GAIN**-2.0
        if holds_scale:
            keyframe.freeze()
            way, row = keyframe.T_world_camera[4:] - self.keyframes[-2].T_world_camera[4:], np.zeros(size)
            for index, sign in ((-2, -1.0), (-1, 1.0)):  # of the distance alone: where both are is another matter
                first = size + index * DOF
                row[first + 3 : first + 6] = sign * quaternion.to_matrix(self.keyframes[index].T_world_camera[:4]).T @ way
            H += np.outer(row, row) / (_SIGMA_SCALE * float(way @ way)) ** 2
        C[-DOF:-1, -DOF:-1], C[-1, -1] = covariance, _ANY_GAIN**2.0
        self.H_prior, self.g_prior, self._covariance = H, g, C

    def adjust(self, max_iterations: int = 6, tolerance: float = 1e-3) -> Adjustment:
        """Levenberg-Marquardt over the window, in place; ends when the cost changes by less than `tolerance`, relatively."""
        self.sigma = self._sigma()
        system = self._linearize()
        cost = before = self._cost(system, system.seen)
        damping, tried = _DAMPING, 0
        while tried < max_iterations and damping <= _LARGEST_DAMPING:
            tried += 1
            saved = [(k.T_world_camera, k.log_gain, k.patches.rho) for k in self.keyframes]
            self._step(system, damping)
            trial = self._linearize()
            trial_cost, allowed = self._cost(trial, system.seen), tolerance * system.cost
            # The gradient is not that of the cost to the last digit: first estimates, and differences without the image's noise.
            if trial_cost < cost + allowed:
                is_done = trial_cost > cost - allowed
                system, damping = trial, 0.1 * damping
                cost = self._cost(system, system.seen)
                if is_done:
                    break
                continue
            for keyframe, (T, log_gain, rho) in zip(self.keyframes, saved, strict=True):
                keyframe.T_world_camera, keyframe.log_gain, keyframe.patches.rho = T, log_gain, rho
            damping *= 100.0
        self._judge(system)
        return Adjustment(tried, before, cost, self.sigma, self.spread, system.good, system.outliers)

    def _moved(self) -> Matrix:
        return np.concatenate([k.moved() for k in self.keyframes])

    def _linearize(self) -> System:
        return linearize(self.keyframes, self.camera, self.sigma, self.spread)

    def _cost(self, system: System, seen: int) -> float:
        """As if `seen` patches were seen: one that leaves an image is no gain, and one that enters no loss."""
        moved = self._moved()
        return system.cost * seen / max(system.seen, 1) + float(0.5 * moved @ self.H_prior @ moved + self.g_prior @ moved)

    def _sigma(self) -> float:
        """By the median of the patches' mean |e|."""
        errors = np.concatenate(linearize(self.keyframes, self.camera, 1e30, 1.0, with_jacobians=False).errors)
        least = max(_LEAST_SIGMA * self.keyframes[-1].tracker.contrast, 1e-30)
        return max(_MEAN_TO_SIGMA * float(np.median(errors)), least) if len(errors) else least

    def _step(self, system: System, damping: float) -> None:
        """One damped Gauss-Newton step."""
        H, g = system.reduced()
        H, g = H + self.H_prior, g + self.H_prior @ self._moved() + self.g_prior
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        damped = H * scale[:, None] * scale
        damped[np.diag_indices_from(damped)] += damping + 1e-12
        step = -scale * np.linalg.solve(damped, scale * g)
        for index, keyframe in enumerate(self.keyframes):
            own, of_host, patches = step[keyframe.block(index)], system.hosts[index], keyframe.patches
            keyframe.T_world_camera = se3.compose(keyframe.T_world_camera, se3.exp(own[:6]))
            keyframe.log_gain += float(own[6])
            pull, known = of_host.g_rho + of_host.W @ step, of_host.H_rho > 0.0
            change = np.where(known, -pull / np.where(known, of_host.H_rho, 1.0), 0.0)
            patches.rho = np.clip(patches.rho + change, 0.5 * patches.rho, 2.0 * patches.rho)

    def _judge(self, system: System) -> None:
        """Covariance of the keyframes, and f."""
        H, _ = system.reduced()
        whole = H + self.H_prior
        scale = 1.0 / np.sqrt(np.maximum(np.diag(whole), 1e-300))
        covariance = np.linalg.inv(whole * scale[:, None] * scale) * scale[:, None] * scale
        informed = float(np.sum(covariance * H))
        if informed > 0.0:
            ratio = float(np.sum(covariance * system.scatter(self.keyframes))) / informed
            self.spread = float(np.clip(self.spread * (0.5 + 0.5 * ratio), 1.0, _LARGEST_SPREAD))
        self._covariance, self._visible = covariance, {self.keyframes[i].number: s for i, s in system.visible.items()}

    def _leaving(self, coming: WindowKeyframe) -> int:
        """Which keyframe leaves: one of which the newest sees next to nothing, else one close to others; never the newest."""
        seen = [self._visible.get(k.number, 1.0) for k in self.keyframes[:-1]]
        if min(seen) < _LEAST_VISIBLE:
            return int(np.argmin(seen))
        centres = np.array([k.T_world_camera[4:] for k in self.keyframes])
        scores = []
        for i in range(len(self.keyframes) - 1):
            near = np.linalg.norm(centres - centres[i], axis=1)
            near[i] = np.inf
            away = np.linalg.norm(centres[i] - coming.T_world_camera[4:])
            scores.append(np.sqrt(away) * float(np.sum(1.0 / (near + 1e-5))))
        return int(np.argmax(scores))

    def _marginalize(self, index: int) -> None:
        """Let a keyframe go, and keep what its patches said of the others' poses."""
        for keyframe in self.keyframes:
            keyframe.freeze()
        if self.sigma > 0.0:
            H, g = linearize(self.keyframes, self.camera, self.sigma, self.spread, hosts=[index]).reduced()
            self.H_prior = self.H_prior + H
            self.g_prior = self.g_prior + g - H @ self._moved()
        own = self.keyframes[index].block(index)
        gone = np.arange(own.start, own.stop)
        stay = np.setdiff1d(np.arange(len(self.g_prior)), gone)
        H_gone = self.H_prior[np.ix_(gone, gone)]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H_gone), 1e-300))
        inverse = np.linalg.pinv(H_gone * scale[:, None] * scale, rcond=1e-12, hermitian=True) * scale[:, None] * scale
        across: Matrix = self.H_prior[np.ix_(stay, gone)] @ inverse
        self.g_prior = self.g_prior[stay] - across @ self.g_prior[gone]
        H = self.H_prior[np.ix_(stay, stay)] - across @ self.H_prior[np.ix_(gone, stay)]
        self.H_prior, self._covariance = 0.5 * (H + H.T), self._covariance[np.ix_(stay, stay)]
        self._finished.append(self.keyframes.pop(index).points())
