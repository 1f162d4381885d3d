"""Where a calibration starts: poses of the target and a focal length, without a guess.

With a lens that is given, a pixel is a direction b in the camera. The target is a plane, its corners (X, Y, 0), so that
b ~ R (X, Y, 0) + t = H (X, Y, 1) with H = [r₁ r₂ t], and b × H (X, Y, 1) = 0 are linear equations in H. Written with
directions instead of pixels they hold for lenses that see beyond 90°, too. The smallest eigenvector gives H up to scale; the sign
is such that the corners lie where the camera looks, and [r₁ r₂] becomes two columns of a rotation by the singular value
decomposition. Equations are weighted anew by their errors, so that single corners that are wrong do not matter.

The focal length is the one number that decides whether views of a plane from several sides agree (Zhang, PAMI 2000): it is looked
for on a grid, by the error of reprojection, which needs no special case for a lens. Views that all face the target agree with any
focal length; what then remains undetermined shows in the covariance.

Source: Zhang, A flexible new technique for camera calibration, PAMI 2000, with directions for points of the image plane.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.model import CameraModel
from boxplus.manifolds import quaternion, se3
from boxplus.systems.camera_calibration.lens import LensKind, plain_lens

Floats = NDArray[np.float64]

_FOCAL_SHARES = np.geomspace(0.2, 4.0, 16)
_ROUNDS = 4
_FEWEST = 6
_VIEWS = 24


def target_pose(model: CameraModel, pixels: Floats, places: Floats) -> Floats | None:
    """T_camera_target (7,) from corners of one image, or None where they do not give it.

    Args:
        pixels: (N, 2).
        places: (N, 3) of the corners in the target's plane, z = 0 [m].
    """
    bearings, found = model.bearings(pixels)
    if int(found.sum()) < _FEWEST:
        return None
    b, plane = bearings[found], places[found, :2]
    middle, size = plane.mean(axis=0), float(np.abs(plane - plane.mean(axis=0)).mean()) + 1e-12
    x = np.column_stack([(plane - middle) / size, np.ones(len(b))])
    zero = np.zeros_like(x)
    rows = np.stack(
        [
            np.concatenate([zero, -b[:, 2:] * x, b[:, 1:2] * x], axis=1),
            np.concatenate([b[:, 2:] * x, zero, -b[:, :1] * x], axis=1),
            np.concatenate([-b[:, 1:2] * x, b[:, :1] * x, zero], axis=1),
        ],
        axis=1,
    )
    weights = np.ones(len(b))
    for _ in range(_ROUNDS):
        H = np.linalg.eigh(np.einsum("n,nki,nkj->ij", weights, rows, rows))[1][:, 0].reshape(3, 3)
        ray = x @ H.T
        ray /= np.linalg.norm(ray, axis=1, keepdims=True) + 1e-300
        error = np.linalg.norm(np.cross(b, ray), axis=1)
        weights = 1.0 / (1.0 + (error / (2.0 * np.median(error) + 1e-12)) ** 2) ** 2
    if np.median(np.einsum("ni,ni->n", b, x @ H.T)) < 0.0:
        H = -H
    H = np.column_stack([H[:, :2] / size, H[:, 2]])
    H[:, 2] -= H[:, :2] @ middle
    U, lengths, Vt = np.linalg.svd(H[:, :2], full_matrices=False)
    if not lengths[1] > 1e-6 * lengths[0]:
        return None
    columns = U @ Vt
    R = np.column_stack([columns, np.cross(columns[:, 0], columns[:, 1])])
    return np.concatenate([quaternion.from_matrix(R), H[:, 2] / lengths.mean()])


def reprojection_errors(model: CameraModel, T_camera_target: Floats, pixels: Floats, places: Floats) -> Floats:
    """(N,) distances of corners from where they should be seen [px]; infinite where they cannot be."""
    seen_at, seen = model.project(se3.act(T_camera_target, places))
    return np.where(seen, np.linalg.norm(seen_at - pixels, axis=1), np.inf)


def starting_lenses(
    kind: LensKind, size: tuple[int, int], views: list[tuple[Floats, Floats]], count: int
) -> list[tuple[float, CameraModel]]:
    """The most promising lenses without distortion, as (median error [px], model), best first.

    Args:
        size: of the images [px].
        views: pixels (N, 2) and places (N, 3) of every view.
        count: how many to return.
    """
    chosen = sorted(views, key=lambda view: -len(view[0]))[:_VIEWS]
    tried: list[tuple[float, CameraModel]] = []
    for share in _FOCAL_SHARES:
        model = plain_lens(kind, float(share * max(size)), size)
        errors = []
        for pixels, places in chosen:
            T = target_pose(model, pixels, places)
            errors.append(np.inf if T is None else float(np.median(reprojection_errors(model, T, pixels, places))))
        tried.append((float(np.mean(np.minimum(errors, 0.1 * max(size)))), model))
    return sorted(tried, key=lambda candidate: candidate[0])[:count]
