"""Several LiDARs in one recording: how the others are read, where they lie, and their scans merged with those of the first."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from boxplus.errors import RecordingError
from boxplus.recordings.bags.container import Container
from boxplus.recordings.bags.probe import find_out, static_chain
from boxplus.recordings.info import Evidence, OtherLidarInfo, RecordingInfo
from boxplus.recordings.options import OtherLidar, RecordingOptions
from boxplus.recordings.recording import Event, Tally
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.lidar.scan_merger import ScanMerger

LidarEvent = tuple[int, Scan] | ImuSamples
"""A scan with the number of its LiDAR, 0 the first one, or samples of the IMU."""

_APART_S, _DOUBTFUL_S = 1.0, 0.15
_ITS_OWN = ("lidar_topic", "point_time_field", "point_time_unit", "point_time_reference")


def find_out_all(path: Path, container: Container, options: RecordingOptions) -> RecordingInfo:
    """How the recording is read, the other LiDARs included.

    Raises:
        RecordingError, AmbiguityError: as `find_out`, of each LiDAR; the pose of one is not known, or its clock is another.
    """
    info = find_out(path, container, options)
    for other in options.other_lidars or ():
        found = _found(path, container, options, other)
        info.evidence += [
            replace(e, key=f"{e.key} of {other.topic}") for e in found.evidence if e.key in _ITS_OWN and e.key != "lidar_topic"
        ]
        info.other_lidars.append(_placed(container, info, found, other))
        info.message_count += info.other_lidars[-1].messages
    return info


def _found(path: Path, container: Container, options: RecordingOptions, other: OtherLidar) -> RecordingInfo:
    """How the LiDAR would be read alone; what is refused names it."""
    try:
        return find_out(path, container, options.alone(other))
    except RecordingError as error:
        advice = f"{error.advice}; options of {other.topic} are keys of --other-lidars '{{topic: {other.topic}, …}}'"
        raise type(error)(f"{error.expected}, of {other.topic}", error.got, advice) from error


def _placed(container: Container, info: RecordingInfo, found: RecordingInfo, other: OtherLidar) -> OtherLidarInfo:
    """Where the LiDAR lies and how its clock goes, with the evidence."""
    key, first = f"T_lidar_other of {other.topic}", info.lidar_topic
    if other.T_lidar_other is not None:
        T, source, disagreement = np.array(other.T_lidar_other), "given", ""
    else:
        same = info.lidar_frame == found.lidar_frame
        chained = None if same else static_chain(container, [], info.lidar_frame, found.lidar_frame)
        if chained is None:
            what = "both name the frame" if same else "the static transforms do not connect"
            names = repr(info.lidar_frame) if same else f"{info.lidar_frame!r} and {found.lidar_frame!r}"
            raise RecordingError(
                f"the pose of {other.topic} in the frame of {first}",
                f"{what} {names}",
                f"give it: --other-lidars '{{topic: {other.topic}, T_lidar_other: [[…], …]}}' (docs/several_lidars.md)",
            )
        T, disagreement = chained.T_target_source, chained.disagreement
        source = f"static transforms {' ← '.join(chained.way)}"
    text = f"{source}; held while running" + (f"; {disagreement}: give T_lidar_other" if disagreement else "")
    how = "given" if source == "given" else "static transforms"
    info.evidence.append(Evidence(key, how, "warning" if disagreement else "ok", text))
    apart = found.stamp_delay_s - other.time_offset_s - info.stamp_delay_s
    text = f"clouds of {other.topic} arrive {apart:+.3f} s after their stamps, compared with those of {first}"
    if abs(apart) >= _APART_S:
        raise RecordingError(
            f"one clock for {first} and {other.topic}",
            text,
            f"synchronise them, or give time_offset_s of {other.topic}: about {apart + other.time_offset_s:+.3f} s",
        )
    doubt = "; a difference of the clocks of that size would smear the map: 'boxplus inspect' measures it"
    if abs(apart) < _DOUBTFUL_S:
        info.evidence.append(Evidence(f"clock of {other.topic}", "one", "ok", text))
    else:
        info.evidence.append(Evidence(f"clock of {other.topic}", "doubtful", "warning", text + doubt))
    messages = next(topic.count for topic in info.topics if topic.name == other.topic)
    share = info.message_count / max(1, sum(topic.count for topic in info.topics if topic.name in (first, info.imu_topic)))
    return OtherLidarInfo(
        other.topic, found.lidar_frame, found.point_time, T, source, other.time_offset_s, round(messages * min(share, 1.0))
    )


def merged_events(events: Iterable[LidarEvent], info: RecordingInfo, tally: Tally) -> Iterator[Event]:
    """The events with the scans of all LiDARs merged, in the frame of the first; what cannot be merged is counted."""
    names = [info.lidar_topic, *(other.topic for other in info.other_lidars)]
    poses = [np.eye(4), *(other.T_lidar_other for other in info.other_lidars)]
    offsets_ns = [0, *(round(other.time_offset_s * 1e9) for other in info.other_lidars)]
    merger = tally.merger = ScanMerger(names, poses, tally.rejected)
    for event in events:
        if isinstance(event, ImuSamples):
            if len(event):
                merger.saw_imu(int(event.time_ns[-1]))
            yield event
            continue
        lidar, scan = event
        yield from merger.add(lidar, scan.shifted(offsets_ns[lidar]) if offsets_ns[lidar] else scan)
    yield from merger.flush()
