"""Whitening: every description of the same noise gives the same weight; what is no noise is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus import InputError
from boxplus.residuals.whitening import Whitening


@given(st.integers(1, 6), st.integers(1, 4), st.integers(0, 10_000))
def test_square_root_of_the_information(dim, count, seed):
    A = np.random.default_rng(seed).standard_normal((count, dim, dim))
    covariance = A @ np.swapaxes(A, 1, 2) + 0.1 * np.eye(dim)
    information = np.linalg.inv(covariance)
    for whitening in (Whitening.of(dim, count, covariance=covariance), Whitening.of(dim, count, information=information)):
        W = whitening.factors
        np.testing.assert_allclose(np.swapaxes(W, 1, 2) @ W, information, rtol=1e-6, atol=1e-8)


def test_sigmas_of_all_shapes():
    for sigma in (2.0, [2.0, 2.0], np.full((3, 1), 2.0), np.full((3, 2), 2.0)):
        factors = Whitening.of(2, 3, sigma=sigma).factors
        np.testing.assert_array_equal(np.broadcast_to(factors, (3, 2, 2)), np.broadcast_to(0.5 * np.eye(2), (3, 2, 2)))
    np.testing.assert_array_equal(Whitening.of(2, 3).factors, np.eye(2)[None])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sigma": 0.0}, "sigma positive and finite – got 0.0"),
        ({"sigma": [1.0, np.inf]}, r"got inf at \(1,\)"),
        ({"sigma": np.ones(5)}, "standard deviation for each row"),
        ({"sigma": 1.0, "information": np.eye(2)}, "sigma and information"),
        ({"information": np.eye(3)}, "shape"),
        ({"information": [[1.0, 0.5], [0.0, 1.0]]}, "symmetric – got an asymmetry of 0.5 in residual 0"),
        ({"covariance": [[1.0, 2.0], [2.0, 1.0]]}, "positive definite and not zero – got eigenvalues from -1"),
        ({"covariance": [[1.0, 0.0], [0.0, 0.0]]}, "known exactly"),
        ({"information": [[1.0, 2.0], [2.0, 1.0]]}, "semi-definite and not zero – got eigenvalues from -1"),
        ({"information": np.zeros((2, 2))}, "not zero"),
        ({"covariance": [[np.nan, 0.0], [0.0, 1.0]]}, "NaN or infinity in residual 0"),
    ],
)
def test_what_is_no_noise_is_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        Whitening.of(2, 3, **arguments)


def test_information_may_leave_directions_open():
    direction = np.array([0.6, 0.8])
    information = 4.0 * np.outer(direction, direction)
    W = Whitening.of(2, 1, information=information).factors[0]
    np.testing.assert_allclose(W.T @ W, information, atol=1e-12)
