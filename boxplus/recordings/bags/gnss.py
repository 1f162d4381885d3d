"""Positions by satellite in bags: which topic they are on, and all of them."""

from __future__ import annotations

import numpy as np

from boxplus.errors import RecordingError
from boxplus.recordings.bags.container import Channel, Container
from boxplus.recordings.bags.messages import MalformedMessageError, parse_nav_sat_fix
from boxplus.recordings.bags.transforms import Transform, chain
from boxplus.recordings.info import Evidence
from boxplus.recordings.options import ANY_GNSS, NO_GNSS
from boxplus.sensors.satellites.gnss import GnssFixes

NAV_SAT_FIX = "sensor_msgs/NavSatFix"
_FEW = 5  # messages looked at for the name of the antenna's frame


def choose_gnss(channels: list[Channel], wanted: str) -> tuple[Channel | None, list[Evidence]]:
    """The stream of positions in use, and what to say about it; nothing where there is none.

    Raises:
        RecordingError: a topic was named that has no positions.
    """
    found = [channel for channel in channels if channel.type == NAV_SAT_FIX]
    listed = ", ".join(f"{channel.topic} ({channel.count})" for channel in found) or "none"
    if wanted == NO_GNSS:
        return None, []
    if wanted != ANY_GNSS:
        named = [channel for channel in found if channel.topic == wanted]
        if not named:
            raise RecordingError(f"positions ({NAV_SAT_FIX}) on {wanted}", f"those on {listed}", "choose another --gnss-topic")
        return named[0], [Evidence("gnss_topic", wanted, "ok", f"{NAV_SAT_FIX}, {named[0].count} messages; given")]
    if not found:
        return None, []
    if len(found) > 1:
        text = f"several topics have positions by satellite, none of them is used: {listed}; choose one with --gnss-topic"
        return None, [Evidence("gnss_topic", "ambiguous", "warning", text)]
    text = f"{NAV_SAT_FIX}, {found[0].count} messages; the only one of its kind"
    return found[0], [Evidence("gnss_topic", found[0].topic, "ok", text)]


def antenna_of(
    container: Container, gnss: Channel, transforms: list[Transform], imu_frame: str
) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.float64]] | None, Evidence]:
    """Position (3,) of the antenna in the IMU's frame [m], where static transforms connect the two; None where not."""
    frame = ""
    for number, (_, _, data) in enumerate(container.messages(frozenset((gnss.topic,)), container.start_ns, container.end_ns + 1)):
        try:
            frame = parse_nav_sat_fix(data, gnss.encoding)[1]
            break
        except MalformedMessageError:
            if number >= _FEW:
                break
    found = None if not frame or frame == imu_frame else chain(transforms, imu_frame, frame)
    key = "p_imu_antenna"
    if found is None:
        text = f"no static transforms from {imu_frame!r} to the antenna's frame {frame!r}: 'boxplus slam' has --gnss-lever-arm"
        return None, Evidence(key, "unknown", "warning", text)
    T, way, disagreement = found
    value = ", ".join(f"{x:.3f}" for x in T[:3, 3])
    text = f"in the IMU frame, by static transforms {' ← '.join(way)}"
    if disagreement:
        return T[:3, 3].copy(), Evidence(key, f"{value} m", "warning", f"{text}; {disagreement}: check --gnss-lever-arm")
    return T[:3, 3].copy(), Evidence(key, f"{value} m", "ok", text)


def bag_fixes(container: Container, topic: str, start_ns: int, stop_ns: int) -> GnssFixes:
    """All positions on a topic that were received in [start_ns, stop_ns)."""
    times, positions, covariances, states = [], [], [], []
    malformed = 0
    for channel, _, data in container.messages(frozenset((topic,)), start_ns, stop_ns):
        try:
            stamp_ns, _, status, position, covariance, kind = parse_nav_sat_fix(data, channel.encoding)
        except MalformedMessageError:
            malformed += 1
            continue
        times.append(stamp_ns)
        positions.append(position)
        covariances.append(covariance if kind else (np.nan,) * 9)
        states.append(status)
    fixes = GnssFixes.from_arrays(
        np.array(times, np.int64), np.array(positions).reshape(-1, 3), np.array(covariances).reshape(-1, 3, 3), np.array(states)
    )
    if malformed:
        fixes.rejected["malformed message"] = malformed
    return fixes
