"""The covariance of a pose against the start of a run, when the map is made from the estimates themselves.

The filter measures the pose against the map and takes the map for exact: its covariance P is that of the pose relative to
the *local map*. The map has been placed by earlier estimates and shares their errors, which no later scan can see. Both are
followed here to first order, with the gain the filter has used (a consider or Schmidt filter, Jazwinski 1970, section 8.4):

    e ← (I − G)(e + w) + G (d + v)        pose error after a scan; G = P Aₓ, Aₓ the scan's information about the pose
    d ← (1 − f) d + f (e + n)             datum error of the map; f, the share of the local map that the scan has brought

w is the IMU's noise over the scan (prior minus last posterior covariance of the filter), v that of the points (K R Kᵀ =
P A P), and n that of the map points: f N points, if N are compared in a scan, place what they bring as badly as a scan
of theirs would be placed, with f n of covariance f A⁻¹. With d = 0, e has the covariance of the filter.

A scan that was brought to its end by the prediction shows where the platform was half way, and half of w it shares with it: of
velocities that are off, ½w; of a walk of variance Q, W(T) less its mean over the scan, of variance Q/3 and Q/2 with w itself.
Then (I − G) w gives way to (I − G)w + Gw', of covariance (I − ½G) Q (I − ½G)ᵀ + GQGᵀ/12 for a walk, and for velocities nearly.
The points themselves lie where the platform was half way: the map takes in e − w', Cov(w') = Q/3 and Cov(e, w') = Q/2 − GQ/6. (Of
points that fill the time since the last scan evenly; where they fill its end only, as after scans that were dropped, less.)

Points that lie on one surface share what is wrong with it, and say less than as many independent ones would: v and n can be
counted several times for that.

The filter's own covariance needs the second equation, too. It follows the pose against the local map, and that moves with every
scan by f (e + n − d): along directions that scans hardly measure, a map of new points creeps aside by centimetres, and a filter
that takes it for fixed reads the creeping as velocity and, seconds later, as biases and gravity. What a scan places anew is off
by its own noise at least: f A⁻¹ is added to the pose's covariance before the next one (`creep`).

What two poses share is in neither of them against the other. Both equations stay as they are when the same motion is taken off e
and d: with the error e₀ of an earlier pose off both, they give the covariance of e − e₀, beginning with 0 and d − e₀.

The local map is what has been taken in within about one lever arm of the points: what lies farther back is not compared any more.
Of a sensor that sees one way, neither is what it has turned away from by as much as its points spread about their mean direction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.filtering.degeneracy import PoseDirections, strong_covariance
from boxplus.filtering.nav_state import MEASURED, P, R
from boxplus.filtering.small_linalg import symmetric_eigen_into
from boxplus.manifolds import so3

SHARED_ERRORS = 1.5  # how many times the covariance of a scan counts: what random recordings need
_FIRST, _MARKED = 0, 1  # the pose that errors are counted against
_POSE = slice(0, 6)
_MAP = slice(6, 12)
_NOTHING = np.zeros((6, 6))
_NO_SHIFT = np.zeros(6)
_LEAST_SPREAD = 0.05  # rad, of the points about their mean direction


@dataclass(frozen=True, slots=True)
class Correction:
    """What a scan has done to the pose.

    Attributes:
        gain: (6, 6) G, how the pose follows a shift of the scan against the map.
        noise: (6, 6) covariance of the pose from the noise of the points.
        alone: (6, 6) covariance of the pose from the points alone, zero along directions they do not determine.
        alone_by_weights: (6, 6) the same as the filter has it, which goes by the weights of the points, see `plane_scatter`.
        lever_arm: root mean square distance of the points [m].
        facing: (3,) mean of the unit vectors towards the points, along the IMU's axes: short where they are all around.
        deskewed: whether the points were brought to the end of the scan by the prediction.
    """

    gain: NDArray[np.float64]
    noise: NDArray[np.float64]
    alone: NDArray[np.float64]
    alone_by_weights: NDArray[np.float64]
    lever_arm: float
    facing: NDArray[np.float64]
    deskewed: bool = False

    @classmethod
    def of(
        cls,
        cov: NDArray[np.float64],
        A: NDArray[np.float64],
        directions: PoseDirections,
        facing: NDArray[np.float64],
        *,
        scatter: float = 1.0,
        shared_shift: NDArray[np.float64] = _NO_SHIFT,
        deskewed: bool = False,
    ) -> Correction:
        """Of a filter.

        Args:
            cov: (24, 24) after the scan.
            A: (12, 12) information of the scan as the filter took it, with the directions of the pose it determines.
            facing: as the attribute.
            scatter: of the variance that A⁻¹ states, what the residuals of the points bear out.
            shared_shift: (6,) a shift of the pose of one standard deviation that A has in it, and no residual shows.
            deskewed: as the attribute.
        """
        gain = cov[_POSE][:, MEASURED] @ A
        noise = gain @ cov[MEASURED][:, _POSE]
        alone = strong_covariance(A, replace(directions, weak=~directions.measured))

        def borne_out(by_weights: NDArray[np.float64], shift: NDArray[np.float64]) -> NDArray[np.float64]:
            return scatter * by_weights + (1.0 - scatter) * np.outer(shift, shift)

        noise, shown = borne_out(noise, gain[:, _POSE] @ shared_shift), borne_out(alone, alone @ A[_POSE, _POSE] @ shared_shift)
        return cls(gain[:, _POSE], noise, shown, alone, directions.lever_arm, facing, deskewed)

    def share_left(self, moved: NDArray[np.float64], turned: NDArray[np.float64]) -> float:
        """Of the points compared before, the share still compared after a motion of the IMU, 0 to 1.

        Args:
            moved: (3,) [m], along any axes.
            turned: (3,) rotation vector about the IMU's axes [rad].
        """
        (fx, fy, fz), (tx, ty, tz) = self.facing.tolist(), turned.tolist()
        spread = math.sqrt(max(1.0 - (fx * fx + fy * fy + fz * fz), _LEAST_SPREAD**2))
        aside = math.hypot(ty * fz - tz * fy, tz * fx - tx * fz, tx * fy - ty * fx) / spread
        return math.exp(-math.hypot(*moved.tolist()) / self.lever_arm - aside)


class MapDatum:
    """Joint covariance (12, 12) of the errors of pose and map, as small motions about the IMU: [θ, p] along the world's axes.

    Twice: against the first pose, and against the one that was marked last.

    Args:
        x: (36,) first state; cov: (24, 24) its covariance. The first scan makes the map at this pose.
        shared_errors: how many times the covariance of a scan counts, since its points are not independent.
    """

    def __init__(self, x: NDArray[np.float64], cov: NDArray[np.float64], shared_errors: float = 1.0) -> None:
        self._shared = shared_errors
        self._filter = _along_world(cov[_POSE, _POSE], x)
        self._joint = np.zeros((2, 12, 12))
        self._joint[_FIRST, _POSE, _POSE] = self._filter
        self._p_world_imu = x[P : P + 3].copy()
        self._R_world_imu = x[R : R + 9].reshape(3, 3).copy()
        self._within, self._across = _NOTHING, np.zeros((2, 12, 6))  # Cov(w'), and of both errors with w'
        self._alone = _NOTHING
        self._local_points = 0.0
        self._new_share = 0.0

    @property
    def new_share(self) -> float:
        """Of the local map, what the last scan has brought to it; 0 to 1."""
        return self._new_share

    def follow(
        self,
        x: NDArray[np.float64],
        cov_prior: NDArray[np.float64],
        cov: NDArray[np.float64],
        correction: Correction | None = None,
    ) -> None:
        """The filter has gone on by a scan.

        Args:
            x: (36,) posterior; cov_prior, cov: (n, n), covariance of the filter before and after the scan, the pose first.
            correction: by the scan; None if the filter took none.
        """
        R_world_imu = x[R : R + 9].reshape(3, 3).copy()
        if correction is not None:
            turned = so3.log(self._R_world_imu.T @ R_world_imu)
            self._local_points *= correction.share_left(x[P : P + 3] - self._p_world_imu, turned)
        self._R_world_imu = R_world_imu
        gain, noise, alone = (_NOTHING,) * 3 if correction is None else (correction.gain, correction.noise, correction.alone)
        counts, deskewed = (self._shared, self._shared * self._new_share), correction is not None and correction.deskewed
        self._within, self._across = np.zeros((6, 6)), np.zeros((2, 12, 6))
        _follow(
            x, cov_prior, cov, gain, noise, alone, counts, deskewed, self._p_world_imu, self._filter, self._joint, self._within,
            self._across,
        )  # fmt: skip
        self._alone = alone if correction is None else correction.alone_by_weights
        if correction is not None:
            self._new_share = 0.0

    def insert(self, points: int, replaced: int = 0) -> None:
        """The map has taken in so many points of the scan, so many of them in the place of others."""
        self._local_points += points - replaced
        self._new_share = points / self._local_points if points else 0.0
        _bring(self._new_share, self._joint, self._within, self._across)

    def creep(self, cov: NDArray[np.float64], x: NDArray[np.float64]) -> None:
        """Widen the filter's `cov` (n, n), in place, by how the last scan has moved the local map against the pose at x (36,).

        Call it after `insert`, with the covariance that goes on to the next scan.
        """
        cov[_POSE, _POSE] += 0.5 * self._shared * self._new_share * (self._alone + self._alone.T)
        self._filter = _along_world(cov[_POSE, _POSE], x)

    def widen(self, excess: NDArray[np.float64], x: NDArray[np.float64]) -> None:
        """An error of covariance (6, 6), [θ about the IMU's axes, p along the world's], that pose and map share at x (36,)."""
        self._joint += np.kron(np.ones((2, 2)), _along_world(excess, x))

    def mark(self) -> None:
        """Count `covariance_since_mark` against the present pose from now on."""
        step = np.eye(12)
        step[_POSE, _POSE] = 0.0
        step[_MAP, _POSE] = -np.eye(6)
        self._joint[_MARKED] = step @ self._joint[_MARKED] @ step.T
        self._across[_MARKED] = step @ self._across[_MARKED]

    def pose_covariance(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(6, 6) covariance of the pose at x (36,) against the first pose: [θ about the IMU's axes, p along the world's]."""
        return _turned(self._joint[_FIRST, _POSE, _POSE], x[R : R + 9].reshape(3, 3).T)

    def covariance_since_mark(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(6, 6) covariance of the pose at x (36,) against the one marked last (the first one before any), likewise.

        Of the motion e − e₀ about the present position, e₀ what the error of the marked pose moves there: a heading that is off
        since long before is in neither the turn nor the way between the two.
        """
        return _turned(self._joint[_MARKED, _POSE, _POSE], x[R : R + 9].reshape(3, 3).T)


@kernel
def _follow(
    x: NDArray[np.float64],
    cov_prior: NDArray[np.float64],
    cov: NDArray[np.float64],
    gain: NDArray[np.float64],
    noise: NDArray[np.float64],
    alone: NDArray[np.float64],
    counts: tuple[float, float],
    deskewed: bool,
    p_world_imu: NDArray[np.float64],
    before: NDArray[np.float64],
    joint: NDArray[np.float64],
    within: NDArray[np.float64],
    across: NDArray[np.float64],
) -> None:
    """The joint covariances (2, 12, 12), the filter's (6, 6) `before` and the position (3,), from scan to scan, in place.

    `noise` and `alone` count `counts` times; `gain`, `noise` and `alone` (6, 6) are zero where nothing corrected. Zeros `within`
    (6, 6) and `across` (2, 12, 6) receive what the map does not take in of the pose's error.
    """
    rotation, move, step = x[R : R + 9], np.eye(6), np.eye(12)
    prior, turned, work = np.empty((6, 6)), np.empty((6, 6)), np.empty((12, 12))
    sx, sy, sz = x[P] - p_world_imu[0], x[P + 1] - p_world_imu[1], x[P + 2] - p_world_imu[2]
    # A small motion about the last position, as one about this position.
    move[3, 1], move[3, 2], move[4, 0], move[4, 2], move[5, 0], move[5, 1] = sz, -sy, -sz, sx, sy, -sx
    _turn_into(cov_prior, rotation, prior)
    _congruence(move, before, work, turned)
    added = prior - turned
    positive_part_into(added)
    _turn_into(gain, rotation, turned)
    through, by_imu, own = np.eye(6), np.empty((6, 6)), np.zeros((6, 6))
    for i in range(6):
        for j in range(6):
            step[i, j] -= turned[i, j]
            step[i, 6 + j] = turned[i, j]
            through[i, j] -= (0.5 if deskewed else 1.0) * turned[i, j]
    _congruence(through, added, work, by_imu)
    if deskewed:
        _congruence(turned, added, work, own)
        for i in range(6):
            for j in range(6):
                within[i, j] = added[i, j] / 3.0
                cross = 0.5 * added[i, j]
                for k in range(6):
                    cross -= turned[i, k] * added[k, j] / 6.0
                across[0, i, j] = across[1, i, j] = cross
    _turn_into(noise, rotation, turned)
    _turn_into(alone, rotation, prior)
    both, moved = np.zeros((12, 12)), np.empty((12, 12))
    for i in range(6):  # an assignment of slices would bring in a library for its message, seconds of compiling
        for j in range(6):
            both[i, j] = both[6 + i, 6 + j] = move[i, j]
    for k in range(2):
        _congruence(both, joint[k], work, moved)
        for i in range(6):
            for j in range(6):
                moved[6 + i, 6 + j] += counts[1] * prior[i, j]
        _congruence(step, moved, work, joint[k])
        for i in range(6):
            for j in range(6):
                joint[k, i, j] += by_imu[i, j] + own[i, j] / 12.0 + counts[0] * turned[i, j]
    _turn_into(cov, rotation, before)
    for i in range(3):
        p_world_imu[i] = x[P + i]


@kernel
def _bring(share: float, joint: NDArray[np.float64], within: NDArray[np.float64], across: NDArray[np.float64]) -> None:
    """The map errs by a share of what the pose's error e is less w', and by the rest of its own: joint (2, 12, 12), in place.

    Args:
        share: of the local map, that is new.
        within: (6, 6) covariance of w'; across: (2, 12, 6) of both errors with w'.
    """
    kept = 1.0 - share
    for k in range(joint.shape[0]):
        for i in range(6):
            for j in range(i + 1):
                both = joint[k, i, 6 + j] + joint[k, j, 6 + i] - across[k, 6 + i, j] - across[k, 6 + j, i]
                brought = joint[k, i, j] + within[i, j] - across[k, i, j] - across[k, j, i]
                of_map = kept * kept * joint[k, 6 + i, 6 + j] + kept * share * both + share * share * brought
                joint[k, 6 + i, 6 + j] = joint[k, 6 + j, 6 + i] = of_map
        for i in range(6):
            for j in range(6):
                of_pose = joint[k, i, j] - across[k, i, j]  # of e with e − w'
                joint[k, i, 6 + j] = joint[k, 6 + j, i] = kept * joint[k, i, 6 + j] + share * of_pose


@kernel
def _congruence(T: NDArray[np.float64], M: NDArray[np.float64], work: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """out = T M Tᵀ for symmetric M (n, n)."""
    n = T.shape[0]
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += T[i, k] * M[k, j]
            work[i, j] = total
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(n):
                total += work[i, k] * T[j, k]
            out[i, j] = total
            out[j, i] = total


@kernel
def _turn_into(M: NDArray[np.float64], rotation: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """The first six rows and columns of M, over [θ about the IMU's axes, p], with θ about the world's; rotation (9,)."""
    half = np.empty((6, 6))
    for j in range(6):
        for i in range(3):
            half[i, j] = rotation[3 * i] * M[0, j] + rotation[3 * i + 1] * M[1, j] + rotation[3 * i + 2] * M[2, j]
            half[3 + i, j] = M[3 + i, j]
    for i in range(6):
        for j in range(3):
            out[i, j] = rotation[3 * j] * half[i, 0] + rotation[3 * j + 1] * half[i, 1] + rotation[3 * j + 2] * half[i, 2]
            out[i, 3 + j] = half[i, 3 + j]


@kernel
def positive_part_into(M: NDArray[np.float64]) -> None:
    """The positive semidefinite part of a symmetric matrix takes its place."""
    n = M.shape[0]
    values, vectors = np.empty(n), np.empty((n, n))
    symmetric_eigen_into(M, values, vectors)
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for k in range(n):
                total += vectors[i, k] * max(values[k], 0.0) * vectors[j, k]
            M[i, j] = total
            M[j, i] = total


def _along_world(M: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """A (6, 6) over [θ about the IMU's axes, p], with θ about the world's."""
    return _turned(M, x[R : R + 9].reshape(3, 3))


def _turned(M: NDArray[np.float64], rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    turned = np.empty((6, 6))
    _turn_into(np.ascontiguousarray(M), rotation.ravel(), turned)
    return turned


def positive_part(M: NDArray[np.float64]) -> NDArray[np.float64]:
    """The positive semidefinite part of a symmetric matrix."""
    positive: NDArray[np.float64] = np.array(M, dtype=np.float64)
    positive_part_into(positive)
    return positive
