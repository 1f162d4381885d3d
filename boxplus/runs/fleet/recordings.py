"""The recordings of a fleet: a folder of them, or a list in a file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from boxplus.errors import InputError

_PARTS = (".mcap", ".db3")
_SUFFIXES = (".bag", *_PARTS, ".pcap", ".pcapng")
_LISTS = (".txt", ".list")


def find_recordings(path: str | Path) -> dict[str, Path]:
    """Recordings by name, in order: those in a folder, or those that the lines of a text file name.

    Lines are paths, relative ones to the file; empty ones and those that begin with # are left out. Names are those of the files,
    with a number where two are alike.

    Raises:
        InputError: no such folder or file, none in it, one that is not there, or a URL.
    """
    base = Path(path)
    if base.is_dir():
        found = sorted(entry for entry in base.iterdir() if _is_recording(entry))
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
    else:
        raise InputError("a folder with recordings, or a list in a .txt file", f"{base}", "check the path")
    return named(found)


def holds_recordings(path: str | Path) -> bool:
    """Whether it is a folder of recordings, and no recording itself to `open_recording`."""
    folder = Path(path)
    if not folder.is_dir() or _is_recording(folder):
        return False
    # Parts of a ROS 2 bag without metadata.yaml are one recording to the readers, and stay one.
    loose = {entry.suffix.lower() for entry in folder.iterdir() if entry.is_file() and _is_recording(entry)}
    return any(map(_is_recording, folder.iterdir())) and not (loose and loose <= set(_PARTS))


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


def _is_recording(entry: Path) -> bool:
    if entry.is_dir():
        return (entry / "metadata.yaml").is_file() or (entry / "velodyne_points").is_dir()
    return entry.suffix.lower() in _SUFFIXES
