"""What a run could not see: errors stay in all later poses, and steps along it are kept."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.manifolds import quaternion, se3, so3
from boxplus.systems.refinement.unshown import after_unshown, between, is_mostly_unshown, kept_steps, open_steps

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
    found = open_steps(["ok"] * 10 + ["weak"] * 10, T, P)
    assert not found[:10].any()
    np.testing.assert_allclose(found[10:], np.broadcast_to(np.outer(axis, axis), (10, 3, 3)), atol=0.05)
    assert not open_steps(["ok"] * 20, T, P).any()
    lost = open_steps(["ok"] * 10 + ["weak"] * 5 + ["lost"] * 5, T, P)
    assert lost[10:15].any() and not lost[15:].any()  # nothing that was seen there has a place


def test_steps_are_kept_along_what_is_open_and_free_across() -> None:
    T, P = run(0.7)
    open_ = open_steps(["ok"] * 10 + ["weak"] * 10, T, P)
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
