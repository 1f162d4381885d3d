"""The start of one camera alone: how it moved between two views, up to scale, or why that is not known.

Corners are followed from a reference image on. Their motion is first explained by a rotation alone: what is left, the parallax,
is all that tells depths, and with too little of it there is no start. Then the essential matrix E = [t]ₓ R is found by random
samples of five corners and from directions all around, refined by min Σ ρ(d²) of the Sampson distances

    d = m₂ᵀ E m₁ / √(|(E m₁)₁₂|² + |(Eᵀ m₂)₁₂|²)

and believed when parallax is many times what corners err by, most corners agree and lie in front of both cameras, the direction
of t is known, and no motion in another direction does nearly as well (a turn and a step sideways look alike, as do the two
motions by which a plane may have moved). The unit of length is the median depth of the corners in the first view.

Source: Nistér, An efficient solution to the five-point relative pose problem, PAMI 2004 (as OpenCV has it); Hartley and
Zisserman, Multiple view geometry, 2nd edition, 11.4.3 (Sampson distance) and 9.6.2 (which of four motions).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from boxplus._extras import require
from boxplus.cameras.pinhole import Pinhole
from boxplus.manifolds import quaternion, so3
from boxplus.sensors.images.image import Image
from boxplus.systems.visual_inertial_odometry.config import VioConfig
from boxplus.systems.visual_inertial_odometry.corners.tracking import FeatureTracker
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks
from boxplus.systems.visual_inertial_odometry.corners.triangulation import inverse_depths
from boxplus.systems.visual_inertial_odometry.corners.turning import distances, turn_between
from boxplus.systems.visual_inertial_odometry.rig import Rig

Matrix = NDArray[np.float64]

_CORNERS = 300
_FEWEST = 40  # corners
_LEAST_SEEN = 0.4  # share of the reference's corners; with less of them the reference is a new one
_LEAST_PARALLAX = 0.006  # median, by the sum of the image's width and height
_LEAST_SIGMAS = 8.0  # of the parallax by the standard deviation of the Sampson distances
_AGREES, _MOST_SIGMA = 4.0, 0.5  # standard deviations of Sampson distance up to which a corner does; their largest value [px]
_LEAST_AGREE = 0.75  # share of the corners
_LEAST_AHEAD = 0.95  # of those that agree, in front of both cameras
_MOST_DIRECTION_DEG = 2.0  # standard deviation of the direction of t
_DIRECTIONS, _APART_DEG, _LEAST_WORSE = 20, 15.0, 1.5  # that are tried; what is another one; its cost by corner and variance
_STILL_PX, _SOME_STAND = 0.5, 0.03  # a corner that stands still; their share from which on they may be carried along
_SAMPLED_PX = 0.5  # that a sampled motion agrees within
_STEPS, _STEP, _LONGEST = 10, 1e-6, 0.3
_HUBER, _KNEE, _LEAST_SIGMA = 1.345, 1.0, 0.05  # the latter in pixels
_BEYOND = 2.0  # factor by which depths may lie outside of those of the corners


class TwoViews(NamedTuple):
    """A start.

    Attributes:
        time_ns: of both images; first, second: the images.
        T_21: (7,) from the first camera to the second, in units of the median depth in the first.
        within: inverse depths in the first camera that corners have, and some more.
        is_partly_carried: whether corners stand still that the motion of the others should move: the camera carries them along.
    """

    time_ns: tuple[int, int]
    first: Image
    second: Image
    T_21: Matrix
    within: tuple[float, float]
    is_partly_carried: bool


class TwoViewStart:
    """Waits for a view from which depths are known.

    Args:
        camera: of all images.

    Raises:
        InputError: OpenCV is not installed.

    Attributes:
        problem: why there was no start so far, with the number that is not met.
    """

    def __init__(self, camera: Pinhole) -> None:
        self._camera, self._tracker = camera, None  # type: tuple[Pinhole, FeatureTracker | None]
        self._reference: tuple[int, Image, Tracks] | None = None
        self._shape: tuple[int, int] | None = None
        self.problem = "one image so far"

    def push(self, time_ns: int, image: Image) -> TwoViews | None:
        """The next image; returns a start when there is one."""
        if self._tracker is None:
            self._tracker = self._new_tracker(image.shape)
        tracks = self._tracker.track(time_ns, {0: image.grey}, np.eye(3))
        if self._reference is not None:
            found = self._judge(time_ns, image, tracks)
            if found is not None or self._reference is not None:
                return found
        tracks = self._tracker.detect(tracks)
        if len(tracks) < _FEWEST:
            self.problem = f"{len(tracks)} corners are seen ({_FEWEST} are needed): there is little texture, or no light"
        else:
            self._reference = time_ns, image, tracks
        return None

    def _new_tracker(self, shape: tuple[int, int]) -> FeatureTracker:
        height, width = self._shape = shape
        config = VioConfig(features=_CORNERS, cell_size=max(width // 24, 8))
        return FeatureTracker(config, Rig.of([self._camera], [np.eye(4)], [(width, height)]))

    def snapshot(self) -> dict[str, object]:
        """All that `push` depends on beside the camera; only to be read."""
        tracker = None if self._tracker is None else self._tracker.snapshot()
        return {"problem": self.problem, "reference": self._reference, "shape": self._shape, "tracker": tracker}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Go on from a `snapshot`."""
        self.problem, self._reference = snapshot["problem"], snapshot["reference"]
        if snapshot["shape"] is not None:
            self._tracker = self._new_tracker(snapshot["shape"])
            self._tracker.restore(snapshot["tracker"])

    def _judge(self, time_ns: int, image: Image, tracks: Tracks) -> TwoViews | None:
        """Against the reference, which is forgotten when too little of it is left."""
        reference = self._reference
        if reference is None:
            return None
        first_ns, first, before = reference
        common, i, j = np.intersect1d(before.ids, tracks.ids, return_indices=True)
        if len(common) < max(_FEWEST, _LEAST_SEEN * len(before)):
            self.problem = f"{len(common)} of {len(before)} corners were followed so far, before parallax told their depth"
            self._reference = None
            return None
        m1, m2 = before.rays[i, 0], tracks.rays[j, 0]
        stands = self._camera.fx * np.linalg.norm(m2 - m1, axis=1) < _STILL_PX
        still = m1[stands]
        if (~stands).sum() >= _FEWEST:  # what stands still tells no depth; the camera may carry it along
            m1, m2 = m1[~stands], m2[~stands]
        f, size = self._camera.fx, sum(image.shape)
        moved = f * float(np.median(np.linalg.norm(m2 - m1, axis=1)))
        left = f * float(np.median(distances(turn_between(m1, m2), m1, m2)))
        if left < _LEAST_PARALLAX * size:
            self.problem = (
                f"corners moved by {moved:.1f} pixels, of which a rotation leaves {left:.1f} ({_LEAST_PARALLAX * size:.1f} are "
                "needed): the camera only turns or stands, or what it sees is too far away for its way"
            )
            return None
        motion = _essential(m1, m2, f, left)
        if isinstance(motion, str):
            self.problem = motion
            return None
        R, t, rho = motion
        T_21 = np.concatenate([quaternion.from_matrix(R), t])
        apart = np.abs(f * _sampson(R, t, still, still)) > _AGREES * _MOST_SIGMA
        is_partly_carried = bool(apart.sum() > _SOME_STAND * len(common))
        unit = 1.0 / float(np.median(rho))  # of a depth, by |t|
        T_21[4:] /= unit
        low, high = np.quantile(rho * unit, [0.02, 0.98])
        return TwoViews((first_ns, time_ns), first, image, T_21, (float(low) / _BEYOND, float(high) * _BEYOND), is_partly_carried)


def _sampson(R: Matrix, t: Matrix, m1: Matrix, m2: Matrix) -> Matrix:
    E = so3.hat(t) @ R
    one, two = m1 @ E.T, m2 @ E
    return np.asarray((m2 * one).sum(axis=1) / np.sqrt((one[:, :2] ** 2).sum(axis=1) + (two[:, :2] ** 2).sum(axis=1) + 1e-300))


def _essential(m1: Matrix, m2: Matrix, f: float, parallax: float) -> tuple[Matrix, Matrix, Matrix] | str:
    """R_21, t_21 of length 1, and the inverse depths of those that agree in camera 1; or why not."""
    starts = [(turn_between(m1, m2), direction) for direction in _directions()] + _sampled(m1, m2, f)
    motions = sorted((_refined(R, t, m1, m2, f) for R, t in starts), key=lambda motion: motion.cost)
    best = motions[0]
    sigma = best.sigma
    if parallax < _LEAST_SIGMAS * sigma:
        return (
            f"a rotation leaves {parallax:.1f} pixels of how corners move, and they err by {sigma:.2f} pixels: it has to be "
            f"{_LEAST_SIGMAS:g} times as much"
        )
    agrees = np.abs(f * _sampson(best.R, best.t, m1, m2)) < _AGREES * sigma
    if agrees.mean() < _LEAST_AGREE or sigma > _MOST_SIGMA:
        return (
            f"{agrees.mean():.0%} of the corners move as one motion of the camera moves them, with {sigma:.2f} pixels of error "
            f"({_LEAST_AGREE:.0%} are needed, and {_MOST_SIGMA:g} pixels)"
        )
    if best.deviation_deg > _MOST_DIRECTION_DEG:
        return f"the direction of the motion is known to {best.deviation_deg:.1f} degrees ({_MOST_DIRECTION_DEG:g} at most)"
    for other in motions[1:]:
        apart_deg = float(np.degrees(np.arccos(np.clip(abs(other.t @ best.t), 0.0, 1.0))))
        if apart_deg > _APART_DEG and other.cost < best.cost + _LEAST_WORSE * len(m1) * sigma**2:
            return f"a motion of the camera in a direction {apart_deg:.0f} degrees away explains the corners nearly as well"
    R, t = best.R, best.t
    if _depths(R, -t, m1, m2).sum() > _depths(R, t, m1, m2).sum():
        t = -t
    ahead = _depths(R, t, m1, m2)
    if ahead[agrees].mean() < _LEAST_AHEAD:
        share = ahead[agrees].mean()
        return f"{share:.0%} of the corners lie in front of both cameras by their motion ({_LEAST_AHEAD:.0%} are needed)"
    return R, t, inverse_depths(m1 @ R.T, t, m2)[0][agrees & ahead]


def _sampled(m1: Matrix, m2: Matrix, f: float) -> list[tuple[Matrix, Matrix]]:
    """Motions from random samples of five corners."""
    cv2 = require("cv2", "which finds the essential matrix")
    cv2.setRNGSeed(0)
    one, two = (np.ascontiguousarray(m[:, :2]) for m in (m1, m2))
    E, _ = cv2.findEssentialMat(one, two, np.eye(3), method=cv2.RANSAC, prob=0.9999, threshold=_SAMPLED_PX / f)
    return _two_rotations(np.asarray(E, dtype=np.float64)) if E is not None and E.shape == (3, 3) else []


def _directions() -> Matrix:
    """(n, 3) spread over half of the sphere: t and −t have the same epipolar lines."""
    k = np.arange(_DIRECTIONS) + 0.5
    z, angle = 1.0 - k / _DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * k
    return np.stack([np.cos(angle) * np.sqrt(1.0 - z * z), np.sin(angle) * np.sqrt(1.0 - z * z), z], axis=1)


def _two_rotations(E: Matrix) -> list[tuple[Matrix, Matrix]]:
    U, _, Vt = np.linalg.svd(E)
    U, Vt = U * np.sign(np.linalg.det(U)), Vt * np.sign(np.linalg.det(Vt))
    W = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return [(U @ w @ Vt, U[:, 2]) for w in (W, W.T)]


class _Motion(NamedTuple):
    """R_21, direction t, robust cost [px²] and σ of the Sampson distances [px], standard deviation of the direction [deg]."""

    R: Matrix
    t: Matrix
    cost: float
    sigma: float
    deviation_deg: float


def _refined(R: Matrix, t: Matrix, m1: Matrix, m2: Matrix, f: float) -> _Motion:
    """Least squares with Huber weights over rotation and direction."""
    H, sigma = np.eye(5), 1.0
    for _ in range(_STEPS):
        across = np.linalg.svd(t[None])[2][1:]  # (2, 3) at right angles to t
        r = f * _sampson(R, t, m1, m2)
        steps = []
        for k in range(5):
            turned = so3.exp(np.eye(3)[k] * _STEP) @ R if k < 3 else R
            t_k = t if k < 3 else _unit(t + _STEP * across[k - 3])
            steps.append((f * _sampson(turned, t_k, m1, m2) - r) / _STEP)
        J = np.stack(steps, axis=1)
        sigma = max(1.4826 * float(np.median(np.abs(r))), _LEAST_SIGMA)
        weight = np.minimum(1.0, _HUBER * sigma / np.maximum(np.abs(r), 1e-12))
        H = (weight[:, None] * J).T @ J
        x = -np.linalg.lstsq(H, (weight[:, None] * J).T @ r, rcond=1e-12)[0]
        x *= min(1.0, _LONGEST / float(np.linalg.norm(x) + 1e-12))
        R, t = so3.exp(x[:3]) @ R, _unit(t + x[3:] @ across)
    r = np.abs(f * _sampson(R, t, m1, m2))
    cost = float(np.sum(np.where(r < _KNEE, r**2, _KNEE * (2.0 * r - _KNEE))))
    C = sigma**2 * np.linalg.pinv(H, rcond=1e-12)
    return _Motion(R, t, cost, sigma, float(np.degrees(np.sqrt(max(np.linalg.eigvalsh(C[3:, 3:])[-1], 0.0)))))


def _unit(x: Matrix) -> Matrix:
    return np.asarray(x / np.linalg.norm(x))


def _depths(R: Matrix, t: Matrix, m1: Matrix, m2: Matrix) -> NDArray[np.bool_]:
    """(n,) whether the points lie in front of both cameras."""
    rho, _ = inverse_depths(m1 @ R.T, t, m2)
    return np.asarray((rho > 0.0) & ((m1 @ R.T + rho[:, None] * t)[:, 2] > 0.0))
