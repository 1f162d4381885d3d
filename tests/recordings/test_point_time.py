"""Unit and reference of point times are found for every kind of sensor, and refused where two readings fit."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.errors import AmbiguityError, RecordingError
from boxplus.recordings.info import PointTimeReading
from boxplus.recordings.options import RecordingOptions, TimeUnit
from boxplus.recordings.point_time import UNIT_NS, absolute_times, choose_time_field, delay_ns, read_point_time, times_of_cloud

START_NS = 1_700_000_000_000_000_000
UNITS = st.sampled_from(list(UNIT_NS))


def clouds_of(values_of_scan, period_ns: int, delay_ns: int, count: int = 6):
    """Time extents of clouds whose raw values are values_of_scan(stamp_ns)."""
    stamps = [START_NS + k * period_ns for k in range(count)]
    return [times_of_cloud(stamp, stamp + delay_ns, values_of_scan(stamp)) for stamp in stamps]


@given(unit=UNITS, period_s=st.floats(0.02, 0.5), share=st.floats(0.1, 1.05))
def test_unit_of_times_from_the_stamp(unit: TimeUnit, period_s: float, share: float) -> None:
    period_ns = round(period_s * 1e9)
    offsets_ns = np.linspace(0.0, share * period_ns, 50)
    clouds = clouds_of(lambda _: offsets_ns / UNIT_NS[unit], period_ns, delay_ns=2 * period_ns)
    reading, evidence = read_point_time("t", clouds, 0.0, RecordingOptions())
    assert reading == PointTimeReading("t", unit, "scan_start", "stamp")
    assert [e.verdict for e in evidence] == ["ok", "ok"]
    times, valid = absolute_times(reading, START_NS, offsets_ns / UNIT_NS[unit])
    assert valid.all()
    np.testing.assert_allclose(times - START_NS, offsets_ns, atol=1)


@given(unit=UNITS, share=st.floats(0.5, 1.0), late=st.floats(0.0, 0.05))
def test_times_up_to_the_stamp(unit: TimeUnit, share: float, late: float) -> None:
    """The velodyne driver's -0.1 to 0 s, and kiss-icp issue 94's -0.099 to 0.0006 s."""
    offsets_ns = np.linspace(-share * 1e8, late * share * 1e8, 50)
    clouds = clouds_of(lambda _: offsets_ns / UNIT_NS[unit], 100_000_000, delay_ns=2_000_000)
    reading, _ = read_point_time("time", clouds, 0.0, RecordingOptions())
    assert reading == PointTimeReading("time", unit, "scan_end", "stamp")
    times, _ = absolute_times(reading, START_NS, offsets_ns / UNIT_NS[unit])
    np.testing.assert_allclose(times - START_NS, offsets_ns, atol=1)


@given(offset_ms=st.integers(-150, 50), dtype=st.sampled_from([np.float64, np.uint64]))
def test_absolute_times(offset_ms: int, dtype: type) -> None:
    unit: TimeUnit = "s" if dtype is np.float64 else "ns"
    offsets_ns = offset_ms * 1_000_000 + np.linspace(0, 100_000_000, 50).astype(np.int64)

    def raw(stamp_ns: int):
        return (
            ((stamp_ns + offsets_ns) / UNIT_NS[unit]).astype(dtype)
            if dtype is np.float64
            else (stamp_ns + offsets_ns).astype(dtype)
        )

    reading, _ = read_point_time("timestamp", clouds_of(raw, 100_000_000, delay_ns=0), 0.0, RecordingOptions())
    assert reading == PointTimeReading("timestamp", unit, "absolute", "clock")
    times, valid = absolute_times(reading, START_NS, raw(START_NS))
    assert valid.all()
    np.testing.assert_allclose(times - START_NS, offsets_ns, atol=0 if dtype is np.uint64 else 250)


def test_another_clock_is_ambiguous_and_decided_by_the_reference() -> None:
    """A sensor that counts from its own start while the computer stamps the message."""

    def raw(stamp_ns: int):
        return (stamp_ns - START_NS) * 1e-9 + 300.0 + np.linspace(0.0, 0.1, 50)

    clouds = clouds_of(raw, 100_000_000, delay_ns=100_000_000)
    with pytest.raises(AmbiguityError, match=r"another clock – --point-time-reference scan_start puts the first point"):
        read_point_time("timestamp", clouds, 0.0, RecordingOptions())
    for reference, expected in (("scan_start", 0), ("scan_end", -100_000_000)):
        reading, _ = read_point_time("timestamp", clouds, 0.0, RecordingOptions(point_time_reference=reference))
        times, _ = absolute_times(reading, START_NS, raw(START_NS))
        assert abs(int(times[0]) - START_NS - expected) < 10


def test_reception_before_the_last_point_is_ambiguous() -> None:
    clouds = clouds_of(lambda _: np.linspace(0.0, 0.1, 50), 100_000_000, delay_ns=30_000_000)
    two = r"received 0.030 s after their stamps by .*: these are the end of the scan, or the clocks .* about 0.070 s apart"
    with pytest.raises(AmbiguityError, match=two):
        read_point_time("time", clouds, 0.0, RecordingOptions())
    # Before its stamp nothing is received, at whichever end of the scan it was given.
    with pytest.raises(AmbiguityError, match=r"received 0.050 s before their stamps by the clock .* LiDAR and IMU lie apart"):
        read_point_time("time", clouds, 80e6, RecordingOptions())
    # The IMU's own delay shows that the clocks of sensors and recorder differ by 80 ms.
    reading, _ = read_point_time("time", clouds, -80e6, RecordingOptions())
    assert reading.reference == "scan_start"


def test_messages_recorded_with_their_stamps_are_read_from_the_start() -> None:
    clouds = clouds_of(lambda _: np.linspace(0.0, 0.1, 50), 100_000_000, delay_ns=0)
    reading, evidence = read_point_time("time", clouds, 0.0, RecordingOptions())
    assert reading.reference == "scan_start" and "confirms nothing" in evidence[1].text


@pytest.mark.parametrize(
    ("delay_ms", "imu_delay_ms", "doubted"),
    [(105, 2, True), (150, None, True), (160, 120, False), (3, 0, False), (0, 0, False), (5000, 0, False)],
)
def test_a_reference_that_the_arrival_of_messages_contradicts_is_doubted(
    delay_ms: int, imu_delay_ms: int | None, doubted: bool
) -> None:
    """Stamps at the ends of scans are fresh when they arrive; those at the begins are a scan old."""
    given = RecordingOptions(point_time_reference="scan_end")
    clouds = clouds_of(lambda _: np.linspace(0.0, 0.1, 50), 100_000_000, delay_ns=delay_ms * 1_000_000)
    imu_delay_ns = None if imu_delay_ms is None else imu_delay_ms * 1e6
    reading, evidence = read_point_time("time", clouds, imu_delay_ns, given)
    assert reading == PointTimeReading("time", "s", "scan_end", "last")  # who gives it decides
    assert (evidence[1].verdict == "warning") == doubted
    assert ("as they do when the stamp is the start of the scan" in evidence[1].text) == doubted
    # Values that count up to the stamp say themselves that it is the end.
    clouds = clouds_of(lambda _: np.linspace(-0.1, 0.0, 50), 100_000_000, delay_ns=delay_ms * 1_000_000)
    assert read_point_time("time", clouds, imu_delay_ns, given)[1][1].verdict == "ok"


@pytest.mark.parametrize("stamp_at_end", [False, True])
def test_a_recorder_that_holds_all_messages_back_hides_no_stamp_at_the_end(stamp_at_end: bool) -> None:
    """Half a second of them arrives at once: on average the LiDAR's are a quarter of a second late, and the IMU's as well."""
    burst_ns, scan_ns, imu_ns = 500_000_000, 100_000_000, 5_000_000
    stamps = [START_NS + 7_000_000 + k * scan_ns for k in range(30)]
    over_ns = 3_000_000 if stamp_at_end else scan_ns + 3_000_000  # after the stamp

    def received(ready_ns: int) -> int:
        return -(-ready_ns // burst_ns) * burst_ns

    clouds = [times_of_cloud(stamp, received(stamp + over_ns), np.linspace(0.0, 0.1, 50)) for stamp in stamps]
    imu = [START_NS + k * imu_ns for k in range(600)]
    imu_delay_ns = delay_ns(imu, [received(stamp + 1_000_000) for stamp in imu])
    if stamp_at_end:
        with pytest.raises(AmbiguityError, match="these are the end of the scan"):
            read_point_time("time", clouds, imu_delay_ns, RecordingOptions())
    else:
        assert read_point_time("time", clouds, imu_delay_ns, RecordingOptions())[0].reference == "scan_start"


def test_a_span_that_is_no_scan_is_refused_or_warned_about() -> None:
    clouds = clouds_of(lambda _: np.linspace(0.0, 3.0, 50), 100_000_000, delay_ns=0)
    with pytest.raises(RecordingError, match=r"a span of 3 a scan, which is no scan in any of these units.*--point-time-unit"):
        read_point_time("time", clouds, None, RecordingOptions())
    _, evidence = read_point_time("time", clouds, None, RecordingOptions(point_time_unit="ms", point_time_reference="scan_start"))
    assert evidence[0].verdict == "warning" and "does not look like the duration of a scan" in evidence[0].text


@given(st.lists(st.floats(width=32, allow_nan=True, allow_infinity=True), min_size=1, max_size=30))
def test_wild_values_are_marked_and_never_overflow(values: list[float]) -> None:
    reading = PointTimeReading("t", "s", "scan_start", "stamp")
    times, valid = absolute_times(reading, START_NS, np.array(values, np.float32))
    expected = np.array([np.isfinite(v) and abs(v * 1e9) <= 1e10 for v in values])
    np.testing.assert_array_equal(valid, expected)
    assert (np.abs(times - START_NS) <= 10_000_000_001).all()


def test_fields() -> None:
    free = RecordingOptions()
    assert choose_time_field(("x", "t"), ("t",), free) == "t"
    assert choose_time_field(("x", "t"), ("t",), RecordingOptions(point_time_field="none")) is None
    assert choose_time_field(("x", "odd"), (), RecordingOptions(point_time_field="odd")) == "odd"
    with pytest.raises(AmbiguityError, match="several that may be it: t, time – choose one with --point-time-field"):
        choose_time_field(("t", "time"), ("t", "time"), free)
    with pytest.raises(RecordingError, match="the point time field 'u' – got a cloud with the fields x, t"):
        choose_time_field(("x", "t"), ("t",), RecordingOptions(point_time_field="u"))


@pytest.mark.parametrize("share", [0.0, 0.1, 0.3, 0.6])
def test_points_that_share_a_time_are_told(share: float) -> None:
    """Left out for some of the points; points that were not measured bear any time."""
    values = np.linspace(0.0, 0.1, 1000)
    values[np.random.default_rng(0).random(1000) < share] = 0.0
    padded, measured = np.concatenate([values, np.zeros(2000)]), np.arange(3000) < 1000
    stamps = [START_NS + k * 100_000_000 for k in range(6)]
    clouds = [times_of_cloud(stamp, stamp + 102_000_000, padded, measured) for stamp in stamps]
    _, evidence = read_point_time("time", clouds, 0.0, RecordingOptions())
    told = [entry for entry in evidence if entry.key == "point_times"]
    assert bool(told) == (share > 0.2)
    assert all(entry.verdict == "warning" and "one and the same time" in entry.text for entry in told)


def test_times_rounded_to_a_few_values_are_told_and_columns_are_not() -> None:
    stamps = [START_NS + k * 100_000_000 for k in range(6)]
    for step_s, said in ((0.03125, True), (0.1 / 16, False)):
        values = np.floor(np.linspace(0.0, 0.0999, 1000) / step_s) * step_s
        clouds = [times_of_cloud(stamp, stamp + 102_000_000, values) for stamp in stamps]
        _, evidence = read_point_time("time", clouds, 0.0, RecordingOptions())
        assert ("point_times" in {entry.key for entry in evidence}) == said
