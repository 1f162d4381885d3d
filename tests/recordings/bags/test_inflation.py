"""Compressed bags come back as they were written, and what would fill the memory or the disk is damage."""

import bz2
import functools
import re
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tests.bags
from boxplus.errors import RecordingError
from boxplus.recordings import open_recording
from boxplus.recordings.bags import inflation
from boxplus.recordings.bags.container import DamagedRecordError, foreign_errors
from boxplus.sensors.lidar.scan import Scan
from tests.bags import Content, write_bag

SMALL, LARGE = (Content(points=points, scans=8, imu_rate=50) for points in (4_000, 20_000))  # chunks of MCAP hold 1 MB
LIMIT, BOMB = 1 << 22, 1 << 25
Compress = Callable[[bytes], bytes]


def compressor(compression: str) -> Compress:
    if compression == "bz2":
        return functools.partial(bz2.compress, compresslevel=1)
    if compression == "lz4":
        compress: Compress = pytest.importorskip("lz4.frame").compress
    else:
        zstd = inflation._zstd()
        compress = zstd.compress if hasattr(zstd, "ZstdFile") else zstd.ZstdCompressor().compress
    return compress


@pytest.mark.parametrize("compression", ["bz2", "lz4", "zstd"])
def test_what_is_inflated_has_a_limit(compression: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inflation, "LARGEST_CHUNK", 1 << 16)
    compress = compressor(compression)
    chunk = compress(bytes(1 << 16))
    assert inflation.inflate(compression, chunk) == bytes(1 << 16)
    with pytest.raises((ValueError, EOFError, RuntimeError)):
        inflation.inflate(compression, chunk[:-9])
    halves = compress(b"a" * (1 << 15)) + compress(b"b" * (1 << 15))
    assert inflation.inflate(compression, halves) == b"a" * (1 << 15) + b"b" * (1 << 15)
    for large in (compress(bytes((1 << 16) + 1)), chunk + compress(b"a")):
        with pytest.raises(DamagedRecordError, match=rf"^a chunk of {len(large)} bytes inflates to more than 65536 bytes$"):
            inflation.inflate(compression, large)


def write_compressed(folder: Path, kind: str, compress: Compress) -> Path:
    """A recording with an index whose chunks, or messages, `compress` makes smaller."""
    with pytest.MonkeyPatch.context() as patch:
        if kind.startswith("ros1"):
            fmt = tests.bags.Ros1Writer.CompressionFormat[kind.removeprefix("ros1 ").upper()]

            class Writer(tests.bags.Ros1Writer):
                def __init__(self, path: Path) -> None:
                    super().__init__(path)
                    self.set_compression(fmt)
                    self.compressor = compress

            patch.setattr(tests.bags, "Ros1Writer", Writer)
            return write_bag(folder, "ros1", SMALL)
        zstd = inflation._zstd()
        if not hasattr(zstd, "ZstdFile"):
            pytest.skip("this version of rosbags compresses otherwise")
        from rosbags import rosbag2

        new_writer = tests.bags._ros2_writer

        def compressing(path: Path, container: tests.bags.Container) -> Any:
            writer = new_writer(path, container)
            mode = {"mcap": "STORAGE", "messages": "MESSAGE", "file": "FILE"}[kind]
            writer.set_compression(rosbag2.CompressionMode[mode], rosbag2.CompressionFormat.ZSTD)
            return writer

        patch.setattr(tests.bags, "_ros2_writer", compressing)
        patch.setattr(zstd, "compress", compress)
        return write_bag(folder, "mcap" if kind == "mcap" else "sqlite3", LARGE)


KINDS = {"ros1 bz2": "bz2", "ros1 lz4": "lz4", "mcap": "zstd", "messages": "zstd", "file": "zstd"}


@pytest.mark.parametrize("compression", ["bz2", "lz4", "zstd"])
def test_what_follows_a_frame_and_is_none_is_ignored(compression: str) -> None:
    compress, content = compressor(compression), np.random.default_rng(1).bytes(20_000)
    chunk = compress(content)
    for tail in (b"\0", bytes(4), bytes(5_000), b"padding", content):
        assert inflation.inflate(compression, chunk + tail) == content
        assert inflation.inflate(compression, chunk + chunk + tail) == 2 * content
    for damaged in (b"padding" + chunk, chunk + chunk[:-9]):
        with pytest.raises((ValueError, EOFError, OSError, RuntimeError, *foreign_errors())):
            inflation.inflate(compression, damaged)


@pytest.mark.parametrize("kind", ["ros1 bz2", "ros1 lz4"])
def test_chunks_with_bytes_behind_them_are_read(kind: str, tmp_path: Path) -> None:
    compress = compressor(KINDS[kind])
    with open_recording(write_compressed(tmp_path, kind, lambda data: compress(data) + bytes(7))) as recording:
        assert len([event for event in recording if isinstance(event, Scan)]) == SMALL.scans and not recording.rejected


def hiding_a_bomb(kind: str) -> Compress:
    """Compresses, and lets the second chunk, or message, that holds clouds inflate to far more."""
    compress, clouds = compressor(KINDS[kind]), []

    def compress_and_hide(data: bytes) -> bytes:
        clouds.extend([len(data)] if len(data) > 50_000 else [])
        return compress(bytes(data) + bytes(BOMB) if len(clouds) == 2 else data)

    return compress_and_hide


@pytest.mark.parametrize("kind", KINDS)
def test_compressed_bags_come_back(kind: str, tmp_path: Path) -> None:
    with open_recording(write_compressed(tmp_path, kind, compressor(KINDS[kind]))) as recording:
        scans = [event for event in recording if isinstance(event, Scan)]
    content = SMALL if kind.startswith("ros1") else LARGE
    assert len(scans) == content.scans and not recording.rejected
    for index, scan in enumerate(scans):
        np.testing.assert_array_equal(scan.p_lidar, content.p_lidar(index))


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "file"])
def test_a_chunk_that_would_fill_the_memory_is_damage(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The scans of the others are there."""
    path = write_compressed(tmp_path, kind, hiding_a_bomb(kind))
    monkeypatch.setattr(inflation, "LARGEST_CHUNK", LIMIT)
    tracemalloc.start()
    try:
        with open_recording(path) as recording:
            lengths = [len(event) for event in recording if isinstance(event, Scan)]
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < BOMB / 2
    content = SMALL if kind.startswith("ros1") else LARGE
    assert 3 <= len(lengths) < content.scans and set(lengths) == {content.points}
    assert recording.rejected["unreadable stretches of the file"] >= 1
    texts = [finding.text for finding in recording.info.evidence if finding.key == "file"]
    told = re.compile(
        rf"\(a {'message' if kind == 'messages' else 'chunk'} of \d+ bytes inflates to more than 4194304 bytes\); skipped"
    )
    assert any(map(told.search, texts))


def test_a_file_that_would_fill_the_disk_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_compressed(tmp_path, "file", compressor("zstd"))
    monkeypatch.setattr(inflation, "LARGEST_CHUNK", LIMIT)
    (file,) = path.glob("*.zstd")
    file.write_bytes(compressor("zstd")(bytes(BOMB)))
    with pytest.raises(RecordingError, match=r"– got recording: a file of \d+ bytes inflates to more than \d+"):
        open_recording(path)


@pytest.mark.parametrize("size", [-1, 1 << 30])
def test_a_file_is_not_inflated_past_its_limit_to_find_that_out(
    size: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inflation, "LARGEST_CHUNK", 1 << 10)
    small, large = tmp_path / "small", tmp_path / "large"
    small.write_bytes(compressor("zstd")(b"a" * 1000))
    large.write_bytes(compressor("zstd")(bytes(BOMB)))
    with small.open("rb") as file, inflation.Zstd().open(file) as inflated:
        assert inflated.read(10) + inflated.read(size) + inflated.read(size) == b"a" * 1000
    with large.open("rb") as file, inflation.Zstd().open(file) as inflated:
        tracemalloc.start()
        try:
            for _ in range(2):  # nor afterwards
                with pytest.raises(DamagedRecordError, match=r"^a file of "):
                    inflated.read(size)
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    assert peak < BOMB / 8
