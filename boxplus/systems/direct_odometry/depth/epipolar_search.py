"""Inverse depths of pixels of one image by where their surroundings are found in another: coarse to fine along epipolar lines."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.pinhole import Pinhole
from boxplus.manifolds import quaternion
from boxplus.sensors.images.image import Image, half_camera
from boxplus.systems.direct_alignment.keyframe_kernel import select_pixels
from boxplus.systems.direct_odometry.depth.epipolar_kernel import FOUND, OUTSIDE, search_lines

Matrix = NDArray[np.float64]
Pixels = NDArray[np.int64]

CORRELATED = 2.0  # factor of σ: neighbouring pixels err together, and patches are not fronto-parallel
LEAST_ERROR = 0.01  # standard deviation of grey values, by their range
LEAST_DISPARITY = 1.0  # [px]; with less of it a depth is not known

_DIAMOND = np.array([(u, v) for u in range(-2, 3) for v in range(-2, 3) if abs(u) + abs(v) <= 2])
_PATTERN = _DIAMOND[np.argsort(np.abs(_DIAMOND).sum(axis=1), kind="stable")]  # the centre first
_BORDER = 6  # pixels
_AROUND = 3.0  # pixels that the search at half the resolution leaves open
_MOST_ERROR = 0.06  # mean |e| of a match, by the range of grey values
_RATIO = 0.8  # of the costs of the best and the second best match


class View(NamedTuple):
    """An image and its camera; T_view_image (7,) maps points of the image that is searched for to it."""

    image: Image
    camera: Pinhole
    T_view_image: Matrix


class Found(NamedTuple):
    """Inverse depths (n,) [1/m], their standard deviations, and the codes of `epipolar_kernel`."""

    rho: Matrix
    sigma: Matrix
    state: NDArray[np.uint8]


def cell_size(image: Image, count: int) -> int:
    """Side of the cells [pixels] of which `choose_candidates` takes a pixel each."""
    height, width = image.shape
    return max(int(np.sqrt(height * width / count)), 1)


def choose_candidates(image: Image, count: int) -> Pixels:
    """(n, 2) about `count` pixels of steep gradient, spread over the image."""
    height, width = image.shape
    cell = cell_size(image, count)
    inner = np.zeros((height, width), np.float32)
    inner[_BORDER:-_BORDER, _BORDER:-_BORDER] = 1.0
    most = -(-height // cell) * -(-width // cell)
    pixels, gradients, values = (np.empty((most, 2)) for _ in range(3))
    found = select_pixels(image.grey, inner, cell, False, pixels, gradients, values)
    steep = np.linalg.norm(gradients[:found], axis=1) > LEAST_ERROR * float(np.ptp(image.grey))
    centres: Pixels = pixels[:found][steep].astype(np.int64)
    return centres


def pixels_per_inverse_depth(T_21: Matrix, rays: Matrix, rho: Matrix, f: float) -> Matrix:
    """(n,) how far the image of a point (its ray (n, 3) of z = 1) moves in camera 2 by its inverse depth [px m]."""
    Y = rays @ quaternion.to_matrix(T_21[:4]).T + rho[:, None] * T_21[4:]
    z = np.maximum(Y[:, 2], 1e-6)
    moved = T_21[4:6] - Y[:, :2] / z[:, None] * T_21[6]
    return np.asarray(f * np.hypot(moved[:, 0], moved[:, 1]) / z)


def search(
    image: Image,
    camera: Pinhole,
    centres: Pixels,
    view: View,
    near: Matrix,
    far: Matrix,
    *,
    least_disparity: float = LEAST_DISPARITY,
) -> Found:
    """Where the pixels `centres` (n, 2) of an image lie in another one, for inverse depths between `far` and `near` (n,).

    At half the resolution along all of the line, then around what was found there. What moves by less than `least_disparity`
    [px] is not known.
    """
    contrast = float(np.ptp(image.grey))
    half = View(view.image.half(), half_camera(view.camera), view.T_view_image)
    coarse = _lines(image.half(), half_camera(camera), centres // 2, half, near, far, contrast)
    found = coarse.state == FOUND
    rays, _ = camera.unproject(centres[found].astype(np.float64))
    speed = pixels_per_inverse_depth(view.T_view_image, rays, coarse.rho[found], view.camera.fx)
    margin = _AROUND / np.maximum(speed, 1e-12)
    at = coarse.rho[found]
    fine = _lines(image, camera, centres[found], view, at + margin, np.maximum(at - margin, 0.0), contrast)
    rho, sigma, state = np.zeros(len(centres)), np.full(len(centres), np.inf), coarse.state
    rho[found], sigma[found], state[found] = fine.rho, CORRELATED * fine.sigma, fine.state
    near_enough = rho[found] * speed > least_disparity
    state[np.flatnonzero(found)[~near_enough & (fine.state == FOUND)]] = OUTSIDE
    return Found(rho, sigma, state)


def _lines(image: Image, camera: Pinhole, centres: Pixels, view: View, near: Matrix, far: Matrix, contrast: float) -> Found:
    of_pattern = centres[:, None, :] + _PATTERN
    rays, seen = camera.unproject(of_pattern.astype(np.float64))
    grey = image.grey[of_pattern[..., 1], of_pattern[..., 0]].astype(np.float64)
    n = len(centres)
    rho, sigma, state = np.empty(n), np.empty(n), np.empty(n, np.uint8)
    search_lines(
        view.T_view_image, np.ascontiguousarray(rays[..., :2]), grey, near, far, view.image.grey, view.camera.padded_parameters,
        _MOST_ERROR * contrast, _RATIO, LEAST_ERROR * contrast, rho, sigma, state,
    )  # fmt: skip
    state[~seen.all(axis=1)] = OUTSIDE
    return Found(rho, sigma, state)
