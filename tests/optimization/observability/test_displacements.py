"""How poses turn and shift along tangents: the same whichever ⊞ these are of, in the frame that the pose maps to."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus import SE2, SE3, SO3, Euclidean, SE3Left, UnitQuaternion
from boxplus.manifolds import quaternion, se3, so3
from boxplus.manifolds.camera_pose import CameraPose
from boxplus.optimization.observability.world_motions import displacements_of

STEP = 1e-6


@pytest.mark.parametrize("manifold", [SE3, SE3Left, CameraPose], ids=str)
def test_poses_turn_and_shift_as_boxplus_moves_them(manifold) -> None:
    rng = np.random.default_rng(0)
    T, tangents = se3.exp(rng.normal(size=(5, 6))), rng.normal(size=(5, 6))
    turn, shift = displacements_of(manifold, T, tangents)
    moved = manifold.boxplus(T, STEP * tangents)
    R, R_moved = quaternion.to_matrix(T[:, :4]), quaternion.to_matrix(np.ascontiguousarray(moved[:, :4]))
    np.testing.assert_allclose(turn, so3.log(R_moved @ np.swapaxes(R, 1, 2)) / STEP, atol=1e-5)
    np.testing.assert_allclose(shift, (moved[:, 4:] - T[:, 4:]) / STEP, atol=1e-5)


def test_poses_in_the_plane_rotations_and_points_do_too() -> None:
    rng = np.random.default_rng(1)
    x, tangents = rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
    turn, shift = displacements_of(SE2, x, tangents)
    change = (SE2.boxplus(x, STEP * tangents) - x) / STEP
    np.testing.assert_allclose(turn, np.column_stack([np.zeros((4, 2)), change[:, 0]]), atol=1e-5)
    np.testing.assert_allclose(shift, np.column_stack([change[:, 1:], np.zeros(4)]), atol=1e-5)
    q = quaternion.from_matrix(so3.exp(rng.normal(size=(4, 3))))
    R = quaternion.to_matrix(q)
    for manifold, values in ((UnitQuaternion, q), (SO3, R.reshape(4, 9))):
        turn, shift = displacements_of(manifold, values, tangents)
        np.testing.assert_allclose(turn, np.einsum("nij,nj->ni", R, tangents), atol=1e-12)
        assert not shift.any()
    turn, shift = displacements_of(Euclidean(3), x, tangents)
    assert not turn.any() and np.array_equal(shift, tangents)
    assert displacements_of(Euclidean(1), x[:, :1], tangents[:, :1]) is None
