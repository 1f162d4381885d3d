"""Errors that a run could not see stay in all later poses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.systems.refinement.unshown import after_unshown, is_mostly_unshown

STATUS = st.lists(st.sampled_from(["ok", "weak", "lost"]), min_size=1, max_size=30)


@given(STATUS)
def test_from_the_first_one_on(status: list[str]) -> None:
    found = after_unshown(status)
    for k in range(len(status)):
        assert found[k] == any(own != "ok" for own in status[: k + 1])


@pytest.mark.parametrize(("weak", "mostly"), [(0, False), (5, False), (6, True), (10, True)])
def test_more_than_half(weak: int, mostly: bool) -> None:
    assert is_mostly_unshown(np.array(["weak"] * weak + ["ok"] * (10 - weak))) is mostly
