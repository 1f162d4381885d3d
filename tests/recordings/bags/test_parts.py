"""Folders of files without metadata.yaml: parts of one recording by name and time, or several."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from boxplus.errors import RecordingError
from boxplus.recordings import RecordingOptions, open_recording
from boxplus.recordings.bags.parts import bag_files, recordings_among
from boxplus.runs.fleet.recordings import find_recordings, holds_recordings
from boxplus.sensors.lidar.scan import Scan
from tests.bags import PERIOD_NS, Container, Content, write_bag


class Later(Content):
    """A recording that begins some scans later than others."""

    def __init__(self, first: int, scans: int) -> None:
        super().__init__(scans=scans, with_imu=False)
        self.first = first

    def stamp_ns(self, index: int) -> int:
        return super().stamp_ns(index) + self.first * PERIOD_NS


def write_part(folder: Path, name: str, first: int, scans: int, container: Container = "mcap") -> Path:
    """A file as a recorder leaves it, without metadata.yaml; its first scan is number `first` of all."""
    scratch = folder.with_name(f"scratch_{name}")
    scratch.mkdir(parents=True)
    folder.mkdir(exist_ok=True)
    content = Later(first, scans)
    written = next(file for file in write_bag(scratch, container, content).iterdir() if file.suffix in (".mcap", ".db3"))
    target = folder / f"{name}{written.suffix}"
    shutil.move(written, target)
    shutil.rmtree(scratch)
    return target


def starts(path: Path) -> list[int]:
    with open_recording(path, RecordingOptions(imu_topic="none")) as recording:
        return [event.start_ns for event in recording if isinstance(event, Scan)]


@pytest.mark.parametrize("container", ["mcap", "sqlite3"])
def test_parts_of_an_interrupted_recording_are_read_as_one(tmp_path: Path, container: Container) -> None:
    """Twelve of them: part 10 comes after part 9, not after part 1."""
    folder = tmp_path / "flight"
    for part in range(12):
        write_part(folder, f"flight_{part}", 3 * part, 3, container)
    times = starts(folder)
    assert len(times) == 36 and times == sorted(times)
    assert not holds_recordings(folder) and list(find_recordings(folder)) == ["flight"]
    assert list(find_recordings(tmp_path)) == ["flight"]


@pytest.mark.parametrize(
    ("names", "firsts"),
    [(("day_1", "day_2"), (0, 900)), (("monday", "tuesday"), (0, 3)), (("robot_0", "robot_1"), (0, 0)), (("a_0", "a_2"), (0, 3))],
    ids=["a gap between", "other names", "at the same time", "a part is missing"],
)
def test_what_does_not_follow_is_several(tmp_path: Path, names: tuple[str, str], firsts: tuple[int, int]) -> None:
    folder = tmp_path / "days"
    for name, first in zip(names, firsts, strict=True):
        write_part(folder, name, first, 30 if firsts[1] == 0 else 3)
    assert [[file.stem for file in files] for files in recordings_among(bag_files(folder))] == [[names[0]], [names[1]]]
    assert holds_recordings(folder) and list(find_recordings(folder)) == list(names)
    with pytest.raises(
        RecordingError,
        match=rf"2 recordings: {names[1]}.mcap does not go on .* 'ros2 bag reindex' .* take all",
    ):
        open_recording(folder)


def test_a_part_without_an_index_goes_on_all_the_same(tmp_path: Path) -> None:
    """What an empty battery leaves: the last part ends in the middle, and nobody wrote metadata.yaml."""
    folder = tmp_path / "flight"
    write_part(folder, "flight_0", 0, 4)
    last = write_part(folder, "flight_1", 4, 40)
    whole = last.read_bytes()
    last.write_bytes(whole[: len(whole) * 2 // 3])
    assert not holds_recordings(folder)
    with open_recording(folder, RecordingOptions(imu_topic="none")) as recording:
        assert sum(isinstance(event, Scan) for event in recording) >= 4


def test_one_file_among_other_recordings_is_one_of_several(tmp_path: Path) -> None:
    write_part(tmp_path / "days", "monday", 0, 3)
    assert not holds_recordings(tmp_path / "days")
    (tmp_path / "days" / "tuesday").mkdir()
    (tmp_path / "days" / "tuesday" / "metadata.yaml").touch()
    assert list(find_recordings(tmp_path / "days")) == ["monday", "tuesday"] and holds_recordings(tmp_path / "days")


@pytest.mark.parametrize("container", ["mcap", "sqlite3"])
def test_an_empty_part_goes_on_by_its_name(tmp_path: Path, container: Container) -> None:
    """A recorder that is stopped just after it began the next file; the one after that follows the last message."""
    folder = tmp_path / "flight"
    for name, first, scans in (("flight_0", 0, 3), ("flight_1", 3, 0), ("flight_2", 3, 3), ("flight_3", 6, 0)):
        write_part(folder, name, first, scans, container)
    assert len(recordings_among(bag_files(folder))) == 1
    times = starts(folder)
    assert len(times) == 6 and times == sorted(times)
