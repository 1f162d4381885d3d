"""Tangents of a moved world against what moving the world does to each stored variable."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus import SE2, SE3, SO3, Euclidean, Line3D, Product, SE3Left, UnitQuaternion, UnitQuaternionLeft
from boxplus.manifolds import lines, quaternion, se2, se3, so3
from boxplus.manifolds.camera_pose import CameraPose
from boxplus.manifolds.sphere import S2
from boxplus.optimization.observability.world_motions import kinds_of, motions_of, positions_of

H = 1e-5


def moved(manifold, kind, x, tau):
    """x (n, size) after p ↦ (1 + s) Exp(w) p + v for a small τ; every kind from its meaning, not from its tangents."""
    w, v, s = tau[:3], tau[3:6], tau[6]
    R = so3.exp(w)
    if manifold in (SE3, SE3Left, CameraPose, Product(UnitQuaternion, Euclidean(3))):
        if kind == "world_from_body":
            q = quaternion.multiply(quaternion.from_matrix(R), x[:, :4])
            return np.column_stack([q, (1 + s) * x[:, 4:] @ R.T + v])
        q = quaternion.multiply(x[:, :4], quaternion.from_matrix(R.T))
        return np.column_stack([q, (1 + s) * x[:, 4:] - np.einsum("nij,j->ni", quaternion.to_matrix(q), v)])
    if manifold == SE2:
        lift = np.column_stack([np.cos(x[:, 0] / 2), 0 * x[:, 0], 0 * x[:, 0], np.sin(x[:, 0] / 2), x[:, 1:], 0 * x[:, 0]])
        flat = moved(SE3, kind, lift, np.array([0, 0, w[2], v[0], v[1], 0, s]))
        return np.column_stack([2 * np.arctan2(flat[:, 3], flat[:, 0]), flat[:, 4:6]])
    if manifold in (UnitQuaternion, UnitQuaternionLeft):
        turn = quaternion.from_matrix(R)
        inverse = turn * [1, -1, -1, -1]
        return quaternion.multiply(turn, x) if kind == "world_from_body" else quaternion.multiply(x, inverse)
    if manifold == SO3:
        X = x.reshape(-1, 3, 3)
        return (R @ X if kind == "world_from_body" else X @ R.T).reshape(x.shape)
    if manifold == Line3D:
        L = lines.to_plucker(x)
        foot = np.cross(L[:, 3:], L[:, :3]) / (L[:, 3:] ** 2).sum(1, keepdims=True)
        foot, d = (1 + s) * foot @ R.T + v, L[:, 3:] @ R.T
        return lines.from_plucker(np.column_stack([np.cross(foot, d), d]))
    if manifold == S2:
        return x @ R.T
    if kind == "point":
        space = np.column_stack([x, np.zeros((len(x), 3 - x.shape[1]))])
        return ((1 + s) * space @ R.T + v)[:, : x.shape[1]]
    if kind == "vector":
        return (1 + s) * x @ R.T
    if kind == "velocity_first":
        return np.column_stack([(1 + s) * x[:, :3] @ R.T, x[:, 3:]])
    if kind == "inverse_depth":  # after a bearing, if any
        return np.column_stack([x[:, :-1], x[:, -1] / (1 + s)])
    return x


MANIFOLDS = (
    SE3,
    SE3Left,
    CameraPose,
    UnitQuaternionLeft,
    Product(UnitQuaternion, Euclidean(3)),
    SE2,
    UnitQuaternion,
    SO3,
    Line3D,
    S2,
    Euclidean(1),
    Euclidean(2),
    Euclidean(3),
    Euclidean(9),
)


@pytest.mark.parametrize(("manifold", "kind"), [(m, k) for m in MANIFOLDS for k in kinds_of(m)])
def test_tangents_equal_what_the_motion_does(manifold, kind):
    x = manifold.random(np.random.default_rng(0), 5)
    B = motions_of(manifold, kind, x)
    planar = manifold == SE2 or manifold == Euclidean(2)
    for axis in (2, 3, 4, 6) if planar else range(7):
        tau = H * np.eye(7)[axis]
        ahead, back = moved(manifold, kind, x, tau), moved(manifold, kind, x, -tau)
        difference = (manifold.boxminus(ahead, x) - manifold.boxminus(back, x)) / (2 * H)
        np.testing.assert_allclose(B[:, :, axis], difference, atol=1e-6)


def test_products_move_by_their_pose_alone():
    manifold = Product(SE3Left, Euclidean(3))
    x = manifold.random(np.random.default_rng(1), 4)
    assert kinds_of(manifold) == ("world_from_body", "body_from_world")
    B = motions_of(manifold, "body_from_world", x)
    np.testing.assert_array_equal(B[:, :6], motions_of(SE3Left, "body_from_world", x[:, :7]))
    np.testing.assert_array_equal(B[:, 6:], 0.0)


def test_positions_are_where_the_body_stands():
    rng = np.random.default_rng(2)
    T = SE3.random(rng, 6)
    np.testing.assert_allclose(positions_of(SE3, "world_from_body", T), T[:, 4:])
    np.testing.assert_allclose(positions_of(SE3Left, "body_from_world", se3.inverse(T)), T[:, 4:], atol=1e-12)
    flat = SE2.random(rng, 6)
    np.testing.assert_allclose(positions_of(SE2, "body_from_world", se2.inverse(flat))[:, :2], flat[:, 1:], atol=1e-12)
    assert positions_of(Euclidean(1), "inverse_depth", np.ones((2, 1))) is None
