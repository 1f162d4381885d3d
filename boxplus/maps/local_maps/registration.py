"""Two local maps laid over each other: points of one on the planes of the other, and a covariance that means something.

Residuals are e = uᵀ(T p − q) with the plane (u, q) through the nearest points of the target. Their Gauss-Newton normal matrix H
is
no inverse covariance: a thousand points on one wall share the wall's error. With the gradients g_c = Σ J e w added up over cells
of a few metres, within which residuals may be as correlated as they like, the covariance of the minimum is

    Σ = κ H⁻¹ (Σ_c g_c g_cᵀ) H⁻¹ + D      (Liang and Zeger, Biometrika 1986),

with κ from simulated worlds, and D for maps that the odometry bent while it made them (docs/slam.md). Directions without
information of their own are told by the eigenvalues of H, per point and against what noise of the normals alone would give.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import as_settings
from boxplus._jit import kernel, run_chunks
from boxplus.manifolds import quaternion, se3
from boxplus.maps.ikd_tree.search import STACK, STACK_DEPTH, IkdView, copy_found, knn
from boxplus.maps.ikd_tree.tree import IkdTree
from boxplus.maps.local_maps.config import LocalMapRegistrationConfig
from boxplus.maps.plane_fit import fit_plane_into

Floats = NDArray[np.float64]

_NEIGHBOURS = 8  # a plane is fitted to
_CHUNK = 1024
_STAGES = ((2.0, 4, 1500), (1.2, 6, 3000), (0.8, 15, 8000))  # largest distance of a plane's points [m], steps, points
_STEP = 2e-4  # m, at the points: shorter ones are the end
_SHORT = 2e-3  # m, the same where a scan is followed
FEWEST_ON_PLANES = 60  # points
_SCALE = 1.4826  # from the median of |e| to a standard deviation
LEAST_RESIDUAL_SCALE = 0.01  # m, of the residuals
_BLUNT = 0.25  # of a stage's distance: least scale of the residuals where the start is a coarse guess
NOISE = 2.0  # times the information that noise of the normals alone gives


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """A source laid over a target.

    Attributes:
        T_target_source: (7,).
        covariance: (6, 6) of [w, v] [rad, m] on the right of it; `open_sigma` along weak directions.
        information: (6, 6), its inverse on the directions that were measured, zero along the others.
        weak: (k, 6) unit directions in the source's frame, turns scaled by `lever_m`, that the surfaces leave open.
        lever_m: mean distance of the points from their middle, which makes turns and shifts comparable.
        overlap: shares of the source's points near the target, and of the target's near the source.
        rms: robust standard deviation of the distances to the planes [m].
        on_planes: how many points of the source were used.
    """

    T_target_source: Floats
    covariance: Floats
    information: Floats
    weak: Floats
    lever_m: float
    overlap: tuple[float, float]
    rms: float
    on_planes: int


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """The points (N, 3) float32 of a local map [m], and a tree over them."""

    points: NDArray[np.float32]
    tree: IkdTree

    @classmethod
    def of(cls, points: NDArray[np.float32]) -> Surface:
        return cls(points, IkdTree(points, rebuild="inplace"))


def register(
    source: Surface,
    target: Surface,
    T_start: Floats,
    config: LocalMapRegistrationConfig | None = None,
    deformation: Floats | None = None,
    is_close: bool = False,
) -> Registration | None:
    """Lay a source over a target; None where too few points find a plane.

    Args:
        T_start: (7,) T_target_source to start from; `is_close` where `approach` has been there.
        deformation: (6, 6) covariance D of what the maps themselves are bent by, on the right of it; none if left out.

    Example: docs/slam.md.
    """
    config = as_settings(LocalMapRegistrationConfig, config)
    T = _staged(source, target, T_start, config, _STAGES[-1:] if is_close else _STAGES)
    if T is None:
        return None
    distance, _, count = _STAGES[-1]
    found = _Matched.of(spread(source.points, count), target, T, distance, config)
    if found is None:
        return None
    covariance, information, weak = found.covariance(config, np.zeros((6, 6)) if deformation is None else deformation)
    overlap = (
        _share_near(source.points, target, T, config.near),
        _share_near(target.points, source, se3.inverse(T), config.near),
    )
    return Registration(T, covariance, information, weak, found.lever, overlap, found.scale, len(found.e))


def approach(source: Surface, target: Surface, T_start: Floats, config: LocalMapRegistrationConfig) -> Floats | None:
    """(7,) T_target_source before the last stage of `register`, from a sixth of its work; None where that gives none.

    From guesses on a grid of up to a metre. Floors fit at once, and by their spread a wall that is half a metre off would be an
    outlier, and its direction one that nothing measures: residuals are weighed by what a stage may be off.
    """
    return _staged(source, target, T_start, config, _STAGES[:-1], _BLUNT)


def _staged(
    source: Surface,
    target: Surface,
    T_start: Floats,
    config: LocalMapRegistrationConfig,
    stages: tuple[tuple[float, int, int], ...],
    blunt: float = 0.0,
) -> Floats | None:
    T = np.array(T_start, dtype=np.float64)
    for distance, steps, count in stages:
        points = spread(source.points, count)
        for _ in range(steps):
            found = _Matched.of(points, target, T, distance, config, max(blunt * distance, LEAST_RESIDUAL_SCALE))
            if found is None:
                return None
            step, length = found.step(config)
            T = se3.compose(T, se3.exp(step))
            if length < _STEP:
                break
    return T


def refine(
    points: NDArray[np.float32],
    target: Surface,
    T_start: Floats,
    config: LocalMapRegistrationConfig,
    *,
    distance: float,
    steps: int,
) -> Registration | None:
    """Lay few points, near where they belong already, over a target; None where too few find a plane.

    What `register` does in its last stage, for a scan that is followed from one to the next. Overlap is not looked at: NaN.

    Args:
        points: (N, 3) float32 of the source [m].
        distance: of a plane's points, at most [m].
        steps: Gauss-Newton steps.
    """
    T = np.array(T_start, dtype=np.float64)
    found = None
    for _ in range(steps):
        found = _Matched.of(points, target, T, distance, config)
        if found is None:
            return None
        step, length = found.step(config)
        T = se3.compose(T, se3.exp(step))
        if length < _SHORT:
            break
    if found is None:
        return None
    covariance, information, weak = found.covariance(config, np.zeros((6, 6)))
    unasked = float("nan")
    return Registration(T, covariance, information, weak, found.lever, (unasked, unasked), found.scale, len(found.e))


def surface_distance(
    source: Surface, target: Surface, T_target_source: Floats, config: LocalMapRegistrationConfig
) -> float | None:
    """Robust standard deviation of the distances of a source's points to the target's planes [m], laid over it as given."""
    distances = _distances(spread(source.points, _STAGES[-1][2] // 4), target, T_target_source, config)
    return None if distances is None else residual_scale(distances)


def fitting_share(
    source: Surface, target: Surface, T_target_source: Floats, tolerance: float, config: LocalMapRegistrationConfig
) -> float:
    """Share of a source's points that lie within `tolerance` [m] of a plane of the target; one without a plane does not."""
    points = spread(source.points, _STAGES[-1][2])
    distances = _distances(points, target, T_target_source, config)
    return 0.0 if distances is None else float(np.count_nonzero(distances <= tolerance)) / len(points)


def mean_distance(
    points: NDArray[np.float32], target: Surface, T_target_source: Floats, limit: float, config: LocalMapRegistrationConfig
) -> float:
    """Mean distance of points (N, 3) of a source from the planes of the target, each `limit` [m] at most, and without one."""
    distances = _distances(points, target, T_target_source, config)
    if distances is None:
        return limit
    beyond = limit * (len(points) - len(distances))
    return (float(np.minimum(distances, limit).sum()) + beyond) / len(points)


def _distances(points: NDArray[np.float32], target: Surface, T: Floats, config: LocalMapRegistrationConfig) -> Floats | None:
    """Distances (n,) of the points that lie beside a plane of the target to that [m]; None where too few do."""
    planes, valid = planes_beside(points, target, T, _STAGES[-1][0], config)
    return np.abs(planes[valid, 3]) if np.count_nonzero(valid) >= FEWEST_ON_PLANES else None


def plane_normals(points: NDArray[np.float32], surface: Surface, config: LocalMapRegistrationConfig) -> Floats:
    """(N, 3) unit normals of the planes through a surface's points next to each of these; NaN where there is none."""
    planes, valid = planes_beside(points, surface, np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), _STAGES[-1][0], config)
    return np.where(valid[:, None], planes[:, :3], np.nan)


def facing_planes(
    points: NDArray[np.float32],
    target: Surface,
    T_target_source: Floats,
    axis: Floats,
    cosine: float,
    distance: float,
    config: LocalMapRegistrationConfig,
) -> tuple[Floats, NDArray[np.bool_]]:
    """(N,) signed distances [m] of points (N, 3) to planes of the target next to them, and which have one facing along an axis.

    Args:
        axis: (3,) unit, in the target's frame; cosine: between it and a normal, at least.
        distance: of a plane's points, at most [m].
    """
    planes, valid = planes_beside(points, target, T_target_source, distance, config)
    with np.errstate(invalid="ignore"):
        return planes[:, 3], valid & (np.abs(planes[:, :3] @ axis) >= cosine)


@dataclass(frozen=True, slots=True, eq=False)
class _Matched:
    """Points on planes, linearised about their middle: ξ' = [lever · w, v'] moves them there."""

    e: Floats
    J: Floats
    weight: Floats
    where: Floats
    to_origin: Floats
    lever: float
    scale: float
    planes: Floats

    @classmethod
    def of(
        cls,
        points: NDArray[np.float32],
        target: Surface,
        T: Floats,
        distance: float,
        config: LocalMapRegistrationConfig,
        least_scale: float = LEAST_RESIDUAL_SCALE,
    ) -> _Matched | None:
        planes, valid = planes_beside(points, target, T, distance, config)
        if np.count_nonzero(valid) < FEWEST_ON_PLANES:
            return None
        p, plane = points[valid].astype(np.float64), planes[valid]
        middle = p.mean(axis=0)
        arm = p - middle
        lever = max(float(np.sqrt((arm**2).sum(axis=1).mean())), 1.0)
        C = plane[:, :3] @ quaternion.to_matrix(T[:4])
        J = np.hstack([np.cross(arm, C) / lever, C])
        e = plane[:, 3]
        scale = residual_scale(e, least_scale)
        weight = residual_weights(e, scale)
        # w about the middle moves the origin: v = v' + middle × w … on the right, T Exp(ξ) with ξ = A ξ'.
        A = np.eye(6)
        A[:3, :3] /= lever
        x, y, z = middle
        A[3:, :3] = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) / lever
        return cls(e, J, weight, p @ quaternion.to_matrix(T[:4]).T, A, lever, scale, plane)

    def _modes(self, config: LocalMapRegistrationConfig) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        H = self.J.T @ (self.J * self.weight[:, None])
        values, vectors = np.linalg.eigh(H)
        return values, vectors, has_information(values, self.weight, self.planes, config)

    def step(self, config: LocalMapRegistrationConfig) -> tuple[Floats, float]:
        """The Gauss-Newton step [w, v] within the measured directions, and its length at the points [m]."""
        values, vectors, good = self._modes(config)
        g = vectors[:, good].T @ (self.J.T @ (self.weight * self.e))
        step = -vectors[:, good] @ (g / values[good])
        return self.to_origin @ step, float(np.linalg.norm(step))

    def covariance(self, config: LocalMapRegistrationConfig, deformation: Floats) -> tuple[Floats, Floats, Floats]:
        values, vectors, good = self._modes(config)
        _, cell = np.unique(np.floor(self.where / config.cluster).astype(np.int64), axis=0, return_inverse=True)
        gradients = np.zeros((int(cell.max()) + 1, 6))
        np.add.at(gradients, cell.ravel(), self.J * (self.weight * self.e)[:, None])
        V = vectors[:, good]
        G = gradients @ V / values[good]
        own = config.inflation * (G.T @ G)
        floor = np.diag(np.repeat([(config.floor_rotation * self.lever) ** 2, config.floor_position**2], 3))
        back = np.linalg.inv(self.to_origin)
        own += V.T @ (floor + back @ deformation @ back.T) @ V
        sigma, axes = np.linalg.eigh(own)
        measured = sigma < config.weak_sigma**2
        strong = V @ axes[:, measured]
        weak = np.vstack([vectors[:, ~good].T, (V @ axes[:, ~measured]).T])
        information = back.T @ ((strong / sigma[measured]) @ strong.T) @ back
        open_ = config.open_sigma**2 * weak.T @ weak
        covariance = self.to_origin @ ((strong * sigma[measured]) @ strong.T + open_) @ self.to_origin.T
        return 0.5 * (covariance + covariance.T), 0.5 * (information + information.T), weak


def residual_scale(e: Floats, least: float = LEAST_RESIDUAL_SCALE) -> float:
    """Robust standard deviation of distances (N,) to planes [m], `least` at least."""
    return max(_SCALE * float(np.median(np.abs(e))), least)


def residual_weights(e: Floats, scale: float) -> Floats:
    """(N,) weights of distances (N,) to planes, of Geman and McClure."""
    return np.asarray(1.0 / (1.0 + (e / (2.0 * scale)) ** 2) ** 2)


def has_information(values: Floats, weight: Floats, planes: Floats, config: LocalMapRegistrationConfig) -> NDArray[np.bool_]:
    """Which eigenvalues of a normal matrix tell a direction; planes (N, 5) as of `planes_beside`, with their weights (N,).

    Normals that noise tilts seem to measure what they do not: in sum, that much of any direction.
    """
    return np.asarray(values > max(config.weak_information * weight.sum(), NOISE * float(weight @ planes[:, 4])))


def spread(points: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """About `count` of the points, one in so many."""
    return np.ascontiguousarray(points[:: max(len(points) // count, 1)])


def planes_beside(
    points: NDArray[np.float32], target: Surface, T: Floats, distance: float, config: LocalMapRegistrationConfig
) -> tuple[Floats, NDArray[np.bool_]]:
    """(N, 5) planes of a target next to points, as `_match_planes` has them, and where there is one."""
    count = len(points)
    planes, valid = np.empty((count, 5)), np.zeros(count, dtype=np.bool_)
    view, origin = target.tree.view(), target.tree.origin

    def work(_: int, begin: int, end: int) -> None:
        sq = np.empty(_NEIGHBOURS, dtype=np.float32)
        near = np.empty((_NEIGHBOURS, 3), dtype=np.float32)
        stack = np.empty(STACK_DEPTH + _NEIGHBOURS, dtype=STACK)
        _match_planes(view, origin, T, points, begin, end, distance * distance, config.thickness, planes, valid, sq, near, stack)

    run_chunks(work, count, _CHUNK, config.threads)
    return planes, valid


def _share_near(points: NDArray[np.float32], target: Surface, T: Floats, distance: float) -> float:
    chosen = se3.act(T, spread(points, 4000).astype(np.float64))
    return float(np.mean(target.tree.nearest(chosen, 1, max_distance=distance).counts > 0))


@kernel
def _match_planes(
    view: IkdView,
    origin: Floats,
    T: Floats,
    points: NDArray[np.float32],
    begin: int,
    end: int,
    max_sq: float,
    thickness: float,
    planes: Floats,
    valid: NDArray[np.bool_],
    sq: NDArray[np.float32],
    near: NDArray[np.float32],
    stack: NDArray[np.void],
) -> None:
    """Unit normal of, and signed distance to, the planes of the nearest neighbours; and the variance of the normal [rad²]."""
    R = quaternion.rotation_entries(T[0], T[1], T[2], T[3])
    fit = np.empty(9)
    for n in range(np.uint64(begin), np.uint64(end)):
        px, py, pz = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        x = R[0] * px + R[1] * py + R[2] * pz + T[4] - origin[0]
        y = R[3] * px + R[4] * py + R[5] * pz + T[5] - origin[1]
        z = R[6] * px + R[7] * py + R[8] * pz + T[6] - origin[2]
        found = knn(view, np.float32(x), np.float32(y), np.float32(z), np.float32(max_sq), sq, stack)
        valid[n] = False
        if found < _NEIGHBOURS:
            continue
        copy_found(view, stack, _NEIGHBOURS, _NEIGHBOURS, near)
        if not fit_plane_into(near, _NEIGHBOURS, thickness, fit):
            continue
        planes[n, 0], planes[n, 1], planes[n, 2] = fit[0], fit[1], fit[2]
        planes[n, 3] = fit[0] * x + fit[1] * y + fit[2] * z - fit[3]
        planes[n, 4] = fit[7] / fit[8]
        valid[n] = True
