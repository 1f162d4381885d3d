"""Landmarks by id against a dictionary."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from boxplus.runs.cameras.landmark_file import LandmarksById


@given(st.lists(st.lists(st.integers(0, 5000), unique=True, max_size=20), max_size=12), st.integers(0, 2**16))
def test_the_last_place_of_every_landmark_is_kept(updates: list[list[int]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    table: LandmarksById = LandmarksById()
    expected: dict[int, np.ndarray] = {}
    for ids in updates:
        points = rng.normal(size=(len(ids), 3))
        table.update(np.array(ids, dtype=np.int64), points)
        expected.update(zip(ids, points, strict=True))
    assert len(table) == len(expected)
    wanted = [expected[k] for k in sorted(expected)]
    assert np.array_equal(table.points(), np.array(wanted, dtype=np.float32).reshape(-1, 3))
