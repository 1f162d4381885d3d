"""The inverse by Cholesky and the eigenvectors by rotations, against LAPACK."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.filtering.small_linalg import cholesky_inverse_into, inverse_root_into, symmetric_eigen_into
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


@given(seeds, st.sampled_from([1, 3, 6, 24]))
def test_root_of_the_inverse_whitens(seed: int, size: int) -> None:
    """From the lower triangle of A alone, into that of the root alone."""
    A = random_covariance(np.random.default_rng(seed), size)
    sigma = np.sqrt(A.diagonal())
    A /= np.outer(sigma, sigma)
    root = np.full_like(A, np.nan)
    assert inverse_root_into(np.where(np.tri(size) > 0.0, A, np.nan), root)
    assert np.isnan(root[np.triu_indices(size, 1)]).all()
    lower = np.tril(np.nan_to_num(root))
    assert np.allclose(lower @ A @ lower.T, np.eye(size), atol=1e-8)


@pytest.mark.parametrize(
    "A", [np.zeros((3, 3)), np.diag([1.0, -1.0, 1.0]), np.ones((3, 3)) - 2.0 * np.eye(3), np.full((3, 3), np.nan)]
)
def test_what_is_not_positive_definite_is_refused(A: np.ndarray) -> None:
    assert not cholesky_inverse_into(A, np.zeros((3, 3)), np.zeros((3, 3)))
    assert not inverse_root_into(A, np.zeros((3, 3)))


@given(seeds, st.sampled_from([1, 2, 6, 12]), st.sampled_from([0, 1, 3]))
def test_eigenvectors_against_lapack(seed: int, size: int, equal: int) -> None:
    """Of either sign, over twelve orders of magnitude, `equal` of them the same."""
    random = np.random.default_rng(seed)
    Q = np.linalg.qr(random.normal(size=(size, size)))[0]
    expected = random.choice([-1.0, 1.0], size) * 10.0 ** random.uniform(-6.0, 6.0, size)
    expected[: min(equal, size)] = expected[0]
    A = (Q * expected) @ Q.T
    A = 0.5 * (A + A.T)
    values, vectors = np.zeros(size), np.zeros((size, size))
    symmetric_eigen_into(A.copy(), values, vectors)
    size_of = np.abs(expected).max()
    np.testing.assert_allclose(values, np.linalg.eigvalsh(A), rtol=0.0, atol=1e-14 * size * size_of)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(size), atol=1e-14 * size)
    np.testing.assert_allclose((vectors * values) @ vectors.T, A, atol=1e-14 * size * size_of)


@pytest.mark.parametrize("A", [np.zeros((3, 3)), np.diag([3.0, 1.0, 2.0]), np.full((3, 3), np.nan)])
def test_eigenvectors_of_what_is_diagonal_and_of_nothing(A: np.ndarray) -> None:
    values, vectors = np.zeros(3), np.zeros((3, 3))
    symmetric_eigen_into(A.copy(), values, vectors)
    np.testing.assert_array_equal(values, np.sort(A.diagonal()))
    assert np.isnan(A).any() or (np.abs(vectors).sum(axis=0) == 1.0).all()
