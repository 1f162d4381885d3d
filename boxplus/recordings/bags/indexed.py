"""Bags with an index, ROS 1 and ROS 2 (SQLite, MCAP), through rosbags."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from boxplus.recordings.bags.bounded_readers import open_reader
from boxplus.recordings.bags.container import READ_ERRORS, Channel, foreign_errors
from boxplus.recordings.bags.messages import Encoding

_FIRST_SKIP_NS = 250_000_000


def rosbags_errors() -> tuple[type[Exception], ...]:
    """What rosbags raises on files that it does not take."""
    from rosbags.rosbag1 import ReaderError as Ros1Error
    from rosbags.rosbag2 import ReaderError as Ros2Error

    return Ros1Error, Ros2Error, *foreign_errors()


class IndexedContainer:
    """A healthy recording, through rosbags: messages come in the order of their reception times."""

    def __init__(self, path: Path, files: list[Path]) -> None:
        self._readers: list[Any] = []
        self.damage: list[str] = []
        self._errors = READ_ERRORS + rosbags_errors()
        try:
            for file in files:
                self._readers.append(open_reader(file))
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
