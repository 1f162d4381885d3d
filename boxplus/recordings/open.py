"""Which reader a file or folder goes to."""

from __future__ import annotations

from pathlib import Path

from boxplus._arguments import as_path, as_settings
from boxplus.errors import RecordingError
from boxplus.recordings.bags.bag import open_bag
from boxplus.recordings.kitti import open_kitti
from boxplus.recordings.options import RecordingOptions
from boxplus.recordings.pcap import open_pcap
from boxplus.recordings.recording import Recording


def open_recording(path: str | Path, options: RecordingOptions | None = None) -> Recording:
    """Open a recording: a ROS 1 bag, a ROS 2 folder or file, a KITTI raw folder, or a vendor's pcap.

    The format is found from the content, topics, times and units from the first seconds of data; `info.evidence` says how.

    Args:
        path: file or folder.
        options: what is decided by the user; the rest is found.

    Raises:
        RecordingError: no such file, unknown format, missing topics or point times, unreadable.
        AmbiguityError: two readings fit; the message names the option that decides.

    Example:
        >>> with bp.open_recording("flight.bag") as recording:
        ...     scans = sum(isinstance(event, bp.Scan) for event in recording)
        ...     print(recording.info.format, recording.info.point_time.unit, scans)
        ROS 1 bag s 19
    """
    options = as_settings(RecordingOptions, options)
    recording = _open(as_path(path, "a recording"), options)
    if options.lidar_time_offset_s:
        recording.shift_lidar(options.lidar_time_offset_s)
    return recording


def _open(path: Path, options: RecordingOptions) -> Recording:
    if not path.exists():
        raise RecordingError("a recording", f"no file or folder {path}", "check the path")
    kitti = path.is_dir() and (path / "velodyne_points").is_dir()
    if options.other_lidars and (kitti or path.suffix.lower() in (".pcap", ".pcapng")):
        raise RecordingError(
            "a bag (ROS 1, ROS 2, MCAP) for several LiDARs", f"{path.name}", "leave other_lidars out, or convert it to a bag"
        )
    if kitti:
        return open_kitti(path, options)
    if path.suffix.lower() in (".pcap", ".pcapng"):
        return open_pcap(path, options)
    if path.is_dir() or path.suffix.lower() in (".bag", ".mcap", ".db3", ".active"):
        return open_bag(path, options)
    raise RecordingError(
        "a ROS 1 bag (.bag), a ROS 2 folder or file (.mcap, .db3), a KITTI raw folder (velodyne_points/, oxts/) or a pcap",
        f"{path.name}",
        "convert the recording, or push arrays from Python; recordings of cameras alone are for 'boxplus vo' and 'vio' "
        "(open_camera_recording)",
    )
