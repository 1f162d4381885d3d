"""The chordal error: its definition in NumPy, its Jacobians, and the weights of SE-Sync."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from boxplus.errors import InputError
from boxplus.manifolds import quaternion, se2, se3
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3, SE3Left
from boxplus.optimization.jacobian_check import check_jacobian
from boxplus.residuals.chordal_pose import ChordalPose, ChordalPose2D, chordal_weights

COUNT = 40


def turn(theta: np.ndarray) -> np.ndarray:
    c, s = np.cos(theta), np.sin(theta)
    return np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)


def parts(T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return (quaternion.to_matrix(T[:, :4]), T[:, 4:]) if T.shape[1] == 7 else (turn(T[:, 0]), T[:, 1:])


@pytest.mark.parametrize(("kind", "manifold"), [(ChordalPose, SE3), (ChordalPose2D, SE2)])
def test_residual_and_jacobians(kind, manifold):
    rng = np.random.default_rng(1)
    T_i, T_j, Z = (manifold.random(rng, COUNT) for _ in range(3))
    residual = kind(Z)
    (R_i, t_i), (R_j, t_j), (R, t) = parts(T_i), parts(T_j), parts(Z)
    difference = R_j - R_i @ R
    columns = np.swapaxes(difference, 1, 2).reshape(COUNT, -1)
    expected = np.hstack([columns, t_j - t_i - np.einsum("nab,nb->na", R_i, t)])
    assert_allclose(residual.evaluate(T_i, T_j), expected, atol=1e-12)
    assert_allclose(residual.linearize(T_i, T_j).residuals, expected, atol=1e-12)
    for side in [(manifold, manifold)] + ([(SE3Left, SE3Left)] if manifold is SE3 else []):
        report = check_jacobian(residual, T_i, T_j, manifolds=side)
        assert report.passed and report.invalid == 0 and report.largest_residual > 1.0, str(report)


@pytest.mark.parametrize(("kind", "manifold", "group"), [(ChordalPose, SE3, se3), (ChordalPose2D, SE2, se2)])
def test_near_zero_it_is_the_logarithmic_error(kind, manifold, group):
    """κ ‖R_j − R_i R_ij‖² is 2 κ θ² of a small angle θ, and the translation that of the logarithm."""
    rng = np.random.default_rng(2)
    T_i, Z = manifold.random(rng, COUNT), manifold.random(rng, COUNT)
    e = 1e-4 * rng.standard_normal((COUNT, manifold.dof))
    T_j = manifold.boxplus(group.compose(T_i, Z), e)
    r = kind(Z, kappa=3.0, tau=5.0)
    whitened = np.einsum("nab,nb->na", r.whitening.factors, r.evaluate(T_i, T_j))
    split = 3 if manifold is SE3 else 1
    expected = 2.0 * 3.0 * (e[:, :split] ** 2).sum(1) + 5.0 * (e[:, split:] ** 2).sum(1)
    assert_allclose((whitened**2).sum(1), expected, rtol=1e-3)


def test_weights_of_isotropic_noise():
    """κ is then half the precision of the angles in 3D, the whole in 2D; τ the precision of the translation."""
    kappa, tau = chordal_weights(np.diag([8.0, 8.0, 8.0, 5.0, 5.0, 5.0])[None])
    assert_allclose([kappa[0], tau[0]], [4.0, 5.0])
    kappa, tau = chordal_weights(np.diag([8.0, 2.0, 6.0])[None])
    assert_allclose([kappa[0], tau[0]], [8.0, 2.0 / (1 / 2 + 1 / 6)])


def test_bad_weights_are_refused():
    with pytest.raises(InputError, match=r"expected kappa as positive finite numbers"):
        ChordalPose(SE3.identity(), kappa=-1.0)
    with pytest.raises(InputError, match="information on all axes"):
        chordal_weights(np.diag([0.0, 1.0, 1.0])[None])
    with pytest.raises(InputError, match=r"information of shape"):
        chordal_weights(np.eye(4))
