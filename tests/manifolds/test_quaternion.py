"""Quaternions as matrices, their Jacobians in four and three numbers, half-angle vectors, and the little adjoints."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import scipy.linalg

from boxplus.errors import InputError
from boxplus.manifolds import quaternion, se3, so3
from boxplus.manifolds.quaternion import UnitQuaternion, UnitQuaternionLeft


def _numeric(function: Callable[[np.ndarray], np.ndarray], count: int, h: float = 1e-3) -> np.ndarray:
    """Fourth-order central differences at zero, as columns."""
    columns = [
        (8.0 * (function(h * e) - function(-h * e)) - (function(2 * h * e) - function(-2 * h * e))) / (12.0 * h)
        for e in np.eye(count)
    ]
    return np.stack(columns, axis=-1)


def _samples() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return UnitQuaternion.random(rng, 20), rng.normal(size=(20, 3))


def _sandwich(q: np.ndarray, p: np.ndarray) -> np.ndarray:
    """The vector of q ⊗ [0, p] ⊗ q*, of quaternions of any length."""
    pure = np.concatenate([np.zeros((*p.shape[:-1], 1)), p], axis=-1)
    return quaternion.multiply(quaternion.multiply(q, pure), q * [1.0, -1.0, -1.0, -1.0])[..., 1:]


def test_products_are_matrices() -> None:
    p, q = UnitQuaternion.random(np.random.default_rng(1), 40).reshape(2, 20, 4)
    product = quaternion.multiply(p, q)
    left, right = quaternion.left_matrix(p), quaternion.right_matrix(q)
    assert np.allclose((left @ q[..., None])[..., 0], product, atol=1e-15)
    assert np.allclose((right @ p[..., None])[..., 0], product, atol=1e-15)
    assert np.allclose(left @ right, right @ left, atol=1e-15)
    assert np.allclose(quaternion.left_matrix(p * [1.0, -1.0, -1.0, -1.0]), np.swapaxes(left, 1, 2))
    assert quaternion.left_matrix(p[0]).shape == (4, 4)


def test_the_jacobian_of_four_free_numbers() -> None:
    q, p = _samples()
    numeric = _numeric(lambda d: _sandwich(q + d, p), 4)
    assert np.allclose(quaternion.rotation_jacobian(q, p), numeric, atol=1e-9)
    # By a tangent it is the minimal form.
    for matrix, by in ((quaternion.left_matrix, "right"), (quaternion.right_matrix, "left")):
        minimal = quaternion.rotation_jacobian(q, p) @ (0.5 * matrix(q)[..., 1:])
        assert np.allclose(quaternion.rotation_jacobian(q, p, by=by), minimal, atol=1e-14)


def test_the_jacobians_of_three_numbers() -> None:
    q, p = _samples()

    def rotated(turned: np.ndarray) -> np.ndarray:
        return (quaternion.to_matrix(turned) @ p[..., None])[..., 0]

    moves = {
        "right": lambda d: UnitQuaternion.boxplus(q, d),
        "left": lambda d: UnitQuaternionLeft.boxplus(q, d),
        "half_angle": lambda d: quaternion.multiply(q, quaternion.from_half_angle_vector(d)),
    }
    for by, move in moves.items():
        numeric = _numeric(lambda d, move=move: rotated(move(d)), 3)
        assert np.allclose(quaternion.rotation_jacobian(q, p, by=by), numeric, atol=1e-9)
    with pytest.raises(InputError, match="half_angle"):
        quaternion.rotation_jacobian(q, p, by="angle")


def test_half_angle_vectors_go_there_and_back() -> None:
    q, _ = _samples()
    epsilon = quaternion.to_half_angle_vector(q)
    assert np.array_equal(epsilon, quaternion.to_half_angle_vector(-q))
    assert np.allclose(UnitQuaternion.boxminus(quaternion.from_half_angle_vector(epsilon), q), 0.0, atol=1e-12)
    angle = np.linalg.norm(so3.log(quaternion.to_matrix(q)), axis=1)
    assert np.allclose(np.linalg.norm(epsilon, axis=1), np.sin(0.5 * angle))
    with pytest.raises(InputError, match=r"no longer than 1 – got \[0. 2. 0.\] in row 1"):
        quaternion.from_half_angle_vector([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]])


def test_little_adjoints() -> None:
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(2, 6))
    assert np.allclose(scipy.linalg.expm(se3.ad(a)), se3.adjoint(se3.exp(a)), atol=1e-12)
    assert np.allclose(scipy.linalg.expm(so3.ad(a[:3])), so3.exp(a[:3]), atol=1e-12)
    assert np.allclose(se3.ad(a) @ b, -se3.ad(b) @ a)
    assert np.allclose(so3.ad(a[:3]) @ b[:3], np.cross(a[:3], b[:3]))
    assert se3.ad(rng.normal(size=(2, 5, 6))).shape == (2, 5, 6, 6)
    e = 1e-4 * a
    assert np.allclose(se3.right_jacobian_inverse(e), np.eye(6) + 0.5 * se3.ad(e), atol=float(e @ e))
