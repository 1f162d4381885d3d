"""The recordings of a fleet: a folder of them, or a list in a file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from boxplus.errors import InputError
from boxplus.recordings.bags.parts import SUFFIXES, bag_files, is_described, recordings_among

_SUFFIXES = (".bag", *SUFFIXES, ".pcap", ".pcapng")
_LISTS = (".txt", ".list")


def find_recordings(path: str | Path) -> dict[str, Path]:
    """Recordings by name, in order: those in a folder, or those that the lines of a text file name.

    A folder with `metadata.yaml`, or with nothing but the parts of one recording, NAME_0, NAME_1, …, that follow each other
    without a gap, is one recording, as it is to `open_recording`; any other one holds as many as it has files and folders of
    recordings.
    Lines are paths, relative ones to the file; empty ones and those that begin with # are left out. Names are those of the files,
    with a number where two are alike.

    Raises:
        InputError: no such folder or file, none in it, one that is not there or is named twice, parts of one beside others, or a
            URL.
    """
    base = Path(path)
    if base.is_dir():
        found = _entries(base)
        advice = f"put bags, MCAP files, captures ({', '.join(_SUFFIXES)}) or folders of ROS 2 or KITTI into it, or give a list"
        if not found:
            raise InputError("a folder with recordings", f"none in {base}", advice)
    elif base.is_file() and base.suffix.lower() in _LISTS:
        lines = [line.strip() for line in base.read_text(encoding="utf-8").splitlines()]
        lines = [line for line in lines if line and not line.startswith("#")]
        if urls := [line for line in lines if "://" in line]:
            raise InputError(
                "paths that every worker can read", urls[0], "mount the store, or copy the recordings to a shared folder"
            )
        found = [(base.parent / line) for line in lines]
        if missing := [entry for entry in found if not entry.exists()]:
            raise InputError(f"recordings that {base} names", f"nothing at {missing[0]}", "correct the list")
        if not found:
            raise InputError("a list of recordings, one a line", f"none in {base}", "write paths into it")
        if again := [entry for entry, times in Counter(entry.resolve() for entry in found).items() if times > 1]:
            raise InputError("every recording once", f"{again[0]} twice in {base}", "leave one out: it would count twice")
    else:
        got, advice = f"nothing at {base}", "check the path"
        if base.exists():
            got = f"the file {base}"
            advice = "give the folder that it is in, or a .txt file with one path a line; for one recording run 'boxplus slam'"
        raise InputError("a folder with recordings, or a list in a .txt file", got, advice)
    return named(found)


def holds_recordings(path: str | Path) -> bool:
    """Whether it is a folder of recordings, and no recording itself to `open_recording`."""
    folder = Path(path)
    return folder.is_dir() and not is_recording(folder) and any(map(is_recording, folder.iterdir()))


def named(recordings: Iterable[Path]) -> dict[str, Path]:
    """Recordings by the names of their files or folders, with a number where two are alike."""
    found: dict[str, Path] = {}
    for entry in recordings:
        stem, number = entry.name if entry.is_dir() else entry.stem, 1
        name = stem
        while name in found:
            number += 1
            name = f"{stem}_{number}"
        found[name] = entry.resolve()
    return found


def is_recording(entry: Path) -> bool:
    """Whether `open_recording` takes a file or folder, by its name or what is in it."""
    if not entry.is_dir():
        return entry.suffix.lower() in _SUFFIXES
    return is_described(entry) or (entry / "velodyne_points").is_dir() or _is_undescribed(entry)


def _is_undescribed(folder: Path) -> bool:
    """Whether an interrupted recorder has left the parts of one recording there, and there is no other one beside them."""
    parts = bag_files(folder)
    others = (entry for entry in folder.iterdir() if entry not in parts and is_recording(entry))
    return bool(parts) and not any(others) and len(recordings_among(parts)) == 1


def _entries(folder: Path) -> list[Path]:
    """The recordings in a folder, or itself."""
    if is_recording(folder):
        return [folder]
    for parts in recordings_among(bag_files(folder)):
        if len(parts) > 1:
            raise InputError(
                "recordings of one file each, or in a folder of their own",
                f"{len(parts)} parts of one, {parts[0].name} to {parts[-1].name}, beside others in {folder}",
                "put them into a folder of their own; where all are one with a pause, let 'ros2 bag reindex' write metadata.yaml",
            )
    return sorted(entry for entry in folder.iterdir() if is_recording(entry))
