"""Direct alignment of two images, one of them with depth: the pose that makes grey values agree (SPEC.md 4).

    T* = argmin_T Σ ρ(e(T)/σ),   e = I₁(p₁) − I₂(π(T X₁))

over all pixels p₁ of image 1 that have a depth, from coarse to fine in a pyramid, by Levenberg-Marquardt with T ← Exp(ξ) T. The
scale σ of the residuals is estimated anew in every iteration by their median, so that ρ sees occlusions and reflections as
outliers at every stage.

Source: Steinbrücker, Sturm and Cremers, Real-Time Visual Odometry from Dense RGB-D Images, ICCV-W 2011; Kerl, Sturm and
Cremers, Robust Odometry Estimation for RGB-D Cameras, ICRA 2013.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.cameras.model import check_pinhole
from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import InputError
from boxplus.manifolds import se3
from boxplus.manifolds.quaternion import rotation_entries
from boxplus.manifolds.se3 import SE3Left
from boxplus.optimization.losses import Huber, Loss, loss_at
from boxplus.residuals.camera.photometric_kernel import warped_pixel
from boxplus.sensors.image import Image, half_camera, two_by_two

_DEPTH_STEP = 0.05  # share by which depths of 2×2 pixels may differ to be averaged: no means across an edge
_LEAST_SIGMA = 1e-3  # of the range of grey values in image 1; identical images have residuals of zero
_FEWEST_PIXELS = 100
_LEAST_OVERLAP = 0.2  # share of the pixels with depth that land in image 2
_LEAST_CURVATURE = 1e-9  # smallest over largest eigenvalue of H, translations measured in units of the median depth
_SEARCH_STEP_DEG, _SEARCH_ITERATIONS = 10.0, 15
_FIRST_DAMPING, _LEAST_DAMPING, _LARGEST_DAMPING = 1e-4, 1e-9, 1e4

Status = Literal["converged", "iteration limit", "little overlap", "unobservable"]


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """What `align_rgbd` found; figures are those of the last linearisation.

    Attributes:
        T_21: (7,) wxyz and xyz, maps points in camera 1 to camera 2.
        covariance: (6, 6) of ξ = [w, v] in Exp(ξ) T_21 [rad², rad·m, m²], as if pixels were independent and depth exact, which
            makes it too small by a factor; NaN when the status is `unobservable` or `little overlap`.
        cost: mean of ρ over the pixels that count, in units of σ².
        sigma: robust standard deviation of the residuals [grey values].
        mean_error: mean |e| [grey values].
        pixels: of image 1 that count at the finest level; overlap: their share of those with depth.
        iterations: linearisations at every level, coarsest first; levels with fewer than 100 pixels with depth are left out.
        status: `converged`; `iteration limit` at the finest level; `little overlap`, fewer than 100 pixels or a fifth of
            them land in image 2; `unobservable`, a direction of motion that changes no grey value.
    """

    T_21: NDArray[np.float64]
    covariance: NDArray[np.float64]
    cost: float
    sigma: float
    mean_error: float
    pixels: int
    overlap: float
    iterations: tuple[int, ...]
    status: Status


@dataclass(frozen=True, slots=True, eq=False)
class _Level:
    """One level of the pyramid: pixels of image 1 with their rays, and image 2."""

    rays_1: NDArray[np.float64]
    inverse_depth_1: NDArray[np.float64]
    grey_1: NDArray[np.float64]
    image_2: NDArray[np.float32]
    intrinsics: NDArray[np.float64]
    z_min: float


@kernel
def _errors(
    T_21: NDArray[np.float64],
    rays_1: NDArray[np.float64],
    inverse_depth_1: NDArray[np.float64],
    grey_1: NDArray[np.float64],
    image_2: NDArray[np.float32],
    intrinsics: NDArray[np.float64],
    z_min: float,
    loss_code: int,
    loss_scale: float,
    sigma: float,
    normal: bool,
    e: NDArray[np.float64],
    H: NDArray[np.float64],
    g: NDArray[np.float64],
) -> tuple[int, float, float]:
    """Residuals e (n,) of all pixels, those that count first; where `normal`, also H = Σ ρ' JᵀJ/σ² (6, 6), g = Σ ρ' Jᵀe/σ² (6,).

    Returns:
        number of pixels that count, Σ ρ((e/σ)²), Σ |e|.
    """
    R = rotation_entries(T_21[0], T_21[1], T_21[2], T_21[3])
    t = (T_21[4], T_21[5], T_21[6])
    c = (
        intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3], intrinsics[4],
        intrinsics[5], intrinsics[6], intrinsics[7], intrinsics[8],
    )  # fmt: skip
    H[:] = 0.0
    g[:] = 0.0
    J = np.empty(6)
    count, cost, total = np.uint64(0), 0.0, 0.0
    information = 1.0 / (sigma * sigma)
    for n in range(np.uint64(len(grey_1))):
        rho = inverse_depth_1[n]
        found, value, _, _, x, y, z, gx, gy, gz = warped_pixel(image_2, R, t, rays_1[n, 0], rays_1[n, 1], rho, c, z_min)
        if not found:
            continue
        error = grey_1[n] - value
        e[count] = error
        count += np.uint64(1)
        loss, slope, _ = loss_at(loss_code, loss_scale, error * error * information)
        cost += loss
        total += abs(error)
        if normal:
            weight = slope * information
            J[0], J[1], J[2] = gy * z - gz * y, gz * x - gx * z, gx * y - gy * x
            J[3], J[4], J[5] = -rho * gx, -rho * gy, -rho * gz
            for i in range(6):
                weighted = weight * J[i]
                g[i] += weighted * error
                for j in range(i + 1):
                    H[i, j] += weighted * J[j]
    for i in range(6):
        for j in range(i):
            H[j, i] = H[i, j]
    return int(count), cost, total


def align_rgbd(
    image_1: Image | ArrayLike,
    depth_1: ArrayLike,
    image_2: Image | ArrayLike,
    camera: Pinhole,
    *,
    T_21: ArrayLike = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    levels: int = 5,
    loss: Loss | None = None,
    max_iterations: int = 50,
    tolerance: float = 1e-5,
    search_deg: float = 0.0,
) -> Alignment:
    """Align image 1, which has depth, to image 2.

    Args:
        image_1, image_2: grey values (H, W), or colours, of the same camera.
        depth_1: (H, W) z in camera 1 [m]; 0 or NaN where there is none.
        camera: intrinsics of both images.
        T_21: (7,) start, by default no motion.
        levels: of the pyramid, each half the resolution of the one before.
        loss: of e/σ; by default `Huber(1.345)`.
        max_iterations: linearisations at each level.
        tolerance: a level ends with a step below this [rad; the translation in units of the median depth].
        search_deg: start at the coarsest level from rotations up to this far from `T_21`, 10 degrees apart, and go on with the
            best; for turns beyond 6 to 20 degrees, depending on the scene. The number of starts grows with its cube.

    Raises:
        InputError: images or depth of another shape or not finite, too many levels, fewer than 100 pixels with depth.
    """
    camera = check_pinhole(camera, "direct alignment")
    first, second = (image if isinstance(image, Image) else Image.from_array(image) for image in (image_1, image_2))
    if first.shape != second.shape:
        raise InputError("two images of the same shape", f"{first.shape} and {second.shape}", "resize one of them and its camera")
    depth = _checked_depth(depth_1, first)
    if max_iterations < 1:
        raise InputError("max_iterations at least 1", f"{max_iterations}", "leave it out for 50")
    robust = Huber(1.345) if loss is None else loss
    pose = SE3Left.check("T_21", T_21)[0]
    reach = float(np.median(depth[depth > 0.0]))
    floor = max(_LEAST_SIGMA * float(first.grey.max() - first.grey.min()), 1e-30)

    pyramid = _pyramid(first, depth, second, camera, levels)
    if search_deg > 0.0:
        pose = _search(pyramid[0], pose, search_deg, robust, reach, floor)
    iterations: list[int] = []
    for level in pyramid:
        pose, found = _align_level(level, pose, robust, max_iterations, tolerance, reach, floor)
        iterations.append(found.iterations)
        if found.status in ("little overlap", "unobservable"):
            break
    covariance = np.full((6, 6), np.nan)
    if found.status in ("converged", "iteration limit"):
        covariance[:] = np.linalg.inv(found.H)
    count = max(found.count, 1)
    return Alignment(
        T_21=pose,
        covariance=covariance,
        cost=found.cost / count,
        sigma=found.sigma,
        mean_error=found.total / count,
        pixels=found.count,
        overlap=found.count / max(len(level.grey_1), 1),
        iterations=tuple(iterations),
        status=found.status,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """What the last linearisation of a level saw; cost, Σ ρ, and total, Σ |e|, are over the pixels that count."""

    H: NDArray[np.float64]
    count: int
    cost: float
    total: float
    sigma: float
    iterations: int
    status: Status


def _align_level(
    level: _Level, T_21: NDArray[np.float64], loss: Loss, max_iterations: int, tolerance: float, reach: float, floor: float
) -> tuple[NDArray[np.float64], _Found]:
    """Levenberg-Marquardt at one level; returns the pose and what was found there."""
    e, H, g = np.zeros(len(level.grey_1)), np.zeros((6, 6)), np.zeros(6)
    unused = np.zeros((6, 6)), np.zeros(6)
    pixels = (level.rays_1, level.inverse_depth_1, level.grey_1, level.image_2, level.intrinsics, level.z_min)
    unit = np.array([1.0, 1.0, 1.0, reach, reach, reach])
    damping = _FIRST_DAMPING
    status: Status = "iteration limit"
    for iteration in range(1, max_iterations + 1):
        count, _, _ = _errors(T_21, *pixels, loss.code, loss.scale, 1.0, False, e, *unused)
        if count < max(_FEWEST_PIXELS, _LEAST_OVERLAP * len(e)):
            return T_21, _Found(H, count, 0.0, float(np.abs(e[:count]).sum()), floor, iteration, "little overlap")
        sigma = max(1.4826 * float(np.median(np.abs(e[:count]))), floor)
        count, cost, total = _errors(T_21, *pixels, loss.code, loss.scale, sigma, True, e, H, g)
        # In units of the depth, rotations and translations move pixels alike, and eigenvalues can be compared.
        eigenvalues = np.linalg.eigvalsh(H * unit[:, None] * unit)
        if not eigenvalues[0] > _LEAST_CURVATURE * eigenvalues[-1]:
            return T_21, _Found(H, count, cost, total, sigma, iteration, "unobservable")
        is_better = is_small = False
        while not (is_better or is_small) and damping <= _LARGEST_DAMPING:
            xi = -np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
            is_small = bool(np.abs(xi / unit).max() < tolerance)
            trial = SE3Left.boxplus(T_21, xi)
            new_count, new_cost, _ = _errors(trial, *pixels, loss.code, loss.scale, sigma, False, e, *unused)
            # Means, as pixels enter and leave the image; at least half must stay, as an empty sum is no success.
            is_better = 2 * new_count > count and new_cost * count < cost * new_count
            damping = max(0.1 * damping, _LEAST_DAMPING) if is_better else 10.0 * damping
        if is_better:
            T_21 = trial
        if is_small or not is_better:
            status = "converged"
            break
    return T_21, _Found(H, count, cost, total, sigma, iteration, status)


def _search(
    level: _Level, T_21: NDArray[np.float64], search_deg: float, loss: Loss, reach: float, floor: float
) -> NDArray[np.float64]:
    """The pose that a grid of starts around T_21 leads to, with the smallest mean of |e| where enough of image 2 is seen."""
    steps = np.radians(np.arange(-(search_deg // _SEARCH_STEP_DEG), search_deg // _SEARCH_STEP_DEG + 1.0) * _SEARCH_STEP_DEG)
    grid = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = grid[np.linalg.norm(grid, axis=1) <= np.radians(search_deg)]
    best, least = T_21, np.inf
    for rotation in grid:
        start = se3.compose(se3.exp(np.concatenate([rotation, np.zeros(3)])), T_21)
        pose, found = _align_level(level, start, loss, _SEARCH_ITERATIONS, 1e-3, reach, floor)
        if found.status in ("converged", "iteration limit") and found.total < least * found.count:
            best, least = pose, found.total / found.count
    return best


def _pyramid(first: Image, depth: NDArray[np.float32], second: Image, camera: Pinhole, levels: int) -> list[_Level]:
    """The levels that have pixels enough, coarsest first."""
    result: list[_Level] = []
    for image_1, image_2 in zip(first.pyramid(levels), second.pyramid(levels), strict=True):
        rows, columns = np.nonzero(depth > 0.0)
        rays, seen = camera.unproject(np.stack([columns, rows], axis=1).astype(np.float64))
        rows, columns, rays = rows[seen], columns[seen], rays[seen]
        result.append(
            _Level(
                rays_1=np.ascontiguousarray(rays[:, :2]),
                inverse_depth_1=1.0 / depth[rows, columns].astype(np.float64),
                grey_1=image_1.grey[rows, columns].astype(np.float64),
                image_2=image_2.grey,
                intrinsics=camera.padded_parameters,
                z_min=camera.z_min,
            )
        )
        depth, camera = _half_depth(depth), half_camera(camera)
    return [level for level in result[::-1] if len(level.grey_1) >= _FEWEST_PIXELS]


def _half_depth(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth at half the resolution: the mean of those of 2×2 pixels that have one, if all are of the same surface; else none."""
    blocks = two_by_two(depth)
    count = np.count_nonzero(blocks, axis=(1, 3))
    farthest = blocks.max(axis=(1, 3))
    nearest = np.where(blocks > 0.0, blocks, np.inf).min(axis=(1, 3))
    same = (count > 0) & (farthest < (1.0 + _DEPTH_STEP) * nearest)
    return np.where(same, blocks.sum(axis=(1, 3)) / np.maximum(count, 1), 0.0).astype(np.float32)


def _checked_depth(depth_1: ArrayLike, image: Image) -> NDArray[np.float32]:
    depth = np.array(depth_1, dtype=np.float32)
    if depth.shape != image.shape:
        raise InputError(f"depth_1 of shape {image.shape}, as image 1", f"shape {depth.shape}", "register the depth to the image")
    depth[~np.isfinite(depth)] = 0.0
    if depth.min() < 0.0:
        raise InputError("depth_1 not negative [m]", f"{depth.min()}", "mark pixels without depth by 0 or NaN")
    if np.count_nonzero(depth) < _FEWEST_PIXELS:
        raise InputError(
            f"at least {_FEWEST_PIXELS} pixels with depth",
            f"{np.count_nonzero(depth)}",
            "check the unit and the file of the depth",
        )
    return depth
