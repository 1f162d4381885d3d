"""Scans of several LiDARs become one stream: every point is in one scan or counted, whatever order, rate or faults."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.manifolds import so3
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.lidar.scan_merger import ScanMerger

MS = 1_000_000
START_NS = 1_700_000_000 * 10**9
T_REAR = np.eye(4)
T_REAR[:3, :3] = so3.exp([0.1, -0.2, 3.0])
T_REAR[:3, 3] = -0.4, 0.1, 0.2


def scan(begin_ms: float, end_ms: float, points: int = 11, intensity: float | None = None) -> Scan:
    """A scan whose points tell their own time in their first coordinate."""
    time_ns = START_NS + np.linspace(begin_ms * MS, end_ms * MS, points).astype(np.int64)
    p = np.column_stack([(time_ns - START_NS) * 1e-9 + 1.0, np.ones(points), np.zeros(points)])
    return Scan.from_arrays(p, time_ns, None if intensity is None else np.full(points, intensity))


def merger(**changes: float) -> ScanMerger:
    return ScanMerger(("/front", "/rear"), (np.eye(4), T_REAR), **changes)


def accounted(used: ScanMerger, merged: list[Scan]) -> None:
    """Every point that came is in a scan or counted with its LiDAR's name, and none is in two."""
    for number, share in enumerate(used.shares):
        inside = sum(int((one.lidar == number).sum()) for one in merged if one.lidar is not None)
        left_out = sum(count for reason, count in used.rejected.items() if reason.startswith(f"points of {share.name}:"))
        assert inside == share.merged
        assert inside + left_out == share.points
        times = np.concatenate([one.of_lidar(number).time_ns for one in merged] or [np.empty(0, np.int64)])
        assert len(np.unique(times)) == len(times)


def test_a_scan_takes_the_points_of_the_other_up_to_its_end_each_at_its_own_time() -> None:
    used = merger()
    merged = used.add(0, scan(0, 100)) + used.add(1, scan(50, 150, 21))
    merged += used.add(0, scan(101, 200)) + used.add(1, scan(151, 250, 21))
    assert [one.end_ns - START_NS for one in merged] == [100 * MS, 200 * MS]
    first = merged[0]
    assert first.lidar is not None and np.bincount(first.lidar).tolist() == [11, 11]
    rear = first.of_lidar(1)
    own = (rear.p_lidar.astype(np.float64) - T_REAR[:3, 3]) @ T_REAR[:3, :3]
    np.testing.assert_allclose(own[:, 0] - 1.0, (rear.time_ns - START_NS) * 1e-9, atol=1e-6)
    accounted(used, merged + used.flush())


def test_intensities_and_points_dropped_on_construction_are_kept() -> None:
    used = merger()
    front = Scan.from_arrays(np.eye(3) * 5.0, START_NS + np.arange(3) * MS, [1.0, 2.0, 3.0], min_range=0.5)
    rear = Scan.from_arrays(np.diag([5.0, 0.1, 5.0]), START_NS + np.arange(3) * MS, min_range=0.5)
    (one,) = used.add(1, rear) + used.add(0, front)
    assert one.rejected == {"nearer than min_range": 1}
    assert one.intensity is not None and one.intensity[:3].tolist() == [1.0, 2.0, 3.0] and np.isnan(one.intensity[3:]).all()


def test_a_silent_lidar_is_waited_for_then_done_without_and_reported() -> None:
    used = merger(max_wait_s=0.5)
    merged = []
    for k in range(30):
        merged += used.add(0, scan(100 * k, 100 * k + 99))
        if not 10 <= k < 20:
            merged += used.add(1, scan(100 * k, 100 * k + 99))
    merged += used.flush()
    assert len(merged) == 30
    (silence,) = used.shares[1].silences
    assert np.allclose([(time - START_NS) / MS for time in silence], [999, 2099], atol=110)
    assert used.shares[1].absent == 10 and not used.rejected
    accounted(used, merged)


def test_where_the_first_lidar_falls_silent_the_other_gives_the_scans() -> None:
    used = merger(max_wait_s=0.5)
    merged = []
    for k in range(30):
        if not 10 <= k < 20:
            merged += used.add(0, scan(100 * k, 100 * k + 99))
        merged += used.add(1, scan(100 * k, 100 * k + 98))
    merged += used.flush()
    ends = [one.end_ns for one in merged]
    assert ends == sorted(set(ends)) and len(merged) == 30
    assert len(used.shares[0].silences) == 1
    accounted(used, merged)


def test_points_that_come_after_their_scan_are_counted_not_merged() -> None:
    used = merger(max_wait_s=0.2)
    merged = [one for k in range(6) for one in used.add(0, scan(100 * k, 100 * k + 99))]
    assert merged
    merged += used.add(1, scan(0, 99, 5)) + used.add(1, scan(100, 199, 5)) + used.flush()
    assert used.rejected["points of /rear: later than the scan they belong to"] > 0
    accounted(used, merged)


def test_times_that_step_back_or_leap_ahead_are_rejected_with_their_reason() -> None:
    used = merger()
    used.add(0, scan(0, 99))
    used.add(1, scan(0, 99))
    assert used.add(1, scan(0, 99)) == [] and used.add(1, scan(3_600_000, 3_600_099)) == []
    assert used.rejected["scans of /rear: going back in time, or repeated"] == 1
    assert used.rejected["scans of /rear: jumping ahead in time"] == 1
    for k in range(1, 15):
        used.add(0, scan(100 * k, 100 * k + 99))
        used.add(1, scan(100 * k, 100 * k + 99))
    assert used.shares[1].merged > 0.8 * used.shares[1].points


def test_after_a_silence_of_all_lidars_the_imu_vouches_for_the_time() -> None:
    used = merger()
    used.add(0, scan(0, 99))
    used.saw_imu(START_NS + 5_000 * MS)
    used.add(0, scan(5_000, 5_099))
    assert not used.rejected


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_nothing_is_lost_or_doubled_and_scans_stay_in_order(data: st.DataObject) -> None:
    used, merged, arrived = merger(max_wait_s=0.3), [], Counter[str]()
    clock = [0.0, float(data.draw(st.integers(-150, 150)))]
    for _ in range(data.draw(st.integers(1, 40))):
        which = data.draw(st.integers(0, 1))
        length = data.draw(st.sampled_from([30.0, 60.0, 100.0]))
        begin = clock[which] + data.draw(st.sampled_from([1.0, 1.0, 1.0, 70.0, 450.0]))
        clock[which] = begin + length
        one = scan(begin, begin + length, data.draw(st.integers(2, 9)))
        arrived[str(which)] += len(one)
        merged += used.add(which, one)
    merged += used.flush()
    ends = [one.end_ns for one in merged]
    assert ends == sorted(set(ends))
    for one in merged:
        assert one.time_ns.max() == one.end_ns and one.time_ns.min() >= one.start_ns
    skipped = [reason for reason in used.rejected if reason.startswith("scans of")]
    if not skipped:
        accounted(used, merged)
    assert sum(share.points for share in used.shares) == sum(arrived.values())


def test_the_same_arrivals_give_the_same_scans() -> None:
    def run() -> list[Scan]:
        used = merger()
        out = []
        for k in range(8):
            out += used.add(k % 2, scan(50 * k, 50 * k + 90))
        return out + used.flush()

    for one, other in zip(run(), run(), strict=True):
        np.testing.assert_array_equal(one.p_lidar, other.p_lidar)
        np.testing.assert_array_equal(one.time_ns, other.time_ns)


@pytest.mark.parametrize("index", [0, 1])
def test_of_lidar_without_labels_is_all_or_nothing(index: int) -> None:
    assert len(scan(0, 99).of_lidar(index)) == (11 if index == 0 else 0)
