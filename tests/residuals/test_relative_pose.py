"""Relative pose errors in space and plane, and priors (docs/residuals/relative_pose.md)."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.errors import InputError
from boxplus.manifolds import se2, se3
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.lines import Line3D
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import UnitQuaternion
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3, SE3Left
from boxplus.manifolds.so3 import SO3
from boxplus.optimization.jacobian_check import check_jacobian
from boxplus.optimization.problem import Problem
from boxplus.residuals.prior import Prior
from boxplus.residuals.relative_pose import RelativePose
from boxplus.residuals.relative_pose_2d import RelativePose2D

PRODUCT = Product(UnitQuaternion, Euclidean(3))
seeds = st.integers(0, 2**32 - 1)


@given(seeds)
def test_the_error_is_the_logarithm_of_the_loop(seed: int) -> None:
    rng = np.random.default_rng(seed)
    Z, T_i, T_j = (SE3.random(rng, 4) for _ in range(3))
    loop = se3.compose(se3.inverse(Z), se3.compose(se3.inverse(T_i), T_j))
    assert np.allclose(RelativePose(Z).evaluate(T_i, T_j), se3.log(loop), atol=1e-9)
    Z, T_i, T_j = (SE2.random(rng, 4) for _ in range(3))
    loop = se2.compose(se2.inverse(Z), se2.compose(se2.inverse(T_i), T_j))
    assert np.allclose(RelativePose2D(Z).evaluate(T_i, T_j), se2.log(loop), atol=1e-9)


@pytest.mark.parametrize(
    "sides", [(SE3, SE3), (SE3Left, SE3Left), (SE3, SE3Left), (PRODUCT, PRODUCT), (SE3Left, PRODUCT)], ids=str
)
def test_jacobians_on_every_side(sides: tuple[Manifold, Manifold]) -> None:
    rng = np.random.default_rng(1)
    Z, T_i, T_j = (SE3.random(rng, 50) for _ in range(3))
    T_i[:, 4:] *= 10.0
    residual = RelativePose(Z)
    assert np.abs(residual.evaluate(T_i, T_j)).max(axis=1).min() > 0.5
    report = check_jacobian(residual, T_i, T_j, manifolds=sides)
    assert report.passed, report


def test_jacobians_are_those_of_the_specification() -> None:
    """docs/residuals/relative_pose.md in both its forms, and 5.2 on the left, each from its own formula."""
    rng = np.random.default_rng(2)
    Z, T_i, T_j = (SE3.random(rng, 20) for _ in range(3))
    linear = RelativePose(Z).linearize(T_i, T_j)
    e = linear.residuals
    right = se3.right_jacobian_inverse(e)
    assert np.allclose(linear.jacobians[1], right, atol=1e-13)
    assert np.allclose(linear.jacobians[0], -right @ se3.adjoint(se3.compose(se3.inverse(T_j), T_i)), atol=1e-12)
    assert np.allclose(linear.jacobians[0], -se3.left_jacobian_inverse(e) @ se3.adjoint(se3.inverse(Z)), atol=1e-12)
    on_the_left = right @ se3.adjoint(se3.inverse(T_j))
    assert np.allclose(linear.jacobians[1] @ se3.adjoint(se3.inverse(T_j)), on_the_left, atol=1e-12)
    assert np.allclose(linear.jacobians[0] @ se3.adjoint(se3.inverse(T_i)), -on_the_left, atol=1e-12)


def test_the_left_jacobians_are_not_those_of_the_right_update() -> None:
    # The source derives on the left and announces the right: the check tells them apart.
    rng = np.random.default_rng(2)
    Z, T_i, T_j = (SE3.random(rng, 3) for _ in range(3))
    residual = RelativePose(Z)
    residual.manifolds = (SE3Left, SE3Left)
    assert not check_jacobian(residual, T_i, T_j).passed


def test_first_order_is_an_option_with_the_stated_error() -> None:
    rng = np.random.default_rng(3)
    Z = SE3.random(rng, 200)
    e = rng.normal(size=(200, 6))
    e *= rng.uniform(0.01, 0.5, (200, 1)) / np.linalg.norm(e, axis=1, keepdims=True)
    T_i = SE3.random(rng, 200)
    T_j = SE3.boxplus(se3.compose(T_i, Z), e)
    exact, first = RelativePose(Z).linearize(T_i, T_j), RelativePose(Z, jacobian="first_order").linearize(T_i, T_j)
    assert np.array_equal(exact.residuals, first.residuals)
    assert np.allclose(exact.residuals, e, atol=1e-13)
    error = np.linalg.norm(exact.jacobians[1] - first.jacobians[1], 2, axis=(1, 2))
    assert (error <= (e**2).sum(axis=1) / 6.0).all() and error.max() > 1e-3
    with pytest.raises(InputError, match='expected jacobian "exact" or "first_order" – got \'fast\''):
        RelativePose(Z, jacobian="fast")  # type: ignore[arg-type]


@pytest.mark.parametrize("angle", [np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-9, np.pi])
def test_half_a_turn_stays_finite_and_is_told(angle: float) -> None:
    T_i = SE3.random(np.random.default_rng(4), 1)
    axis = np.array([0.6, 0.0, 0.8])
    residual = RelativePose(SE3.identity())
    T_j = SE3.boxplus(T_i, [*(angle * axis), 1.0, 2.0, 3.0])
    linear = residual.linearize(T_i, T_j)
    assert np.isclose(np.linalg.norm(linear.residuals[0, :3]), angle, atol=1e-9)
    assert all(np.isfinite(J).all() and np.abs(J).max() < 10.0 for J in linear.jacobians)
    assert linear.valid.all()
    assert residual.at_half_turn(T_i, T_j).tolist() == [angle >= np.pi - 1e-6]
    flat = RelativePose2D(SE2.identity()).linearize([0.0, 0.0, 0.0], [angle, 1.0, 2.0])
    assert np.isclose(abs(flat.residuals[0, 0]), angle)
    assert all(np.isfinite(J).all() for J in flat.jacobians)


def test_jacobians_in_the_plane() -> None:
    rng = np.random.default_rng(5)
    Z, T_i, T_j = (SE2.random(rng, 100) for _ in range(3))
    residual = RelativePose2D(Z)
    angle = np.abs(residual.evaluate(T_i, T_j)[:, 0])
    keep = angle < 3.1  # a step across half a turn is a jump, not a derivative
    residual = RelativePose2D(Z[keep])
    T_i, T_j = T_i[keep], T_j[keep]
    report = check_jacobian(residual, T_i, T_j)
    assert keep.sum() > 80 and report.passed, report
    linear = residual.linearize(T_i, T_j)
    right = se2.right_jacobian_inverse(linear.residuals)
    assert np.allclose(linear.jacobians[1], right, atol=1e-13)
    assert np.allclose(linear.jacobians[0], -right @ se2.adjoint(se2.compose(se2.inverse(T_j), T_i)), atol=1e-12)


def test_moving_everything_together_changes_nothing() -> None:
    rng = np.random.default_rng(6)
    Z, T_i, T_j = (SE3.random(rng, 5) for _ in range(3))
    T = SE3.random(rng, 1)[0]
    residual = RelativePose(Z)
    assert np.allclose(residual.evaluate(T_i, T_j), residual.evaluate(se3.compose(T, T_i), se3.compose(T, T_j)), atol=1e-12)
    assert not residual.fixes_gauge and Prior(SE3, T).fixes_gauge


def test_noise_and_measurements_are_checked() -> None:
    Z = SE3.random(np.random.default_rng(7), 3)
    assert np.allclose(RelativePose(Z, information=4.0 * np.eye(6)).whitening.factors[0], 2.0 * np.eye(6))
    with pytest.raises(InputError, match="expected measured with unit quaternions wxyz first"):
        RelativePose(2.0 * Z)
    with pytest.raises(InputError, match=r"expected measured of shape \(n, 3\) on SE2"):
        RelativePose2D(Z)
    with pytest.raises(InputError, match="expected information positive semi-definite"):
        RelativePose(Z, information=-np.eye(6))
    with pytest.raises(InputError, match=r"expected T_world_j of shape \(3, 7\) or \(7,\) on SE3"):
        RelativePose(Z).evaluate(Z, Z[:2])


@pytest.mark.parametrize("manifold", [SO3, UnitQuaternion, SE2, SE3, SE3Left, Line3D, Euclidean(4), PRODUCT], ids=str)
def test_priors_on_every_manifold(manifold: Manifold) -> None:
    rng = np.random.default_rng(8)
    mean = manifold.random(rng, 20)
    delta = rng.uniform(-1.0, 1.0, (20, manifold.dof))
    residual = Prior(manifold, mean, sigma=0.5)
    x = manifold.boxplus(mean, delta)
    assert np.allclose(residual.evaluate(x), delta, atol=1e-12)
    report = check_jacobian(residual, x)
    assert report.passed, report
    assert np.allclose(residual.whitening.factors[0], 2.0 * np.eye(manifold.dof))


def test_a_prior_of_the_position_alone() -> None:
    mean = PRODUCT.random(np.random.default_rng(9), 1)[0]
    residual = Prior(PRODUCT, mean, information=np.diag([0.0, 0.0, 0.0, 4.0, 4.0, 4.0]))
    x = PRODUCT.boxplus(mean, [0.5, 0.2, -0.1, 1.0, 2.0, 3.0])
    whitened = residual.whitening.factors[0] @ residual.evaluate(x)[0]
    assert np.isclose(whitened @ whitened, 4.0 * 14.0)


@pytest.mark.parametrize("other", [SE3Left, PRODUCT], ids=str)
def test_a_prior_holds_for_a_variable_on_another_side(other: Manifold) -> None:
    rng = np.random.default_rng(9)
    residual = Prior(SE3, SE3.random(rng, 10))
    assert check_jacobian(residual, SE3.random(rng, 10), manifolds=(other,)).passed


def test_a_prior_refuses_a_mean_off_the_manifold() -> None:
    with pytest.raises(InputError, match="expected mean with unit quaternions"):
        Prior(SE3, np.ones(7))


def test_rows_outside_of_a_chunk_are_left_alone() -> None:
    rng = np.random.default_rng(10)
    for residual, x in (
        (RelativePose(SE3.random(rng, 6)), SE3.random(rng, 6)),
        (RelativePose2D(SE2.random(rng, 6)), SE2.random(rng, 6)),
        (Prior(SE3, SE3.random(rng, 6)), SE3.random(rng, 6)),
    ):
        slots = len(residual.manifolds)
        index = (np.arange(6, dtype=np.uint32)[::-1].copy(), np.arange(6, dtype=np.uint32))[:slots]
        r, valid = np.full((6, residual.dim), 7.0), np.zeros(6, dtype=bool)
        J = tuple(np.full((6, residual.dim, residual.dim), 7.0) for _ in range(slots))
        residual.linearize_into(2, 5, (x,) * slots, index, r, J, valid)
        expected = residual.linearize(*(x[rows] for rows in index))
        assert np.array_equal(r[2:5], expected.residuals[2:5])
        assert all(np.array_equal(J[s][2:5], expected.jacobians[s][2:5]) for s in range(slots))
        assert (r[:2] == 7.0).all() and (r[5:] == 7.0).all() and (J[0][5:] == 7.0).all()
        assert valid.tolist() == [False, False, True, True, True, False]


def test_a_solution_names_what_began_or_ended_half_a_turn_off() -> None:
    still, turned = SE3.identity(), SE3.boxplus(SE3.identity(), [0.0, 0.0, np.pi, 0.0, 0.0, 0.0])
    problem = Problem()
    poses = problem.add_variables(SE3, [still, turned, still])
    problem.add_residuals(RelativePose([still, still]), poses[[0, 0]], poses[[1, 2]], name="edges")
    problem.fix(poses[0])
    (note,) = [note for note in problem.solve().notes if "half a turn" in note]
    assert note.startswith("1 of the residuals of edges (0) began half a turn off, which way they turned back was arbitrary")
    problem.fix(poses[1])
    notes = [note for note in problem.solve().notes if "half a turn" in note]
    assert len(notes) == 2 and "ended half a turn off" in notes[1]
    planar = RelativePose2D([[0.0, 0.0, 0.0]])
    assert planar.at_half_turn([0.0, 0.0, 0.0], [np.pi, 1.0, 0.0]).tolist() == [True]
    assert planar.at_half_turn([0.0, 0.0, 0.0], [3.0, 9.0, 0.0]).tolist() == [False]
