"""How far the others contradict an edge, against the directions of its covariance one by one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.systems.pose_graph.doubts.contradiction import Contradiction


def by_directions(errors, predicted, least):
    """Σ over the eigenvectors of S whose eigenvalue counts."""
    squared, directions, bent = [], [], []
    for e, M, limit in zip(errors, predicted, least, strict=True):
        share, U = np.linalg.eigh(np.eye(len(e)) - M)
        known = share > limit
        own, share = (U.T @ e)[known] ** 2, share[known]
        squared.append((own / share).sum())
        bent.append(np.sqrt((own / share**2 * np.clip(1.0 - share, 0.0, 1.0)).sum()))
        directions.append(known.sum())
    return np.array(squared), np.array(directions), np.array(bent)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([3, 6]))
def test_the_factor_says_what_the_directions_say(seed, d):
    rng = np.random.default_rng(seed)
    m = 40
    Q = np.linalg.qr(rng.standard_normal((m, d, d)))[0]
    share = 10.0 ** rng.uniform(-3.0, 0.0, (m, d))
    share[::3, 0] = 10.0 ** rng.uniform(-17.0, -4.0, len(share[::3]))  # on both sides of the limit
    share[::7] = 0.0
    S = Q @ (share[:, :, None] * np.swapaxes(Q, 1, 2))
    predicted = np.eye(d) - 0.5 * (S + np.swapaxes(S, 1, 2))
    errors, least = rng.standard_normal((m, d)), np.full(m, 1e-5)
    # What lies on the limit to rounding may fall on either side.
    clear = (np.abs(np.linalg.eigvalsh(np.eye(d) - predicted) - 1e-5) > 1e-12).all(axis=1)
    found, expected = Contradiction.of(errors, predicted, least), by_directions(errors, predicted, least)
    np.testing.assert_array_equal(found.directions[clear], expected[1][clear])
    np.testing.assert_allclose(found.squared[clear], expected[0][clear], rtol=1e-8)
    np.testing.assert_allclose(found.bent[clear], expected[2][clear], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("d", [3, 6])
def test_what_nothing_checks_is_contradicted_by_nothing(d):
    found = Contradiction.of(np.ones((2, d)), np.stack([np.eye(d), np.zeros((d, d))]), np.full(2, 1e-5))
    assert found.squared.tolist() == [0.0, pytest.approx(d)] and found.bent.tolist() == [0.0, 0.0]
    assert found.directions.tolist() == [0, d]
