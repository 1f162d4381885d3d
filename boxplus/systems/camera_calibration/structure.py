"""What is left in residuals that should be noise: patterns over the image and over the target, and halves that disagree.

*Image.* The mean residual m of the n corners in a cell of the image has variance σ²/n a coordinate where there is noise alone.
The share of all squares that the means explain, less what they explain of noise,

    share = Σ n ‖m‖²/Σ ‖e‖² − cells/N,

is 0 for noise and near 1 where the lens is of another kind than the model.

*Target.* A corner that is printed elsewhere, by d in the target's plane, moves what is seen by J d, J = ∂π/∂(X, Y). Least squares
over all views of a corner give d, and the share of squares is that of Σ dᵀ Σ Jᵀ e. A target that bends, or a spacing that is
not as stated, shows here.

*Halves.* Even and odd frames share nothing but the cameras: the difference of their intrinsics, squared and measured by the sum
of their covariances, is χ² distributed. Where it is k² times as large, standard deviations are too small by k.

*Views.* Every view alone says by δ = [κ, c_x, c_y] how it would have focal lengths (by 1 + κ) and centre, its pose free and the
distortion held, with the covariance σ² (Aᵀ(1 − P)A)⁻¹, A = ∂π/∂δ and P the projection on what a pose explains. One lens gives
scatter by noise alone; what views scatter beyond it is that of lenses that differ, or of a target that bends (the variance
between studies of DerSimonian and Laird, Controlled Clinical Trials 1986).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion, se3
from boxplus.systems.camera_calibration.adjustment import Adjustment

Floats = NDArray[np.float64]

CELLS = (12, 8)
"""Cells of the image, to the right and down."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageStructure:
    """Means of residuals over the image of one camera.

    Attributes:
        mean: (8, 12, 2) of every cell [px], NaN without corners.
        count: (8, 12) corners in it.
        share: of the squares that the means explain beyond noise, 0 to 1.
        coverage: share of the cells that hold corners.
    """

    mean: Floats
    count: NDArray[np.int64]
    share: float
    coverage: float


def image_structure(found: Adjustment, camera: int) -> ImageStructure:
    """The pattern of residuals over the image of a camera."""
    rows = found.kept & (found.corners.camera_of == camera)
    width, height = found.corners.sizes[camera]
    across, down = CELLS
    x, y = ((found.corners.pixels[rows] + 0.5) / (width, height) * CELLS).T
    cell = np.clip(y.astype(int), 0, down - 1) * across + np.clip(x.astype(int), 0, across - 1)
    count = np.bincount(cell, minlength=across * down)
    errors = found.residuals[rows]
    sums = np.stack([np.bincount(cell, errors[:, k], across * down) for k in range(2)], axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = sums / count[:, None]
    explained = float(np.nansum(count * np.sum(mean**2, axis=1)))
    share = _beyond_noise(explained, float(np.sum(errors**2)), int((count > 0).sum()), len(errors))
    return ImageStructure(mean.reshape(down, across, 2), count.reshape(down, across), share, float((count > 0).mean()))


def _beyond_noise(explained: float, squares: float, cells: int, corners: int) -> float:
    """Share of the squares; `cells` pairs of numbers were free to explain those of `corners` pairs."""
    if squares <= 0.0 or corners <= cells:
        return 0.0
    noise = cells / corners
    return max((explained / squares - noise) / (1.0 - noise), 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class TargetStructure:
    """Where the residuals would have the corners of the target.

    Attributes:
        shift: (n, 2) from where they should be, along the target's x and y [m]; NaN of corners never seen.
        share: of the squares that these shifts explain beyond noise, 0 to 1.
    """

    shift: Floats
    share: float

    @property
    def rms_m(self) -> float:
        """Root mean square shift of a corner [m]."""
        return float(np.sqrt(np.nanmean(np.sum(self.shift**2, axis=1))))


def target_structure(singles: Sequence[Adjustment], places: Floats) -> TargetStructure:
    """The pattern of residuals over the target, all cameras together, each adjusted on its own."""
    count = len(places)
    A, b = np.zeros((count, 2, 2)), np.zeros((count, 2))
    squares, kept = 0.0, 0
    for single in singles:
        corners, rig, rows = single.corners, single.rig, np.flatnonzero(single.kept)
        T = se3.inverse(rig.T_target_body[corners.frame_of[rows]])
        J_point = rig.models[0].project_with_jacobians(se3.act(T, places[corners.corner_of[rows]]))[1]
        J = J_point @ quaternion.to_matrix(np.ascontiguousarray(T[:, :4]))[:, :, :2]
        np.add.at(A, corners.corner_of[rows], np.einsum("nki,nkj->nij", J, J))
        np.add.at(b, corners.corner_of[rows], np.einsum("nki,nk->ni", J, single.residuals[rows]))
        squares += float(np.sum(single.residuals[rows] ** 2))
        kept += len(rows)
    seen = np.linalg.det(A) > 0.0
    shift = np.full((count, 2), np.nan)
    shift[seen] = np.linalg.solve(A[seen], b[seen][:, :, None])[:, :, 0]
    explained = float(np.einsum("ni,ni->", shift[seen], b[seen]))
    return TargetStructure(shift, _beyond_noise(explained, squares, int(seen.sum()), kept))


def halves_disagree(first: Adjustment, second: Adjustment) -> float:
    """√(χ²/dof) of the difference of both halves' intrinsics of one camera: 1 where standard deviations are right."""
    own = first.intrinsics(0)
    difference = first.rig.models[0].parameters - second.rig.models[0].parameters
    together = first.covariance[own, own] + second.covariance[own, own]
    return float(np.sqrt(difference @ np.linalg.solve(together, difference) / len(difference)))


@dataclass(frozen=True, slots=True, eq=False)
class ViewScatter:
    """How differently single views would have the lens.

    Attributes:
        focal: standard deviation of the focal length between views, beyond noise, by itself.
        centre_px: likewise of the centre [px], both axes together.
        ratio: χ²/dof of the views' differences: 1 where noise is all there is.
    """

    focal: float
    centre_px: float
    ratio: float


_FEWEST_VIEWS, _FEWEST_CORNERS = 6, 12  # for a scatter, and in a view


def view_scatter(single: Adjustment, places: Floats) -> ViewScatter | None:
    """The scatter between the views of one camera, adjusted alone; None with fewer than six views."""
    corners, model = single.corners, single.rig.models[0]
    c = model.parameters[2:4]
    found: list[Floats] = []
    informations: list[Floats] = []
    for frame in np.unique(corners.frame_of[single.kept]):
        rows = np.flatnonzero(single.kept & (corners.frame_of == frame))
        if len(rows) < _FEWEST_CORNERS:
            continue
        T = se3.inverse(single.rig.T_target_body[frame])
        p = se3.act(np.tile(T, (len(rows), 1)), places[corners.corner_of[rows]])
        pixels, by_point = model.project_with_jacobians(p)[:2]
        x, y, z = p.T
        zero, one = np.zeros(len(rows)), np.ones(len(rows))
        turned = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)  # −[p]×
        poses = np.linalg.qr(np.concatenate([by_point @ turned, by_point], axis=2).reshape(-1, 6))[0]
        by_centre = np.stack([np.stack([one, zero], axis=1), np.stack([zero, one], axis=1)], axis=2)
        A = np.concatenate([(pixels - c)[:, :, None], by_centre], axis=2).reshape(-1, 3)
        A, e = (part - poses @ (poses.T @ part) for part in (A, single.residuals[rows].reshape(-1)))
        if np.linalg.cond(A.T @ A) < 1e12:
            found.append(np.linalg.solve(A.T @ A, A.T @ e))
            informations.append(A.T @ A / single.sigma_px**2)
    if len(found) < _FEWEST_VIEWS:
        return None
    delta, W = np.array(found), np.array(informations)
    mean = np.linalg.solve(W.sum(axis=0), np.einsum("nij,nj->i", W, delta))
    ratio = float(np.einsum("ni,nij,nj->", delta - mean, W, delta - mean)) / (3 * (len(delta) - 1))
    weights = 1.0 / np.linalg.inv(W)[:, range(3), range(3)]
    off = delta - (weights * delta).sum(axis=0) / weights.sum(axis=0)
    beyond = (weights * off**2).sum(axis=0) - (len(delta) - 1)
    variance = np.maximum(beyond / (weights.sum(axis=0) - (weights**2).sum(axis=0) / weights.sum(axis=0)), 0.0)
    return ViewScatter(float(np.sqrt(variance[0])), float(np.sqrt(variance[1] + variance[2])), ratio)
