"""How variables move when the world as a whole is moved, turned or scaled: the tangents of a similarity, for every manifold.

A motion of the world is τ = (w, v, s): a point p moves by w × p + v + s p. Poses are met in both directions (T_world_body and
T_camera_world), and three numbers may be a point, a velocity or something that does not know of the world; each such reading is
a kind, and which one holds is found by trying.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import lines, quaternion
from boxplus.manifolds.camera_pose import CameraPose
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.lines import Line3D
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import UnitQuaternion, UnitQuaternionLeft
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3, SE3Left
from boxplus.manifolds.so3 import SO3
from boxplus.manifolds.sphere import S2, tangent_basis
from boxplus.manifolds.tangents.change import POSES

DOF = 7
"""Numbers of a motion: rotation, translation, scale."""

_STEP = 1e-6  # of the difference quotient for lines
POSE_KINDS = ("world_from_body", "body_from_world")

Motions = NDArray[np.float64]
Points = NDArray[np.float64]


def kinds_of(manifold: Manifold) -> tuple[str, ...]:
    """What a variable on this manifold may stand for."""
    if manifold in POSES or manifold in (SE2, SO3, UnitQuaternion, UnitQuaternionLeft):
        return POSE_KINDS
    if isinstance(manifold, Product):
        return tuple(dict.fromkeys(kind for part in manifold.components for kind in kinds_of(part) if kind in POSE_KINDS)) or (
            "constant",
        )
    if isinstance(manifold, Euclidean):
        return {
            1: ("constant", "inverse_depth"),
            2: ("point", "constant"),
            3: ("point", "vector", "constant", "inverse_depth"),
        }.get(manifold.n, ("constant", "velocity_first"))
    if manifold == S2:
        return ("direction",)
    return ("line",) if manifold == Line3D else ("constant",)


def motions_of(manifold: Manifold, kind: str, x: Points) -> Motions:
    """Tangents (n, dof, 7) at x (n, size) of the seven motions of the world."""
    if manifold in POSES:
        return _pose(manifold, kind, x)
    if manifold == SE2:
        return _pose_2d(kind, x)
    if manifold in (SO3, UnitQuaternion, UnitQuaternionLeft):
        R = x.reshape(-1, 3, 3) if manifold == SO3 else quaternion.to_matrix(x)
        B = np.zeros((len(x), 3, DOF))
        B[:, :, :3] = np.swapaxes(R, 1, 2) if kind == "world_from_body" else -np.eye(3)
        if manifold == UnitQuaternionLeft:
            B = R @ B
        return B
    if manifold == Line3D:
        return _line(x)
    if manifold == S2:
        return _direction(x)
    B = np.zeros((len(x), manifold.dof, DOF))
    if isinstance(manifold, Product):
        size, dof = 0, 0
        for part in manifold.components:
            if kind in kinds_of(part):
                B[:, dof : dof + part.dof] = motions_of(part, kind, x[:, size : size + part.size])
            size, dof = size + part.size, dof + part.dof
    elif kind == "point":
        space = np.zeros((len(x), 3))
        space[:, : x.shape[1]] = x
        B += _displacement(space)[:, : x.shape[1]]
    elif kind in ("vector", "velocity_first"):
        B[:, :3] = _displacement(x[:, :3])
        B[:, :3, 3:6] = 0.0
    elif kind == "inverse_depth":
        B[:, -1, 6] = -x[:, -1]  # a bearing before it does not know of the world
    return B


def displacements_of(manifold: Manifold, x: Points, tangents: Motions) -> tuple[Points, Points] | None:
    """How variables (n, size) turn and shift, (n, 3) each, along tangents (n, dof), whichever ⊞ these are of.

    Rotation and translation of a pose are those in the frame that it maps to: with T_world_body, of the body in the world.

    Returns:
        None for what is no pose, rotation or point.
    """
    none = np.zeros((len(x), 3))
    if isinstance(manifold, Product) and manifold not in POSES:
        size, dof = 0, 0
        for part in manifold.components:
            if part in POSES:
                return displacements_of(part, x[:, size : size + part.size], tangents[:, dof : dof + part.dof])
            size, dof = size + part.size, dof + part.dof
        return None
    if isinstance(manifold, Euclidean):
        if "point" not in kinds_of(manifold):
            return None
        return none, np.column_stack([tangents, none[:, manifold.n :]])
    if kinds_of(manifold) != POSE_KINDS:
        return None
    motion = np.zeros((len(x), 6))
    free = [2, 3, 4] if manifold == SE2 else list(range(min(manifold.dof, 6)))
    B = motions_of(manifold, "world_from_body", x)[:, :, free]
    motion[:, free] = np.linalg.solve(B, tangents[:, :, None])[:, :, 0]
    position = positions_of(manifold, "world_from_body", x)
    return motion[:, :3], motion[:, 3:] + (none if position is None else np.cross(motion[:, :3], position))


def positions_of(manifold: Manifold, kind: str, x: Points) -> Points | None:
    """Where variables are in the world, (n, 3); None where they have no place."""
    n = len(x)
    if isinstance(manifold, Product) and manifold not in POSES:
        size = 0
        for part in manifold.components:
            if part in POSES:
                return positions_of(part, kind, x[:, size : size + part.size])
            size += part.size
        return None
    if manifold in POSES:
        t = x[:, 4:7]
        return t if kind == "world_from_body" else -np.einsum("nji,nj->ni", quaternion.to_matrix(x[:, :4]), t)
    if manifold == SE2:
        c, s = np.cos(x[:, 0]), np.sin(x[:, 0])
        if kind == "world_from_body":
            return np.column_stack([x[:, 1], x[:, 2], np.zeros(n)])
        return -np.column_stack([c * x[:, 1] + s * x[:, 2], c * x[:, 2] - s * x[:, 1], np.zeros(n)])
    if kind == "point":
        return np.column_stack([x, np.zeros((n, 3 - x.shape[1]))])
    if manifold == Line3D:
        L = lines.to_plucker(x)
        return np.asarray(np.cross(L[:, 3:], L[:, :3]) / (L[:, 3:] ** 2).sum(axis=1, keepdims=True))
    return None


def _displacement(p: Points) -> Motions:
    """(n, 3, 7) with τ ↦ w × p + v + s p."""
    B = np.zeros((len(p), 3, DOF))
    B[:, 0, 1], B[:, 0, 2] = p[:, 2], -p[:, 1]
    B[:, 1, 0], B[:, 1, 2] = -p[:, 2], p[:, 0]
    B[:, 2, 0], B[:, 2, 1] = p[:, 1], -p[:, 0]
    B[:, :, 3:6] = np.eye(3)
    B[:, :, 6] = p
    return B


def _direction(x: Points) -> Motions:
    """A direction turns with the world and does not know of its origin: w × x along the basis of the tangent."""
    B = np.zeros((len(x), 2, DOF))
    B[:, :, :3] = np.cross(x[:, None, :], np.swapaxes(tangent_basis(x), 1, 2))
    return B


def _pose(manifold: Manifold, kind: str, x: Points) -> Motions:
    R, t = quaternion.to_matrix(x[:, :4]), x[:, 4:7]
    turn = np.zeros((len(x), 3, DOF))  # of the axes, in the frame that the pose maps to
    if kind == "world_from_body":
        turn[:, :, :3] = np.eye(3)
        shift = _displacement(t)
    else:
        turn[:, :, :3] = -R
        shift = np.zeros((len(x), 3, DOF))
        shift[:, :, 3:6] = -R
        shift[:, :, 6] = t
    Rt = np.swapaxes(R, 1, 2)
    if manifold == SE3Left:  # t' = ω × t + v
        shift = shift - np.cross(turn, t[:, :, None], axis=1)
        return np.concatenate([turn, shift], axis=1)
    return np.concatenate([turn if manifold == CameraPose else Rt @ turn, Rt @ shift if manifold == SE3 else shift], axis=1)


def _pose_2d(kind: str, x: Points) -> Motions:
    c, s = np.cos(x[:, 0]), np.sin(x[:, 0])
    R = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    t = np.column_stack([x[:, 1:], np.zeros(len(x))])
    B = np.zeros((len(x), 3, DOF))
    if kind == "world_from_body":
        B[:, 0, 2] = 1.0
        shift = _displacement(t)[:, :2]
    else:
        B[:, 0, 2] = -1.0
        shift = np.zeros((len(x), 2, DOF))
        shift[:, :, 3:5] = -R
        shift[:, :, 6] = t[:, :2]
    B[:, 1:] = np.swapaxes(R, 1, 2) @ shift
    B[:, :, [0, 1, 5]] = 0.0  # these leave the plane
    return B


def _line(x: Points) -> Motions:
    L = lines.to_plucker(x)
    m, d = L[:, :3], L[:, 3:]
    change = np.zeros((DOF, len(x), 6))
    for axis in range(3):
        unit = np.eye(3)[axis]
        change[axis] = np.concatenate([np.cross(unit, m), np.cross(unit, d)], axis=1)
        change[3 + axis, :, :3] = np.cross(unit, d)
    change[6, :, :3] = m
    sides = [Line3D.boxminus(lines.from_plucker(L + sign * _STEP * change), x) for sign in (1.0, -1.0)]
    return np.moveaxis((sides[0] - sides[1]) / (2.0 * _STEP), 0, -1)
