"""Which container a recording's file or folder is."""

from __future__ import annotations

import logging
from pathlib import Path

from boxplus.errors import RecordingError
from boxplus.recordings.bags.bounded_readers import KNOWN_ROSBAGS, UnknownRosbagsError
from boxplus.recordings.bags.container import READ_ERRORS, Container
from boxplus.recordings.bags.indexed import IndexedContainer, rosbags_errors
from boxplus.recordings.bags.parts import bag_files, is_compressed, is_described, recordings_among
from boxplus.recordings.bags.sequential import begins_like_a_bag, open_sequential

_LOG = logging.getLogger(__name__)

_HEALTHY_ALL_THE_SAME = ("Profile is not ros2", "not supported", "metadata")
"""Why rosbags declines healthy files: ROS 1 in MCAP, and, in older versions, newer metadata and files without any."""


def open_container(path: Path) -> Container:
    """Open a bag, an MCAP file or a ROS 2 folder; one without a usable index is read from front to back.

    Raises:
        RecordingError: not such a file, a folder with several recordings, or nothing in it can be read.
    """
    files = _parts(path) if path.is_dir() and not is_described(path) else [path]
    try:
        return IndexedContainer(path, files)
    except READ_ERRORS + rosbags_errors() as error:
        reason = str(error) or type(error).__name__
        if isinstance(error, UnknownRosbagsError) and is_described(path) and is_compressed(path):
            raise RecordingError(
                "a version of rosbags that can be limited, for a folder whose messages or files are compressed",
                f"{path.name}: {reason}",
                f"install rosbags {KNOWN_ROSBAGS}",
            ) from error
    _LOG.info("%s has no usable index (%s): reading it from front to back", path, reason)
    if path.is_dir():
        files = bag_files(path)
    container = open_sequential(files)
    if container is None:
        if files and not any(map(begins_like_a_bag, files)):
            what = "which begins like none of them" if any(file.stat().st_size for file in files) else "which is empty"
            raise RecordingError(
                "a ROS 1 bag, an MCAP file or a ROS 2 database",
                f"{path.name}, {what}",
                "give the recording, or copy it again where this is it",
            )
        raise RecordingError(
            "a readable ROS bag or MCAP file",
            f"{path.name}: {reason}",
            "copy the recording again; nothing in this file can be read",
        )
    if container.damage or not any(benign in reason for benign in _HEALTHY_ALL_THE_SAME):
        container.damage.append(f"the index cannot be used ({reason}); the messages were collected from front to back")
    return container


def _parts(folder: Path) -> list[Path]:
    """The files of a folder that its recorder has not described, in order."""
    recordings = recordings_among(bag_files(folder))
    if not recordings:
        raise RecordingError(
            "a folder with .mcap or .db3 files (ROS 2), or with velodyne_points and oxts (KITTI raw)",
            f"{folder.resolve().name} with {', '.join(sorted(file.name for file in folder.iterdir())[:5]) or 'nothing in it'}",
            "give the folder that holds them; of ROS 1 bags give one file; folders of images are for 'boxplus vo' and 'vio' "
            "(open_camera_recording)",
        )
    if len(recordings) > 1:
        first, second = recordings[0][-1], recordings[1][0]
        raise RecordingError(
            "one recording: a folder with metadata.yaml, or with files NAME_0, NAME_1, … that follow each other without a gap",
            f"{folder.resolve().name} with {len(recordings)} recordings: {second.name} does not go on where {first.name} ends",
            "give one of the files; where they are one recording with a pause, let 'ros2 bag reindex' write metadata.yaml; of "
            "files that are a recording each 'boxplus lio' and 'boxplus fleet run' take all",
        )
    return recordings[0]
