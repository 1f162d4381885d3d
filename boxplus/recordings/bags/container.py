"""A container of serialised messages: its channels, and (channel, reception time, bytes) in the order of reception.

A file that was cut off or damaged is read as far as it goes: the container then says so in `damage` instead of raising.
"""

from __future__ import annotations

import importlib
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

from boxplus.recordings.bags.messages import Encoding

READ_ERRORS: tuple[type[Exception], ...] = (
    *(ArithmeticError, AssertionError, AttributeError, EOFError, LookupError, MemoryError, OSError, RuntimeError),
    *(TypeError, ValueError, struct.error),
)
"""What decoders raise on damaged bytes, their own error classes aside."""


class DamagedRecordError(ValueError):
    """A record is cut off, its header makes no sense, or it inflates to more than any recorder writes."""


@dataclass(frozen=True, slots=True)
class Channel:
    """One topic of a container: its name, its message type without `/msg/`, how its messages are serialised, how many."""

    topic: str
    type: str
    encoding: Encoding
    count: int


class Container(Protocol):
    """A file or folder of serialised messages."""

    format: str
    channels: list[Channel]
    start_ns: int
    end_ns: int
    damage: list[str]
    """What could not be read, one sentence each; grows while reading."""

    def messages(self, topics: frozenset[str], start_ns: int, stop_ns: int) -> Iterator[tuple[Channel, int, bytes]]:
        """Messages of these topics received in [start_ns, stop_ns)."""
        ...

    def close(self) -> None:
        """Release the files."""
        ...


def foreign_errors() -> tuple[type[Exception], ...]:
    """The error classes of the decompressors and of SQLite, which do not derive from the built-in ones above."""
    errors: list[type[Exception]] = []
    zstd = [(module, "ZstdError") for module in ("compression.zstd", "backports.zstd", "zstandard")]
    for module, name in (*zstd, ("apsw", "Error"), ("sqlite3", "Error")):
        try:
            errors.append(getattr(importlib.import_module(module), name))
        except ImportError:
            continue
    return tuple(errors)


def interval(container: Container, start_s: float, duration_s: float | None) -> tuple[int, int]:
    """Reception times [start, stop) of a stretch that begins `start_s` after the start; without a duration up to the end."""
    start_ns = container.start_ns + round(start_s * 1e9)
    if duration_s is None:
        return start_ns, container.end_ns + 1
    return start_ns, start_ns + round(duration_s * 1e9)


def share(container: Container, start_s: float, duration_s: float | None) -> float:
    """How much of the recording such a stretch is, by time."""
    start_ns, stop_ns = interval(container, start_s, duration_s)
    return max(min(stop_ns, container.end_ns) - start_ns, 0) / max(container.end_ns - container.start_ns, 1)
