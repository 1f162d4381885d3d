"""The covariance of a pose against the start of a run, when the map is made from the estimates themselves.

The filter measures the pose against the map and takes the map for exact: its covariance P is that of the pose relative to
the *local map*. The map has been placed by earlier estimates and shares their errors, which no later scan can see. Both are
followed here to first order, with the gain the filter has used (a consider or Schmidt filter, Jazwinski 1970, section 8.4):

    e ← (I − G E)(Φ e + w) + G (d + v)    error after a scan, E the rows of the pose; G = P Aₓ, Aₓ the scan's information of it
    d ← (I − F) d + F (l + n)             datum error of the map; F, how much of what the scan sees is new since the last one

e is the error of the pose alone, or of all that moves it: velocity, biases and gravity, with Φ, how they go on through the IMU's
samples. A gyroscope's bias that a start has taken to be off by half a degree a second turns scan after scan the same way, until
the filter has learned it; noise as large would come to a fifth of that over twenty scans. Where Φ is not known, the pose goes
along as a rigid motion does, and all else that the filter's prior has is noise. w is the IMU's noise over the scan (the filter's
prior covariance without that of Φ e), v that of the points (K R Kᵀ = P A P), n that of the map points, and l the error with which
those of the last scan were laid down. F is what of the information of a scan rests on them, A⁻¹A'; by their number alone, f I, f
their share of the local map. They are as far off as the points of a scan, so that F n has the covariance F A⁻¹. Scalars will
not do: rings that wander over the floor as the platform sinks stand on those of the scan before, which carry height and tilt
along, while walls around hold all else on a hundred scans. With d = 0, e has the covariance of the filter.

A scan that was brought to its end by the prediction shows where the platform was half way, and half of what went wrong over the
scan it shares with the prediction: ½(Φ − rigid) e, of what was known badly before it, and w', of a walk of variance Q the last
value less its mean, of variance Q/3 and Q/2 with w itself. Both together are u, and the scan shows E e − u in place of E e. The
points themselves lie where the platform was half way: l = E e − u. (Of points that fill the time since the last scan
evenly; where they fill its end only, as after scans that were dropped, less.)

Points that lie on one surface share what is wrong with it, and say less than as many independent ones would: v and n can be
counted several times for that.

The filter's own covariance needs the second equation, too. It follows the pose against the local map, and that moves with every
scan by f (e + n − d): along directions that scans hardly measure, a map of new points creeps aside by centimetres, and a filter
that takes it for fixed reads the creeping as velocity and, seconds later, as biases and gravity. What a scan places anew is off
by its own noise at least: f A⁻¹ is added to the pose's covariance before the next one (`creep`).

What two poses share is in neither of them against the other. Both equations stay as they are when the same motion is taken off e
and d, velocity and gravity turned along: with the error e₀ of an earlier pose off both, they give the covariance of e − e₀,
beginning with 0 and d − e₀.

The local map is what has been taken in within about one lever arm of the points: what lies farther back is not compared any more.
Of a sensor that sees one way, neither is what it has turned away from by as much as its points spread about their mean direction.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import T_G, T_V, G, P, R, V
from boxplus.filtering.pose_covariance.correction import Correction
from boxplus.filtering.pose_covariance.joint_errors import correct, lay_down, move_map, predict, renew, turn_into
from boxplus.filtering.small_linalg import positive_part
from boxplus.manifolds import so3

SHARED_ERRORS = 1.5  # how many times the covariance of a scan counts: what random recordings need
_FIRST, _MARKED = 0, 1  # the pose that errors are counted against
_POSE = slice(0, 6)
_NO_TRANSITION = np.zeros((0, 0))


class MapDatum:
    """Joint covariance of the errors e of the state (m), d of the map (6), and u or l (6): m is 6 or 18, the pose first.

    Those of pose and map are small motions about the IMU: [θ, p] along the world's axes; velocity, biases and gravity are as in
    the filter. Twice: against the first pose, and against the one that was marked last.

    Args:
        x: (36,) first state; cov: (24, 24) its covariance, of which (m, m) is used. The first scan makes the map at this pose.
        shared_errors: how many times the covariance of a scan counts, since its points are not independent.
        followed: m; with 18 of a filter of the navigation state, biases and all are followed where the transition is given.
    """

    def __init__(self, x: NDArray[np.float64], cov: NDArray[np.float64], shared_errors: float = 1.0, followed: int = 6) -> None:
        self._shared, self._followed = shared_errors, followed
        self._filter = _along_world(cov[:followed, :followed], x)
        self._joint = np.zeros((2, followed + 12, followed + 12))
        self._joint[:, :followed, :followed] = self._filter
        self._x = x.copy()
        self._alone = np.zeros((6, 6))
        self._laid = False  # whether the third block is l
        self._local_points = 0.0
        self._new_share = 0.0
        self.mark()

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
        transition: NDArray[np.float64] | None = None,
    ) -> None:
        """The filter has gone on by a scan.

        Args:
            x: (36,) posterior; cov_prior, cov: (n, n), covariance of the filter before and after the scan, the pose first.
            correction: by the scan; None if the filter took none.
            transition: Φ (m, m) of the filter's errors from the last posterior to this prior; None where it is not known.
        """
        m, R_world_imu = self._followed, x[R : R + 9].reshape(3, 3)
        if correction is not None:
            turned = so3.log(self._x[R : R + 9].reshape(3, 3).T @ R_world_imu)
            self._local_points *= correction.share_left(x[P : P + 3] - self._x[P : P + 3], turned)
        move_map(self._x, x, self._joint)
        if correction is not None and self._laid:
            renewed = correction.renewed
            if renewed is None or self._new_share == 1.0:
                renewed = self._new_share * np.eye(6)
            placed = positive_part(0.5 * self._shared * (renewed @ correction.alone + correction.alone @ renewed.T))
            renew(x, renewed, placed, self._joint)
            self._laid, self._new_share = False, 0.0
        phi = _NO_TRANSITION if transition is None else transition
        deskewed = 0.0 if correction is None else float(correction.deskewed)
        predict(self._x, x, phi, cov_prior[:m, :m].copy(), self._filter, self._laid, deskewed, self._joint)
        if correction is not None:
            correct(x, correction.gain[:m].copy(), self._shared * correction.noise[:m, :m], self._joint)
        self._filter, self._x = _along_world(cov[:m, :m], x), x.copy()
        self._alone = np.zeros((6, 6)) if correction is None else correction.alone_by_weights

    def insert(self, points: int, replaced: int = 0) -> None:
        """The map has taken in so many points of the scan, so many of them in the place of others."""
        self._local_points += points - replaced
        self._new_share = points / self._local_points if points else 0.0
        if self._laid:  # the pose has gone on since, without a correction
            self._joint[:, self._followed + 6 :], self._joint[:, :, self._followed + 6 :] = 0.0, 0.0
        self._laid = points > 0
        lay_down(self._joint)

    def creep(self, cov: NDArray[np.float64], x: NDArray[np.float64]) -> None:
        """Widen the filter's `cov` (n, n), in place, by how the last scan has moved the local map against the pose at x (36,).

        Call it after `insert`, with the covariance that goes on to the next scan.
        """
        crept = 0.5 * self._shared * self._new_share * (self._alone + self._alone.T)
        cov[_POSE, _POSE] += crept
        self._filter[_POSE, _POSE] += _along_world(crept, x)

    def widen(self, excess: NDArray[np.float64], x: NDArray[np.float64]) -> None:
        """An error of covariance (6, 6), [θ about the IMU's axes, p along the world's], that pose and map share at x (36,)."""
        both = self._moved_by(x)
        self._joint += both @ _along_world(excess, x) @ both.T

    def mark(self) -> None:
        """Count `covariance_since_mark` against the present pose from now on."""
        step = np.eye(self._followed + 12)
        step[:, _POSE] -= self._moved_by(self._x)
        self._joint[_MARKED] = step @ self._joint[_MARKED] @ step.T

    def pose_covariance(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(6, 6) covariance of the pose at x (36,) against the first pose: [θ about the IMU's axes, p along the world's]."""
        return _turned(self._joint[_FIRST, _POSE, _POSE], x[R : R + 9].reshape(3, 3).T)

    def covariance_since_mark(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(6, 6) covariance of the pose at x (36,) against the one marked last (the first one before any), likewise.

        Of the motion e − e₀ about the present position, e₀ what the error of the marked pose moves there: a heading that is off
        since long before is in neither the turn nor the way between the two.
        """
        return _turned(self._joint[_MARKED, _POSE, _POSE], x[R : R + 9].reshape(3, 3).T)

    def _moved_by(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """(m + 12, 6): what a small motion about the IMU at x (36,), of pose and map together, adds to e, d and l."""
        m = self._followed
        moved = np.zeros((m + 12, 6))
        moved[_POSE] = moved[m : m + 6] = np.eye(6)
        if self._laid:
            moved[m + 6 :] = np.eye(6)
        if m > T_G:
            moved[T_V : T_V + 3, :3], moved[T_G : T_G + 3, :3] = -so3.hat(x[V : V + 3]), -so3.hat(x[G : G + 3])
        return moved


def _along_world(M: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """M (n, n) over [θ about the IMU's axes, ...], with θ about the world's."""
    return _turned(M, x[R : R + 9].reshape(3, 3))


def _turned(M: NDArray[np.float64], rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    turned, axes = np.empty(M.shape), np.ascontiguousarray(rotation).ravel()
    turn_into(np.ascontiguousarray(M), axes, axes, turned)
    return turned
