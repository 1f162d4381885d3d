"""The odometry as it is used: right on a simulated room, the same bits every time, and unshaken by faulty data."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from boxplus.errors import InputError
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.sequencer import Frame
from boxplus.simulation import Simulation
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from boxplus.systems.lidar_inertial_odometry.start.grown_paths import GrownPaths
from boxplus.systems.lidar_inertial_odometry.start.search import StartSearch
from boxplus.systems.lidar_inertial_odometry.start.start import Start, find_start
from tests.systems.lidar_inertial_odometry.small_drives import config, position_errors, room_walk, run

MS = 1_000_000


@pytest.fixture(scope="module")
def room() -> Simulation:
    return room_walk(4.0)


@pytest.fixture(scope="module")
def events(room: Simulation) -> list[Scan | ImuSamples]:
    return list(room.events())


@pytest.fixture(scope="module")
def estimates(room: Simulation, events: list[Scan | ImuSamples]) -> list[Estimate]:
    return run(LidarInertialOdometry(config(room)), events)


def _points_add_up(estimates: list[Estimate]) -> bool:
    return all(e.points_used + sum(e.rejected.values()) == e.points_filtered for e in estimates)


def _sound(estimates: list[Estimate]) -> bool:
    """Finite states, covariances symmetric and positive definite, time moving on, points adding up."""
    for e in estimates:
        sigma = np.sqrt(e.covariance.diagonal())
        if not (np.isfinite(e.state.pack()).all() and np.isfinite(sigma).all() and np.array_equal(e.covariance, e.covariance.T)):
            return False
        if np.linalg.eigvalsh(e.covariance / np.outer(sigma, sigma)).min() <= 0:
            return False
    times = [e.time_ns for e in estimates]
    return _points_add_up(estimates) and times == sorted(set(times))


def test_it_follows_a_walk_through_a_room(room: Simulation, estimates: list[Estimate]) -> None:
    assert len(estimates) == room.scan_count  # those that waited for the start, too
    errors = position_errors(room, estimates)
    assert np.sqrt(np.mean(errors**2)) < 0.02
    truth = room.ground_truth(np.array([e.time_ns for e in estimates]))
    speeds = np.array([np.linalg.norm(e.state.v_world_imu) for e in estimates])
    assert np.abs(speeds - np.linalg.norm(truth.v_world_imu, axis=1)).max() < 0.1
    assert speeds.max() > 0.5
    assert all(e.status == "ok" and not e.warnings and not e.weak_directions for e in estimates)
    assert _sound(estimates)
    assert np.allclose([e.state.gravity_world for e in estimates][-1], [0.0, 0.0, -9.81], atol=0.1)


def test_every_scan_says_what_the_lidar_measured(estimates: list[Estimate]) -> None:
    for e in estimates[1:]:
        assert np.all((e.lidar_share >= 0) & (e.lidar_share <= 1))
        assert e.points_used > 0
        assert 1 <= e.iterations <= 5
        assert e.points_raw >= len(e.p_lidar) >= e.points_filtered
        assert e.points_world().shape == e.p_lidar.shape
        assert np.array_equal(e.T_world_imu[:3, 3], e.state.p_world_imu)
        assert e.pose_covariance.shape == (6, 6)


@pytest.mark.parametrize("threads", [1, 2])
def test_the_same_bits_every_time(
    room: Simulation, events: list[Scan | ImuSamples], estimates: list[Estimate], threads: int
) -> None:
    again = run(LidarInertialOdometry(config(room, threads=threads)), events)
    assert len(again) == len(estimates)
    for one, other in zip(estimates, again, strict=True):
        assert one.state.pack().tobytes() == other.state.pack().tobytes()
        assert one.covariance.tobytes() == other.covariance.tobytes()
        assert one.p_lidar.tobytes() == other.p_lidar.tobytes()


def test_scans_of_one_instant_can_start_it(room: Simulation, events: list[Scan | ImuSamples]) -> None:
    flat = [Scan.from_arrays(e.p_lidar, np.full(len(e), e.end_ns, np.int64)) if isinstance(e, Scan) else e for e in events[:36]]
    odometry = LidarInertialOdometry(config(room))
    found = run(odometry, flat)
    assert odometry.start is not None
    assert len(found) == sum(isinstance(e, Scan) for e in flat)
    assert _sound(found)


def test_without_an_imu_nothing_is_invented(events: list[Scan | ImuSamples]) -> None:
    odometry = LidarInertialOdometry()
    scans = [e for e in events if isinstance(e, Scan)]
    assert run(odometry, scans) == []
    assert odometry.counters == {"scan without any IMU sample": len(scans)}


def test_read_from_the_middle_it_begins_with_a_scan_that_the_imu_covers(
    events: list[Scan | ImuSamples], room: Simulation
) -> None:
    """Once the map began with a scan undistorted by the one sample after it, and the biases left what was known of them."""
    scans = [e for e in events if isinstance(e, Scan)]
    cut_ns = scans[20].end_ns - 5 * MS
    later = [e for e in events if (e.end_ns if isinstance(e, Scan) else int(e.time_ns[-1])) > cut_ns]
    late = [
        e if isinstance(e, Scan) else ImuSamples(*(values[e.time_ns > cut_ns] for values in (e.time_ns, e.gyro, e.accel)))
        for e in later
    ]
    odometry = LidarInertialOdometry(config(room))
    found = run(odometry, late)
    assert odometry.counters == {"scan that began before the first IMU sample": 1}
    assert found[0].time_ns == scans[21].end_ns


def test_why_there_was_no_start_sooner_is_kept(
    events: list[Scan | ImuSamples], room: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries: list[int] = []

    def refused_once(frames: Sequence[Frame], settings: LioConfig, grown: GrownPaths) -> Start | str:
        tries.append(len(frames))
        return find_start(frames, settings, grown) if len(tries) > 1 else "a wall says little"

    monkeypatch.setattr(f"{StartSearch.__module__}.find_start", refused_once)
    odometry = LidarInertialOdometry(config(room))
    assert run(odometry, events) and odometry.start is not None
    assert odometry.start_problem == "a wall says little"


def test_without_scans_nothing_is_invented(events: list[Scan | ImuSamples]) -> None:
    odometry = LidarInertialOdometry()
    assert run(odometry, (e for e in events if isinstance(e, ImuSamples))) == []
    assert odometry.counters == {}


def test_a_gap_in_the_imu_is_said_and_survived(room: Simulation, events: list[Scan | ImuSamples]) -> None:
    begin, end = room.start_ns + 1_500 * MS, room.start_ns + 1_800 * MS

    def with_gap() -> Iterator[Scan | ImuSamples]:
        for e in events:
            if isinstance(e, ImuSamples):
                keep = (e.time_ns < begin) | (e.time_ns > end)
                e = ImuSamples(e.time_ns[keep], e.gyro[keep], e.accel[keep])
            yield e

    found = run(LidarInertialOdometry(config(room)), with_gap())
    assert len(found) == room.scan_count
    assert _sound(found)
    warned = [e for e in found if e.warnings]
    assert 2 <= len(warned) <= 5
    assert all("motion taken from the LiDAR alone, covariance widened" in " ".join(e.warnings) for e in warned)
    assert "IMU gap of 0.3" in warned[0].warnings[0]
    assert all(begin - 100 * MS <= e.time_ns <= end + 200 * MS for e in warned)
    assert position_errors(room, found).max() < 0.1


def test_an_imu_that_stops_is_said(room: Simulation, events: list[Scan | ImuSamples]) -> None:
    stop = room.start_ns + 3_000 * MS
    kept = [e for e in events if isinstance(e, Scan) or e.time_ns[-1] <= stop]
    found = run(LidarInertialOdometry(config(room)), kept)
    assert _sound(found)
    late = [e for e in found if e.time_ns > stop + 200 * MS]
    assert all("no IMU sample at or after the end of the scan: the last one was held" in e.warnings for e in late)


def test_faulty_data_is_counted_and_survived(
    room: Simulation, events: list[Scan | ImuSamples], estimates: list[Estimate]
) -> None:
    nothing = np.zeros((4, 3))

    def faulty() -> Iterator[Scan | ImuSamples]:
        for index, e in enumerate(events):
            yield e
            if index % 8 == 0 and isinstance(e, ImuSamples) and len(e):
                last = e.time_ns[-1:]
                yield ImuSamples.from_arrays(last + 1, [np.nan, 0, 0], [0, 0, 0])
                yield ImuSamples.from_arrays(last, [9, 9, 9], [9, 9, 9])
                yield ImuSamples.from_arrays(last - 5, [9, 9, 9], [9, 9, 9])
                yield ImuSamples.from_arrays(np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3)))
            if index % 8 == 1 and isinstance(e, Scan):
                yield e
                yield Scan.from_arrays(nothing, np.full(4, e.end_ns + 1))
                yield Scan.from_arrays(nothing * np.nan, np.full(4, e.end_ns + 1))
                yield Scan.from_arrays(np.ones((4, 3)), np.full(4, e.end_ns - MS))

    odometry = LidarInertialOdometry(config(room))
    found = run(odometry, faulty())
    groups = sum(1 for index, e in enumerate(events) if index % 8 == 0 and len(e))
    scans = sum(1 for index, e in enumerate(events) if index % 8 == 1)
    assert odometry.counters == {
        "IMU sample not finite": groups,
        "IMU sample with a repeated time": groups,
        "IMU sample going back in time": groups,
        "scan with a repeated time": scans,
        "scan without a valid point": 2 * scans,
        "scan going back in time": scans,
    }
    # None of it reached the filter.
    assert [e.time_ns for e in found] == [e.time_ns for e in estimates]
    assert all(np.array_equal(a.state.pack(), b.state.pack()) for a, b in zip(found, estimates, strict=True))


def test_a_scan_of_nonsense_is_lost_and_said(room: Simulation, events: list[Scan | ImuSamples]) -> None:
    random = np.random.default_rng(0)
    odometry = LidarInertialOdometry(config(room))
    found: list[Estimate] = []
    for index, e in enumerate(events):
        if index in (41, 43, 45) and isinstance(e, Scan):
            points = random.normal(size=(40, 3)) * [[1e3], [1e8], [1e30], [30.0]][index // 2 % 4]
            e = Scan.from_arrays(points.astype(np.float32), np.linspace(e.start_ns, e.end_ns, 40).astype(np.int64))
        found += odometry.push_scan(e) if isinstance(e, Scan) else odometry.push_imu(e)
    found += odometry.flush()
    assert len(found) == room.scan_count
    assert _sound(found)
    lost = [e for e in found if e.status == "lost"]
    assert 1 <= len(lost) <= 3
    assert all(not e.lidar_share.any() and e.points_used == 0 for e in lost)
    assert position_errors(room, found).max() < 0.1


dtypes = st.sampled_from([np.float64, np.float32, np.int64, np.int32, np.uint8, np.uint64, np.bool_, np.complex64, "U3"])
shapes = st.one_of(st.sampled_from([(2,), (2, 3), (2, 3)]), hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4))
anything = dtypes.flatmap(lambda d: hnp.arrays(d, shapes))
times = hnp.arrays(np.int64, st.integers(1, 4), elements=st.integers(-(2**62), 2**62))


@settings(max_examples=200)
@given(anything, anything, anything)
def test_garbage_is_refused_with_an_explanation(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    odometry = LidarInertialOdometry()
    for push, make in ((odometry.push_imu, ImuSamples.from_arrays), (odometry.push_scan, Scan.from_arrays)):
        try:
            block = make(a, b, c)  # type: ignore[operator]
        except InputError as error:
            assert str(error).startswith("expected ")
            continue
        push(block)  # type: ignore[operator]
    odometry.flush()


@settings(max_examples=40)
@given(st.lists(st.tuples(times, st.integers(0, 2**32 - 1), st.booleans()), max_size=8))
def test_well_formed_nonsense_never_raises(blocks: list[tuple[np.ndarray, int, bool]]) -> None:
    odometry = LidarInertialOdometry()
    for time, seed, is_scan in blocks:
        random = np.random.default_rng(seed)
        values = random.normal(size=(len(time), 6)) * 10.0 ** random.integers(-3, 20)
        values[random.random(values.shape) < 0.1] = random.choice([np.nan, np.inf, 0.0])
        if is_scan:
            odometry.push_scan(Scan.from_arrays(values[:, :3], time))
        else:
            odometry.push_imu(ImuSamples.from_arrays(time, values[:, :3], values[:, 3:]))
    # Means that happen to look like an accelerometer in g are refused with that sentence.
    with contextlib.suppress(InputError):
        odometry.flush()
    assert odometry.start is None


FAULTS = ("spike", "gap", "shifted scan", "stray time", "one spot", "huge points", "no scan")


def _spoil(event: Scan | ImuSamples, fault: str, random: np.random.Generator) -> Scan | ImuSamples | None:
    """The event with the fault, where it applies to this kind of event."""
    if isinstance(event, ImuSamples):
        if fault == "gap":
            return None
        if fault == "spike":
            gyro, accel = event.gyro.copy(), event.accel.copy()
            which = random.integers(len(event))
            accel[which] = 10.0 ** random.uniform(1, 6) * random.normal(size=3)
            gyro[which] = 10.0 ** random.uniform(0, 5) * random.normal(size=3)
            return ImuSamples(event.time_ns, gyro, accel)
        return event
    points, time = event.p_lidar, event.time_ns
    if fault == "shifted scan":
        return Scan.from_arrays(points, time + int(random.integers(-9, 9)) * 1000 * MS)
    if fault == "stray time":
        time = time.copy()
        time[random.integers(len(time))] += int(random.integers(-9, 9)) * 1000 * MS
        return Scan.from_arrays(points, time)
    if fault == "one spot":
        return Scan.from_arrays(np.ones_like(points), time)
    if fault == "huge points":
        return Scan.from_arrays(points * np.float32(1e4), time)
    return None if fault == "no scan" else event


@pytest.mark.slow
@settings(max_examples=25)
@given(
    st.lists(st.tuples(st.sampled_from(FAULTS), st.floats(0, 4), st.floats(0.01, 0.6)), min_size=1, max_size=3),
    st.integers(0, 2**32 - 1),
)
def test_a_healthy_run_survives_whatever_is_injected(
    events: list[Scan | ImuSamples], room: Simulation, faults: list[tuple[str, float, float]], seed: int
) -> None:
    random = np.random.default_rng(seed)
    spoilt: list[Scan | ImuSamples] = []
    for event in events:
        now: Scan | ImuSamples | None = event
        seconds = (int(event.time_ns[0]) - room.start_ns) * 1e-9
        for fault, begin, length in faults:
            if now is not None and begin <= seconds < begin + length:
                now = _spoil(now, fault, random)
        if now is not None:
            spoilt.append(now)
    odometry = LidarInertialOdometry(config(room))
    found = run(odometry, spoilt)
    assert all(np.isfinite(e.state.pack()).all() and np.isfinite(e.covariance).all() for e in found)
    assert _points_add_up(found)
    assert [e.time_ns for e in found] == sorted({e.time_ns for e in found})
