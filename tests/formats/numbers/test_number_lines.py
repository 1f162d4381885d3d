"""Text to numbers: the values of Python's own float(), exact integers, lines, and what is no number."""

from __future__ import annotations

import bz2
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from boxplus.errors import InputError
from boxplus.formats.numbers import lines as number_lines
from boxplus.formats.numbers.lines import read_number_lines
from boxplus.formats.numbers.parser import INTEGER, NO_TAG, OTHER, REAL, UNKNOWN_TAG


def parse(folder: Path, text: str | bytes, tags: tuple[str, ...] = ()) -> list[number_lines.NumberLines]:
    path = folder / "numbers.txt"
    path.write_bytes(text if isinstance(text, bytes) else text.encode() + b"\n")
    return list(read_number_lines(path, tags))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("numbers")


decimals = st.one_of(
    st.floats(allow_nan=False).map(repr),
    st.floats(allow_nan=False, allow_infinity=False).map(lambda value: f"{value:.16e}"),
    st.from_regex(r"[+-]?([0-9]{1,24}\.?|[0-9]{0,20}\.[0-9]{1,24})([eE][+-]?[0-9]{1,3})?", fullmatch=True),
    st.integers(-(2**70), 2**70).map(str),
)


@given(st.lists(decimals, min_size=1, max_size=20))
@example(["18446744073709551616", "18446744073709551615", "9223372036854775808", "9007199254740993"])
@example(["2.2250738585072011e-308", "5e-324", "1.7976931348623157e308", "1e400", "1e-400", "0e999999999999"])
@example(["-0", "-0.0", "+1", ".5", "5.", "1e23", "9007199254740993e1", "0.1e-1", "00000000000000000000000012"])
def test_numbers_are_those_of_python(folder: Path, words: list[str]) -> None:
    (chunk,) = parse(folder, " ".join(words))
    expected = [float(word) for word in words]
    assert chunk.values.tolist() == expected
    assert [math.copysign(1.0, value) for value in chunk.values] == [math.copysign(1.0, value) for value in expected]
    for word, kind, integer in zip(words, chunk.kinds, chunk.integers, strict=True):
        if kind == INTEGER:
            assert int(integer) == int(word)
        elif word.lstrip("+-").isdigit():
            assert abs(int(word)) >= 2**63 or len(word) > 19


def test_random_bit_patterns(folder: Path) -> None:
    bits = np.random.default_rng(3).integers(0, 2**63, 2000).view(np.float64)
    values = bits[np.isfinite(bits)]
    (chunk,) = parse(folder, "\n".join(map(repr, values.tolist())))
    assert np.array_equal(chunk.values, values)


def test_words_that_are_no_numbers(folder: Path) -> None:
    words = ["1_000", "0x10", "1e", "--1", "1.2.3", "e5", ".", "+", "image.png", "1,5"]
    (chunk,) = parse(folder, " ".join(words))
    assert (chunk.kinds == OTHER).all()
    (chunk,) = parse(folder, "nan -inf 1e5000")
    assert (chunk.kinds == REAL).all()
    assert np.isnan(chunk.values[0]) and chunk.values[1] == -np.inf and chunk.values[2] == np.inf


def test_lines_tags_and_comments(folder: Path) -> None:
    text = "# a comment\nPOINT 1 2\n\n  LINE\t3.5 \r\nother x y z\n POINT 7"
    (chunk,) = parse(folder, text, ("POINT", "LINE"))
    assert chunk.number.tolist() == [2, 3, 4, 5, 6]
    assert chunk.tag.tolist() == [0, NO_TAG, 1, UNKNOWN_TAG, 0]
    assert chunk.count.tolist() == [2, 0, 1, 0, 1]
    assert chunk.first.tolist() == [0, 2, 2, 3, 3]
    assert chunk.values.tolist() == [1.0, 2.0, 3.5, 7.0]
    assert [chunk.line(row) for row in range(5)] == ["POINT 1 2", "", "  LINE\t3.5 ", "other x y z", " POINT 7"]


@pytest.mark.parametrize("size", [16, 64, 1000])
def test_chunks_break_no_line(folder: Path, size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(number_lines, "CHUNK", size)
    rng = np.random.default_rng(size)
    rows = [rng.normal(size=rng.integers(0, 9)).tolist() for _ in range(60)]
    text = "\n".join(" ".join(map(repr, row)) for row in rows)
    path = folder / "chunks.txt"
    path.write_text(text)
    values, numbers = [], []
    for chunk in read_number_lines(path):
        for row in range(len(chunk.number)):
            first = int(chunk.first[row])
            values.append(chunk.values[first : first + int(chunk.count[row])].tolist())
            numbers.append(int(chunk.number[row]))
    assert values == rows[: len(values)] and not any(rows[len(values) :])
    assert numbers == list(range(1, len(values) + 1))


def test_compressed_text_reads_the_same(folder: Path) -> None:
    path = folder / "numbers.bz2"
    path.write_bytes(bz2.compress(b"1 2 3\n4.5\n" * 1000))
    assert sum(chunk.values.sum() for chunk in read_number_lines(path)) == pytest.approx(10500.0)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(InputError, match=r"expected a whole bzip2 file – got the end inside of the data"):
        list(read_number_lines(path))


def test_text_as_editors_under_windows_save_it(folder: Path) -> None:
    (chunk,) = parse(folder, b"\xef\xbb\xbfEDGE 1 2\r\nEDGE 3 4\r\n", ("EDGE",))
    assert chunk.values.tolist() == [1.0, 2.0, 3.0, 4.0] and chunk.tag.tolist() == [0, 0]
    assert number_lines.first_text(folder / "numbers.txt", 7) == "EDGE"
    assert parse(folder, b"\xef\xbb\xbf") == []
    with pytest.raises(
        InputError, match=r"a text file, in UTF-8 – got text in UTF-16 \(.*numbers.txt\) – save it again as UTF-8"
    ):
        parse(folder, "EDGE 1 2\n".encode("utf-16"))


def test_files_that_are_no_text(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"expected a text file – got a binary file"):
        parse(folder, b"1 2 3\0\0")
    with pytest.raises(InputError, match=r"expected a readable text file – got .*missing.txt: No such file"):
        list(read_number_lines(folder / "missing.txt"))
    monkeypatch.setattr(number_lines, "CHUNK", 16)
    monkeypatch.setattr(number_lines, "LONGEST_LINE", 100)
    with pytest.raises(InputError, match=r"expected a text file – got a line of more than"):
        parse(folder, b"1 " * 1000)
    assert parse(folder, b"") == []


def test_a_refused_line_is_quoted(folder: Path) -> None:
    (chunk,) = parse(folder, "1 2\n3 4 5\n6 x\n\n" + "7 " * 100)
    with pytest.raises(InputError, match=r"expected two numbers – got '3 4 5' \(.*numbers.txt, line 2\) – remove it"):
        chunk.table(np.array([0, 1]), 2, "two numbers", "remove it")
    with pytest.raises(InputError, match=r"got '6 x' .*line 3\)"):
        chunk.table(np.array([0, 2]), 2, "two numbers", "remove it")
    with pytest.raises(InputError, match=r"got an empty line .*line 4\)"):
        chunk.table(np.array([3]), 2, "two numbers", "remove it")
    with pytest.raises(InputError, match=r"got '(7 )*7?…' .*line 5\)"):
        chunk.table(np.array([4]), 2, "two numbers", "remove it")
    assert chunk.table(np.array([0]), 2, "two numbers", "remove it", whole=[0, 1]).tolist() == [[1.0, 2.0]]
    assert chunk.column(np.array([0]), 1).tolist() == [2]
