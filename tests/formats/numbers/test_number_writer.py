"""Numbers to text: the digits of Python's own repr()."""

from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from boxplus.formats.numbers.writer import write_rows


def written(prefix: str, whole: object, numbers: object) -> str:
    file = io.BytesIO()
    write_rows(file, prefix, np.array(whole, np.int64), np.array(numbers, np.float64))
    return file.getvalue().decode()


short = st.decimals(-(10**9), 10**9, places=5).map(float)


@given(st.lists(st.one_of(st.floats(), short, st.integers(-(2**60), 2**60).map(float)), min_size=1, max_size=20))
@example([0.0, -0.0, 1.0, -1.5, 0.1, 1e15, 1e16, 123456789012345680.0, 1e-4, 1e-5, 9.5e-5, 0.0001])
@example([1e22, 1e23, 1e126, 9007199254740993.0, 1125899906842624.5, 5e-324, 1.7976931348623157e308, float("nan"), float("inf")])
@example([9.999999999999999e22, 0.3, 2.0 / 3.0, 1e300, 1e-300, 99999999999999990.0, 2.0**-60, 2.0**90])
def test_digits_are_those_of_repr(values: list[float]) -> None:
    assert written("", np.empty((len(values), 0)), np.array(values)[:, None]) == "".join(f"{value!r}\n" for value in values)


@pytest.mark.parametrize("scale", [1.0, 1e-9, 1e7, 1e20])
def test_digits_of_many_random_numbers(scale: float) -> None:
    values = np.random.default_rng(5).normal(size=(700, 3)) * scale
    assert written("", np.empty((700, 0)), values) == "".join("{!r} {!r} {!r}\n".format(*row) for row in values.tolist())


def test_random_bit_patterns() -> None:
    values = np.random.default_rng(6).integers(0, 2**63, 2000).view(np.float64)[:, None]
    assert written("", np.empty((2000, 0)), values) == "".join(f"{value!r}\n" for value in values[:, 0].tolist())


@given(st.lists(st.tuples(st.integers(-(2**63), 2**63 - 1), st.integers(-9, 9), st.floats(), st.floats()), max_size=9))
def test_rows_of_both_kinds(rows: list[tuple[int, int, float, float]]) -> None:
    whole = np.array([row[:2] for row in rows], np.int64).reshape(-1, 2)
    numbers = np.array([row[2:] for row in rows], np.float64).reshape(-1, 2)
    assert written("EDGE 100% ", whole, numbers) == "".join(f"EDGE 100% {a} {b} {x!r} {y!r}\n" for a, b, x, y in rows)


def test_rows_of_whole_numbers_only() -> None:
    assert written("FIX ", [[1], [-20]], np.empty((2, 0))) == "FIX 1\nFIX -20\n"
