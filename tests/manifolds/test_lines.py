"""Lines in the orthonormal representation against points and Plücker coordinates (docs/residuals/line_reprojection.md)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.errors import InputError
from boxplus.manifolds import lines, quaternion, se3, so3
from boxplus.manifolds.body_pose import BodyPose
from boxplus.manifolds.camera_pose import CameraPose
from boxplus.manifolds.lines import Line3D
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.se3 import SE3, SE3Left

seeds = st.integers(0, 2**32 - 1)


@given(seeds, st.sampled_from([1e-6, 1.0, 1e6]))
def test_a_line_through_two_points_contains_them(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    p, q = size * rng.normal(size=(2, 3))
    L = lines.to_plucker(lines.from_points(p, q))
    m, d = L[:3], L[3:]
    assert np.isclose(np.linalg.norm(L), 1.0) and abs(m @ d) < 1e-15
    for point in (p, q, 0.3 * p + 0.7 * q):
        assert np.allclose(np.cross(point, d), m, atol=1e-12 * max(1.0, size * np.linalg.norm(d)))
    assert (q - p) @ d > 0


@given(seeds, st.floats(1e-3, 1e3))
def test_plucker_coordinates_of_any_scale_come_back(seed: int, scale: float) -> None:
    line = Line3D.random(np.random.default_rng(seed), 3)
    L = lines.to_plucker(line)
    assert np.allclose(lines.to_plucker(lines.from_plucker(scale * L)), L, atol=1e-12)
    assert np.allclose(Line3D.boxminus(lines.from_plucker(scale * L), line), 0.0, atol=1e-9)


@given(seeds)
def test_the_moment_is_made_orthogonal_first(seed: int) -> None:
    rng = np.random.default_rng(seed)
    m, d = rng.normal(size=(2, 3))
    L = lines.to_plucker(lines.from_plucker(np.concatenate([m, d])))
    orthogonal = m - (m @ d) / (d @ d) * d
    expected = np.concatenate([orthogonal, d])
    assert np.allclose(L, expected / np.linalg.norm(expected), atol=1e-13)


@given(seeds)
def test_derivative_of_the_coordinates(seed: int) -> None:
    """∂L/∂[θ, δ] of docs/residuals/line_reprojection.md: what this ⊞ has to mean for the line residual."""
    line = Line3D.random(np.random.default_rng(seed), 1)[0]
    U = quaternion.to_matrix(line[:4])
    w1, w2 = np.cos(line[4]), np.sin(line[4])
    u1, u2, u3 = U.T
    zero = np.zeros(3)
    expected = np.vstack(
        [np.column_stack([zero, -w1 * u3, w1 * u2, -w2 * u1]), np.column_stack([w2 * u3, zero, -w2 * u1, w1 * u2])]
    )
    h = 1e-3
    steps = h * np.eye(4)
    ahead = lines.to_plucker(Line3D.boxplus(line, steps)) - lines.to_plucker(Line3D.boxplus(line, -steps))
    further = lines.to_plucker(Line3D.boxplus(line, 2 * steps)) - lines.to_plucker(Line3D.boxplus(line, -2 * steps))
    assert np.allclose(((8 * ahead - further) / (12 * h)).T, expected, atol=1e-10)


def test_a_line_through_the_origin_is_not_singular() -> None:
    line = lines.from_points([[1.0, 2.0, 3.0], [1.0, 0.0, 0.0]], [[-1.0, -2.0, -3.0], [-2.0, 0.0, 0.0]])
    L = lines.to_plucker(line)
    assert np.allclose(L[:, :3], 0.0, atol=1e-15)
    assert np.allclose(L[1, 3:], [-1.0, 0.0, 0.0])
    assert np.isfinite(Line3D.check("line", line)).all()


def test_phi_tells_the_distance_to_the_origin() -> None:
    line = lines.from_points([0.0, 0.0, 2.5], [1.0, 0.0, 2.5])
    assert np.isclose(1.0 / np.tan(line[4]), 2.5)


def test_lines_without_direction_are_refused() -> None:
    with pytest.raises(
        InputError, match=r"expected Plücker coordinates \[m; d\] with a finite m and a direction d – got .* in row 1"
    ):
        lines.from_points([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], [[1.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    with pytest.raises(InputError, match="leave this line out"):
        lines.from_plucker([np.nan, 0.0, 0.0, 1.0, 0.0, 0.0])


def test_the_pluecker_transform_moves_points_of_the_line() -> None:
    rng = np.random.default_rng(8)
    T, p, q = SE3.random(rng, 10), rng.normal(size=(10, 3)), rng.normal(size=(10, 3))

    def through(p, q):
        return np.concatenate([np.cross(p, q - p), q - p], axis=-1)

    moved = lines.transform(T, through(p, q))
    assert np.allclose(moved, through(se3.act(T, p), se3.act(T, q)), atol=1e-12)
    back = lines.transform(se3.inverse(T), moved)
    assert np.allclose(back, through(p, q), atol=1e-12)
    assert np.allclose(lines.motion_matrix(se3.inverse(T)) @ lines.motion_matrix(T), np.eye(6), atol=1e-12)


@pytest.mark.parametrize("manifold", [SE3Left, SE3, BodyPose, CameraPose], ids=str)
def test_jacobians_of_the_pluecker_transform(manifold: Manifold) -> None:
    rng, h = np.random.default_rng(9), 1e-4
    T, L = SE3.random(rng, 10), rng.normal(size=(10, 6))
    numeric = np.stack(
        [
            (lines.transform(manifold.boxplus(T, h * e), L) - lines.transform(manifold.boxplus(T, -h * e), L)) / (2.0 * h)
            for e in np.eye(6)
        ],
        axis=-1,
    )
    assert np.allclose(lines.transform_jacobian(T, L, manifold), numeric, atol=1e-6)
    if manifold == CameraPose:  # as the page writes it
        M, t, d = lines.motion_matrix(T), T[:, 4:], lines.transform(T, L)[:, 3:]
        block = -so3.hat((M[:, :3, :3] @ L[:, :3, None])[..., 0]) - so3.hat(t) @ so3.hat(d)
        assert np.allclose(lines.transform_jacobian(T, L, manifold)[:, :3, :3], block, atol=1e-12)
