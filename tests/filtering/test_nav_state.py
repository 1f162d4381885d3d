"""The navigation state: the ⊞ axioms where they are delicate, packing, and the check of transforms.

Derivation: docs/lidar_inertial_odometry.md, section 1.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.errors import InputError
from boxplus.filtering.nav_state import PL, RL, TANGENT, NavState, P, R, boxplus_into, check_transform
from boxplus.manifolds import so3
from tests.filtering.random_states import derivative, random_state

ROTATIONS = (slice(0, 3), slice(18, 21))
# Identity, tiny, both sides of the switches from series to closed form, generic, just below a half turn.
ANGLES = [0.0, 1e-8, 0.5 - 1e-9, 0.5 + 1e-9, 1.0 - 1e-9, 1.0 + 1e-9, 2.0, np.pi - 1e-6]
angles = st.one_of(st.sampled_from(ANGLES), st.floats(0.0, np.pi - 1e-6))
seeds = st.integers(0, 2**32 - 1)


def _state(seed: int) -> NavState:
    return random_state(np.random.default_rng(seed))


def _tangent(seed: int, angle: float, size: float = 2.0) -> np.ndarray:
    """A tangent vector whose two rotations have the length `angle`."""
    delta = size * np.random.default_rng(seed).normal(size=TANGENT)
    for block in ROTATIONS:
        delta[block] *= angle / np.linalg.norm(delta[block])
    return delta


def _same(x: NavState, y: NavState, tolerance: float = 1e-12) -> bool:
    return bool(np.allclose(x.pack(), y.pack(), atol=tolerance, rtol=0))


@given(seeds)
def test_zero_changes_nothing(seed: int) -> None:
    x = _state(seed)
    assert _same(x.boxplus(np.zeros(TANGENT)), x, 1e-15)


@given(seeds)
def test_a_state_does_not_differ_from_itself(seed: int) -> None:
    x = _state(seed)
    assert np.abs(x.boxminus(x)).max() < 1e-7


@given(seeds, angles)
def test_the_difference_leads_to_the_other_state(seed: int, angle: float) -> None:
    x = _state(seed)
    y = x.boxplus(_tangent(seed + 1, angle))
    assert _same(x.boxplus(y.boxminus(x)), y)
    z = _state(seed + 2)
    assert _same(x.boxplus(z.boxminus(x)), z)


@given(seeds, angles)
def test_a_step_is_recovered(seed: int, angle: float) -> None:
    x, delta = _state(seed), _tangent(seed + 1, angle)
    # The logarithm loses digits like 1 / (π − angle); everything else is exact.
    assert np.allclose(x.boxplus(delta).boxminus(x), delta, atol=1e-9 if angle > 3.14 else 1e-12, rtol=0)


@given(seeds)
def test_at_a_half_turn_the_step_is_recovered_up_to_its_sign(seed: int) -> None:
    x, delta = _state(seed), _tangent(seed + 1, np.pi)
    y = x.boxplus(delta)
    found = y.boxminus(x)
    assert _same(x.boxplus(found), y, 1e-7)
    for block in ROTATIONS:
        assert np.isclose(np.linalg.norm(found[block]), np.pi)
        assert np.isclose(abs(found[block] @ delta[block]), np.pi**2)


@given(seeds, angles, angles)
def test_steps_are_never_farther_apart_than_their_tangents(seed: int, first: float, second: float) -> None:
    x, a, b = _state(seed), _tangent(seed + 1, first), _tangent(seed + 2, second)
    distance = np.linalg.norm(x.boxplus(a).boxminus(x.boxplus(b)))
    assert distance <= np.linalg.norm(a - b) + 1e-9


@given(seeds, angles)
def test_the_opposite_step_leads_back(seed: int, angle: float) -> None:
    x, delta = _state(seed), _tangent(seed + 1, angle)
    assert _same(x.boxplus(delta).boxplus(-delta), x)


@given(seeds, angles)
def test_differences_are_antisymmetric(seed: int, angle: float) -> None:
    x = _state(seed)
    y = x.boxplus(_tangent(seed + 1, angle))
    assert np.allclose(x.boxminus(y), -y.boxminus(x), atol=1e-9)


@given(seeds)
def test_triangle_inequality(seed: int) -> None:
    x, y, z = (_state(seed + i) for i in range(3))
    direct = x.boxminus(z)
    for block in ROTATIONS:
        detour = np.linalg.norm(x.boxminus(y)[block]) + np.linalg.norm(y.boxminus(z)[block])
        assert np.linalg.norm(direct[block]) <= detour + 1e-9


@given(seeds, angles)
def test_rotations_stay_rotations_and_the_rest_is_added(seed: int, angle: float) -> None:
    x, delta = _state(seed), _tangent(seed + 1, angle)
    before = x.pack()
    y = x.boxplus(delta)
    assert so3.is_rotation(y.R_world_imu, 1e-13)
    assert so3.is_rotation(y.R_imu_lidar, 1e-13)
    assert np.array_equal(y.pack()[P:RL], before[P:RL] + delta[3:18])
    assert np.array_equal(y.pack()[PL:], before[PL:] + delta[21:])
    assert np.allclose(y.R_world_imu, x.R_world_imu @ so3.exp(delta[:3]), atol=1e-14)  # on the right
    assert np.array_equal(x.pack(), before)


@pytest.mark.parametrize("angle", ANGLES[:-1])
def test_derivative_is_the_inverse_right_jacobian(angle: float) -> None:
    x, d = _state(3), _tangent(4, angle)
    y = x.boxplus(d)
    expected = np.eye(TANGENT)
    for block in ROTATIONS:
        expected[block, block] = so3.right_jacobian_inverse(d[block])
    assert np.allclose(derivative(lambda e: y.boxplus(e).boxminus(x), TANGENT), expected, atol=1e-8)


def test_a_step_in_place() -> None:
    x = _state(0)
    packed, delta = x.pack(), _tangent(1, 0.7)
    boxplus_into(packed, delta, packed)
    assert np.array_equal(packed, x.boxplus(delta).pack())


def test_packing_keeps_everything_and_shares_nothing() -> None:
    x = _state(5)
    packed = x.pack()
    again = NavState.unpack(packed)
    packed[:] = 0.0
    for name in NavState.__slots__:
        assert np.array_equal(getattr(again, name), getattr(x, name))
    assert np.array_equal(x.pack()[R:P].reshape(3, 3), x.R_world_imu)


def test_identity_takes_the_extrinsic() -> None:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = so3.exp([0.1, 0.2, 0.3]), [1.0, 2.0, 3.0]
    x = NavState.identity(T)
    assert np.allclose(x.R_imu_lidar, T[:3, :3], atol=1e-15)
    assert np.array_equal(x.p_imu_lidar, [1.0, 2.0, 3.0])
    assert np.array_equal(x.gravity_world, [0.0, 0.0, -9.81])


def test_a_transform_with_few_digits_is_made_orthonormal() -> None:
    T = np.eye(4)
    T[:3, :3] = np.round(so3.exp([0.4, -0.2, 0.9]), 4)
    clean = check_transform("T_imu_lidar", T)
    assert so3.is_rotation(clean[:3, :3], 1e-14)
    assert np.abs(clean - T).max() < 1e-4


@pytest.mark.parametrize(
    ("T", "expected", "got"),
    [
        (np.eye(3), "T_imu_lidar as a 4×4 matrix", "shape (3, 3)"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "determinant +1", "determinant -1"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "orthonormal", "RᵀR off by 3"),
        (np.full((4, 4), np.nan), "orthonormal", "RᵀR off by nan"),
        (np.eye(4).T + np.diag([0.0, 0.0, 0.0, 1.0]), "last row 0 0 0 1", "last row [0.0, 0.0, 0.0, 2.0]"),
    ],
)
def test_what_is_not_a_transform_is_refused(T: np.ndarray, expected: str, got: str) -> None:
    with pytest.raises(InputError) as error:
        check_transform("T_imu_lidar", T)
    assert expected in error.value.expected
    assert got in error.value.got
