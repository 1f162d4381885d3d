"""Positions by satellite of a recording, whatever else is in it: for comparisons with a trajectory."""

from __future__ import annotations

from pathlib import Path

from boxplus.errors import AmbiguityError, RecordingError
from boxplus.recordings.bags.gnss import NAV_SAT_FIX, bag_fixes
from boxplus.recordings.bags.open_container import open_container
from boxplus.recordings.kitti import sensor_files
from boxplus.recordings.kitti_oxts import oxts_fixes
from boxplus.recordings.options import ANY_GNSS
from boxplus.sensors.satellites.gnss import GnssFixes

_FILES = (".bag", ".mcap", ".db3")


def holds_fixes(path: Path) -> bool:
    """Whether a path is of a kind that positions by satellite are read from, and trajectories are not."""
    return path.is_dir() or path.suffix.lower() in _FILES


def read_fixes(path: str | Path, topic: str = ANY_GNSS) -> GnssFixes:
    """All positions of a bag, a KITTI raw folder or its folder `oxts`.

    Raises:
        RecordingError: no such file, or it has no positions (on that topic).
        AmbiguityError: several topics have some, and none is named.
    """
    path = Path(path)
    if not path.exists():
        raise RecordingError("a recording", f"no file or folder {path}", "check the path")
    for folder in (path / "oxts", path):
        if folder.is_dir() and (folder / "timestamps.txt").is_file() and (folder / "data").is_dir():
            files = sensor_files(folder, ".txt")
            fixes = oxts_fixes(files.paths, files.time_ns)
            if files.untimed:
                fixes.rejected["data file without a time"] = files.untimed
            return fixes
    container = open_container(path)
    try:
        found = [channel for channel in container.channels if channel.type == NAV_SAT_FIX and channel.count]
        if not found:
            advice = "give the trajectory of another run or of the ground truth, or a recording with positions"
            raise RecordingError(f"positions by satellite ({NAV_SAT_FIX})", f"none in {path.resolve().name}", advice)
        listed = ", ".join(f"{channel.topic} ({channel.count})" for channel in found)
        chosen = [channel for channel in found if topic in (ANY_GNSS, channel.topic)]
        if not chosen:
            raise RecordingError(f"positions ({NAV_SAT_FIX})", f"those on {listed} in {path.name}", "name one with --gnss-topic")
        if len(chosen) > 1:
            raise AmbiguityError("one topic with positions", f"several: {listed}", "choose one with --gnss-topic")
        return bag_fixes(container, chosen[0].topic, container.start_ns, container.end_ns + 1)
    finally:
        container.close()
