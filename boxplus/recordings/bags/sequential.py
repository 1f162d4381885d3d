"""Bags, MCAP and SQLite files read from front to back, without rosbags and without an index.

For recordings that were cut off (a full disk, a dead battery, an interrupted copy: the index is written last) and for files
some versions of rosbags do not take (ROS 1 messages in MCAP, files without their metadata.yaml). Formats: ROS bag 2.0
(wiki.ros.org/Bags/Format/2.0), MCAP (mcap.dev/spec), and the tables of rosbag2's SQLite storage.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import BinaryIO, NamedTuple

from boxplus.recordings.bags.container import READ_ERRORS, Channel, DamagedRecordError, foreign_errors
from boxplus.recordings.bags.inflation import inflate

ROS1_MAGIC, _ANY_ROS1_MAGIC = b"#ROSBAG V2.0\n", b"#ROSBAG V"
MCAP_MAGIC = b"\x89MCAP0\r\n"
SQLITE_MAGIC = b"SQLite format"
_LARGEST_RECORD = 1 << 31


class _Message(NamedTuple):
    channel: int
    time_ns: int
    data: bytes


class _Connection(NamedTuple):
    channel: int
    topic: str
    type: str
    encoding: str


_Record = _Message | _Connection
_Scanner = Callable[[BinaryIO], Iterator[_Record | None]]


def open_sequential(files: list[Path]) -> SequentialContainer | None:
    """A container over these files, or None when none of them holds a single message."""
    container = SequentialContainer(files)
    return container if any(channel.count for channel in container.channels) else None


def first_time_ns(file: Path) -> int | None:
    """When the first message of a file was received; None where none can be read."""
    return next((time_ns for _, time_ns, _ in _read([file], [])), None)


class SequentialContainer:
    """Files read in order; the first pass, on opening, counts what is readable."""

    def __init__(self, files: list[Path]) -> None:
        self._files = files
        self.damage: list[str] = []
        self.start_ns, self.end_ns = 2**63 - 1, 0
        counts: dict[tuple[str, str, str], int] = {}
        for connection, time_ns, _ in _read(self._files, self.damage):
            key = connection.topic, connection.type, connection.encoding
            counts[key] = counts.get(key, 0) + 1
            self.start_ns, self.end_ns = min(self.start_ns, time_ns), max(self.end_ns, time_ns + 1)
        self._channels = {
            (topic, kind): Channel(topic, kind, "ros1" if encoding == "ros1" else "cdr", count)
            for (topic, kind, encoding), count in sorted(counts.items())
        }
        self.channels = list(self._channels.values())
        kinds = {".mcap": "MCAP", ".db3": "ROS 2 bag (sqlite3)"}
        self.format = kinds.get(files[0].suffix, "ROS 1 bag") if files else ""

    def messages(self, topics: frozenset[str], start_ns: int, stop_ns: int) -> Iterator[tuple[Channel, int, bytes]]:
        for connection, time_ns, data in _read(self._files, self.damage):
            if connection.topic in topics and start_ns <= time_ns < stop_ns:
                yield self._channels[connection.topic, connection.type], time_ns, data

    def close(self) -> None:
        """Nothing is held open between passes."""


def _read(files: list[Path], damage: list[str]) -> Iterator[tuple[_Connection, int, bytes]]:
    """Messages of all files, each as far as it can be read."""
    errors = READ_ERRORS + foreign_errors()
    for file in files:
        connections: dict[int, _Connection] = {}
        position = 0
        try:
            with file.open("rb") as stream:
                for record in _scanner(stream)(stream):
                    position = stream.tell()
                    if record is None:
                        damage.append(f"{file.name}: a damaged block before byte {position} was skipped")
                    elif isinstance(record, _Connection):
                        connections[record.channel] = record
                    elif record.channel in connections:
                        yield connections[record.channel], record.time_ns, record.data
        except errors as error:
            damage.append(f"{file.name} is readable up to byte {position} only ({str(error) or type(error).__name__})")


def begins_like_a_bag(file: Path) -> bool:
    """Whether a file has the first bytes of a bag, of whatever version, an MCAP file or a SQLite database."""
    with file.open("rb") as stream:
        return stream.read(len(SQLITE_MAGIC)).startswith((_ANY_ROS1_MAGIC, MCAP_MAGIC, SQLITE_MAGIC))


def _scanner(stream: BinaryIO) -> _Scanner:
    magic = stream.read(len(ROS1_MAGIC))
    if magic == ROS1_MAGIC:
        return _scan_ros1
    if magic.startswith(MCAP_MAGIC):
        stream.seek(len(MCAP_MAGIC))
        return _scan_mcap
    if magic.startswith(SQLITE_MAGIC):
        return _scan_sqlite
    raise DamagedRecordError("neither a ROS 1 bag (version 2.0) nor an MCAP or SQLite file")


def _take(stream: BinaryIO, size: int) -> bytes:
    if size > _LARGEST_RECORD:
        raise DamagedRecordError(f"a record claims {size} bytes")
    data = stream.read(size)
    if len(data) < size:
        raise DamagedRecordError("the file is cut off in the middle of a record")
    return data


# --- ROS 1 bags: records of (header length, header, data length, data); headers are (length, name=value) pairs. ---

_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7


def _scan_ros1(stream: BinaryIO) -> Iterator[_Record | None]:
    while length := stream.read(4):
        if len(length) < 4:
            raise DamagedRecordError("the file is cut off in the middle of a record")
        header = _ros1_header(_take(stream, struct.unpack("<I", length)[0]))
        data = _take(stream, struct.unpack("<I", _take(stream, 4))[0])
        if header.get(b"op") == bytes([_CHUNK]):
            yield from _skipping_damage(_ros1_chunk(header, data))
        else:
            yield from _ros1_record(header, data)


def _ros1_chunk(header: dict[bytes, bytes], data: bytes) -> Iterator[_Record]:
    chunk = inflate(header.get(b"compression", b"none").decode(), data)
    position = 0
    while position < len(chunk):
        (length,) = struct.unpack_from("<I", chunk, position)
        inner = _ros1_header(chunk[position + 4 : position + 4 + length])
        position += 4 + length
        (length,) = struct.unpack_from("<I", chunk, position)
        yield from _ros1_record(inner, chunk[position + 4 : position + 4 + length])
        position += 4 + length


def _ros1_header(data: bytes) -> dict[bytes, bytes]:
    fields = {}
    position = 0
    while position < len(data):
        (length,) = struct.unpack_from("<I", data, position)
        name, separator, value = data[position + 4 : position + 4 + length].partition(b"=")
        if not separator:
            raise DamagedRecordError("a record header makes no sense")
        fields[name] = value
        position += 4 + length
    return fields


def _ros1_record(header: dict[bytes, bytes], data: bytes) -> Iterator[_Record]:
    operation = header.get(b"op")
    if operation == bytes([_MESSAGE]):
        seconds, nanoseconds = struct.unpack("<II", header[b"time"])
        yield _Message(struct.unpack("<I", header[b"conn"])[0], seconds * 1_000_000_000 + nanoseconds, data)
    elif operation == bytes([_CONNECTION]):
        topic = "/" * header[b"topic"].startswith(b"/") + "/".join(part for part in header[b"topic"].decode().split("/") if part)
        kind = _ros1_header(data)[b"type"].decode()
        yield _Connection(struct.unpack("<I", header[b"conn"])[0], topic, kind, "ros1")


# --- MCAP: records of (opcode, length, content). ---

_MCAP_SCHEMA, _MCAP_CHANNEL, _MCAP_MESSAGE, _MCAP_CHUNK, _MCAP_DATA_END = 3, 4, 5, 6, 15


def _scan_mcap(stream: BinaryIO) -> Iterator[_Record | None]:
    schemas: dict[int, str] = {}
    while head := stream.read(9):
        if len(head) < 9:
            raise DamagedRecordError("the file is cut off in the middle of a record")
        operation, length = struct.unpack("<BQ", head)
        if operation == _MCAP_DATA_END:
            return
        content = _take(stream, length)
        if operation == _MCAP_CHUNK:
            yield from _skipping_damage(_mcap_chunk(content, schemas))
        else:
            yield from _mcap_record(operation, content, schemas)
    raise DamagedRecordError("the file ends without its closing record")


def _mcap_chunk(content: bytes, schemas: dict[int, str]) -> Iterator[_Record]:
    (name_length,) = struct.unpack_from("<I", content, 28)
    compression = content[32 : 32 + name_length].decode()
    (stored,) = struct.unpack_from("<Q", content, 32 + name_length)
    begin = 40 + name_length
    chunk = inflate(compression, content[begin : begin + stored])
    position = 0
    while position < len(chunk):
        operation, length = struct.unpack_from("<BQ", chunk, position)
        yield from _mcap_record(operation, chunk[position + 9 : position + 9 + length], schemas)
        position += 9 + length


def _mcap_record(operation: int, content: bytes, schemas: dict[int, str]) -> Iterator[_Record]:
    if operation == _MCAP_SCHEMA:
        key, length = struct.unpack_from("<HI", content)
        schemas[key] = content[6 : 6 + length].decode()
    elif operation == _MCAP_CHANNEL:
        key, schema, length = struct.unpack_from("<HHI", content)
        topic = content[8 : 8 + length].decode()
        (encoding_length,) = struct.unpack_from("<I", content, 8 + length)
        encoding = content[12 + length : 12 + length + encoding_length].decode()
        yield _Connection(key, topic, schemas.get(schema, "").replace("/msg/", "/"), encoding)
    elif operation == _MCAP_MESSAGE:
        key, _, log_time, _ = struct.unpack_from("<HIQQ", content)
        yield _Message(key, log_time, content[22:])


# --- ROS 2 in SQLite: tables `topics` and `messages`. ---


def _scan_sqlite(stream: BinaryIO) -> Iterator[_Record | None]:
    database = sqlite3.connect(f"{Path(stream.name).resolve().as_uri()}?immutable=1", uri=True)
    with closing(database):
        for key, topic, kind in database.execute("SELECT id, name, type FROM topics"):
            if type(key) is int and type(topic) is str and type(kind) is str:
                yield _Connection(key, topic, kind.replace("/msg/", "/"), "cdr")
        for key, time_ns, data in database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id"):
            if type(time_ns) is int and type(data) is bytes:
                yield _Message(key, time_ns, data)
            else:
                yield None


def _skipping_damage(records: Iterator[_Record]) -> Iterator[_Record | None]:
    """The records of a chunk; None in the end when its rest makes no sense (the file goes on behind the chunk)."""
    try:
        yield from records
    except READ_ERRORS + foreign_errors():
        yield None
