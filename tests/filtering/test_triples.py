"""Vectors and rotations as tuples, against NumPy."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from boxplus.filtering import triples

seeds = st.integers(0, 2**32 - 1)


@given(seeds)
def test_products_are_those_of_matrices(seed: int) -> None:
    random = np.random.default_rng(seed)
    x = random.normal(size=36)
    A, B = triples.rotation_of(x, 0), triples.rotation_of(x, 9)
    p, t = triples.triple_of(x, 18), triples.triple_of(x, 21)
    M, N = x[:9].reshape(3, 3), x[9:18].reshape(3, 3)
    assert np.allclose(triples.turned(A, p), M @ x[18:21], rtol=1e-13, atol=1e-13)
    assert np.allclose(triples.turned_back(A, p), M.T @ x[18:21], rtol=1e-13, atol=1e-13)
    assert np.allclose(triples.placed(A, t, p), M @ x[18:21] + x[21:24], rtol=1e-13, atol=1e-13)
    assert np.allclose(np.reshape(triples.product(A, B), (3, 3)), M @ N, rtol=1e-13, atol=1e-13)
    assert np.isclose(triples.dot(p, t), x[18:21] @ x[21:24], rtol=1e-13, atol=1e-13)
    assert np.allclose(triples.cross(p, t), np.cross(x[18:21], x[21:24]), rtol=1e-13, atol=1e-13)


def test_stored_points_become_numbers_of_full_precision() -> None:
    point = np.array([0.1, 0.2, 0.3], np.float32)
    assert triples.triple_of(point, 0) == tuple(float(value) for value in point)
