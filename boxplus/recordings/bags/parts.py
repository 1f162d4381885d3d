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


def recordings_among(files: Iterable[Path]) -> list[list[Path]]:
    """Files by recording, the parts of each in order."""
    found: list[list[Path]] = []
    for file in sorted(files, key=_order):
        if found and _goes_on(found[-1][-1], file):
            found[-1].append(file)
        else:
            found.append([file])
    return found


def _order(file: Path) -> tuple[str, str, int, str]:
    name, number = _numbered(file)
    return file.suffix.lower(), name, number, file.name


def _numbered(file: Path) -> tuple[str, int]:
    match = _NUMBERED.fullmatch(file.stem)
    return (match[1], int(match[2])) if match else (file.stem, -1)


def _goes_on(before: Path, file: Path) -> bool:
    """Whether a file is the next part after another one; by its name alone where the times cannot be read."""
    (name, number), (next_name, next_number) = _numbered(before), _numbered(file)
    if number < 0 or before.suffix != file.suffix or (next_name, next_number) != (name, number + 1):
        return False
    ends, begins = _span(before), _span(file)
    begin = first_time_ns(file) if begins is None else begins[0]
    return ends is None or begin is None or abs(begin - ends[1]) <= _SEAM_NS


def _span(file: Path) -> tuple[int, int] | None:
    """First and last reception time [ns] by the index; None without one."""
    with suppress(*READ_ERRORS, *rosbags_errors()), closing(IndexedContainer(file, [file])) as container:
        return container.start_ns, container.end_ns
    return None
