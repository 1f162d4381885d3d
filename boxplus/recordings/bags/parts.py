"""Which files of a folder are one recording: a ROS 2 recorder splits what it writes into NAME_0.mcap, NAME_1.mcap and so on.

With a `metadata.yaml` the folder is one recording, as that file says. It is written last, though, and missing after an
interruption. Without it files are parts of one recording where their names say so and each begins when the one before ends;
all others are recordings of their own.

Source: docs.ros.org, rosbag2, "Splitting files during recording".
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from contextlib import closing, suppress
from pathlib import Path
from typing import NamedTuple

from boxplus.recordings.bags.container import READ_ERRORS
from boxplus.recordings.bags.indexed import IndexedContainer, rosbags_errors
from boxplus.recordings.bags.sequential import first_time_ns

SUFFIXES = (".mcap", ".db3")
_NUMBERED = re.compile(r"(.+)_(\d+)")
_SEAM_NS = 2_000_000_000  # a recorder begins the next file with the next message


def bag_files(folder: Path) -> list[Path]:
    """MCAP and SQLite files in a folder, part 10 after part 9."""
    return sorted((file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and file.is_file()), key=_order)


def is_described(folder: Path) -> bool:
    """Whether the recorder has left its `metadata.yaml`: the folder is one recording."""
    return (folder / "metadata.yaml").is_file()


def is_compressed(folder: Path) -> bool:
    """Whether `metadata.yaml` says that messages, or files as a whole, are compressed."""
    text = (folder / "metadata.yaml").read_text("utf-8", errors="replace")
    return re.search(r"compression_mode: *['\"]?(message|file)\b", text, re.IGNORECASE) is not None


def recordings_among(files: Iterable[Path]) -> list[list[Path]]:
    """Files by recording, the parts of each in order."""
    found: list[list[Path]] = []
    ends: int | None = None  # of the last part that says so
    for file in sorted(files, key=_order):
        times = _times(file) if _numbered(file)[1] >= 0 else _UNKNOWN
        if found and _is_next(found[-1][-1], file) and _goes_on(ends, times):
            found[-1].append(file)
            ends = times.end_ns if times.end_ns is not None else ends
        else:
            found.append([file])
            ends = times.end_ns
    return found


def _order(file: Path) -> tuple[str, str, int, str]:
    name, number = _numbered(file)
    return file.suffix.lower(), name, number, file.name


def _numbered(file: Path) -> tuple[str, int]:
    match = _NUMBERED.fullmatch(file.stem)
    return (match[1], int(match[2])) if match else (file.stem, -1)


def _is_next(before: Path, file: Path) -> bool:
    """Whether a file is the next part after another one by its name."""
    (name, number), (next_name, next_number) = _numbered(before), _numbered(file)
    return number >= 0 and before.suffix == file.suffix and (next_name, next_number) == (name, number + 1)


class _Times(NamedTuple):
    """First and last reception time [ns] of a file; None where they cannot be read, or where no message is in it."""

    begin_ns: int | None
    end_ns: int | None


_UNKNOWN = _Times(None, None)


def _goes_on(ends_ns: int | None, times: _Times) -> bool:
    """Whether a part begins where the ones before it end; its name alone says so where the times are not known."""
    return ends_ns is None or times.begin_ns is None or abs(times.begin_ns - ends_ns) <= _SEAM_NS


def _times(file: Path) -> _Times:
    """By the index; the first one from the file itself, where it has none."""
    with suppress(*READ_ERRORS, *rosbags_errors()), closing(IndexedContainer(file, [file])) as container:
        is_empty = container.start_ns > container.end_ns  # an interrupted recorder may have begun a file and no more
        return _UNKNOWN if is_empty else _Times(container.start_ns, container.end_ns)
    return _Times(first_time_ns(file), None)
