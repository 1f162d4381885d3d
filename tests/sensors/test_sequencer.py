"""Whatever arrives, in whatever order: every scan is in one frame or counted, and so is every IMU sample."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.sequencer import REPEATED, Frame, Sequencer

MS = 1_000_000
T0 = 1_700_000_000_000_000_000


def _imu(*times_ms: float, gyro: float = 0.0) -> ImuSamples:
    time = T0 + np.round(np.array(times_ms) * MS).astype(np.int64)
    return ImuSamples.from_arrays(time, np.full((len(time), 3), gyro), np.tile([0.0, 0.0, 9.81], (len(time), 1)))


def _scan(begin_ms: float, end_ms: float, points: int = 3) -> Scan:
    time = T0 + np.round(np.linspace(begin_ms, end_ms, points) * MS).astype(np.int64)
    return Scan.from_arrays(np.ones((points, 3)), time)


def _check(frame: Frame) -> None:
    end = frame.scan.end_ns
    time = frame.imu.time_ns
    assert len(time)
    assert np.all(np.diff(time) > 0)
    assert np.isfinite(frame.imu.gyro).all()
    assert np.isfinite(frame.imu.accel).all()
    assert frame.covered == bool(time[-1] >= end)
    # From the last one at or before the begin to the first one at or after the end.
    assert np.sum(time <= frame.begin_ns) <= 1
    assert np.sum(time >= end) <= 1
    assert frame.largest_gap_s >= 0.0
    inside = np.diff(time)[(time[1:] > frame.begin_ns) & (time[:-1] < end)]
    assert frame.largest_gap_s >= inside.max(initial=0) * 1e-9 - 1e-12


class SequencerMachine(RuleBasedStateMachine):
    """Blocks of samples and scans with every fault there is."""

    def __init__(self) -> None:
        super().__init__()
        self.frames: list[Frame] = []
        self.offered_scans = 0
        self.offered_samples = 0
        self.kept_samples: set[int] = set()

    @initialize(wait=st.sampled_from([0.05, 0.5]))
    def begin(self, wait: float) -> None:
        self.sequencer = Sequencer(max_wait_s=wait)
        self.now = 0.0

    @rule(
        steps=st.lists(st.sampled_from([5.0, 5.0, 5.0, 0.0, -7.0, 400.0, 20_000.0]), min_size=1, max_size=12),
        bad=st.sets(st.integers(0, 11), max_size=2),
    )
    def imu(self, steps: list[float], bad: set[int]) -> None:
        samples = _imu(*(self.now + np.cumsum(steps)))
        for row in bad & set(range(len(samples))):
            samples.gyro[row, row % 3] = [np.nan, np.inf][row % 2]
        self.offered_samples += len(samples)
        self.now += sum(step for step in steps if step < 1000.0)
        self.sequencer.add_imu(samples)

    @rule(
        lag=st.sampled_from([0.0, 0.0, 30.0, -40.0, 300.0, 30_000.0, -1000.0]),
        length=st.sampled_from([0.0, 20.0, 100.0]),
        points=st.sampled_from([0, 1, 3]),
    )
    def scan(self, lag: float, length: float, points: int) -> None:
        self.offered_scans += 1
        self.sequencer.add_scan(_scan(self.now - length - lag, self.now - lag, points))

    @rule(flush=st.booleans())
    def take(self, flush: bool) -> None:
        self.frames += self.sequencer.frames(flush=flush)

    @invariant()
    def frames_are_whole_and_in_order(self) -> None:
        ends = [frame.scan.end_ns for frame in self.frames]
        assert all(a < b for a, b in pairwise(ends))
        for before, frame in pairwise(self.frames):
            assert frame.begin_ns == before.scan.end_ns
        for frame in self.frames:
            _check(frame)

    def teardown(self) -> None:
        if not hasattr(self, "sequencer"):
            return
        self.frames += self.sequencer.frames(flush=True)
        self.frames_are_whole_and_in_order()
        counted = {
            kind: sum(n for reason, n in self.sequencer.rejected.items() if reason.startswith(kind)) for kind in ("scan", "IMU")
        }
        assert sum(counted.values()) == self.sequencer.rejected.total()
        assert len(self.frames) + counted["scan"] == self.offered_scans
        assert len({id(frame.scan) for frame in self.frames}) == len(self.frames)
        seen = np.unique(np.concatenate([np.zeros(0, np.int64), *(frame.imu.time_ns for frame in self.frames)]))
        assert len(seen) + counted["IMU"] <= self.offered_samples
        assert self.sequencer.frames(flush=True) == []


SequencerMachine.TestCase.settings = settings(max_examples=60, stateful_step_count=25)
TestSequencer = SequencerMachine.TestCase


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1))
def test_frames_do_not_depend_on_how_the_stream_is_cut(seed: int) -> None:
    random = np.random.default_rng(seed)
    times = np.cumsum(random.uniform(2.0, 8.0, 200))
    scans = [_scan(begin, begin + 95.0) for begin in np.arange(10.0, times[-1] - 100.0, 100.0)]
    whole = Sequencer()
    whole.add_imu(_imu(*times))
    for scan in scans:
        whole.add_scan(scan)
    expected = whole.frames()
    pieces, found, pending = Sequencer(), [], list(scans)
    for block in np.split(times, np.sort(random.integers(0, 200, 30))):
        pieces.add_imu(_imu(*block))
        while pending and len(block) and pending[0].end_ns <= T0 + block[-1] * MS:
            pieces.add_scan(pending.pop(0))
        found += pieces.frames()
    for scan in pending:
        pieces.add_scan(scan)
    found += pieces.frames()
    assert len(found) == len(expected) == len(scans)
    for one, other in zip(found, expected, strict=True):
        assert one.scan is other.scan
        assert np.array_equal(one.imu.time_ns, other.imu.time_ns)
        assert (one.begin_ns, one.covered, one.largest_gap_s) == (other.begin_ns, other.covered, other.largest_gap_s)


def test_a_scan_waits_for_the_samples_that_cover_it() -> None:
    sequencer = Sequencer()
    sequencer.add_imu(_imu(0, 50, 99))
    sequencer.add_scan(_scan(0, 100))
    assert sequencer.frames() == []
    sequencer.add_imu(_imu(101, 105))
    (frame,) = sequencer.frames()
    assert frame.covered
    assert (frame.imu.time_ns - T0).tolist() == [0, 50 * MS, 99 * MS, 101 * MS]
    assert frame.largest_gap_s == pytest.approx(0.05)


def test_it_does_not_wait_for_ever() -> None:
    sequencer = Sequencer(max_wait_s=0.5)
    sequencer.add_imu(_imu(0, 50))
    for index in range(6):
        sequencer.add_scan(_scan(100 * index, 100 * index + 99))
    (frame,) = sequencer.frames()
    assert not frame.covered
    assert frame.largest_gap_s == pytest.approx(0.05)


def test_the_end_of_the_data_releases_everything() -> None:
    sequencer = Sequencer()
    sequencer.add_imu(_imu(0, 5))
    sequencer.add_scan(_scan(0, 100))
    assert sequencer.frames() == []
    (frame,) = sequencer.frames(flush=True)
    assert not frame.covered
    assert frame.largest_gap_s == pytest.approx(0.095)


def test_every_fault_is_counted_by_its_name() -> None:
    sequencer = Sequencer()
    sequencer.add_imu(_imu(0, 5, 5, 3, 10))
    sequencer.add_imu(_imu(20, gyro=np.nan))
    sequencer.add_imu(_imu(99_000))
    for scan in (_scan(0, 8), _scan(0, 8), _scan(0, 7), _scan(0, 9, 0), _scan(90_000, 90_100)):
        sequencer.add_scan(scan)
    assert sequencer.rejected == {
        "IMU sample with a repeated time": 1,
        "IMU sample going back in time": 1,
        "IMU sample not finite": 1,
        "IMU sample jumping ahead in time": 1,
        "scan with a repeated time": 1,
        "scan going back in time": 1,
        "scan without a valid point": 1,
        "scan jumping ahead in time": 1,
    }
    assert [frame.scan.end_ns for frame in sequencer.frames()] == [T0 + 8 * MS]


def test_a_jump_that_lasts_is_the_new_time() -> None:
    sequencer = Sequencer()
    sequencer.add_imu(_imu(0, 5, 10))
    later = 60_000.0 + 5.0 * np.arange(30)
    sequencer.add_imu(_imu(*later))
    assert sequencer.rejected == {"IMU sample jumping ahead in time": 10}
    sequencer.add_scan(_scan(60_060, 60_100))
    (frame,) = sequencer.frames()
    assert frame.covered


def test_without_any_sample_a_scan_is_counted() -> None:
    sequencer = Sequencer()
    sequencer.add_scan(_scan(0, 100))
    assert sequencer.frames(flush=True) == []
    assert sequencer.rejected["scan without any IMU sample"] == 1


def _feed(sequencer: Sequencer, begin_ms: float, seconds: float) -> list[Frame]:
    frames = []
    for k in range(round(10 * seconds)):
        now = begin_ms + 100.0 * k
        sequencer.add_imu(_imu(*np.arange(now, now + 100.0, 10.0)))
        sequencer.add_scan(_scan(now, now + 99.0))
        frames += sequencer.frames()
    return frames


def test_a_first_scan_that_began_before_the_imu_is_no_frame() -> None:
    sequencer = Sequencer()
    sequencer.add_scan(_scan(0, 100))
    sequencer.add_scan(_scan(100, 200))
    sequencer.add_imu(_imu(*range(100, 206, 5)))  # as where a recording is read from its middle on
    (frame,) = sequencer.frames()
    assert (frame.begin_ns, frame.largest_gap_s) == (T0 + 100 * MS, 0.005)
    assert sequencer.rejected == {"scan that began before the first IMU sample": 1}


@pytest.mark.parametrize("first_ms", [5.0, 60.0])
def test_a_sample_is_held_for_an_interval_and_not_for_half_a_scan(first_ms: float) -> None:
    sequencer = Sequencer()
    sequencer.add_imu(_imu(*np.arange(first_ms, 106.0, 5.0)))
    sequencer.add_scan(_scan(0, 100))
    assert len(sequencer.frames()) == (first_ms == 5.0)


def test_a_first_scan_of_an_instant_asks_for_no_earlier_sample() -> None:
    sequencer = Sequencer()
    sequencer.add_scan(_scan(0, 0))
    sequencer.add_imu(_imu(5))
    assert len(sequencer.frames()) == 1


def test_times_that_step_back_for_good_are_told() -> None:
    sequencer = Sequencer()
    _feed(sequencer, 0.0, 3.0)
    assert sequencer.time_steps == []
    assert _feed(sequencer, -60_000.0, 0.9) == []
    assert sequencer.time_steps == []  # not yet: samples out of order
    assert _feed(sequencer, -59_100.0, 4.1) == []
    lidar, imu = sequencer.time_steps
    assert lidar.startswith(
        "the times of the LiDAR step back by 62.900 s after 1700000002.999 s and go on from there: 4.9 s of it"
    )
    assert imu.startswith("the times of the IMU step back by 62.990 s after 1700000002.990 s and go on from there: 5.0 s of it")
    assert "split the recording there" in lidar


def test_a_stretch_that_comes_twice_is_told_and_left_out() -> None:
    sequencer = Sequencer()
    first = _feed(sequencer, 0.0, 5.0)
    again = _feed(sequencer, 2000.0, 5.0)  # of which three seconds were there before
    assert len(first) + len(again) >= 68
    assert [text.split(" and ")[0] for text in sequencer.time_steps] == [
        "the times of the LiDAR step back by 2.900 s after 1700000004.999 s",
        "the times of the IMU step back by 2.990 s after 1700000004.990 s",
    ]


def test_single_samples_out_of_order_are_only_counted() -> None:
    sequencer = Sequencer()
    for k in range(200):
        sequencer.add_imu(_imu(10.0 * k, 10.0 * k - 25.0))
        sequencer.add_scan(_scan(10.0 * k, 10.0 * k + 9.0))
        sequencer.add_scan(_scan(10.0 * k - 50.0, 10.0 * k - 41.0))
    assert sequencer.rejected["IMU sample going back in time"] == sequencer.rejected["scan going back in time"] == 200
    assert sequencer.time_steps == []


@pytest.mark.parametrize("extreme", [2**63 - 1, -(2**63), T0 + 3_600_000_000_000])
@pytest.mark.parametrize("together", [True, False])
def test_a_first_time_that_is_nonsense_does_not_shut_out_all_that_follow(extreme: int, together: bool) -> None:
    sequencer = Sequencer()
    good = _imu(*range(0, 400, 5))
    wrong = ImuSamples(np.array([extreme]), np.zeros((1, 3)), np.array([[0.0, 0.0, 9.81]]))
    if together:
        joined = ImuSamples(
            np.concatenate([wrong.time_ns, good.time_ns]),
            np.vstack([wrong.gyro, good.gyro]),
            np.vstack([wrong.accel, good.accel]),
        )
        sequencer.add_imu(joined)
    else:
        sequencer.add_imu(wrong)
        sequencer.add_imu(good)
    frames = []
    for k in range(3):
        sequencer.add_scan(_scan(100.0 * k, 100.0 * k + 99.0))
        frames += sequencer.frames()
    assert len(frames) >= 2
    for frame in frames[1:]:
        _check(frame)
    assert sum(sequencer.rejected.values()) <= 10


def test_a_first_scan_far_ahead_does_not_shut_out_all_that_follow() -> None:
    sequencer = Sequencer()
    sequencer.add_imu(_imu(*range(0, 400, 5)))
    time = np.full(3, 2**63 - 1)
    sequencer.add_scan(Scan(np.ones((3, 3), np.float32), time, None, int(time[0]), int(time[0]), {}))
    frames = []
    for k in range(3):
        sequencer.add_scan(_scan(100.0 * k, 100.0 * k + 99.0))
        frames += sequencer.frames()
    assert len(frames) == 3
    assert sequencer.rejected == {"scan far ahead of all that follow": 1}


@pytest.mark.parametrize("turning", [True, False])
def test_scans_that_come_again_with_new_stamps_are_left_out_while_the_imu_moves(turning: bool) -> None:
    random = np.random.default_rng(3)
    first, second = random.normal(size=(2, 3000, 3))
    sequencer = Sequencer()
    time_ns = 5_000_000 * np.arange(170)
    gyro = np.full((170, 3), 0.2 if turning else 0.01)
    sequencer.add_imu(ImuSamples(time_ns, gyro, np.full((170, 3), 5.0)))
    for index, points in enumerate((first, first, second, second, second, first, first[:2900], first)):
        begin_ns = 100_000_000 * index
        sequencer.add_scan(Scan.from_arrays(points, begin_ns + np.arange(len(points))))
    taken = [frame.scan.start_ns // 100_000_000 for frame in sequencer.frames(flush=True)]
    assert taken == ([0, 2, 5, 6, 7] if turning else list(range(8)))
    assert sequencer.rejected == ({REPEATED: 3} if turning else {})
