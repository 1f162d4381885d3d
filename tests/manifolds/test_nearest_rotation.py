"""The rotation between sets of vectors, against SciPy's."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from boxplus.manifolds import so3
from boxplus.manifolds.nearest_rotation import nearest_rotation


@given(st.integers(0, 10_000), st.sampled_from((0.0, 0.1, 1.0)))
def test_it_turns_one_set_of_vectors_onto_another(seed: int, noise: float) -> None:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(8, 3))
    b = a @ so3.exp(rng.normal(size=3)).T + noise * rng.normal(size=a.shape)
    R = nearest_rotation(b.T @ a)
    assert so3.is_rotation(R, 1e-12)
    expected, _ = Rotation.align_vectors(b, a)
    # Where noise is as large as the vectors, two rotations may fit alike: what counts is how well they do.
    ours, theirs = (float(np.sum((b - a @ turn.T) ** 2)) for turn in (R, expected.as_matrix()))
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-20)
