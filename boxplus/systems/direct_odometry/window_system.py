"""The window's normal equations at one point: those of every pair of keyframes, mapped to its state (see `window.py`)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.pinhole import Pinhole
from boxplus.manifolds import quaternion, se3
from boxplus.systems.direct_alignment.keyframe import Keyframe
from boxplus.systems.direct_odometry.patches import Patches
from boxplus.systems.direct_odometry.window_kernel import GOOD, OUTLIER, OUTSIDE, add_rows, eliminate, patch_pair

Matrix = NDArray[np.float64]

DOF = 7  # of a keyframe: ξ of its pose, a
_HUBER, _OUTLIER = 1.345, 4.0  # in standard deviations: of a pixel, and of the mean over a patch
_CELLS_ACROSS, _CELLS_DOWN = 4, 3  # of an image, whose errors are taken for independent of each other


@dataclass(slots=True, eq=False)
class WindowKeyframe:
    """A keyframe in the window.

    Attributes:
        number: of the keyframe, counted from 0; time_ns: of its image.
        grey: (H, W) float32.
        T_world_camera: (7,); log_gain: a, of its brightness.
        tracker: what images are tracked against; patches: what the window adjusts.
        first: first estimates of pose and a, from when on a prior knows it.
        least_sigma: of the frames that were aligned to it so far [grey values].
    """

    number: int
    time_ns: int
    grey: NDArray[np.float32]
    T_world_camera: Matrix
    log_gain: float
    tracker: Keyframe
    patches: Patches
    first: tuple[Matrix, float] | None = None
    least_sigma: float = np.inf

    @property
    def first_pose(self) -> Matrix:
        """(7,) where Jacobians are taken."""
        return self.T_world_camera if self.first is None else self.first[0]

    def freeze(self) -> None:
        """From now on Jacobians are taken here."""
        if self.first is None:
            self.first = self.T_world_camera.copy(), self.log_gain

    def moved(self) -> Matrix:
        """(7,) x ⊟ x₀."""
        if self.first is None:
            return np.zeros(DOF)
        T, log_gain = self.first
        return np.append(se3.log(se3.compose(se3.inverse(T), self.T_world_camera)), self.log_gain - log_gain)

    def points(self) -> NDArray[np.float32]:
        """(k, 3) of its patches, in the world [m]."""
        R, p = quaternion.to_matrix(self.T_world_camera[:4]), self.T_world_camera[4:]
        return (self.patches.points() @ R.T + p).astype(np.float32)

    def block(self, index: int) -> slice:
        """Its place in the window's state, where it is the `index`-th."""
        return slice(DOF * index, DOF * index + DOF)


@dataclass(slots=True, eq=False)
class OfHost:
    """What the patches of one keyframe say.

    Attributes:
        W: (n, m) of inverse depths with the window's state; H_rho, g_rho: (n,); pulls: (n, m) Jᵀe by patch.
    """

    W: Matrix
    H_rho: Matrix
    g_rho: Matrix
    pulls: Matrix

    def reduced_pulls(self) -> Matrix:
        """(n, m) pulls once the inverse depths gave way."""
        informed = self.H_rho > 0.0
        share = np.where(informed, self.g_rho / np.where(informed, self.H_rho, 1.0), 0.0)
        return self.pulls - self.W * share[:, None]


@dataclass(slots=True, eq=False)
class System:
    """Normal equations of photometric residuals and measured depths.

    Attributes:
        H, g: (m, m), (m,) of the state; hosts: what is to be eliminated from them, by index of the keyframe.
        cost: ½ Σ; good, outliers: patches in other keyframes that count, or do not; errors: mean |e| of those seen, by pair.
        visible: share of each keyframe's patches that the newest one sees, by index.
    """

    H: Matrix
    g: Matrix
    hosts: dict[int, OfHost] = field(default_factory=dict)
    cost: float = 0.0
    good: int = 0
    outliers: int = 0
    errors: list[Matrix] = field(default_factory=list)
    visible: dict[int, float] = field(default_factory=dict)

    @property
    def seen(self) -> int:
        """Patches in other keyframes that lie in their images."""
        return self.good + self.outliers

    def reduced(self) -> tuple[Matrix, Matrix]:
        """H and g without the inverse depths."""
        H, g = self.H.copy(), self.g.copy()
        for of_host in self.hosts.values():
            eliminate(of_host.W, of_host.H_rho, of_host.g_rho, H, g)
        return H, g

    def scatter(self, keyframes: Sequence[WindowKeyframe]) -> Matrix:
        """(m, m) covariance of the reduced gradient, as the cells of the images scatter it."""
        total = np.zeros_like(self.H)
        for index, of_host in self.hosts.items():
            height, width = keyframes[index].grey.shape
            u, v = keyframes[index].patches.pixels.T
            row, column = (v * _CELLS_DOWN / height).astype(np.int64), (u * _CELLS_ACROSS / width).astype(np.int64)
            sums = np.zeros((_CELLS_ACROSS * _CELLS_DOWN, len(self.H)))
            np.add.at(sums, row * _CELLS_ACROSS + column, of_host.reduced_pulls())
            total += sums.T @ sums
        return total


class _Between:
    """T_th (n, n, 7) from every keyframe h to every t, now and at first estimates, and adjoints (n, n, 6, 6) of the latter."""

    def __init__(self, keyframes: Sequence[WindowKeyframe]) -> None:
        self.now = _relative(np.array([k.T_world_camera for k in keyframes]))
        self.first = _relative(np.array([k.first_pose for k in keyframes]))
        n = len(keyframes)
        self.adjoints = se3.adjoint(self.first.reshape(-1, 7)).reshape(n, n, 6, 6)


def _relative(T_world_camera: Matrix) -> Matrix:
    n = len(T_world_camera)
    return se3.compose(np.repeat(se3.inverse(T_world_camera), n, axis=0), np.tile(T_world_camera, (n, 1))).reshape(n, n, 7)


def linearize(
    keyframes: Sequence[WindowKeyframe],
    camera: Pinhole,
    sigma: float,
    spread: float,
    *,
    hosts: Iterable[int] | None = None,
    with_jacobians: bool = True,
) -> System:
    """The patches of all keyframes, or of those at `hosts`, in all others; their information divided by `spread`."""
    size = DOF * len(keyframes)
    system = System(np.zeros((size, size)), np.zeros(size))
    between = _Between(keyframes)
    for host in range(len(keyframes)) if hosts is None else hosts:
        patches = keyframes[host].patches
        n, difference = len(patches), patches.rho - patches.measured
        pull = patches.information * difference
        of_host = OfHost(np.zeros((n, size)), patches.information.copy(), pull, np.zeros((n, size)))
        system.cost += 0.5 * float(pull @ difference)
        for target in range(len(keyframes)):
            if target != host:
                _add_pair(system, of_host, keyframes, between, host, target, camera, sigma, 1.0 / spread, with_jacobians)
        system.hosts[host] = of_host
    return system


def _add_pair(
    system: System,
    of_host: OfHost,
    keyframes: Sequence[WindowKeyframe],
    between: _Between,
    host: int,
    target: int,
    camera: Pinhole,
    sigma: float,
    scale: float,
    with_jacobians: bool,
) -> None:
    """Patches of one keyframe in another: ξ = Ad(T_th) ξ_h − ξ_t, and a_t − a_h."""
    h, t, n = keyframes[host], keyframes[target], len(of_host.H_rho)
    T_th, T_first = between.now[target, host], between.first[target, host]
    H, g, cross, pulls = np.empty((DOF, DOF)), np.empty(DOF), np.empty((n, DOF)), np.empty((n, DOF))
    h_rho, g_rho, errors, state = np.empty(n), np.empty(n), np.empty(n), np.empty(n, np.uint8)
    p = h.patches
    system.cost += scale * patch_pair(
        T_th, T_first, float(np.exp(t.log_gain - h.log_gain)), p.rays, p.grey, p.share, p.tilt, p.rho, t.grey,
        camera.padded_parameters, camera.z_min, sigma, _HUBER, _OUTLIER, with_jacobians, H, g, cross, h_rho, g_rho, pulls,
        errors, state,
    )  # fmt: skip
    system.good += int(np.count_nonzero(state == GOOD))
    system.outliers += int(np.count_nonzero(state == OUTLIER))
    system.errors.append(errors[state != OUTSIDE])
    if target == len(keyframes) - 1:
        system.visible[host] = float(np.mean(state != OUTSIDE)) if n else 0.0
    if not with_jacobians:
        return
    of_h, of_t = h.block(host), t.block(target)
    M_h, M_t = np.zeros((DOF, DOF)), np.diag([-1.0] * 6 + [1.0])
    M_h[:6, :6], M_h[6, 6] = between.adjoints[target, host], -1.0
    HM_h, HM_t = scale * H @ M_h, scale * H @ M_t
    system.H[of_h, of_h] += M_h.T @ HM_h
    system.H[of_h, of_t] += M_h.T @ HM_t
    system.H[of_t, of_h] += M_t.T @ HM_h
    system.H[of_t, of_t] += M_t.T @ HM_t
    system.g[of_h] += scale * (g @ M_h)
    system.g[of_t] += scale * (g @ M_t)
    adjoint = between.adjoints[target, host]
    add_rows(cross, adjoint, scale, of_h.start, of_t.start, of_host.W)
    add_rows(pulls, adjoint, scale, of_h.start, of_t.start, of_host.pulls)
    of_host.H_rho += scale * h_rho
    of_host.g_rho += scale * g_rho
