"""Whitening of Jacobians, against NumPy's products."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.optimization.terms.weighting import whiten_jacobian


@pytest.mark.parametrize("shape", [(3, 3), (6, 6), (2, 6), (6, 3), (1, 1)])
@pytest.mark.parametrize("kind", ["upper", "full", "diagonal", "even"])
@pytest.mark.parametrize("shared", [False, True])
def test_rows_are_multiplied_by_their_factors(shape: tuple[int, int], kind: str, shared: bool) -> None:
    rng = np.random.default_rng(0)
    dim, width = shape
    W = rng.normal(size=(1 if shared else 9, dim, dim))
    if kind == "upper":
        W = np.triu(W)
    elif kind == "diagonal":
        W = W * np.eye(dim)
    elif kind == "even":
        W = W[:, :1, :1] * np.eye(dim)
    J = rng.normal(size=(9, dim, width))
    white = J.copy()
    whiten_jacobian(2, 8, W, kind in ("diagonal", "even"), white)
    np.testing.assert_allclose(white[2:8], (W @ J)[2:8], rtol=1e-13, atol=1e-13)
    np.testing.assert_array_equal(white[[0, 1, 8]], J[[0, 1, 8]])
