"""Containers of serialised messages: ROS 1 bags, ROS 2 bags (sqlite3, MCAP), read through rosbags.

A container knows its channels and yields (channel, reception time, bytes) in the order of reception. A file that was cut off or
damaged is read as far as it goes: the container then says so in `damage` instead of raising.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from boxplus.errors import RecordingError
from boxplus.recordings.messages import Encoding

_LOG = logging.getLogger(__name__)

READ_ERRORS: tuple[type[Exception], ...] = (
    *(ArithmeticError, AssertionError, AttributeError, EOFError, LookupError, MemoryError, OSError, RuntimeError),
    *(TypeError, ValueError, struct.error),
)
"""What decoders raise on damaged bytes, their own error classes aside."""


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


def open_container(path: Path) -> Container:
    """Open a bag, an MCAP file or a ROS 2 folder; one without a usable index is read from front to back.

    Raises:
        RecordingError: not such a file, or nothing in it can be read.
    """
    from boxplus.recordings.sequential import open_sequential

    files = [path]
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        files = sorted(file for file in path.iterdir() if file.suffix in (".mcap", ".db3"))
        if not files:
            raise RecordingError(
                "a folder with .mcap or .db3 files (ROS 2), or with velodyne_points and oxts (KITTI raw)",
                f"{path.name} with {', '.join(sorted(file.name for file in path.iterdir())[:5]) or 'nothing in it'}",
                "give the folder that holds them; of ROS 1 bags give one file",
            )
    try:
        return IndexedContainer(path, files)
    except READ_ERRORS + _rosbags_errors() as error:
        reason = str(error) or type(error).__name__
    _LOG.info("%s has no usable index (%s): reading it from front to back", path, reason)
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix in (".mcap", ".db3"))
    container = open_sequential(files)
    if container is None:
        raise RecordingError(
            "a readable ROS bag or MCAP file",
            f"{path.name}: {reason}",
            "copy the recording again; nothing in this file can be read",
        )
    if container.damage or not any(benign in reason for benign in _HEALTHY_ALL_THE_SAME):
        container.damage.append(f"the index cannot be used ({reason}); the messages were collected from front to back")
    return container


_HEALTHY_ALL_THE_SAME = ("Profile is not ros2", "not supported", "metadata")
"""Why rosbags declines healthy files: ROS 1 in MCAP, and, in older versions, newer metadata and files without any."""


def _rosbags_errors() -> tuple[type[Exception], ...]:
    from rosbags.rosbag1 import ReaderError as Ros1Error
    from rosbags.rosbag2 import ReaderError as Ros2Error

    return Ros1Error, Ros2Error, *foreign_errors()


def foreign_errors() -> tuple[type[Exception], ...]:
    """The error classes of the decompressors and of SQLite, which do not derive from the built-in ones above."""
    import importlib

    errors: list[type[Exception]] = []
    for module, name in (("backports.zstd", "ZstdError"), ("zstandard", "ZstdError"), ("apsw", "Error"), ("sqlite3", "Error")):
        try:
            errors.append(getattr(importlib.import_module(module), name))
        except ImportError:
            continue
    return tuple(errors)


_FIRST_SKIP_NS = 250_000_000


class IndexedContainer:
    """A healthy recording, through rosbags: messages come in the order of their reception times."""

    def __init__(self, path: Path, files: list[Path]) -> None:
        self._readers: list[Any] = []
        self.damage: list[str] = []
        self._errors = READ_ERRORS + _rosbags_errors()
        try:
            for file in files:
                self._readers.append(_open_reader(file))
            self.channels = self._collect_channels()
            self.start_ns = min(int(reader.start_time) for reader in self._readers)
            self.end_ns = max(int(reader.end_time) for reader in self._readers)
        except BaseException:
            self.close()
            raise
        self.format = _format_name(files[0])

    def _collect_channels(self) -> list[Channel]:
        counts: dict[tuple[str, str], int] = {}
        for reader in self._readers:
            for connection in reader.connections:
                key = connection.topic, connection.msgtype.replace("/msg/", "/")
                counts[key] = counts.get(key, 0) + connection.msgcount
        self._encoding: Encoding = "ros1" if _is_ros1(self._readers[0]) else "cdr"
        return [Channel(topic, kind, self._encoding, count) for (topic, kind), count in sorted(counts.items())]

    def messages(self, topics: frozenset[str], start_ns: int, stop_ns: int) -> Iterator[tuple[Channel, int, bytes]]:
        by_name = {(channel.topic, channel.type): channel for channel in self.channels}
        for reader in self._readers:
            wanted = [connection for connection in reader.connections if connection.topic in topics]
            channel_of = {id(c): by_name[c.topic, c.msgtype.replace("/msg/", "/")] for c in wanted}
            position, skip = start_ns, _FIRST_SKIP_NS
            while wanted and position < stop_ns:
                last = position - 1
                try:
                    for connection, received, data in reader.messages(connections=wanted, start=position, stop=stop_ns):
                        if type(received) is not int or type(data) is not bytes:
                            self.damage.append(f"a record of {connection.topic} holds no message; skipped")
                            continue
                        last = received
                        channel = (
                            channel_of.get(id(connection)) or by_name[connection.topic, connection.msgtype.replace("/msg/", "/")]
                        )
                        yield channel, received, data
                    break
                except self._errors as error:
                    # A chunk is damaged: go on behind it, in growing steps because its end is not known.
                    skip = _FIRST_SKIP_NS if last >= position else 2 * skip
                    position = last + 1 + skip
                    where = (last + 1 - self.start_ns) * 1e-9
                    self.damage.append(
                        f"unreadable {max(where, 0.0):.2f} s after the start ({str(error) or type(error).__name__}); skipped"
                    )

    def close(self) -> None:
        while self._readers:
            self._readers.pop().close()


def _open_reader(file: Path) -> Any:
    from rosbags.rosbag1 import Reader as Ros1Reader
    from rosbags.rosbag2 import Reader as Ros2Reader

    reader = Ros1Reader(file) if file.suffix == ".bag" else Ros2Reader(file)
    reader.open()
    return reader


def _is_ros1(reader: object) -> bool:
    from rosbags.rosbag1 import Reader as Ros1Reader

    return isinstance(reader, Ros1Reader)


def _format_name(file: Path) -> str:
    if file.suffix == ".bag":
        return "ROS 1 bag"
    storage = file.suffix.lstrip(".")
    if file.is_dir():
        storage = "sqlite3" if any(child.suffix.startswith(".db3") for child in file.iterdir()) else "mcap"
    return f"ROS 2 bag ({storage.replace('db3', 'sqlite3')})"
