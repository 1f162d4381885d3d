"""Point-to-point, point-to-plane and GICP: NumPy, differences on both sides, and what they solve."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.manifolds import quaternion, se3
from boxplus.manifolds.se3 import SE3, SE3Left
from boxplus.optimization.jacobian_check import check_jacobian
from boxplus.residuals.gicp import Gicp, plane_covariances
from boxplus.residuals.point_to_plane import PointToPlane
from boxplus.residuals.point_to_point import PointToPoint
from boxplus.residuals.residual import Residual

COUNT = 40
seeds = st.integers(0, 2**32 - 1)


def unit_vectors(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    vectors = rng.normal(size=(count, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def scene(seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Points of source and target that have nothing to do with each other, normals, and a pose."""
    rng = np.random.default_rng(seed)
    p, q = rng.normal(size=(2, COUNT, 3)) * 5.0
    return p, q, unit_vectors(rng, COUNT), SE3.random(rng, 1)[0]


def assert_jacobians(residual: Residual, T: NDArray[np.float64]) -> None:
    for side in (SE3, SE3Left):
        report = check_jacobian(residual, T, manifolds=(side,))
        assert report.passed and report.invalid == report.unsteady == 0 and report.largest_residual > 1.0, str(report)


def solve(residual: Residual, T: NDArray[np.float64], iterations: int = 15) -> NDArray[np.float64]:
    """Gauss-Newton; GICP's weights follow the pose."""
    for _ in range(iterations):
        if isinstance(residual, Gicp):
            residual.refresh(T)
        linear = residual.linearize(T)
        W = np.broadcast_to(residual.whitening.factors, (residual.count, residual.dim, residual.dim))
        J = (W @ linear.jacobians[0]).reshape(-1, 6)
        r = np.einsum("nij,nj->ni", W, linear.residuals).ravel()
        T = SE3.boxplus(T, -np.linalg.lstsq(J, r, rcond=None)[0])
    return T


@given(seeds)
@settings(max_examples=15)
def test_point_to_point(seed: int) -> None:
    p, q, _, T = scene(seed)
    residual = PointToPoint(p, q)
    np.testing.assert_allclose(residual.evaluate(T), p @ quaternion.to_matrix(T[:4]).T + T[4:] - q, atol=1e-12)
    assert_jacobians(residual, T)


@given(seeds)
@settings(max_examples=15)
def test_point_to_plane(seed: int) -> None:
    p, q, u, T = scene(seed)
    residual = PointToPlane(p, q, u)
    expected = np.einsum("ni,ni->n", u, p @ quaternion.to_matrix(T[:4]).T + T[4:] - q)
    np.testing.assert_allclose(residual.evaluate(T)[:, 0], expected, atol=1e-12)
    assert_jacobians(residual, T)
    flipped = PointToPlane(p, q, -u).linearize(T)
    linear = residual.linearize(T)
    assert np.array_equal(flipped.residuals, -linear.residuals)
    assert np.array_equal(flipped.jacobians[0], -linear.jacobians[0])


@given(seeds)
@settings(max_examples=15)
def test_gicp_is_weighted_by_both_surfaces(seed: int) -> None:
    p, q, u, T = scene(seed)
    C_source, C_target = plane_covariances(np.roll(u, 1, axis=0)), plane_covariances(u, along=2.0, across=0.01)
    residual = Gicp(p, q, C_source, C_target, T)
    assert_jacobians(residual, T)
    R = quaternion.to_matrix(T[:4])
    e = residual.evaluate(T)
    squared = (np.einsum("nij,nj->ni", residual.whitening.factors, e) ** 2).sum(axis=1)
    for n in range(COUNT):
        assert np.isclose(squared[n], e[n] @ np.linalg.solve(C_target[n] + R @ C_source[n] @ R.T, e[n]), rtol=1e-9)


def test_gicp_weights_move_only_when_told_to() -> None:
    p, q, u, T = scene(1)
    residual = Gicp(p, q, plane_covariances(u), plane_covariances(u))
    before = residual.whitening
    residual.evaluate(T)
    assert residual.whitening is before
    residual.refresh(T)
    assert not np.allclose(residual.whitening.factors, before.factors)
    again = Gicp(p, q, plane_covariances(u), plane_covariances(u), T)
    assert np.array_equal(residual.whitening.factors, again.whitening.factors)


def test_plane_covariances_are_flat_along_the_normal() -> None:
    u = unit_vectors(np.random.default_rng(2), 5)
    for normal, C in zip(u, plane_covariances(u, along=4.0, across=0.25), strict=True):
        np.testing.assert_allclose(C @ normal, 0.25 * normal, atol=1e-14)
        np.testing.assert_allclose(np.linalg.eigvalsh(C), [0.25, 4.0, 4.0])


@pytest.mark.parametrize("kind", ["point", "plane", "gicp"])
def test_registration_finds_the_pose(kind: str) -> None:
    """Exact correspondences on surfaces, the pose 0.5 rad and 1.5 m away; those on planes slide along them."""
    rng = np.random.default_rng(3)
    T = se3.exp(np.array([0.3, -0.3, 0.25, 1.0, -0.8, 0.8]))
    p, u_source = rng.normal(size=(200, 3)) * 5.0, unit_vectors(rng, 200)
    R = quaternion.to_matrix(T[:4])
    q, u = p @ R.T + T[4:], u_source @ R.T
    along = np.cross(u, rng.normal(size=(200, 3)))
    residual: Residual
    if kind == "point":
        residual = PointToPoint(p, q)
    elif kind == "plane":
        residual = PointToPlane(p, q + along, u)
    else:
        # Nearly no weight within the planes: the sliding is forgiven to about across/along.
        flat = {"along": 1.0, "across": 1e-9}
        residual = Gicp(p, q + 0.01 * along, plane_covariances(u_source, **flat), plane_covariances(u, **flat))
    found = solve(residual, SE3.identity())
    assert np.abs(SE3.boxminus(found, T)).max() < (1e-6 if kind == "gicp" else 1e-12)


def test_sigma_and_refusals() -> None:
    p, q, u, _ = scene(4)
    assert np.array_equal(PointToPlane(p, q, u, sigma=0.1).whitening.factors, [[[10.0]]])
    with pytest.raises(InputError, match=r"p_target of shape \(40, 3\) – got shape \(39, 3\)"):
        PointToPoint(p, q[:-1])
    bad = p.copy()
    bad[7] = np.nan
    with pytest.raises(InputError, match=r"p_source finite – got .* in row 7"):
        PointToPlane(bad, q, u)
    with pytest.raises(InputError, match="normals_target of length 1 – got 2 in row 0"):
        PointToPlane(p, q, 2.0 * u)
    with pytest.raises(InputError, match=r"covariance_target finite, of shape \(40, 3, 3\)"):
        Gicp(p, q, plane_covariances(u), np.eye(3))
    with pytest.raises(InputError, match="covariance positive definite"):
        Gicp(p, q, np.zeros((40, 3, 3)), np.zeros((40, 3, 3)))
    with pytest.raises(InputError, match="T_target_source of shape"):
        Gicp(p, q, plane_covariances(u), plane_covariances(u), np.eye(4))
    with pytest.raises(InputError, match="positive variances"):
        plane_covariances(u, across=0.0)
