"""The inverse by Cholesky against LAPACK."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.filtering.small_linalg import cholesky_inverse_into
from tests.filtering.random_states import random_covariance

seeds = st.integers(0, 2**32 - 1)


@given(seeds, st.sampled_from([1, 3, 24]))
def test_against_lapack(seed: int, size: int) -> None:
    A = random_covariance(np.random.default_rng(seed), size)
    inverse, before = np.zeros_like(A), A.copy()
    assert cholesky_inverse_into(A, inverse, np.zeros_like(A))
    assert np.array_equal(A, before)
    assert np.array_equal(inverse, inverse.T)
    sigma = np.sqrt(A.diagonal())
    scaled = np.linalg.inv(A / np.outer(sigma, sigma)) / np.outer(sigma, sigma)
    assert np.allclose(inverse * np.outer(sigma, sigma), scaled * np.outer(sigma, sigma), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(
    "A", [np.zeros((3, 3)), np.diag([1.0, -1.0, 1.0]), np.ones((3, 3)) - 2.0 * np.eye(3), np.full((3, 3), np.nan)]
)
def test_what_is_not_positive_definite_is_refused(A: np.ndarray) -> None:
    assert not cholesky_inverse_into(A, np.zeros((3, 3)), np.zeros((3, 3)))
