"""SE(3) and SE(2) against the matrix exponential, their Jacobians against integrals of it (docs/manifolds.md)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm

from boxplus.errors import InputError
from boxplus.manifolds import quaternion, se2, se3, so3
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3, SE3Left

ANGLES = [0.0, 1e-8, 1e-3, 0.5 - 1e-9, 0.5 + 1e-9, 1.0 - 1e-9, 1.0 + 1e-9, 2.0, np.pi - 1e-6, np.pi]
angles = st.one_of(st.sampled_from(ANGLES), st.floats(0.0, np.pi))
seeds = st.integers(0, 2**32 - 1)


def _xi(angle: float, seed: int) -> NDArray[np.float64]:
    xi = np.random.default_rng(seed).normal(size=6)
    xi[:3] *= angle / np.linalg.norm(xi[:3])
    return xi


def _ad(xi: NDArray[np.float64]) -> NDArray[np.float64]:
    """ad(ξ) for [w, v] (docs/manifolds.md)."""
    zero = np.zeros((3, 3))
    return np.block([[so3.hat(xi[:3]), zero], [so3.hat(xi[3:]), so3.hat(xi[:3])]])


def _matrix(T: NDArray[np.float64]) -> NDArray[np.float64]:
    M = np.eye(4)
    M[:3, :3], M[:3, 3] = quaternion.to_matrix(T[:4]), T[4:]
    return M


def _left_jacobian(ad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Σ adᵏ/(k+1)!, read off the exponential of [[ad, I], [0, 0]]."""
    n = len(ad)
    return expm(np.block([[ad, np.eye(n)], [np.zeros((n, 2 * n))]]))[:n, n:]


def _spec_q(w: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Q(w, v) as docs/manifolds.md writes it, closed forms of the coefficients."""
    W, V, t = so3.hat(w), so3.hat(v), float(np.linalg.norm(w))
    C = (t - np.sin(t)) / t**3
    c2 = (t**2 + 2 * np.cos(t) - 2) / (2 * t**4)
    c3 = (2 * t - 3 * np.sin(t) + t * np.cos(t)) / (2 * t**5)
    first = 0.5 * V + C * (W @ V + V @ W + W @ V @ W)
    return first + c2 * (W @ W @ V + V @ W @ W - 3 * W @ V @ W) + c3 * (W @ V @ W @ W + W @ W @ V @ W)


@given(angles, seeds)
def test_exp_is_the_matrix_exponential(angle: float, seed: int) -> None:
    xi = _xi(angle, seed)
    X = np.zeros((4, 4))
    X[:3, :3], X[:3, 3] = so3.hat(xi[:3]), xi[3:]
    assert np.allclose(_matrix(se3.exp(xi)), expm(X), atol=1e-13)


@given(st.one_of(st.sampled_from(ANGLES[:-1]), st.floats(0.0, np.pi - 1e-6)), seeds)
def test_log_inverts_exp(angle: float, seed: int) -> None:
    xi = _xi(angle, seed)
    assert np.allclose(se3.log(se3.exp(xi)), xi, atol=1e-9 if angle > 3.14 else 1e-13)
    # q and −q are one rotation.
    assert np.allclose(se3.log(se3.exp(xi) * [-1, -1, -1, -1, 1, 1, 1]), xi, atol=1e-9 if angle > 3.14 else 1e-13)


@given(angles, seeds)
def test_jacobians_are_the_series_of_ad(angle: float, seed: int) -> None:
    xi = _xi(angle, seed)
    left = _left_jacobian(_ad(xi))
    assert np.allclose(se3.left_jacobian(xi), left, atol=1e-13)
    assert np.allclose(se3.right_jacobian(xi), _left_jacobian(_ad(-xi)), atol=1e-13)
    assert np.allclose(se3.left_jacobian_inverse(xi) @ left, np.eye(6), atol=1e-13)
    assert np.allclose(se3.right_jacobian_inverse(xi) @ se3.right_jacobian(xi), np.eye(6), atol=1e-13)
    # J_l = Ad(Exp ξ) J_r: a swap of sides does not pass.
    assert np.allclose(se3.adjoint(se3.exp(xi)) @ se3.right_jacobian(xi), left, atol=1e-12)


@given(st.floats(0.5, np.pi), seeds)
def test_the_lower_left_block_is_q_of_the_specification(angle: float, seed: int) -> None:
    xi = _xi(angle, seed)
    assert np.allclose(se3.left_jacobian(xi)[3:, :3], _spec_q(xi[:3], xi[3:]), atol=1e-12)
    J_inverse = so3.left_jacobian_inverse(xi[:3])
    assert np.allclose(se3.left_jacobian_inverse(xi)[3:, :3], -J_inverse @ _spec_q(xi[:3], xi[3:]) @ J_inverse, atol=1e-12)


@given(angles, seeds)
def test_adjoint_moves_a_tangent_to_the_other_side(angle: float, seed: int) -> None:
    T, xi = se3.exp(_xi(angle, seed)), _xi(0.3, seed + 1)
    assert np.allclose(se3.adjoint(T), expm(_ad(_xi(angle, seed))), atol=1e-12)
    assert np.allclose(se3.compose(T, se3.exp(xi)), se3.compose(se3.exp(se3.adjoint(T) @ xi), T), atol=1e-12)
    # The right step ξ and the left step Ad ξ are the same motion.
    assert np.allclose(SE3Left.boxminus(SE3.boxplus(T, xi), T), se3.adjoint(T) @ xi, atol=1e-12)


@given(seeds)
def test_the_group_is_that_of_matrices(seed: int) -> None:
    rng = np.random.default_rng(seed)
    (T_ab, T_bc), p_c = SE3.random(rng, 2), rng.normal(size=3)
    assert np.allclose(_matrix(se3.compose(T_ab, T_bc)), _matrix(T_ab) @ _matrix(T_bc), atol=1e-14)
    assert np.allclose(_matrix(se3.inverse(T_ab)), np.linalg.inv(_matrix(T_ab)), atol=1e-14)
    assert np.allclose(se3.act(T_bc, p_c), (_matrix(T_bc) @ np.append(p_c, 1.0))[:3], atol=1e-14)
    assert np.allclose(SE3.boxplus(T_ab, rng.normal(size=6) * 0.0), T_ab, atol=1e-15)


def test_order_is_rotation_first_and_sides_differ() -> None:
    T = se3.exp([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0])
    ahead = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    assert np.allclose(SE3.boxplus(T, ahead)[4:], [0.0, 1.0, 0.0])
    assert np.allclose(SE3Left.boxplus(T, ahead)[4:], [1.0, 0.0, 0.0])


def _se2_ad(xi: NDArray[np.float64]) -> NDArray[np.float64]:
    w, x, y = xi
    return np.array([[0.0, 0.0, 0.0], [y, 0.0, -w], [-x, w, 0.0]])


def _se2_matrix(T: NDArray[np.float64]) -> NDArray[np.float64]:
    c, s = np.cos(T[0]), np.sin(T[0])
    return np.array([[c, -s, T[1]], [s, c, T[2]], [0.0, 0.0, 1.0]])


@given(st.one_of(st.sampled_from(ANGLES[:-1]), st.floats(-3.1, 3.1)), seeds)
def test_se2_is_the_matrix_exponential(angle: float, seed: int) -> None:
    xi = np.random.default_rng(seed).normal(size=3)
    xi[0] = angle
    w, x, y = xi
    T = se2.exp(xi)
    assert np.allclose(_se2_matrix(T), expm([[0.0, -w, x], [w, 0.0, y], [0.0, 0.0, 0.0]]), atol=1e-14)
    assert np.allclose(se2.log(T), xi, atol=1e-13)
    assert np.allclose(se2.adjoint(T), expm(_se2_ad(xi)), atol=1e-13)
    assert np.allclose(se2.left_jacobian(xi), _left_jacobian(_se2_ad(xi)), atol=1e-13)
    assert np.allclose(se2.right_jacobian(xi), _left_jacobian(_se2_ad(-xi)), atol=1e-13)
    assert np.allclose(se2.left_jacobian_inverse(xi) @ se2.left_jacobian(xi), np.eye(3), atol=1e-13)
    assert np.allclose(se2.right_jacobian_inverse(xi) @ se2.right_jacobian(xi), np.eye(3), atol=1e-13)


@given(seeds)
def test_se2_group(seed: int) -> None:
    rng = np.random.default_rng(seed)
    (T_ab, T_bc), p_c = SE2.random(rng, 2), rng.normal(size=2)
    assert np.allclose(_se2_matrix(se2.compose(T_ab, T_bc)), _se2_matrix(T_ab) @ _se2_matrix(T_bc), atol=1e-14)
    assert np.allclose(_se2_matrix(se2.inverse(T_ab)), np.linalg.inv(_se2_matrix(T_ab)), atol=1e-14)
    assert np.allclose(se2.act(T_bc, p_c), (_se2_matrix(T_bc) @ np.append(p_c, 1.0))[:2], atol=1e-14)


def test_se2_angles_are_wrapped() -> None:
    assert np.allclose(SE2.check("x", [[3.5 * np.pi, 1.0, 2.0]]), [[-0.5 * np.pi, 1.0, 2.0]])
    assert np.isclose(SE2.boxplus([3.0, 0.0, 0.0], [1.0, 0.0, 0.0])[0], 4.0 - 2 * np.pi)
    assert np.isclose(SE2.boxminus([-3.0, 0.0, 0.0], [3.0, 0.0, 0.0])[0], 2 * np.pi - 6.0)
    assert np.isclose(SE2.boxplus([3.0, 0.0, 0.0], [21 * np.pi, 0.0, 0.0])[0], 3.0 - np.pi)


@pytest.mark.parametrize("function", [se3.exp, se3.log, se3.adjoint, se3.inverse, se3.left_jacobian])
def test_wrong_shapes_say_what_to_do(function) -> None:
    with pytest.raises(InputError, match=r"of shape \(\.\.\., \d\) – got shape \(5,\) – put the \d values last"):
        function(np.zeros(5))


def test_leading_axes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match=r"expected T_ab and p_b with leading axes that broadcast – got \(2,\) and \(3,\)"):
        se3.act(np.zeros((2, 7)), np.zeros((3, 3)))
    poses = SE3.random(np.random.default_rng(0), 4)
    assert se3.act(poses[:, None], np.zeros((5, 3))).shape == (4, 5, 3)
