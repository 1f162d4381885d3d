"""NEES: its distribution for honest covariances, and its band."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import kstest

from boxplus.errors import InputError
from boxplus.evaluation.nees import nees, nees_band


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), d=st.integers(1, 6))
def test_against_the_inverse(seed: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(5, d, d)) + 3 * np.eye(d)
    P, e = root @ root.transpose(0, 2, 1), rng.normal(size=(5, d))
    np.testing.assert_allclose(nees(e, P), [x @ np.linalg.inv(C) @ x for x, C in zip(e, P, strict=True)], rtol=1e-7)


def test_honest_errors_are_chi_square_and_stay_in_the_band() -> None:
    rng = np.random.default_rng(0)
    root = np.tril(rng.normal(size=(6, 6))) + 3 * np.eye(6)
    inside = 0
    for _ in range(200):
        values = nees(rng.normal(size=(50, 6)) @ root.T, np.broadcast_to(root @ root.T, (50, 6, 6)))
        low, high = nees_band(6, 50)
        inside += low <= values.mean() <= high
    assert 0.90 < inside / 200 < 0.99
    many = nees(rng.normal(size=(5000, 6)) @ root.T, np.broadcast_to(root @ root.T, (5000, 6, 6)))
    assert kstest(many, "chi2", args=(6,)).pvalue > 1e-3


def test_band_of_the_textbook() -> None:
    """Bar-Shalom et al. 2001, example of section 5.4: 50 runs, 2 degrees of freedom, 95 %: [1.5, 2.6]."""
    assert nees_band(2, 50) == (pytest.approx(1.4844, abs=1e-3), pytest.approx(2.5912, abs=1e-3))
    low, high = nees_band(6, 1, 0.5)
    assert low < 6 < high


def test_what_is_refused() -> None:
    with pytest.raises(InputError, match=r"errors of shape \(N, d\)"):
        nees(np.zeros((3, 2)), np.zeros((3, 3, 3)))
    with pytest.raises(InputError, match="NaN or infinity in row 1"):
        nees([[0.0], [np.nan]], np.ones((2, 1, 1)))
    with pytest.raises(InputError, match=r"positive definite covariances – got smallest eigenvalue -1\.000e\+00 in row 1"):
        nees(np.zeros((2, 2)), [np.eye(2), np.diag([1.0, -1.0])])
    for arguments in ((0, 1), (1, 0), (1, 1, 1.0)):
        with pytest.raises(InputError, match="dof ≥ 1"):
            nees_band(*arguments)
