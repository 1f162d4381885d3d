"""SO(3) and quaternions against SciPy, finite differences and the ⊞ axioms (docs/manifolds.md)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from boxplus.errors import InputError
from boxplus.manifolds import quaternion, so3

ANGLES = [0.0, 1e-8, 1e-3, 0.5 - 1e-9, 0.5 + 1e-9, 1.0 - 1e-9, 1.0 + 1e-9, 2.0, np.pi - 1e-6]
angles = st.one_of(st.sampled_from(ANGLES), st.floats(0.0, np.pi - 1e-6))
seeds = st.integers(0, 2**32 - 1)


def _axis(seed: int) -> np.ndarray:
    axis = np.random.default_rng(seed).normal(size=3)
    return axis / np.linalg.norm(axis)


@given(angles, seeds)
def test_exp_is_the_matrix_exponential(angle: float, seed: int) -> None:
    w = angle * _axis(seed)
    assert np.allclose(so3.exp(w), expm(so3.hat(w)), atol=1e-14)


@given(angles, seeds)
def test_log_inverts_exp(angle: float, seed: int) -> None:
    w = angle * _axis(seed)
    assert np.allclose(so3.log(so3.exp(w)), w, atol=2e-10 if angle > 3.14 else 1e-13, rtol=0)


@given(seeds)
def test_log_at_pi_is_half_turn_about_the_axis(seed: int) -> None:
    w = np.pi * _axis(seed)
    found = so3.log(so3.exp(w))
    assert np.isclose(np.linalg.norm(found), np.pi)
    assert np.allclose(so3.exp(found), so3.exp(w), atol=1e-14)


@given(angles, seeds)
def test_jacobians_against_central_differences(angle: float, seed: int) -> None:
    w = angle * _axis(seed)
    h = 1e-3
    numeric = np.zeros((3, 3))
    for k in range(3):
        d = np.eye(3)[k] * h
        values = [so3.boxminus(so3.exp(w + s * d), so3.exp(w)) for s in (1, -1, 2, -2)]
        numeric[:, k] = (8 * (values[0] - values[1]) - (values[2] - values[3])) / (12 * h)
    assert np.allclose(so3.right_jacobian(w), numeric, atol=1e-9)
    assert np.allclose(so3.right_jacobian(w) @ so3.right_jacobian_inverse(w), np.eye(3), atol=1e-12)


@given(angles, angles, seeds)
def test_boxplus_axioms(angle: float, step: float, seed: int) -> None:
    R, delta = so3.exp(angle * _axis(seed)), step * _axis(seed + 1)
    other = so3.exp(2.0 * _axis(seed + 2))
    assert np.allclose(so3.boxplus(R, np.zeros(3)), R, atol=1e-15)
    assert np.allclose(so3.boxminus(R, R), 0, atol=1e-7)
    assert np.allclose(so3.boxplus(R, so3.boxminus(other, R)), other, atol=1e-12)
    assert np.allclose(so3.boxminus(so3.boxplus(R, delta), R), delta, atol=1e-9)


@given(angles, seeds)
def test_quaternions_agree_with_scipy(angle: float, seed: int) -> None:
    rotation = Rotation.from_rotvec(angle * _axis(seed))
    q_wxyz = quaternion.from_matrix(rotation.as_matrix())
    assert q_wxyz[0] >= 0
    assert np.allclose(quaternion.to_matrix(q_wxyz), rotation.as_matrix(), atol=1e-14)
    other = Rotation.random(rng=seed)
    other_wxyz = quaternion.from_matrix(other.as_matrix())
    product = quaternion.to_matrix(quaternion.multiply(q_wxyz, other_wxyz * [1, -1, -1, -1]))
    assert np.allclose(product, (rotation * other.inv()).as_matrix(), atol=1e-13)


def test_batches_keep_their_shape() -> None:
    w = np.random.default_rng(0).normal(size=(2, 5, 3))
    assert so3.exp(w).shape == (2, 5, 3, 3)
    assert np.allclose(so3.exp(w)[1, 2], so3.exp(w[1, 2]))


def test_wrong_shape_says_what_to_do() -> None:
    with pytest.raises(InputError, match=r"expected w of shape \(\.\.\., 3\) – got shape \(4,\) – put the 3 values last"):
        so3.exp(np.zeros(4))


def test_is_rotation_refuses_reflections_and_nan() -> None:
    assert so3.is_rotation(np.eye(3))
    assert not so3.is_rotation(np.diag([1.0, 1.0, -1.0]))
    assert not so3.is_rotation(np.full((3, 3), np.nan))
