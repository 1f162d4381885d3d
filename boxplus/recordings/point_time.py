"""Finding out in which unit, and from which instant, the times of the points count; and turning them into nanoseconds.

A scan takes about one scan period. The four units lie a factor of 1000 apart, so the span of a scan's times names the
unit; where the values lie relative to the message's stamp names the reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import AmbiguityError, RecordingError
from boxplus.recordings.info import Evidence, PointTimeReading
from boxplus.recordings.options import NO_POINT_TIME, RecordingOptions, TimeReference, TimeUnit

UNIT_NS: dict[TimeUnit, int] = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}

_SHORTEST_SPAN, _LONGEST_SPAN = 0.05, 1.5
"""A scan's times span this fraction of the scan period: a sector of a turn up to a scan that overlaps the next one."""
_LIKELY_PERIODS_S = (0.02, 0.5)
_FEWEST_POINTS = 100  # of a cloud, to tell that too many share a time
_FARTHEST_FROM_STAMP_NS = 10_000_000_000
_SAME_CLOCK_NS = 1_000_000_000
_STAMPED = 1e-3  # of a scan's duration: received with its stamp, as far as a recorder tells them apart
_A_SCAN = (0.9, 1.9)  # scans' durations after the stamp at which a message arrives whose stamp is the start
_EARLY_NS = 10_000_000  # that an IMU message may take longer than a scan to arrive
_QUICKEST = 0.05  # of the messages: where they arrive many at a time, all but the last have waited for it
_AT_ONCE = 0.15  # of the points of a scan: no LiDAR that sweeps measures as many at one instant, of 16 columns each has 0.06


@dataclass(frozen=True, slots=True)
class CloudTimes:
    """What detection needs of one cloud: its stamp, when it was received, and its time values (raw unit).

    Attributes:
        stamp_ns, received_ns: of its message.
        low, high: their extent.
        at_once: share of the points with the commonest of them; 0 where that is not known.
        commonest: it.
    """

    stamp_ns: int
    received_ns: int
    low: float | int
    high: float | int
    at_once: float = 0.0
    commonest: float | int = 0


def times_of_cloud(
    stamp_ns: int, received_ns: int, values: NDArray[np.generic], measured: NDArray[np.bool_] | None = None
) -> CloudTimes | None:
    """The time values (N,) of one cloud, or None when no value is finite.

    Args:
        stamp_ns, received_ns: of its message.
        values: as recorded.
        measured: (N,) which of them belong to a point that was measured: drivers leave 0 where there was none. None: all.
    """
    usable = np.isfinite(values) if values.dtype.kind == "f" else np.ones(len(values), bool)
    finite = values[usable]
    if not len(finite):
        return None
    low, high = finite.min().item(), finite.max().item()
    of_points = finite if measured is None else values[usable & measured]
    if len(of_points) < _FEWEST_POINTS:
        return CloudTimes(stamp_ns, received_ns, low, high)
    different, count = np.unique(of_points, return_counts=True)
    most = int(count.argmax())
    return CloudTimes(stamp_ns, received_ns, low, high, float(count[most] / len(of_points)), different[most].item())


def delay_ns(stamp_ns: Sequence[int], received_ns: Sequence[int]) -> float:
    """Time from the stamps of messages (N,) to their reception [ns]: of those that have not waited for others to be sent on."""
    return float(np.quantile(np.array(received_ns, np.int64) - np.array(stamp_ns, np.int64), _QUICKEST))


def choose_time_field(fields: tuple[str, ...], candidates: tuple[str, ...], options: RecordingOptions) -> str | None:
    """The field that holds the point times; None when the options say to do without.

    Raises:
        RecordingError: no such field.
        AmbiguityError: several.
    """
    listed = ", ".join(fields) or "none"
    if options.point_time_field == NO_POINT_TIME:
        return None
    if options.point_time_field is not None:
        if options.point_time_field not in fields:
            raise RecordingError(
                f"the point time field {options.point_time_field!r}",
                f"a cloud with the fields {listed}",
                "give --point-time-field one of these",
            )
        return options.point_time_field
    if not candidates:
        raise RecordingError(
            "a time for every point (a field such as t, time, timestamp or offset_time), to correct the scan for motion",
            f"a cloud with the fields {listed}",
            "switch point times on in the LiDAR driver; if one of these fields is the time give --point-time-field NAME; "
            "--point-time-field none treats each scan as taken in one instant",
        )
    if len(candidates) > 1:
        raise AmbiguityError(
            "one field with the time of each point",
            f"several that may be it: {', '.join(candidates)}",
            "choose one with --point-time-field NAME",
        )
    return candidates[0]


def scan_period_s(clouds: list[CloudTimes]) -> float | None:
    """Median time between the stamps of consecutive clouds [s], None when fewer than three clouds or no progress."""
    steps = np.diff(np.array([cloud.stamp_ns for cloud in clouds], dtype=np.int64))
    steps = steps[steps > 0]
    return float(np.median(steps)) * 1e-9 if len(steps) >= 2 else None


def read_point_time(
    field: str, clouds: list[CloudTimes], imu_delay_ns: float | None, options: RecordingOptions
) -> tuple[PointTimeReading, list[Evidence]]:
    """Unit and reference of the point times, with the evidence.

    Args:
        field: name of the time field, for the messages.
        clouds: the first clouds of the recording.
        imu_delay_ns: time between the stamp of an IMU message and its reception, of the quickest, or None when it is not known:
            the yardstick that tells a delay of the LiDAR's messages from an offset of the clocks.
        options: what the user decided.

    Raises:
        RecordingError: the values are constant, or fit no unit.
        AmbiguityError: two references fit.
    """
    if not clouds:
        raise RecordingError(
            f"finite times in the field {field!r}", "none in the first scans", "choose another --point-time-field"
        )
    period = scan_period_s(clouds)
    unit, unit_evidence = _read_unit(field, clouds, period, options)
    reference, anchor, text = _read_reference(field, clouds, unit, period, imu_delay_ns, options)
    doubt = _doubt(clouds, UNIT_NS[unit], imu_delay_ns) if options.point_time_reference == "scan_end" and anchor == "last" else ""
    evidence = Evidence("point_time_reference", reference, "warning" if doubt else "ok", text + doubt)
    return PointTimeReading(field, unit, reference, anchor), [unit_evidence, evidence, *_shared_times(field, clouds)]


def _shared_times(field: str, clouds: list[CloudTimes]) -> list[Evidence]:
    """That many points bear one and the same time: some were never given one, or their times are rounded."""
    at_once = float(np.median([cloud.at_once for cloud in clouds]))
    if at_once < _AT_ONCE:
        return []
    usual = min(clouds, key=lambda cloud: abs(cloud.at_once - at_once))
    text = (
        f"{at_once * 100:.0f} % of a scan's points bear one and the same time in the field {field} (such as "
        f"{usual.commonest:.12g}): the driver left it out for some of them, or a type with too few digits has rounded it; motion "
        "within a scan is corrected wrongly: mend the driver, or choose another --point-time-field"
    )
    return [Evidence("point_times", f"{at_once * 100:.0f} % at once", "warning", text)]


def _read_unit(
    field: str, clouds: list[CloudTimes], period: float | None, options: RecordingOptions
) -> tuple[TimeUnit, Evidence]:
    span = float(np.median([cloud.high - cloud.low for cloud in clouds]))
    if period is not None:
        least, most = _SHORTEST_SPAN * period, _LONGEST_SPAN * period
        expected = f"scans come every {period:.4g} s"
    else:
        least, most = _LIKELY_PERIODS_S
        expected = "the scan rate is unknown, 2 to 50 Hz assumed"
    fitting = [unit for unit, scale in UNIT_NS.items() if least <= span * scale * 1e-9 <= most]
    if options.point_time_unit is not None:
        unit = options.point_time_unit
        seconds = span * UNIT_NS[unit] * 1e-9
        verdict: Literal["ok", "warning"] = "ok" if unit in fitting else "warning"
        doubt = "" if verdict == "ok" else "; this does not look like the duration of a scan: check --point-time-unit"
        return unit, Evidence(
            "point_time_unit", unit, verdict, f"given; field {field} then spans {seconds:.4g} s a scan, {expected}{doubt}"
        )
    if span == 0:
        raise RecordingError(
            f"times in the field {field!r} that differ from point to point",
            f"the same value {clouds[0].low:g} for all points of a scan",
            "switch point times on in the LiDAR driver, choose another --point-time-field, or accept distorted scans with "
            "--point-time-field none",
        )
    if not fitting:
        raise RecordingError(
            f"times in the field {field!r} that span about one scan in s, ms, us or ns ({expected})",
            f"a span of {span:g} a scan, which is no scan in any of these units",
            "check the field with --point-time-field, or decide with --point-time-unit",
        )
    unit = fitting[0]
    seconds = span * UNIT_NS[unit] * 1e-9
    return unit, Evidence(
        "point_time_unit", unit, "ok", f"field {field} spans {span:g} {unit} = {seconds:.4g} s a scan, {expected}"
    )


_Anchor = Literal["stamp", "first", "last", "clock"]


def _read_reference(
    field: str,
    clouds: list[CloudTimes],
    unit: TimeUnit,
    period: float | None,
    imu_delay_ns: float | None,
    options: RecordingOptions,
) -> tuple[TimeReference, _Anchor, str]:
    scale = UNIT_NS[unit]
    first = float(np.median([cloud.low * scale for cloud in clouds]))
    last = float(np.median([cloud.high * scale for cloud in clouds]))
    span = last - first
    near = 2.0 * max(period or 0.0, span * 1e-9) * 1e9
    relative = max(abs(first), abs(last)) <= near
    seconds = f"from {first * 1e-9:.4g} to {last * 1e-9:.4g} s"
    given = options.point_time_reference
    if given == "absolute":
        return given, "clock", f"given; the values run {seconds}"
    if given == "scan_start":
        signed = relative and first >= -0.1 * span
        return given, "stamp" if signed else "first", f"given; the values run {seconds}"
    if given == "scan_end":
        signed = relative and abs(last) <= 0.1 * span
        return given, "stamp" if signed else "last", f"given; the values run {seconds}"
    if not relative:
        offset_ns = float(np.median([cloud.low * scale - cloud.stamp_ns for cloud in clouds]))
        if abs(offset_ns) > _SAME_CLOCK_NS:
            raise AmbiguityError(
                "absolute point times in the clock of the message stamps",
                f"times in {field!r} that lie {offset_ns * 1e-9:.6g} s from the stamps: another clock",
                "--point-time-reference scan_start puts the first point of each scan on its stamp, scan_end the last",
            )
        return (
            "absolute",
            "clock",
            f"the values are absolute times; the first point lies {offset_ns * 1e-9:+.4f} s from the stamp",
        )
    if first < -0.1 * span:
        where = "the stamp is the end of the scan" if last <= 0.1 * span else "the stamp lies within the scan"
        return ("scan_end" if abs(last) < abs(first) else "scan_start"), "stamp", f"the values run {seconds}: {where}"
    return "scan_start", "stamp", _confirm_scan_start(clouds, seconds, last, imu_delay_ns)


def _confirm_scan_start(clouds: list[CloudTimes], seconds: str, last_ns: float, imu_delay_ns: float | None) -> str:
    """Check positive times against reception: no message arrives before its last point was measured."""
    delay = delay_ns([cloud.stamp_ns for cloud in clouds], [cloud.received_ns for cloud in clouds])
    if abs(delay) < _STAMPED * last_ns:
        return f"the values run {seconds}, from the stamp; messages were recorded with their stamps, which confirms nothing"
    relative_delay = delay - (imu_delay_ns or 0.0)
    if relative_delay >= _A_SCAN[0] * last_ns:
        arrived = f"the messages arrived {relative_delay * 1e-9:.3f} s after their stamps, when the scan was over"
        return f"the values run {seconds}, and {arrived}"
    when = "after"
    if relative_delay < -_EARLY_NS:
        when = "before"
        meaning = "whichever end of the scan they are, the clocks of LiDAR and IMU lie apart"
    else:
        apart = (last_ns - relative_delay) * 1e-9
        meaning = f"these are the end of the scan, or the clocks of LiDAR and IMU lie about {apart:.3f} s apart"
    against = "" if imu_delay_ns is None else " by the clock of the IMU's stamps"
    raise AmbiguityError(
        f"scans received after their last point, {last_ns * 1e-9:.3f} s after the stamp if times count from it",
        f"messages received {abs(relative_delay) * 1e-9:.3f} s {when} their stamps{against}: {meaning}",
        "decide with --point-time-reference scan_start (the usual case) or scan_end; 'boxplus inspect' then measures the offset, "
        "which --lidar-time-offset corrects",
    )


def _doubt(clouds: list[CloudTimes], scale: int, imu_delay_ns: float | None) -> str:
    """What speaks against stamps at the ends of scans: that messages arrive a whole scan after them, as if these were begins.

    Read wrongly, everything the LiDAR sees is one scan early: a steady motion shows nothing of it, and every pose is where the
    platform was a scan ago.
    """
    span = float(np.median([cloud.high - cloud.low for cloud in clouds])) * scale
    received = delay_ns([cloud.stamp_ns for cloud in clouds], [cloud.received_ns for cloud in clouds])
    delay = received - (imu_delay_ns or 0.0)
    if abs(received) < _STAMPED * span or not _A_SCAN[0] * span <= delay <= _A_SCAN[1] * span:
        return ""
    return (
        f", but the messages arrived {delay * 1e-9:.3f} s after their stamps, a scan of {span * 1e-9:.3f} s and a little, "
        "as they do when the stamp is the start of the scan; check --point-time-reference, which otherwise shifts the whole "
        "trajectory by that duration"
    )


def absolute_times(
    reading: PointTimeReading, stamp_ns: int, values: NDArray[np.generic]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Absolute times of the points of one cloud.

    Args:
        reading: how the values are read.
        stamp_ns: the stamp of the cloud's message [ns].
        values: (N,) point times as recorded.

    Returns:
        (N,) int64 absolute nanoseconds, and (N,) bool: False where the value is not finite or farther than 10 s from the
        stamp (the time is then the stamp).
    """
    scale = UNIT_NS[reading.unit]
    whole, rest = divmod(stamp_ns, scale) if reading.anchor == "clock" else (0, 0)
    if values.dtype.kind == "f":
        with np.errstate(over="ignore", invalid="ignore"):
            offset = (values.astype(np.float64) - whole) * scale - rest
    else:
        offset = (values.astype(np.int64) - whole).astype(np.float64) * scale - rest
    valid = np.isfinite(offset)
    if reading.anchor in ("first", "last") and valid.any():
        offset = offset - (offset[valid].min() if reading.anchor == "first" else offset[valid].max())
    with np.errstate(invalid="ignore"):
        valid &= np.abs(offset) <= _FARTHEST_FROM_STAMP_NS
    if not valid.all():
        offset = np.where(valid, offset, 0.0)
    return np.rint(offset).astype(np.int64) + stamp_ns, valid
