"""Text files of numbers, read in chunks of whole lines: g2o, TORO, BAL and COLMAP text stand on it."""

from __future__ import annotations

import bz2
import codecs
import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, cast

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.numbers.parser import INTEGER, LINE, OTHER, REAL, powers_of_five, tokenise

CHUNK = 1 << 20
"""Bytes read at a time; everything made from a chunk stays in the processor's cache."""

LONGEST_LINE = 1 << 24
"""A longer line [bytes] is taken as a sign that the file is no text."""

INFLATED, INFLATED_RATIO = 1 << 26, 100
"""A compressed file may hold as many bytes, and for each of its own as many more: text of numbers has about 3."""

_SHOWN = 80  # characters of a line in an error message


@dataclass(frozen=True, slots=True, eq=False)
class NumberLines:
    """Some consecutive lines of a file. All arrays are reused for the next lines: copy what you keep.

    Attributes:
        source: the file.
        text: the bytes, up to the last newline.
        number: (n,) int64, line numbers in the file, from 1. Comments (#) are left out; empty lines are there.
        tag: (n,) uint8, index of the word that the line begins with, `UNKNOWN_TAG` or `NO_TAG`.
        begin: (n,) uint32, offset of the line in `text`.
        first, count: (n,) uint32, index of its first token, and how many it has, the tag not counted.
        values, integers: (m,) float64 and int64, the tokens.
        kinds: (m,) uint8: `REAL`, `INTEGER` (both values hold) or `OTHER` (no number).
        begins: (m,) uint32, offset of the token in `text`.
    """

    source: Path
    text: memoryview
    number: NDArray[np.int64]
    tag: NDArray[np.uint8]
    begin: NDArray[np.uint32]
    first: NDArray[np.uint32]
    count: NDArray[np.uint32]
    values: NDArray[np.float64]
    integers: NDArray[np.int64]
    kinds: NDArray[np.uint8]
    begins: NDArray[np.uint32]

    def line(self, row: int) -> str:
        """The text of a line, without the newline."""
        return rest_of_line(self.text, int(self.begin[row]))

    def fail(self, row: int, expected: str, advice: str) -> NoReturn:
        """Refuse a line.

        Raises:
            InputError: always; the message quotes the line and names file and number.
        """
        text = self.line(row).strip()
        shown = repr(text if len(text) <= _SHOWN else text[:_SHOWN] + "…") if text else "an empty line"
        raise InputError(expected, f"{shown} ({self.source}, line {self.number[row]})", advice)

    def table(
        self, rows: NDArray[np.intp], width: int, expected: str, advice: str, whole: Sequence[int] = ()
    ) -> NDArray[np.float64]:
        """The numbers of `rows`, each of which must have `width` of them, whole ones in the columns `whole`.

        Returns:
            (len(rows), width) float64, a copy.

        Raises:
            InputError: at the first line that is otherwise.
        """
        bad = np.flatnonzero(self.count[rows] != width)
        if bad.size:
            self.fail(int(rows[bad[0]]), expected, advice)
        tokens = self.first[rows].astype(np.int64)[:, None] + np.arange(width)
        kinds = self.kinds[tokens]
        wrong = (kinds == OTHER).any(axis=1)
        if whole:
            wrong |= (kinds[:, list(whole)] != INTEGER).any(axis=1)
        if wrong.any():
            self.fail(int(rows[np.argmax(wrong)]), expected, advice)
        return cast(NDArray[np.float64], self.values[tokens])

    def column(self, rows: NDArray[np.intp], column: int) -> NDArray[np.int64]:
        """(len(rows),) int64: the whole number in a column, after `table` has checked it; exact up to 64 bits."""
        return self.integers[self.first[rows].astype(np.int64) + column]


def rest_of_line(text: memoryview, begin: int, errors: str = "replace") -> str:
    """The text from an offset to the end of its line; `errors` as for `bytes.decode`."""
    end = begin
    while end < len(text) and text[end] != 10:
        end += 1
    return bytes(text[begin:end]).decode("utf-8", errors).rstrip("\r")


def read_number_lines(path: str | Path, tags: Sequence[str] = ()) -> Iterator[NumberLines]:
    """Read a text file, plain or bzip2, a chunk of lines at a time.

    Args:
        path: the file.
        tags: words that may stand at the beginning of a line; where there are any, every line must begin with a word.

    Raises:
        InputError: the file cannot be read, is binary, or is cut in the middle of its compressed data.
    """
    source = Path(path)
    with _explaining(source), _open(source) as file:
        yield from _chunks(file, source, tags)


def first_text(path: str | Path, size: int) -> str:
    """At most `size` bytes from the beginning of a text file, plain or bzip2.

    Raises:
        InputError: as `read_number_lines`.
    """
    source = Path(path)
    with _explaining(source), _open(source) as file:
        return bytes(file.read(size)).removeprefix(codecs.BOM_UTF8).decode("utf-8", "replace")


def refuse_binary(head: bytes, source: Path, expected: str) -> None:
    """Refuse a file that begins like no text.

    Raises:
        InputError: a zero byte is in it; the message says where it is text all the same, in UTF-16.
    """
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise InputError(f"{expected}, in UTF-8", f"text in UTF-16 ({source})", "save it again as UTF-8")
    if b"\0" in head:
        raise InputError(expected, f"a binary file ({source})", "give the text file, or read it as what it is")


@contextmanager
def _explaining(source: Path) -> Iterator[None]:
    try:
        yield
    except EOFError:
        raise InputError("a whole bzip2 file", f"the end inside of the data ({source})", "copy the file again") from None
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError("a readable text file", f"{source}: {reason}", "check the path and that the file is whole") from error


def _open(source: Path) -> io.RawIOBase:
    with source.open("rb") as file:
        magic = file.read(3)
    return _Inflated(source) if magic == b"BZh" else source.open("rb", buffering=0)


class _Inflated(io.RawIOBase):
    """What a bzip2 file holds, up to a limit: a few kilobytes may otherwise fill the memory."""

    def __init__(self, source: Path) -> None:
        self._file = bz2.BZ2File(source)
        self._source = source
        self._limit = self._left = INFLATED + INFLATED_RATIO * source.stat().st_size

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        received = self._file.readinto(buffer)
        self._left -= received
        if self._left < 0:
            raise InputError(
                f"at most {self._limit / 1e6:.0f} MB of text in a bzip2 file of {self._source.stat().st_size / 1e3:.1f} kB",
                f"more ({self._source})",
                "check where the file comes from; if it is right, decompress it (bunzip2) and give the text file",
            )
        return received

    def close(self) -> None:
        self._file.close()
        super().close()


def _chunks(file: io.RawIOBase, source: Path, tags: Sequence[str]) -> Iterator[NumberLines]:
    encoded = [tag.encode() for tag in tags]
    words = np.frombuffer(b"".join(encoded), np.uint8)
    word_ends = np.cumsum([len(word) for word in encoded], dtype=np.uint32)
    workspace = _Workspace(CHUNK)
    held, done, checked = 0, 0, False
    while True:
        if held + 1 >= len(workspace.buffer):
            if held > LONGEST_LINE:
                raise InputError("a text file", f"a line of more than {held} bytes ({source})", "check what the file is")
            workspace = _Workspace(2 * len(workspace.buffer), bytes(workspace.buffer[:held]))
        received = file.readinto(memoryview(workspace.buffer)[held:-1]) or 0
        if not checked:
            checked = True
            refuse_binary(bytes(workspace.buffer[: min(received, 4096)]), source, "a text file")
            if workspace.buffer.startswith(codecs.BOM_UTF8):  # as editors under Windows write it
                received -= len(codecs.BOM_UTF8)
                workspace.buffer[:received] = workspace.buffer[len(codecs.BOM_UTF8) : len(codecs.BOM_UTF8) + received]
        held += received
        if not received and held and workspace.buffer[held - 1] != 10:
            workspace.buffer[held] = 10  # the last line may end without a newline
            held += 1
        end = workspace.buffer.rfind(b"\n", 0, held) + 1
        if end:
            newlines = workspace.buffer.count(b"\n", 0, end)
            yield workspace.parse(source, end, newlines, done, words, word_ends)
            done += newlines
            workspace.buffer[: held - end] = workspace.buffer[end:held]
            held -= end
        if not received:
            return


class _Workspace:
    """The memory that the lines of a chunk are parsed in."""

    def __init__(self, size: int, held: bytes = b"") -> None:
        self.buffer = bytearray(size)
        self.buffer[: len(held)] = held
        tokens = size // 2 + 1
        self._text = np.frombuffer(self.buffer, np.uint8)
        self._lines = np.empty(1, LINE)
        self._values = np.empty(tokens)
        self._integers = np.empty(tokens, np.int64)
        self._kinds = np.empty(tokens, np.uint8)
        self._begins = np.empty(tokens, np.uint32)

    def parse(
        self, source: Path, end: int, newlines: int, done: int, words: NDArray[np.uint8], word_ends: NDArray[np.uint32]
    ) -> NumberLines:
        """The lines of the first `end` bytes, which have `newlines`, numbered from `done` + 1."""
        if newlines > len(self._lines):
            self._lines = np.empty(newlines + newlines // 4, LINE)
        powers, exponents = powers_of_five()
        found, tokens = tokenise(
            self._text,
            np.uint64(end),
            words,
            word_ends,
            powers,
            exponents,
            self._lines,
            self._values,
            self._values.view(np.uint64),
            self._integers,
            self._kinds,
            self._begins,
        )
        lines = self._lines[:found]
        text = memoryview(self.buffer)[:end]
        for token in np.flatnonzero(self._kinds[:tokens] == OTHER):
            self._resolve(int(token), text)
        return NumberLines(
            source=source,
            text=text,
            number=lines["number"].astype(np.int64) + (done + 1),
            tag=lines["tag"].copy(),
            begin=lines["begin"].copy(),
            first=lines["first"].copy(),
            count=lines["count"].copy(),
            values=self._values[:tokens],
            integers=self._integers[:tokens],
            kinds=self._kinds[:tokens],
            begins=self._begins[:tokens],
        )

    def _resolve(self, token: int, text: memoryview) -> None:
        """Read a token that the kernel left open: many digits, a rounding it could not decide, nan, or no number."""
        begin = int(self._begins[token])
        end = begin
        while text[end] > 32:
            end += 1
        word = bytes(text[begin:end])
        try:
            value = float(word)
        except ValueError:
            return
        if b"_" not in word:
            self._values[token] = value
            self._kinds[token] = REAL
