"""The shortest rotation that sets a direction upright."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.manifolds import so3
from boxplus.manifolds.upright_rotation import upright_rotation


@given(st.integers(0, 10_000), st.floats(0.01, 100.0))
def test_it_is_the_shortest_rotation_that_takes_the_direction_up(seed: int, length: float) -> None:
    up = np.random.default_rng(seed).normal(size=3)
    up *= length / np.linalg.norm(up)
    R = upright_rotation(up)
    np.testing.assert_allclose(R @ up, [0.0, 0.0, length], atol=1e-12 * length)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.norm(so3.log(R)) == pytest.approx(np.arccos(np.clip(up[2] / length, -1.0, 1.0)), abs=1e-7)


@pytest.mark.parametrize("z", [1.0, -1.0])
def test_what_stands_already_or_upside_down(z: float) -> None:
    R = upright_rotation(np.array([0.0, 0.0, z]))
    np.testing.assert_array_equal(R, np.diag([1.0, z, z]))
