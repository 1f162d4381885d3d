"""Which reader a camera recording goes to."""

from __future__ import annotations

from pathlib import Path

from boxplus._arguments import as_path, as_settings
from boxplus.errors import RecordingError
from boxplus.recordings.bags.open_container import open_container
from boxplus.recordings.bags.probe import CLOUD_PARSERS
from boxplus.recordings.cameras.bag import open_camera_bag
from boxplus.recordings.cameras.bag_probe import IMAGE_PARSERS
from boxplus.recordings.cameras.events import CameraRecording
from boxplus.recordings.cameras.folders.euroc import is_euroc, open_euroc
from boxplus.recordings.cameras.folders.kitti_raw import is_kitti_raw, open_kitti_raw
from boxplus.recordings.cameras.folders.numbered import is_kitti_odometry, is_seven_scenes, open_kitti_odometry, open_seven_scenes
from boxplus.recordings.cameras.folders.tum import is_tum, open_tum
from boxplus.recordings.cameras.options import CameraRecordingOptions


def has_cameras_only(path: Path) -> bool:
    """Whether this is a recording of cameras in which no LiDAR is found, as far as can be told without reading images."""
    if path.is_dir() and (is_euroc(path) or is_tum(path) or is_kitti_odometry(path) or is_seven_scenes(path)):
        return True
    if path.is_dir() and is_kitti_raw(path):
        return not (path / "velodyne_points").is_dir()
    try:
        container = open_container(path)
    except (RecordingError, OSError):
        return False
    kinds = {channel.type for channel in container.channels if channel.count}
    container.close()
    return bool(kinds & set(IMAGE_PARSERS)) and not kinds & set(CLOUD_PARSERS)


def has_no_imu(path: Path) -> bool:
    """Whether this is a folder of a format that has no place for an IMU; told without reading it."""
    return (
        path.is_dir()
        and not (is_euroc(path) or is_tum(path) or is_kitti_raw(path))
        and (is_kitti_odometry(path) or is_seven_scenes(path))
    )


def open_camera_recording(path: str | Path, options: CameraRecordingOptions | None = None) -> CameraRecording:
    """Open a recording of cameras: a bag, a folder of EuRoC, TUM RGB-D, KITTI (raw or odometry) or 7-Scenes.

    The format is found from the content. Calibration is taken from the recording and from `options.calibration`; the source
    of each number is in `info`, and what is not known is None there, with the reason, never guessed.

    Args:
        path: file or folder.
        options: what is decided by the user; the rest is found.

    Raises:
        RecordingError: no such file, unknown format, no images, OpenCV is needed and not installed, unreadable.
        AmbiguityError: two readings fit; the message names the option that decides.

    Example:
        >>> with bp.open_camera_recording("room_stereo") as recording:  # a EuRoC folder
        ...     images = [event for event in recording if isinstance(event, bp.CameraImage)]
        ...     print(len(recording.info.cameras), len(images), images[0].grey().dtype)
        2 8 uint8
    """
    options = as_settings(CameraRecordingOptions, options)
    path = as_path(path, "a recording")
    if not path.exists():
        raise RecordingError("a recording", f"no file or folder {path}", "check the path")
    if path.is_dir() and is_euroc(path):
        return open_euroc(path, options)
    if path.is_dir() and is_tum(path):
        return open_tum(path, options)
    if path.is_dir() and is_kitti_raw(path):
        return open_kitti_raw(path, options)
    if path.is_dir() and is_kitti_odometry(path):
        return open_kitti_odometry(path, options)
    if path.is_dir() and is_seven_scenes(path):
        return open_seven_scenes(path, options)
    if path.suffix.lower() in (".bag", ".mcap", ".db3", ".active") or (
        path.is_dir() and any(file.suffix in (".mcap", ".db3") for file in path.iterdir())
    ):
        return open_camera_bag(path, options)
    raise RecordingError(
        "a ROS bag or MCAP, a EuRoC folder (mav0/cam0), a folder with cam0/<time [ns]>.png, a TUM RGB-D folder (rgb.txt), a "
        "KITTI raw drive (image_00/data, image_00/timestamps.txt), a KITTI odometry sequence (image_0, calib.txt), or a "
        "7-Scenes sequence (frame-000000.color.png)",
        f"{path.resolve().name}",
        "convert the recording",
    )
