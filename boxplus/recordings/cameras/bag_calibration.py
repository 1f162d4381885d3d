"""The calibration of cameras in a bag: what the bag itself says, and what a given camchain says of its topics."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras import CameraModel
from boxplus.recordings.bags.container import Channel, Container
from boxplus.recordings.bags.messages import MalformedMessageError, parse_transforms
from boxplus.recordings.bags.transforms import Transform, chain
from boxplus.recordings.cameras.calibration import THIS_IS_THE_BODY, StatedCamera, camera_model
from boxplus.recordings.cameras.messages import INFO_TYPE, InfoMessage, parse_camera_info

_TRANSFORM_TYPES = ("tf2_msgs/TFMessage", "tf/tfMessage")
_MOST_STATIC_MESSAGES = 1000


def plain_topic(topic: str) -> str:
    """The topic of the images without what image_transport appends to it."""
    for suffix in ("/compressed", "/compressedDepth"):
        topic = topic.removesuffix(suffix)
    return topic


def static_messages(container: Container, channels: list[Channel]) -> tuple[dict[str, InfoMessage], list[Transform]]:
    """The first CameraInfo of each topic, and all static transforms."""
    infos: dict[str, InfoMessage] = {}
    wanted = {channel.topic for channel in channels if channel.type == INFO_TYPE}
    for channel, _, data in container.messages(frozenset(wanted), container.start_ns, container.end_ns + 1):
        try:
            infos.setdefault(channel.topic, parse_camera_info(data, channel.encoding))
        except MalformedMessageError:
            continue
        if len(infos) == len(wanted):
            break
    transforms: list[Transform] = []
    static = frozenset(c.topic for c in channels if c.type in _TRANSFORM_TYPES and c.topic.endswith("tf_static"))
    if static:
        for number, (channel, _, data) in enumerate(container.messages(static, container.start_ns, container.end_ns + 1)):
            if number >= _MOST_STATIC_MESSAGES:
                break
            try:
                transforms += parse_transforms(data, channel.encoding)
            except MalformedMessageError:
                continue
    return infos, transforms


def by_topic(rig: Mapping[str, StatedCamera], topic: str) -> StatedCamera | None:
    return next((camera for camera in rig.values() if camera.topic and plain_topic(camera.topic) == plain_topic(topic)), None)


def given_for(topic: str, rig: Mapping[str, StatedCamera], source: str) -> list[StatedCamera]:
    """What a given camchain says of this topic, by its `rostopic`."""
    if not rig:
        return []
    found = by_topic(rig, topic)
    if found is not None:
        return [found]
    why = f"{source} names no camera with the rostopic {plain_topic(topic)}"
    return [StatedCamera(source, missing={"model": why, "T_body_camera": why})]


def stated_in_bag(
    topic: str,
    frame: str,
    infos: Mapping[str, InfoMessage],
    transforms: list[Transform],
    body_frame: str,
    is_body: bool,
) -> StatedCamera:
    """What the bag itself says: the CameraInfo beside the images, and the static transforms.

    Args:
        topic, frame: of the images.
        infos, transforms: as `static_messages` found them.
        body_frame: frame of the IMU, or of the first camera where there is no IMU.
        is_body: this is that first camera.
    """
    missing: dict[str, str] = {}
    plain = plain_topic(topic)
    info_topic = f"{plain.rpartition('/')[0]}/camera_info"
    rectified = "rect" in plain.rpartition("/")[2]
    info = infos.get(info_topic)
    model = None
    if info is None:
        missing["model"] = f"no CameraInfo on {info_topic}"
    else:
        model, why = _model(info, rectified)
        if model is None:
            missing["model"] = f"{info_topic}: {why}"
    T_body_camera, mounting_source, mounting_doubt = None, "", ""
    if is_body:
        T_body_camera, mounting_source = np.eye(4), THIS_IS_THE_BODY
    elif frame == body_frame:
        missing["T_body_camera"] = f"{plain} and the body both name the frame {frame!r}, which says nothing about the mounting"
    elif (connected := chain(transforms, body_frame, frame)) is not None:
        T_body_camera, mounting_doubt = connected.T_target_source, connected.disagreement
        mounting_source = f"static transforms {' ← '.join(connected.way)}"
    else:
        what = "do not connect" if transforms else "are not in the recording, which would have to connect"
        missing["T_body_camera"] = f"static transforms {what} {body_frame!r} and {frame!r}"
    if T_body_camera is not None and rectified:
        T_body_camera = _rectified(T_body_camera, info)
        if T_body_camera is None:
            missing["T_body_camera"] = f"the images are rectified, and {info_topic} does not say by which rotation R"
    size = None if info is None else (info.width, info.height)
    return StatedCamera(info_topic, model, size, T_body_camera, None, topic, mounting_source, missing, None, mounting_doubt)


def _model(info: InfoMessage, rectified: bool) -> tuple[CameraModel | None, str]:
    """The model of the images a CameraInfo stands beside, or None and why there is none."""
    if info.part:
        return None, "it is of a binned image or of a part of one"
    if not info.K[0] > 0.0 or (rectified and not info.P[0] > 0.0):
        return None, "it is not calibrated (fx is zero)"
    if rectified:
        return camera_model("pinhole", (info.P[0], info.P[5], info.P[2], info.P[6]), "none", ())
    return camera_model("pinhole", (info.K[0], info.K[4], info.K[2], info.K[5]), info.distortion, info.D)


def _rectified(T_body_camera: NDArray[np.float64], info: InfoMessage | None) -> NDArray[np.float64] | None:
    """The mounting of the camera that would see the rectified image: it is turned by R, and the header does not say so."""
    if info is None:
        return None
    R = np.array(info.R).reshape(3, 3)
    if not (np.abs(R @ R.T - np.eye(3)).max() < 1e-3 and np.linalg.det(R) > 0.0):
        return None
    turned = T_body_camera.copy()
    turned[:3, :3] = turned[:3, :3] @ R.T
    return turned
