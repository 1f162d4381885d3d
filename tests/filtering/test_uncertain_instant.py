"""A stamp that is not exact against the same measurement with the correlated noise that it makes, written out."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from boxplus.filtering.degeneracy import PoseDirections
from boxplus.filtering.iterated_update import Information
from boxplus.filtering.nav_state import PACKED
from boxplus.filtering.uncertain_instant import UncertainInstant

_DIRECTIONS = PoseDirections(np.full(6, np.inf), np.eye(6), 1.0, np.zeros(6, bool), np.eye(6))


class _Rows:
    """z of Jacobian H and covariance R, the same at every state."""

    def __init__(self, H: NDArray[np.float64], z: NDArray[np.float64], R: NDArray[np.float64]) -> None:
        R_inverse = np.linalg.inv(R)
        self._said = Information(H.T @ R_inverse @ H, H.T @ R_inverse @ z, -H.T @ R_inverse @ z, _DIRECTIONS, len(z), 1.0)

    def at(self, x: NDArray[np.float64], *, rematch: bool) -> Information:
        del x, rematch
        return self._said

    def has_moved(self, x: NDArray[np.float64]) -> bool:
        return bool(x[0])


@given(st.integers(0, 2**32 - 1), st.integers(1, 30), st.floats(1e-4, 1.0))
def test_it_is_an_error_that_all_rows_share(seed: int, rows: int, sigma_s: float) -> None:
    random = np.random.default_rng(seed)
    H, z, R = random.normal(size=(rows, 12)), random.normal(size=rows), np.diag(random.uniform(0.01, 1.0, rows))
    motion = random.normal(size=(2, 3))
    along = H[:, :6] @ motion.ravel()
    expected = _Rows(H, z, R + sigma_s**2 * np.outer(along, along)).at(np.zeros(PACKED), rematch=True)
    told = UncertainInstant(_Rows(H, z, R), motion, sigma_s).at(np.zeros(PACKED), rematch=True)
    assert np.allclose(told.A, expected.A, rtol=1e-6, atol=1e-7 * np.abs(expected.A).max())
    assert np.allclose(told.b, expected.b, rtol=1e-6, atol=1e-7 * np.abs(H.T @ np.linalg.inv(R) @ z).max())
    assert np.allclose(told.pull, -told.b, rtol=1e-9, atol=1e-12 * np.abs(told.b).max())


def test_at_rest_and_with_an_exact_stamp_nothing_changes() -> None:
    random = np.random.default_rng(0)
    rows = _Rows(random.normal(size=(9, 12)), random.normal(size=9), np.eye(9))
    exact = rows.at(np.zeros(PACKED), rematch=True)
    for motion, sigma_s in ((np.zeros((2, 3)), 1e-3), (np.ones((2, 3)), 0.0)):
        told = UncertainInstant(rows, motion, sigma_s).at(np.zeros(PACKED), rematch=True)
        assert np.array_equal(told.A, exact.A)
        assert np.array_equal(told.b, exact.b)


def test_many_points_do_not_know_the_instant_better_than_its_stamp() -> None:
    """A wall ahead of a car at 10 m/s: 10,000 points of a centimetre, half a millisecond."""
    H = np.zeros((10_000, 12))
    H[:, 3] = 1.0
    wall = _Rows(H[:1], np.ones(1), np.array([[1e-4 / len(H)]]))
    told = UncertainInstant(wall, np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]]), 5e-4).at(np.zeros(PACKED), rematch=True)
    assert np.isclose(1.0 / np.sqrt(told.A[3, 3]), np.hypot(0.005, 1e-4))


def test_the_search_is_that_of_the_measurement() -> None:
    rows = _Rows(np.ones((1, 12)), np.ones(1), np.eye(1))
    stamped = UncertainInstant(rows, np.zeros((2, 3)), 1e-3)
    assert stamped.has_moved(np.ones(PACKED))
    assert not stamped.has_moved(np.zeros(PACKED))
