"""Bags are read by rosbags with a limit, and rosbags itself stays as it is for everybody else in the process."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from rosbags import rosbag1, rosbag2
from rosbags.rosbag1 import reader as ros1_module

from boxplus.errors import RecordingError
from boxplus.recordings import open_recording
from boxplus.recordings.bags import bounded_readers, inflation
from boxplus.sensors.lidar.scan import Scan
from tests.bags import Content, write_bag
from tests.recordings.bags.test_inflation import KINDS, LIMIT, SMALL, compressor, hiding_a_bomb, write_compressed

UNKNOWN = f"rosbags {version('rosbags')} inflates in a way that boxplus does not know and could not limit"


@pytest.fixture
def unknown_rosbags(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], None]]:
    """Takes a name from what the next reader finds in the modules of rosbags."""
    copy = bounded_readers._copy

    def without(missing: str) -> None:
        def incomplete(name: str) -> Any:
            module = copy(name)
            own = [kind for kind in vars(module).values() if isinstance(kind, type) and kind.__module__ == name]
            for holder in (module, *own):
                if missing in vars(holder):
                    delattr(holder, missing)
            return module

        monkeypatch.setattr(bounded_readers, "_copy", incomplete)
        bounded_readers._ros2_reader.cache_clear()

    yield without
    bounded_readers._ros2_reader.cache_clear()


def rosbags_state() -> dict[tuple[str, ...], Any]:
    """What the modules, classes and tables of rosbags hold."""
    state: dict[tuple[str, ...], Any] = {}
    for name in [name for name in sys.modules if name.split(".")[0] == "rosbags"]:
        for key, value in vars(sys.modules[name]).items():
            state[name, key] = value
            if isinstance(value, type) and value.__module__ == name:
                state.update({(name, key, inner): held for inner, held in vars(value).items()})
            elif isinstance(value, dict) and key != "__builtins__":
                state.update({(name, key, str(inner)): held for inner, held in value.items()})
    return state


@pytest.mark.parametrize("kind", KINDS)
def test_rosbags_is_the_same_while_and_after_a_recording_is_read(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_compressed(tmp_path, kind, compressor(KINDS[kind]))
    monkeypatch.setattr(inflation, "LARGEST_CHUNK", LIMIT)
    bounded_readers._ros2_reader.cache_clear()
    before = rosbags_state()
    with open_recording(path) as recording:
        assert any(isinstance(event, Scan) for event in recording)
        within = rosbags_state()
    for state in (within, rosbags_state()):
        assert [key for key in before if state[key] is not before[key]] == [] and state.keys() == before.keys()
    monkeypatch.setattr(inflation, "LARGEST_CHUNK", 1)
    reader = (rosbag1 if kind.startswith("ros1") else rosbag2).Reader(path)
    with reader:
        assert len(list(reader.messages())) == reader.message_count


@pytest.mark.parametrize("wrap", ["table", "chunks"])
def test_functions_of_ros1_that_are_wrapped_are_limited_all_the_same(
    wrap: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_compressed(tmp_path, "ros1 bz2", hiding_a_bomb("ros1 bz2"))
    monkeypatch.setattr(inflation, "LARGEST_CHUNK", LIMIT)
    if wrap == "table":
        for name, inflate in ros1_module.decompressors.items():
            monkeypatch.setitem(ros1_module.decompressors, name, lambda data, inflate=inflate: inflate(data))
    else:  # by functions that nothing tells the compression of
        new_chunk = ros1_module.Chunk
        monkeypatch.setattr(
            ros1_module, "Chunk", lambda size, position, inflate: new_chunk(size, position, lambda data: inflate(data))
        )
    with open_recording(path) as recording:
        assert 3 <= len([event for event in recording if isinstance(event, Scan)]) < SMALL.scans
        texts = " ".join(finding.text for finding in recording.info.evidence if finding.key == "file")
    assert ("inflates to more than 4194304 bytes" in texts) == (wrap == "table")
    assert (f"the index cannot be used ({UNKNOWN}); the messages were collected from front to back" in texts) == (
        wrap == "chunks"
    )


@pytest.mark.parametrize("missing", ["DECOMPRESSORS", "McapReader", "zstd", "STORAGE_PLUGINS"])
def test_a_version_of_rosbags_that_is_not_known_is_not_used(
    missing: str, tmp_path: Path, unknown_rosbags: Callable[[str], None]
) -> None:
    if missing == "zstd" and not hasattr(rosbag2.reader, "zstd"):
        missing = "zstandard"
    content = Content(points=500, scans=4)
    path = write_bag(tmp_path, "mcap", content)
    unknown_rosbags(missing)
    with open_recording(path) as recording:
        assert len([event for event in recording if isinstance(event, Scan)]) == content.scans
        texts = " ".join(finding.text for finding in recording.info.evidence if finding.key == "file")
    assert f"the index cannot be used ({UNKNOWN}); the messages were collected from front to back" in texts


@pytest.mark.parametrize("kind", ["file", "messages"])
def test_what_only_rosbags_reads_names_the_versions_that_are_known(
    kind: str, tmp_path: Path, unknown_rosbags: Callable[[str], None]
) -> None:
    path = write_compressed(tmp_path, kind, compressor("zstd"))
    unknown_rosbags("DECOMPRESSORS")
    with pytest.raises(RecordingError) as raised:
        open_recording(path)
    assert str(raised.value).endswith(f" – got {path.name}: {UNKNOWN} – install rosbags {bounded_readers.KNOWN_ROSBAGS}")
