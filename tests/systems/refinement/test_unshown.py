"""What a run could not see: errors stay in all later poses, and steps along it are kept."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.errors import InputError
from boxplus.manifolds import quaternion, se3, so3
from boxplus.systems.lidar_inertial_odometry.estimate import WeakDirection
from boxplus.systems.refinement.collecting import OdometryRows
from boxplus.systems.refinement.unshown import after_unshown, between, is_mostly_unshown, kept_steps, open_steps

ANY = np.tile(np.eye(3), (20, 1, 1))
STATUS = st.lists(st.sampled_from(["ok", "weak", "lost"]), min_size=1, max_size=30)


@given(STATUS)
def test_from_the_first_one_on(status: list[str]) -> None:
    found = after_unshown(status)
    for k in range(len(status)):
        assert found[k] == any(own != "ok" for own in status[: k + 1])


@pytest.mark.parametrize(("weak", "mostly"), [(0, False), (5, False), (6, True), (10, True)])
def test_more_than_half(weak: int, mostly: bool) -> None:
    assert is_mostly_unshown(np.array(["weak"] * weak + ["ok"] * (10 - weak))) is mostly


def run(turned: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Twenty poses (7,) on a way, and their covariance, from the tenth scan on less and less sure of one direction."""
    axis, grown = np.array([np.cos(turned), np.sin(turned), 0.0]), np.linspace(0.01, 0.2, 10)
    T = np.zeros((20, 7))
    T[:, :4] = quaternion.from_matrix(so3.exp(np.outer(np.linspace(0.0, 0.5, 20), [0.3, -0.1, 1.0])))
    T[:, 4:] = np.outer(np.linspace(0.0, 8.0, 20), axis)
    P = np.zeros((20, 6, 6))
    P[:, 3:, 3:] = 0.005**2 * np.eye(3)
    P[10:, 3:, 3:] += grown[:, None, None] ** 2 * np.outer(axis, axis)
    return T, P


@pytest.mark.parametrize("turned", [0.0, 0.7, 2.0])
def test_the_direction_along_which_a_spell_of_weak_scans_grows_is_open(turned: float) -> None:
    T, P = run(turned)
    axis = np.array([np.cos(turned), np.sin(turned), 0.0])
    found = open_steps(["ok"] * 10 + ["weak"] * 10, T, P, ANY)
    assert not found[:10].any()
    np.testing.assert_allclose(found[10:], np.broadcast_to(np.outer(axis, axis), (10, 3, 3)), atol=0.05)
    assert not open_steps(["ok"] * 20, T, P, ANY).any()
    lost = open_steps(["ok"] * 10 + ["weak"] * 5 + ["lost"] * 5, T, P, ANY)
    assert lost[10:15].any() and not lost[15:].any()  # nothing that was seen there has a place


def test_scans_that_are_weak_in_rotation_alone_leave_no_step_open() -> None:
    """Poses become less sure of where they are in every direction, as they do on any way; the scans measured all of these."""
    T, P = run()
    P[10:, 3:, 3:] += (np.linspace(0.01, 0.2, 10) ** 2)[:, None, None] * np.eye(3)
    status = ["ok"] * 10 + ["weak"] * 10
    assert open_steps(status, T, P, ANY)[10:].any()
    assert not open_steps(status, T, P, np.zeros((20, 3, 3))).any()
    across = np.zeros((20, 3, 3))
    across[10:, 1, 1] = 1.0
    along_y = open_steps(status, T, P, across)
    np.testing.assert_allclose(along_y[11:], np.broadcast_to(np.diag([0.0, 1.0, 0.0]), (9, 3, 3)), atol=1e-9)


def test_rows_know_which_directions_move() -> None:
    turn = WeakDirection(np.array([0.0, 0.0, 0.99]), np.array([0.1, 0.0, 0.1]), 1.0)
    move = WeakDirection(np.array([0.0, 0.0, 0.6]), np.array([0.8, 0.0, 0.0]), 1.0)
    np.testing.assert_array_equal(turn.moves, np.zeros(3))
    np.testing.assert_array_equal(move.moves, [0.8, 0.0, 0.0])


def test_covariances_that_are_none_are_refused() -> None:
    """Weak scans without a covariance, or with one that is not finite, cannot say which steps they leave open."""
    _, P = run()
    status = np.array(["ok"] * 10 + ["weak"] * 10)
    with pytest.raises(
        InputError,
        match=r"as some scans are weak or lost – got none, with 10 of \d+ scans weak or lost",
    ):
        OdometryRows(np.arange(20), [], status)
    P[15, 3, 3] = np.nan
    with pytest.raises(InputError, match=r"a finite covariance of every pose – got 1 with NaN.*at 15 ns"):
        OdometryRows(np.arange(20), [], status, P)


def test_steps_are_kept_along_what_is_open_and_free_across() -> None:
    T, P = run(0.7)
    open_ = open_steps(["ok"] * 10 + ["weak"] * 10, T, P, ANY)
    numbers, along = between(np.array([0, 6, 12, 19]), open_)
    assert numbers.tolist() == [1, 2]
    axis = np.array([np.cos(0.7), np.sin(0.7), 0.0])
    np.testing.assert_allclose(np.einsum("i,nij,j->n", axis, along, axis), 1.0, atol=0.05)
    first, second = np.array([6]), np.array([19])
    kept = kept_steps(T, first, second, along[:1])
    assert np.abs(kept.evaluate(T[first], T[second])).max() < 1e-9
    off = T[second].copy()
    off[:, 4:] += 0.1 * np.cross([0.0, 0.0, 1.0], axis)
    white = kept.whitening.factors @ kept.evaluate(T[first], off)[:, :, None]
    off[:, 4:] += 0.001 * axis
    moved = kept.whitening.factors @ kept.evaluate(T[first], off)[:, :, None]
    assert np.linalg.norm(moved) > 50.0 > 0.5 * np.linalg.norm(white)
    turned = se3.compose(np.array([[np.cos(0.2), 0.0, 0.0, np.sin(0.2), 3.0, -2.0, 1.0]]), T)
    same = kept.evaluate(turned[first], turned[second])
    assert np.abs(same).max() < 1e-9  # a run that is turned as a whole keeps them
