"""Whether two cameras fit their stereo calibration: what one sees lies on its epipolar line in the other.

A patch of the left image was found at π'(Y'), Y' = R' m + ρ t', by a search along its epipolar line alone. What it differs by
there,

    e = I'(π'(Y')) − I(p),      e ≈ −∇I' (P' t' δρ + Σ q ∂π'/∂q) + o

asks, beside its own inverse depth and an offset, for what moves pixels across these lines: another focal length of the second
camera (∂π'/∂q = p' − c'), and turns of it about the baseline and about its axis (P' (axis × Y')). A turn in the plane of the two
looks like other depths, and only a motion tells it (`calibration_causes.py`). Where the second image is taken later by q, its
camera has moved on, P' (−ω × Y' − ρ v) by its velocity [ω, v]: a turn that goes with the motion. As in `leftover.py` the
covariance is that of the scatter between cells of the image, and frames are combined by their information.

Source: docs/direct_odometry.md, "What bad input shows as".
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.model import check_pinhole
from boxplus.cameras.pinhole import Pinhole
from boxplus.manifolds import quaternion
from boxplus.manifolds.se3 import SE3Left
from boxplus.residuals.camera.photometric_sampling import sample
from boxplus.sensors.images.image import Image
from boxplus.systems.direct_odometry.depth.sensed_depth import SensedDepth, StereoPair
from boxplus.systems.direct_odometry.sensor_watches.leftover import Combined

Matrix = NDArray[np.float64]
_PATCH = np.array([(u, v) for u in range(-2, 3) for v in range(-2, 3) if abs(u) + abs(v) <= 2], np.int64)
_BORDER = 3  # pixels
_MOST, _FEWEST = 1000, 100  # patches that are looked at, and at least
_CUT = 3.0  # times the median of the patches' errors beyond which one shows something else
_CELLS = 6  # across and down
_LEAST_PX, _LEAST_SIGMAS = 0.15, 6.0  # of a contradiction; what is off by more than a pixel is not found, and looks smaller
_OWN_ERROR = 0.0005  # standard deviation of one frame that its scatter does not show
_LEAST_LATE_S = 0.001
_LEAST_FLOW_PX_S = 10.0  # of the image, for a frame to tell times
_WHAT = (
    "a focal length of the second camera that is stated {:+.1f} % off or more",
    "a second camera that is turned by {:.2f} degrees or more about the baseline",
    "a second camera that is turned by {:.2f} degrees or more about its axis",
    "a second image that is taken {:+.1f} ms or more after the first, whatever their stamps say",
)
_LATE = 3  # the cause that depends on the motion
_UNITS = np.array([-100.0, np.degrees(1.0), np.degrees(1.0), 1000.0])
_SIGNED = (0, _LATE)


class StereoWatch:
    """What the keyframes so far say of a stereo calibration.

    Args:
        stereo: the second camera.
    """

    def __init__(self, stereo: StereoPair) -> None:
        T = SE3Left.check("T_right_left", stereo.T_right_left)[0]
        self._camera, self._R, self._t = check_pinhole(stereo.camera, "direct odometry"), quaternion.to_matrix(T[:4]), T[4:]
        # Times are asked for beside the others, which are known better without: few frames hardly tell a turn from one that goes
        # with the motion.
        self._found, self._found_late = Combined(_LATE, _OWN_ERROR), Combined(len(_WHAT), _OWN_ERROR)
        # By each cause [px], root mean square over the last frame; over the liveliest one where it depends on the motion.
        self._moved_px = np.zeros(len(_WHAT))

    def add(self, left: Image, right: Image, depth: SensedDepth, camera: Pinhole, velocity: Matrix | None = None) -> None:
        """A pair of images.

        Args:
            left, right: grey values.
            depth: that were found in them.
            camera: of the left image.
            velocity: (6,) [w, v] of the left camera, in itself [rad/s, m/s]; None where it is not known.
        """
        v, u = np.nonzero(depth.z)
        height, width = left.shape
        inside = (u >= _BORDER) & (v >= _BORDER) & (u < width - _BORDER) & (v < height - _BORDER)
        centre = np.stack([u, v], axis=1)[inside]
        centre = centre[:: max(len(centre) // _MOST, 1)]
        if len(centre) < _FEWEST:
            return
        pixels = centre[:, None] + _PATCH  # (n, K, 2)
        rays, found = camera.unproject(pixels.astype(np.float64))
        rho = 1.0 / depth.z[centre[:, 1], centre[:, 0]].astype(np.float64)
        Y = rays @ self._R.T + rho[:, None, None] * self._t
        there, P, _, ahead = self._camera.project_with_jacobians(Y)
        value, slope, seen = sample(right.grey, np.where(ahead[..., None], there, -1.0))
        good = (found & ahead & seen).all(axis=1)
        if np.count_nonzero(good) < _FEWEST:
            return
        e = value[good] - left.grey[pixels[good, :, 1], pixels[good, :, 0]]
        moved = self._moved(Y[good], there[good], P[good])
        self._moved_px[:_LATE] = _root_mean_square(moved)
        by_depth = np.einsum("nki,nkij,j->nk", slope[good], P[good], self._t)
        cell = (centre[good, 1] * _CELLS // height) * _CELLS + centre[good, 0] * _CELLS // width
        J = np.einsum("nki,nkqi->nkq", slope[good], moved)
        found_q = _explained(e, by_depth, J, cell)
        if found_q is not None:
            self._found.add(*found_q)
        if velocity is None:
            return
        flow = np.einsum("nkij,nkj->nki", P[good], self._passed(velocity, Y[good], rho[good]))[:, :, None]
        flow_px_s = float(_root_mean_square(flow)[0])
        if flow_px_s < _LEAST_FLOW_PX_S:
            return
        self._moved_px[_LATE] = max(self._moved_px[_LATE], flow_px_s)
        found_q = _explained(e, by_depth, np.concatenate([J, np.einsum("nki,nkqi->nkq", slope[good], flow)], axis=2), cell)
        if found_q is not None:
            self._found_late.add(*found_q)

    def _passed(self, velocity: Matrix, Y: Matrix, rho: Matrix) -> Matrix:
        """(n, K, 3) what a second makes of Y (n, K, 3), by the velocity (6,) of the left camera."""
        w, centre = velocity[:3], -self._R.T @ self._t  # of the right camera, in the left one
        w_right, v_right = self._R @ w, self._R @ (velocity[3:] + np.cross(w, centre))
        passed: Matrix = -np.cross(np.broadcast_to(w_right, Y.shape), Y) - rho[:, None, None] * v_right
        return passed

    def _moved(self, Y: Matrix, there: Matrix, P: Matrix) -> Matrix:
        """(n, K, 3, 2) pixels by each cause."""
        axis = self._t / np.linalg.norm(self._t)
        turns = [
            np.einsum("nkij,nkj->nki", P, np.cross(np.broadcast_to(a, Y.shape), Y)) for a in (axis, np.array([0.0, 0.0, 1.0]))
        ]
        return np.stack([there - np.array([self._camera.cx, self._camera.cy]), *turns], axis=2)

    @property
    def contradiction(self) -> str:
        """What does not fit, in a sentence; empty where all does."""
        if not self._moved_px[:_LATE].all():
            return ""
        least = _LEAST_PX / np.maximum(self._moved_px, 1e-9)
        least[_LATE] = max(least[_LATE], _LEAST_LATE_S)
        with_time = self._found_late.strongest(least, _LEAST_SIGMAS)
        is_late = with_time is not None and with_time[0] == _LATE
        told_by = self._found_late if is_late else self._found
        found = with_time if is_late else self._found.strongest(least[:_LATE], _LEAST_SIGMAS)
        if found is None:
            return ""
        k, q, sigma = found
        what = _WHAT[k].format(_UNITS[k] * (q if k in _SIGNED else abs(q)))
        return (
            "the stereo calibration does not fit these images: what both cameras see lies beside its epipolar lines, as with "
            f"{what} ({abs(q) / sigma:.0f} standard deviations, over {told_by.frames} keyframes); "
            "check the focal lengths and sizes of the images, which camera is which, T_imu_camera, and the trigger of both"
        )


def _root_mean_square(moved: Matrix) -> Matrix:
    """(q,) lengths of (n, K, q, 2)."""
    size: Matrix = np.sqrt(np.mean(np.sum(moved**2, axis=-1), axis=(0, 1)))
    return size


def _explained(e: Matrix, by_depth: Matrix, J: Matrix, cell: NDArray[np.int64]) -> tuple[Matrix, Matrix] | None:
    """q and its covariance, of errors (n, K) of patches with offsets and depths of their own; None where nothing says it."""
    e, by_depth, J = (x - x.mean(axis=1, keepdims=True) for x in (e, by_depth, J))
    square = np.maximum((by_depth**2).sum(axis=1), 1e-12)
    e = e - by_depth * ((by_depth * e).sum(axis=1) / square)[:, None]
    J = J - by_depth[:, :, None] * (np.einsum("nk,nkq->nq", by_depth, J) / square[:, None])[:, None]
    size = np.sqrt((e**2).mean(axis=1))
    weight = (size < _CUT * np.median(size)).astype(np.float64)
    H = np.einsum("n,nkp,nkq->pq", weight, J, J)
    if not np.linalg.cond(H) < 1e8:
        return None
    inverse = np.linalg.inv(H)
    q = -inverse @ np.einsum("n,nkp,nk->p", weight, J, e)
    scores = np.zeros((_CELLS * _CELLS, len(q)))
    np.add.at(scores, cell, weight[:, None] * np.einsum("nkp,nk->np", J, e + J @ q))
    covariance = _CELLS**2 / (_CELLS**2 - len(q)) * (inverse @ (scores.T @ scores) @ inverse)
    return q, covariance
