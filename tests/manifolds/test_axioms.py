"""The ten ⊞ axioms on every manifold (Hertzberg et al. 2013; docs/manifolds.md), at identity, 1e-8, the switches of the series,
generic, π − 1e-6 and π.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from boxplus.manifolds.camera_pose import CameraPose
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.lines import Line3D
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import UnitQuaternion, UnitQuaternionLeft
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3, SE3Left
from boxplus.manifolds.so3 import SO3

MANIFOLDS = [
    SO3,
    UnitQuaternion,
    SE2,
    SE3,
    SE3Left,
    Line3D,
    Euclidean(1),
    Euclidean(5),
    UnitQuaternionLeft,
    Product(UnitQuaternion, Euclidean(3)),
    CameraPose,
    Product(SE2, Product(SO3, SE3Left)),
]
ANGLES = [0.0, 1e-8, 1e-3, 0.5 - 1e-9, 0.5 + 1e-9, 1.0 - 1e-9, 1.0 + 1e-9, 2.0, 3.0, np.pi - 1e-6, np.pi]
manifolds = st.sampled_from(MANIFOLDS)
angles = st.one_of(st.sampled_from(ANGLES), st.floats(0.0, np.pi - 1e-6))
small_angles = st.one_of(st.sampled_from(ANGLES[:-2]), st.floats(0.0, 3.0))
seeds = st.integers(0, 2**32 - 1)


def _rotations(manifold: Manifold) -> list[slice]:
    """Where the rotation vectors are in a tangent."""
    if isinstance(manifold, Product):
        found, start = [], 0
        for component in manifold.components:
            found += [slice(start + part.start, start + part.stop) for part in _rotations(component)]
            start += component.dof
        return found
    if isinstance(manifold, Euclidean):
        return []
    # SE2 and the last number of a line turn in a plane.
    return [slice(0, 1)] if manifold == SE2 else [slice(0, 3), *([slice(3, 4)] if manifold == Line3D else [])]


def _tangent(manifold: Manifold, angle: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Every rotation in it turns by `angle`; the rest is unit normal."""
    delta = rng.normal(size=manifold.dof)
    for part in _rotations(manifold):
        delta[part] *= angle / np.linalg.norm(delta[part])
    return delta


def _equal_points(manifold: Manifold, x: NDArray[np.float64], y: NDArray[np.float64], tolerance: float) -> bool:
    """By ⊟, for q and −q are one point."""
    return bool(np.abs(manifold.boxminus(x, y)).max() <= tolerance)


def _numeric(function, dof: int, h: float = 1e-3) -> NDArray[np.float64]:
    """Fourth-order central differences of a function of a tangent at zero."""
    columns = []
    for k in range(dof):
        d = h * np.eye(dof)[k]
        columns.append((8 * (function(d) - function(-d)) - (function(2 * d) - function(-2 * d))) / (12 * h))
    return np.stack(columns, axis=-1)


@given(manifolds, angles, seeds)
def test_1_adding_zero_changes_nothing(manifold: Manifold, angle: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = manifold.boxplus(manifold.identity(), _tangent(manifold, angle, rng))
    assert np.allclose(manifold.boxplus(x, np.zeros(manifold.dof)), x, atol=1e-15, rtol=1e-15)


@given(manifolds, angles, seeds)
def test_2_a_point_is_at_distance_zero_from_itself(manifold: Manifold, angle: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = manifold.boxplus(manifold.random(rng, 1)[0], _tangent(manifold, angle, rng))
    assert np.allclose(manifold.boxminus(x, x), 0.0, atol=1e-14)


@given(manifolds, small_angles, seeds)
def test_3_what_is_added_is_the_difference(manifold: Manifold, angle: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, delta = manifold.random(rng, 1)[0], _tangent(manifold, angle, rng)
    assert np.allclose(manifold.boxminus(manifold.boxplus(x, delta), x), delta, atol=1e-13 * max(1.0, np.abs(delta).max()))


@given(manifolds, st.sampled_from([np.pi - 1e-6, np.pi]), seeds)
def test_3_near_half_a_turn_up_to_the_sign_of_the_axis(manifold: Manifold, angle: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, delta = manifold.random(rng, 1)[0], _tangent(manifold, angle, rng)
    found = manifold.boxminus(manifold.boxplus(x, delta), x)
    for part in _rotations(manifold):
        assert np.isclose(np.linalg.norm(found[part]), angle, atol=1e-9)
        assert min(np.abs(found[part] - delta[part]).max(), np.abs(found[part] + delta[part]).max()) < 1e-9
    assert _equal_points(manifold, manifold.boxplus(x, found), manifold.boxplus(x, delta), 1e-9)


@given(manifolds, angles, seeds)
def test_4_the_difference_leads_to_the_other_point(manifold: Manifold, angle: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = manifold.random(rng, 1)[0]
    y = manifold.boxplus(x, _tangent(manifold, angle, rng))
    assert _equal_points(manifold, manifold.boxplus(x, manifold.boxminus(y, x)), y, 1e-13)


@given(manifolds, angles, angles, seeds)
def test_5_points_stay_on_the_manifold(manifold: Manifold, first: float, second: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = manifold.boxplus(manifold.identity(), _tangent(manifold, first, rng))
    for _ in range(3):
        x = manifold.boxplus(x, _tangent(manifold, second, rng))
    assert np.allclose(manifold.check("x", x)[0], x, atol=1e-14, rtol=1e-14)


@given(manifolds, small_angles, seeds)
def test_6_jacobian_of_boxplus(manifold: Manifold, angle: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, delta = manifold.random(rng, 1)[0], _tangent(manifold, angle, rng)
    y = manifold.boxplus(x, delta)
    numeric = _numeric(lambda d: manifold.boxminus(manifold.boxplus(x, delta + d), y), manifold.dof)
    J = manifold.boxplus_jacobian(x, delta)
    assert np.allclose(J, numeric, atol=1e-9 * max(1.0, np.abs(J).max()), rtol=0)


@given(manifolds, small_angles, seeds)
def test_7_jacobian_of_boxminus(manifold: Manifold, angle: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    base = manifold.random(rng, 1)[0]
    x = manifold.boxplus(base, _tangent(manifold, min(angle, 2.9), rng))
    numeric = _numeric(lambda d: manifold.boxminus(manifold.boxplus(x, d), base), manifold.dof)
    J = manifold.boxminus_jacobian(x, base)
    assert np.allclose(J, numeric, atol=1e-8 * max(1.0, np.abs(J).max()), rtol=0)


@given(manifolds, small_angles, seeds)
def test_8_the_jacobians_are_inverse_to_each_other(manifold: Manifold, angle: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    base, delta = manifold.random(rng, 1)[0], _tangent(manifold, angle, rng)
    x = manifold.boxplus(base, delta)
    identity = manifold.boxminus_jacobian(x, base) @ manifold.boxplus_jacobian(base, delta)
    assert np.allclose(identity, np.eye(manifold.dof), atol=1e-12)


@given(manifolds, seeds)
def test_9_jacobians_are_finite_at_half_a_turn_and_identity_at_zero(manifold: Manifold, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = manifold.random(rng, 1)[0]
    delta = _tangent(manifold, np.pi, rng)
    y = manifold.boxplus(x, delta)
    assert np.isfinite(manifold.boxplus_jacobian(x, delta)).all()
    assert np.isfinite(manifold.boxminus_jacobian(y, x)).all()
    assert np.abs(manifold.boxminus_jacobian(y, x)).max() < 100.0
    assert np.allclose(manifold.boxplus_jacobian(x, np.zeros(manifold.dof)), np.eye(manifold.dof), atol=1e-15)
    assert np.allclose(manifold.boxminus_jacobian(x, x), np.eye(manifold.dof), atol=1e-14)


@given(small_angles, seeds)
def test_10_distances_obey_the_triangle(angle: float, seed: int) -> None:
    # ‖(x ⊞ δ₁) ⊟ (x ⊞ δ₂)‖ ≤ ‖δ₁ − δ₂‖ on rotations and vectors; poses are no metric spaces in this sense.
    rng = np.random.default_rng(seed)
    for space in (UnitQuaternion, SO3, Euclidean(3)):
        x = space.random(rng, 1)[0]
        first, second = _tangent(space, angle, rng), _tangent(space, angle, rng)
        distance = np.linalg.norm(space.boxminus(space.boxplus(x, first), space.boxplus(x, second)))
        assert distance <= np.linalg.norm(first - second) + 1e-12


@pytest.mark.parametrize("manifold", MANIFOLDS, ids=str)
def test_batches_broadcast_and_leave_their_inputs_alone(manifold: Manifold) -> None:
    rng = np.random.default_rng(4)
    x, delta = manifold.random(rng, 6), rng.normal(size=(6, manifold.dof))
    kept = x.copy(), delta.copy()
    y = manifold.boxplus(x, delta)
    assert y.shape == (6, manifold.size)
    assert np.array_equal(manifold.boxplus(x.reshape(2, 3, -1), delta.reshape(2, 3, -1)), y.reshape(2, 3, -1))
    assert np.array_equal(manifold.boxplus(x[0], delta)[2], manifold.boxplus(x[0], delta[2]))
    assert np.array_equal(manifold.boxplus(x, delta[1])[3], manifold.boxplus(x[3], delta[1]))
    assert manifold.boxminus(y, x[0]).shape == (6, manifold.dof)
    assert manifold.boxminus_jacobian(y, x).shape == (6, manifold.dof, manifold.dof)
    assert manifold.boxplus(x[:0], delta[:0]).shape == (0, manifold.size)
    assert np.array_equal(x, kept[0]) and np.array_equal(delta, kept[1])
    # A strided view gives the same bits.
    assert np.array_equal(manifold.boxplus(np.repeat(x, 2, axis=0)[::2], delta), y)


@pytest.mark.parametrize("manifold", [m for m in MANIFOLDS if hasattr(m, "boxplus_into")], ids=str)
def test_points_can_be_moved_in_place(manifold: Manifold) -> None:
    rng = np.random.default_rng(4)
    x, delta = manifold.random(rng, 6), rng.normal(size=(6, manifold.dof))
    expected = manifold.boxplus(x, delta)
    manifold.boxplus_into(x, delta, x)
    assert np.array_equal(x, expected)


@pytest.mark.parametrize("manifold", MANIFOLDS, ids=str)
def test_manifolds_describe_themselves(manifold: Manifold) -> None:
    import pickle

    assert repr(manifold) == manifold.name
    assert len(manifold.tangent_names) == len(set(manifold.tangent_names)) == manifold.dof
    assert manifold.identity().shape == (manifold.size,)
    copy = pickle.loads(pickle.dumps(manifold))
    assert copy == manifold and hash(copy) == hash(manifold)
    assert [other == manifold for other in MANIFOLDS].count(True) == 1


@pytest.mark.parametrize("manifold", MANIFOLDS, ids=repr)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_finite_stays_in_its_row(manifold: Manifold, value: float) -> None:
    rng = np.random.default_rng(0)
    points, delta = manifold.random(rng, 3), 0.1 * rng.normal(size=(3, manifold.dof))
    moved, differences = manifold.boxplus(points, delta), manifold.boxminus(points, points[::-1])
    for column in range(manifold.dof):
        wrong = delta.copy()
        wrong[1, column] = value
        found = manifold.boxplus(points, wrong)
        assert not np.isfinite(found[1]).all() and np.array_equal(found[[0, 2]], moved[[0, 2]])
    for column in range(manifold.size):
        wrong = points.copy()
        wrong[1, column] = value
        assert not np.isfinite(manifold.boxplus(wrong, delta)[1]).all()
        found = manifold.boxminus(wrong, points[::-1])
        assert not np.isfinite(found[1]).all() and np.array_equal(found[[0, 2]], differences[[0, 2]])
