"""Camera residuals on the pose of the body that carries the camera, so that all sensors of a body share one variable.

A camera residual is derived by T_camera_world on the left (docs/residuals/on_body.md). Here that pose is made of two variables,

    T_camera_world = (T_world_body T_body_camera)⁻¹,    T_world_body = (R, p),  T_body_camera = (R_c, p_c),

both on `BodyPose`: rotations on the right, positions by addition. With the rows [a, b] = ∂e/∂[w, v] by a left step of
T_camera_world, which the residual gives, and c = R_c b,

    ∂e/∂θ   = c × p_c − R_c a,    ∂e/∂p   = −R c        T_world_body
    ∂e/∂θ_c = −a,                 ∂e/∂p_c = −c          T_body_camera

A residual by T_21 = T_2_world T_1_world⁻¹ comes with two such pairs: [a, b] by T_2_world, −[a, b] Ad(T_21) by T_1_world.
Written out for a point at inverse depth these are the blocks of VINS-Mono, multiplied by ρ and regular at infinity. A variable
that stands in two places of a residual gets the sum of both: an anchor and an observer in one camera share its extrinsic; in one
frame (the stereo partner, the anchor's own pixel) they share the pose, whose rows cancel.

Time offset: an image stamped t by the camera was taken at t + t_d of the IMU's clock, and the body's pose is that at t + t_d0.
What is seen moves with the velocity ż in the image, so that at the time of the pose it was at

    z(t_d) = z − ż (t_d − t_d0),    ∂e/∂t_d = −∂e/∂z ż

(with + the offset would be that of the camera's clock against the IMU's). The anchor's own pixel is a measurement like any other
and moves too: the bearing of the point is that at the time of the anchor's pose. Good while the velocity in the image does not
change: `is_stale` says where the offset moved by more than 5 ms.

Singular: as the residual on the camera's pose.

Source: Qin, Li and Shen, VINS-Mono, TRO 2018, VI-C; Civera et al., TRO 2008; Qin and Shen, Online temporal calibration for
monocular visual-inertial systems, IROS 2018.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_floats
from boxplus.errors import InputError
from boxplus.manifolds.body_pose import BodyPose
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.se3 import SE3Left
from boxplus.residuals.camera.image_residual import ImageResidual
from boxplus.residuals.camera.on_body_kernel import (
    all_camera_poses,
    body_jacobians,
    camera_poses,
    first_of_relative,
    relative_poses,
)
from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows

CUT_ANEW_S = 0.005  # change of the time offset above which the velocity in the image is not constant any more

# The poses of camera residuals, and the pairs of variables that take their places.
_PAIRS = {
    "T_camera_world": (("T_world_body", "T_body_camera"),),
    "T_anchor_world": (("T_world_anchor_body", "T_body_anchor_camera"),),
    "T_observer_world": (("T_world_observer_body", "T_body_observer_camera"),),
    "T_21": (("T_world_body_1", "T_body_camera_1"), ("T_world_body_2", "T_body_camera_2")),
}


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a variable of the camera residual comes from.

    Attributes:
        first: number of the variable, or of the first of its pairs.
        poses: (N, 7) of each pair, T_camera_world; none for a variable that is passed on.
        T: (N, 7) what the camera residual is given.
        jacobians: (N, d, 6) by `poses`; the last one is what the camera residual writes.
    """

    first: int
    poses: tuple[Array, ...]
    T: Array
    jacobians: tuple[Array, ...]
    _known: list[tuple[NDArray[np.uint32], NDArray[np.uint32], int, NDArray[np.uint32]]] = field(default_factory=list)

    def table_rows(self, body_of: NDArray[np.uint32], mounting_of: NDArray[np.uint32], mountings: int) -> NDArray[np.uint32]:
        """(N,) the rows of a table of the poses of all `mountings` on all bodies, mounting by mounting; the last are kept."""
        for body, mounting, count, rows in self._known:
            if body is body_of and mounting is mounting_of and count == mountings:
                return rows
        rows = body_of * np.uint32(mountings) + mounting_of
        self._known[:] = [(body_of, mounting_of, mountings, rows)]
        return rows


class OnBody(Residual):
    """A camera residual on the pose of a body and the place of the camera on it, as derived in the head of this file.

    Variables: those of the camera residual in their order, but for every `T_camera_world` the two `T_world_body` and
    `T_body_camera` (7,) on `BodyPose`; for `InverseDepthReprojection` thus T_world_anchor_body, T_body_anchor_camera,
    T_world_observer_body, T_body_observer_camera, bearing_rho; for `Photometric`, which has `T_21`, two pairs. With
    `image_velocity` the last one is `image_time_offset` (1,) [s] on `Euclidean(1)`: IMU clock minus camera clock. What is
    known is held by `Problem.fix`. Cameras of a rig each have a group: `on_rig` makes them.

    Args:
        residual: on poses of cameras: `Reprojection`, `InverseDepthReprojection`, `LineReprojection`, those with intrinsics as
            variables, `Photometric`, or one's own with a role `T_camera_world` on `SE3Left`. Its noise is taken over.
        image_velocity: (N, k) of what it measures [px/s], from the tracks, such as the difference of neighbouring images.
        time_offset_s: number or (N,), the offset at which the poses were taken, t_d0 [s].

    Raises:
        InputError: a residual without the pose of a camera; velocities for one that measures no image coordinates, of another
            shape or not finite.

    Example:
        >>> camera = bp.Pinhole(500.0, 500.0, 320.0, 240.0)
        >>> seen = bp.residuals.OnBody(bp.residuals.Reprojection(camera, [[320.0, 240.0]]))
        >>> seen.evaluate(bp.BodyPose.identity(), bp.BodyPose.identity(), [0.0, 0.0, 4.0])  # body, mounting, point
        array([[0., 0.]])
    """

    def __init__(
        self, residual: Residual, *, image_velocity: ArrayLike | None = None, time_offset_s: ArrayLike | None = None
    ) -> None:
        roles: list[str] = []
        manifolds: list[Manifold] = []
        self._places: list[_Place] = []
        count, dim = residual.count, residual.dim
        for role, manifold in zip(residual.roles, residual.manifolds, strict=True):
            pairs = _PAIRS.get(role, ()) if manifold == SE3Left else ()
            poses = tuple(np.zeros((count, 7)) for _ in pairs)
            T = poses[0] if len(pairs) == 1 else np.zeros((count if pairs else 0, 7))
            self._places.append(_Place(len(roles), poses, T, tuple(np.zeros((count, dim, 6)) for _ in pairs)))
            roles += [name for pair in pairs for name in pair] or [role]
            manifolds += [BodyPose] * (2 * len(pairs)) or [manifold]
        if not any(place.poses for place in self._places):
            raise InputError(
                f"a residual on the pose of a camera ({', '.join(_PAIRS)}) on SE3Left",
                f"{type(residual).__name__} of {', '.join(residual.roles)}",
                "give a Reprojection, InverseDepthReprojection, LineReprojection or Photometric",
            )
        self.image_velocity: NDArray[np.float64] | None = None
        self._measured: NDArray[np.float64] = np.zeros((0, 0))
        if image_velocity is None and time_offset_s is not None:
            raise InputError("image_velocity with time_offset_s", "none", "give the velocities by which the offset is felt")
        self.residual = residual
        if image_velocity is not None:
            self._observe_clock(residual, image_velocity, 0.0 if time_offset_s is None else time_offset_s)
            roles.append("image_time_offset")
            manifolds.append(Euclidean(1))
        self._each = np.arange(count, dtype=np.uint32)
        super().__init__(
            dim=dim,
            count=count,
            manifolds=tuple(manifolds),
            roles=tuple(roles),
            whitening=residual.whitening,
            fixes_gauge=residual.fixes_gauge,
        )

    def _observe_clock(self, residual: Residual, image_velocity: ArrayLike, time_offset_s: ArrayLike) -> None:
        if not isinstance(residual, ImageResidual):
            raise InputError(
                "a residual of image coordinates where the time offset is a variable",
                type(residual).__name__,
                "leave image_velocity out; grey values do not move with a velocity",
            )
        velocity, cut = np.array(as_floats(image_velocity, "image_velocity")), as_floats(time_offset_s, "time_offset_s")
        for name, array, shapes in (
            ("image_velocity", velocity, (residual.measured.shape,)),
            ("time_offset_s", cut, ((), (residual.count,))),
        ):
            if array.shape not in shapes or not np.isfinite(array).all():
                expected = f"{name} finite, of shape {' or '.join(map(str, shapes))}"
                raise InputError(expected, f"shape {array.shape}", "give one row for each residual")
        self.image_velocity = np.ascontiguousarray(velocity)
        self.time_offset_s = np.array(np.broadcast_to(cut, (residual.count,)))
        self._measured = residual.measured
        self._moved = residual.measured.copy()
        self.residual = residual.measuring(self._moved)

    def is_stale(self, time_offset_s: float) -> NDArray[np.bool_]:
        """(N,) whether the offset moved so far (5 ms) from that of the poses that the velocity in the image no longer does.

        The poses are then to be taken at the new offset, and the residuals made anew with it.

        Raises:
            InputError: the time offset is no variable of these residuals.
        """
        if self.image_velocity is None:
            raise InputError("residuals with a time offset", "no image_velocity", "give the velocities when making them")
        far: NDArray[np.bool_] = np.abs(float(time_offset_s) - self.time_offset_s) > CUT_ANEW_S
        return far

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        """See `Residual.linearize_into`."""
        own_x, own_index = self._at(begin, end, x, index)
        own = tuple(place.jacobians[-1] if place.poses else jacobians[place.first] for place in self._places)
        self.residual.linearize_into(begin, end, own_x, own_index, r, own, valid)
        for place in self._places:
            if len(place.poses) == 2:
                first_of_relative(begin, end, place.T, place.jacobians[1], place.jacobians[0])
            for pair, J in enumerate(place.jacobians):
                body, mounting = place.first + 2 * pair, place.first + 2 * pair + 1
                body_jacobians(
                    begin, end, x[body], index[body], x[mounting], index[mounting], J, jacobians[body], jacobians[mounting]
                )
        if self.image_velocity is not None and isinstance(self.residual, ImageResidual):
            J_time = jacobians[-1][:, :, 0]
            self.residual.change_into(begin, end, own_x, own_index, self.image_velocity, J_time)
            np.negative(J_time[begin:end], out=J_time[begin:end])
            J_time[begin:end][~valid[begin:end]] = 0.0

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        """See `Residual.evaluate_into`."""
        self.residual.evaluate_into(begin, end, *self._at(begin, end, x, index), r, valid)

    def _at(self, begin: int, end: int, x: Arrays, index: Rows) -> tuple[Arrays, Rows]:
        """Variables and rows of the camera residual; moves what it measures to the time of the poses."""
        own_x, own_index = [], []
        tables: dict[tuple[int, int], Array] = {}
        for place in self._places:
            if len(place.poses) == 1:
                body, mounting = place.first, place.first + 1
                bodies, mountings = len(x[body]), len(x[mounting])
                if 2 * bodies * mountings <= end - begin:
                    # The poses of all cameras at all times once, not one for every residual, nor for every place of the same.
                    of = id(x[body]), id(x[mounting])
                    if of not in tables:
                        tables[of] = np.empty((bodies * mountings, 7))
                        all_camera_poses(x[body], x[mounting], tables[of])
                    own_x.append(tables[of])
                    own_index.append(place.table_rows(index[body], index[mounting], mountings))
                    continue
            for pair, T in enumerate(place.poses):
                body, mounting = place.first + 2 * pair, place.first + 2 * pair + 1
                camera_poses(begin, end, x[body], index[body], x[mounting], index[mounting], T)
            if len(place.poses) == 2:
                relative_poses(begin, end, *place.poses, place.T)
            own_x.append(place.T if place.poses else x[place.first])
            own_index.append(self._each if place.poses else index[place.first])
        if self.image_velocity is not None:
            late = x[-1][index[-1][begin:end], 0] - self.time_offset_s[begin:end]
            self._moved[begin:end] = self._measured[begin:end] - late[:, None] * self.image_velocity[begin:end]
        return tuple(own_x), tuple(own_index)
