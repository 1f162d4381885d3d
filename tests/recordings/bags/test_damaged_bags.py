"""Damaged recordings: what is readable is delivered, the rest is reported, nothing else happens."""

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.errors import RecordingError
from boxplus.recordings import Recording, open_recording
from boxplus.runs.inspection.diagnosis import diagnose
from boxplus.sensors.lidar.scan import Scan
from tests.bags import CONTAINERS, Content, write_bag

CONTENT = Content(scans=12, points=60, imu_rate=50)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The bytes of one healthy file of every kind."""
    files = {}
    for container in CONTAINERS:
        path = write_bag(tmp_path_factory.mktemp(container), container, CONTENT)
        file = path if path.is_file() else next(f for f in path.iterdir() if f.suffix in (".mcap", ".db3"))
        files[file.suffix] = file.read_bytes()
    return files


def read_all(path: Path) -> tuple[list[Scan], Recording] | None:
    """All scans, or None when the recording is refused."""
    try:
        with open_recording(path) as recording:
            return [event for event in recording if isinstance(event, Scan)], recording
    except RecordingError as error:
        assert str(error).startswith("expected ") and " – got " in str(error)
        return None


def check_scans(scans: list[Scan]) -> None:
    """Whatever is delivered is well formed."""
    for scan in scans:
        assert scan.p_lidar.shape == (len(scan), 3) and np.isfinite(scan.p_lidar).all()


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0.0, 0.999))
def test_cut_anywhere(whole: dict[str, bytes], tmp_path: Path, suffix: str, share: float) -> None:
    data = whole[suffix]
    path = tmp_path / f"cut{suffix}"
    path.write_bytes(data[: int(share * len(data))])
    result = read_all(path)
    if result is not None:
        scans, recording = result
        check_scans(scans)
        assert len(scans) <= CONTENT.scans
        if len(scans) < CONTENT.scans:
            assert any(e.key == "file" and e.verdict == "warning" for e in recording.info.evidence)


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_flipped_bytes(whole: dict[str, bytes], tmp_path: Path, suffix: str, data: st.DataObject) -> None:
    content = bytearray(whole[suffix])
    for _ in range(data.draw(st.integers(1, 8))):
        content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    path = tmp_path / f"flipped{suffix}"
    path.write_bytes(content)
    result = read_all(path)
    if result is not None:
        check_scans(result[0])


def test_a_cut_bag_yields_what_is_there(shared_data: Path, tmp_path: Path) -> None:
    """Half of a recording with many chunks: about half of its scans, and a sentence about the rest."""
    for name, total in (("v103_velodyne.bag", 219), ("mh05_ouster_ros2/mh05_ouster_ros2.mcap", 249)):
        source = shared_data / "recordings" / name
        path = tmp_path / source.name
        data = source.read_bytes()
        path.write_bytes(data[: len(data) // 2])
        result = read_all(path)
        assert result is not None
        scans, recording = result
        assert 0.4 * total < len(scans) < 0.6 * total
        texts = [e.text for e in recording.info.evidence if e.key == "file"]
        assert any("is readable up to byte" in text for text in texts)
        assert recording.rejected["unreadable stretches of the file"] == 1


def test_a_damaged_chunk_is_skipped(shared_data: Path, tmp_path: Path) -> None:
    for name, total in (("v103_velodyne.bag", 219), ("mh05_ouster_ros2/mh05_ouster_ros2.mcap", 249)):
        source = shared_data / "recordings" / name
        path = tmp_path / source.name
        data = bytearray(source.read_bytes())
        middle = len(data) // 2
        data[middle : middle + 64] = bytes(64)
        path.write_bytes(data)
        result = read_all(path)
        assert result is not None
        scans, recording = result
        assert 0.7 * total < len(scans) < total
        assert recording.rejected["unreadable stretches of the file"] >= 1


def test_a_bag_with_nothing_readable_is_refused(tmp_path: Path) -> None:
    for ending in ("bag", "mcap", "db3"):
        path = tmp_path / f"x.{ending}"
        path.write_bytes(b"")
        with pytest.raises(RecordingError, match=rf"a ROS 1 bag, an MCAP .* – got x\.{ending}, which is empty"):
            open_recording(path)
        path.write_bytes(b"VERTEX_SE2 0 0 0 0\n" * 9)  # a file of another kind under this name
        with pytest.raises(RecordingError, match=rf"got x\.{ending}, which begins like none of them – give the recording"):
            open_recording(path)
    for head in (b"#ROSBAG V1.2\n", b"\x89MCAP0\r\n"):
        path.write_bytes(head)
        with pytest.raises(RecordingError, match=r"a readable ROS bag or MCAP file – got x\.db3: .* nothing in this file"):
            open_recording(path)


@pytest.mark.parametrize("definition", ["= = =", "int32[", "a/b/c/d e", "string<=3 x = 'a", "\x00", "float64 x 1\nMSG: y"])
def test_damaged_message_definitions_stop_nothing(tmp_path: Path, definition: str) -> None:
    """They are not needed: the messages that are read are known."""
    path = write_bag(tmp_path, "sqlite3", CONTENT)
    with closing(sqlite3.connect(next(path.rglob("*.db3")))) as database:
        database.execute("UPDATE message_definitions SET encoded_message_definition = ?", (definition,))
        database.commit()
    result = read_all(path)
    assert result is not None and len(result[0]) == CONTENT.scans


def test_escape_sequences_in_a_topic_do_not_reach_a_terminal(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", CONTENT)
    path.write_bytes(path.read_bytes().replace(b"/points", b"/p\x1b[2K\x07"))
    found = diagnose(path)
    assert any("\\x1b[2K" in finding.value + finding.text for finding in found.evidence)
    assert "\x1b" not in CliRunner().invoke(app, ["inspect", str(path)]).output
