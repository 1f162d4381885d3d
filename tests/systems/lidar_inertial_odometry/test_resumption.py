"""After a pause of both sensors: on from where the scan fits the map and nowhere else, or a new start."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from boxplus.filtering.nav_state import NavState, P, R, V
from boxplus.manifolds import so3
from boxplus.maps.ikd_tree import IkdTree
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.sequencer import Frame
from boxplus.simulation import Simulation, simulate
from boxplus.systems.lidar_inertial_odometry.imu_gap import guessed_until
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from boxplus.systems.lidar_inertial_odometry.resumption import Resumption, after_pause, before_pause, resumption, usual_distance
from tests.systems.lidar_inertial_odometry.small_drives import config, run

S = 1_000_000_000
UP = np.array([0.0, 0.0, 1.0])
SPEED = np.array([1.0, 0.2, 0.0])
ROOM = (
    ((-4.0, -3.0, 0.0), (5.0, 3.5, 2.6)),
    ((2.0, 1.2, 0.0), (2.8, 3.5, 1.5)),
    ((-4.0, -3.0, 0.0), (-2.8, -1.0, 0.9)),
    ((5.0, -3.0, 0.0), (8.0, -0.5, 2.6)),  # what it has and, turned round, would not have
)
OTHER_ROOM = ((-1.5, -6.0, 0.0), (1.5, 6.0, 3.5)), ((-1.5, 2.0, 0.0), (0.0, 2.6, 2.0))
SQUARE = (((-4.0, -4.0, 0.0), (4.0, 4.0, 2.6)), ((-0.5, 2.5, 0.0), (0.5, 4.0, 1.0)), ((-0.5, -4.0, 0.0), (0.5, -2.5, 1.0)))
CORRIDOR = (((-60.0, -1.5, 0.0), (60.0, 1.5, 2.6)),)
Boxes = tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...]


def faces(boxes: Boxes, seed: int, density: float = 60.0) -> NDArray[np.float64]:
    """Points on the faces of boxes, with a centimetre of noise."""
    random, points = np.random.default_rng(seed), []
    for low, high in (np.array(box) for box in boxes):
        for axis in range(3):
            others = [k for k in range(3) if k != axis]
            for side in (low[axis], high[axis]):
                face = np.empty((int(density * np.prod((high - low)[others])), 3))
                face[:, others] = random.uniform(low[others], high[others], (len(face), 2))
                face[:, axis] = side + random.normal(0.0, 0.01, len(face))
                points.append(face)
    return np.vstack(points)


def state() -> NDArray[np.float64]:
    """Before the pause, in the middle of the room."""
    x = NavState.identity().pack()
    x[P : P + 3], x[V : V + 3] = (0.0, 0.0, 1.2), SPEED
    return x


def everything(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.ones(len(points), bool)


def middle_of_wall(points: NDArray[np.float64], side: float) -> NDArray[np.bool_]:
    return (side * points[:, 0] > 3.9) & (np.abs(points[:, 1]) < 1.5)


def resumed(
    boxes: Boxes,
    seen: Boxes,
    turn: float,
    moved: tuple[float, float],
    seconds: float = 1.0,
    *,
    mapped: Callable[[NDArray[np.float64]], NDArray[np.bool_]] = everything,
    in_view: Callable[[NDArray[np.float64]], NDArray[np.bool_]] = everything,
) -> tuple[Resumption, NDArray[np.float64], NDArray[np.float64]]:
    """What is made of a pause over which the platform turned by a yaw and moved."""
    x = state()
    R_world_imu, p = so3.exp(turn * UP), x[P : P + 3] + np.array([*moved, 0.0])
    world = faces(seen, 2, 20.0)
    world = world[(np.linalg.norm(world - p, axis=1) < 15.0) & in_view(world)]
    p_lidar = ((world - p) @ R_world_imu).astype(np.float32)
    end = round(seconds * S)
    scan = Scan(p_lidar, np.full(len(p_lidar), end), None, end - S // 10, end)
    map_points = faces(boxes, 1)
    tree = IkdTree(map_points[mapped(map_points)])
    before = faces(boxes, 3, 20.0)
    before = before[mapped(before) & (np.linalg.norm(before - x[P : P + 3], axis=1) < 15.0)] - x[P : P + 3]
    usual_m = usual_distance(before.astype(np.float32), x, tree)
    return resumption(x, usual_m, x, p_lidar, tree, scan, seconds), R_world_imu, p


@settings(max_examples=8, deadline=None)
@given(turn=st.floats(-1.5, 1.5), moved=st.tuples(st.floats(-0.5, 1.6), st.floats(-0.8, 1.0)))
def test_it_is_found_where_it_is(turn: float, moved: tuple[float, float]) -> None:
    again, R_world_imu, p = resumed(ROOM, ROOM, turn, moved)
    assert again.x is not None, again.text
    assert np.linalg.norm(so3.log(again.x[R : R + 9].reshape(3, 3).T @ R_world_imu)) < np.deg2rad(0.3)
    assert np.linalg.norm(again.x[P : P + 3] + 0.1 * again.x[V : V + 3] - p) < 0.02  # at the end of the scan
    assert "found again" in again.text


def test_its_speed_is_that_of_an_arc() -> None:
    turn, length = np.deg2rad(80.0), 1.5
    chord = so3.exp(0.5 * turn * UP) @ (SPEED / np.linalg.norm(SPEED) * length * np.sinc(0.5 * turn / np.pi))
    again, _, _ = resumed(ROOM, ROOM, turn, (float(chord[0]), float(chord[1])))
    assert again.x is not None
    along = so3.exp(turn * UP) @ (SPEED / np.linalg.norm(SPEED) * length)
    np.testing.assert_allclose(again.x[V : V + 3], along, atol=0.05)


@pytest.mark.parametrize("seconds", [0.6, 2.0])
def test_along_a_corridor_it_is_where_it_would_be_and_after_seconds_nowhere(seconds: float) -> None:
    again, _, p = resumed(CORRIDOR, CORRIDOR, 0.1, (1.02 * seconds, 0.2 * seconds), seconds)
    if seconds > 1.0:
        assert again.x is None
        assert "alike at places" in again.text
        return
    assert again.x is not None, again.text
    assert "had it gone on as before" in again.text
    off = np.abs(again.x[P : P + 3] + 0.1 * again.x[V : V + 3] - p)
    assert off[0] < np.sqrt(again.variances[3]) and off[1:].max() < 0.02


def test_another_room_is_not_the_map() -> None:
    again, _, _ = resumed(ROOM, OTHER_ROOM, 0.1, (0.5, 0.0))
    assert again.x is None
    assert "fits the map at no place" in again.text


def test_in_a_room_that_looks_alike_turned_round_what_was_not_mapped_yet_does_not_decide() -> None:
    """What the scan sees and the map lacks lies, turned round, on a wall that the map has."""
    again, _, _ = resumed(
        SQUARE,
        SQUARE,
        0.1,
        (0.5, 0.0),
        3.0,
        mapped=lambda points: ~middle_of_wall(points, 1.0),
        in_view=lambda points: ~middle_of_wall(points, -1.0),
    )
    assert again.x is None
    assert "alike at places" in again.text and "180 deg apart" in again.text


def test_a_narrow_view_that_may_look_at_what_is_not_mapped_is_found_only_where_it_fits_as_before() -> None:
    """It looks into an annex that the map lacks, and a wall of the room that it does not face fits two thirds of it."""

    def ahead(points: NDArray[np.float64]) -> NDArray[np.bool_]:
        return (points[:, 0] > 1.0) & (np.abs(points[:, 1]) < 3.6) & (np.abs(points[:, 2] - 1.2) < 1.0)

    again, _, _ = resumed(ROOM, ROOM, 0.0, (0.5, 0.0), 2.5, mapped=lambda points: points[:, 0] < 4.9, in_view=ahead)
    assert again.x is None


def pause(imu_ns: list[int], begin_ns: int, start_ns: int, end_ns: int) -> Frame:
    scan = Scan(np.ones((1, 3), np.float32), np.array([end_ns]), None, start_ns, end_ns)
    samples = ImuSamples(np.array(imu_ns), np.arange(3.0 * len(imu_ns)).reshape(-1, 3), np.zeros((len(imu_ns), 3)))
    return Frame(scan, samples, begin_ns, imu_ns[-1] >= end_ns, float(np.diff(imu_ns, append=end_ns).max()) * 1e-9)


@pytest.mark.parametrize(
    ("imu_ns", "paused_ns", "before", "after"),
    [
        ([90, 190, 290, 1010, 1110], 290, 3, [1010, 1110]),  # it went on for a while after the LiDAR
        ([90, 1010, 1110], 100, 1, [1010, 1110]),  # it stopped with it
        ([90, 190], 190, 2, [1000]),  # it is not back yet
        ([90, 800, 900, 1010, 1110], 100, 1, [1000, 1010, 1110]),  # it is back before it
    ],
)
def test_what_the_imu_tells_before_and_after_it(imu_ns: list[int], paused_ns: int, before: int, after: list[int]) -> None:
    ms = S // 1000
    frame = pause([t * ms for t in imu_ns], 100 * ms, 1000 * ms, 1100 * ms)
    samples, until_ns = before_pause(frame)
    assert (len(samples), until_ns) == (before, paused_ns * ms)
    begin = after_pause(frame)
    assert begin.begin_ns == begin.scan.start_ns
    assert begin.imu.time_ns.tolist() == [t * ms for t in after]
    np.testing.assert_array_equal(begin.imu.gyro, frame.imu.gyro[-len(after) :])


def test_while_the_imu_is_not_back_the_velocity_stays_guessed() -> None:
    frame = pause([90, 1200], 1000, 1000, 1100)
    assert guessed_until(frame, 1000) == 1250  # of the next two scans, whenever the one after them begins
    assert guessed_until(frame, 999) == 999


def with_pause(
    simulation: Simulation, begin_s: float, duration_s: float, until_s: float, imu_later_s: float = 0.0
) -> Iterator[Scan | ImuSamples]:
    begin, end, last = (simulation.start_ns + round(s * S) for s in (begin_s, begin_s + duration_s, until_s))
    for event in simulation.events():
        if isinstance(event, Scan):
            if event.start_ns > last:
                return
            if event.end_ns <= begin or event.start_ns >= end:
                yield event
        elif (kept := (event.time_ns < begin) | (event.time_ns > end + round(imu_later_s * S))).any():
            yield ImuSamples(event.time_ns[kept], event.gyro[kept], event.accel[kept])


@pytest.mark.slow
@pytest.mark.parametrize(("duration_s", "imu_later_s", "seed"), [(0.3, 0.0, 0), (1.0, 0.0, 0), (3.0, 0.0, 0), (0.4, 0.3, 7710)])
def test_a_walk_goes_on_after_a_pause(duration_s: float, imu_later_s: float, seed: int) -> None:
    simulation = simulate("walk", seed)
    odometry = LidarInertialOdometry(config(simulation))
    estimates = run(odometry, with_pause(simulation, 24.5, duration_s, 24.5 + duration_s + 3.0, imu_later_s))
    truth = simulation.ground_truth(np.array([one.time_ns for one in estimates]))
    R_map = estimates[0].state.R_world_imu @ truth.R_world_imu[0].T
    away = np.array([one.state.p_world_imu - estimates[0].state.p_world_imu for one in estimates])
    error = np.linalg.norm(away - (truth.p_world_imu - truth.p_world_imu[0]) @ R_map.T, axis=1)
    assert error.max() < (0.12 if imu_later_s else 0.08) and error[-1] < 0.02
    assert odometry.contradiction is None
    assert [one for one in estimates if any("found again" in text for text in one.warnings)]
    assert all(one.status == "ok" for one in estimates)
