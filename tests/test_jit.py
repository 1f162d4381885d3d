"""The door to Numba: chunks that do not depend on the threads."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus import _jit


@given(st.integers(0, 50), st.integers(1, 20), st.integers(1, 4))
def test_chunks_cover_everything_once(items: int, chunk: int, threads: int) -> None:
    done: dict[int, tuple[int, int]] = {}
    count = _jit.run_chunks(lambda index, begin, end: done.__setitem__(index, (begin, end)), items, chunk, threads)
    assert count == len(done) == -(-items // chunk)
    assert [row for index in range(count) for row in range(*done[index])] == list(range(items))
    assert all(end - begin <= chunk for begin, end in done.values())


@given(st.integers(0, 2**32 - 1), st.integers(1, 64))
def test_partial_sums_do_not_depend_on_the_threads(seed: int, chunk: int) -> None:
    values = np.random.default_rng(seed).normal(size=200) * 10.0 ** np.arange(-100, 100)
    totals = []
    for threads in (1, 2, 3):
        parts = np.zeros(200)

        def work(index: int, begin: int, end: int, parts: np.ndarray = parts) -> None:
            parts[index] = values[begin:end].sum()

        count = _jit.run_chunks(work, len(values), chunk, threads)
        total = 0.0
        for part in parts[:count]:
            total += part
        totals.append(total)
    assert totals[0] == totals[1] == totals[2]


def test_one_thread_is_the_callers_own() -> None:
    seen = set()
    _jit.run_chunks(lambda *_: seen.add(threading.get_ident()), 10, 3, 1)
    assert seen == {threading.get_ident()}


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_in_a_chunk_comes_out(threads: int) -> None:
    def work(index: int, begin: int, end: int) -> None:
        if index == 1:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        _jit.run_chunks(work, 10, 3, threads)
