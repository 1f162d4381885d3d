"""A scan against a map: the information it gives, its gradient, and the count of every point.

Derivation: docs/lidar_inertial_odometry.md, sections 5 to 7.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.filtering.nav_state import NavState
from boxplus.manifolds import so3
from boxplus.maps.first_arrivals import FirstArrivals
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.plane_measurement import PlaneMeasurement
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import align

seeds = st.integers(0, 2**32 - 1)


def _faces(random: np.random.Generator, count: int, open_x: bool = False) -> np.ndarray:
    """Points on the walls, the floor and the ceiling of a room 12 × 6 × 4 m about the origin; `open_x`: without its ends."""
    half = np.array([6.0, 3.0, 2.0])
    points = random.uniform(-half, half, (count, 3))
    axis = random.integers(1 if open_x else 0, 3, count)
    points[np.arange(count), axis] = half[axis] * random.choice([-1.0, 1.0], count)
    return points


def _look(world: np.ndarray, x: NavState) -> np.ndarray:
    p_imu = (world - x.p_world_imu) @ x.R_world_imu
    return ((p_imu - x.p_imu_lidar) @ x.R_imu_lidar).astype(np.float32)


def _pose(random: np.random.Generator, scale: float = 1.0) -> NavState:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = so3.exp(random.normal(size=3)), 0.1 * random.normal(size=3)
    delta = np.zeros(24)
    delta[:6] = scale * random.normal(size=6) * np.repeat([0.3, 0.5], 3)
    return NavState.identity(T).boxplus(delta)


def _measure(points: np.ndarray, tree: IkdTree, *, threads: int = 1, with_extrinsic: bool = False) -> PlaneMeasurement:
    return PlaneMeasurement(points, tree, RegistrationConfig(threads=threads), with_extrinsic=with_extrinsic)


@settings(max_examples=10)
@given(seeds)
def test_every_point_is_used_or_counted(seed: int) -> None:
    random = np.random.default_rng(seed)
    tree = IkdTree(_faces(random, 4000))
    world = np.concatenate([_faces(random, 150), random.uniform(-1.5, 1.5, (30, 3)), [[50.0, 0.0, 0.0]]])
    x = _pose(random)
    measurement = _measure(_look(world, x), tree, with_extrinsic=True)
    information = measurement.at(x.pack(), rematch=True)
    assert information.used + sum(measurement.rejected().values()) == len(world)
    assert information.used > 100
    assert measurement.rejected()["fewer than five map points near"] >= 1
    assert np.array_equal(information.A, information.A.T)
    assert np.linalg.eigvalsh(information.A).min() > -1e-6 * np.trace(information.A)


def test_the_share_of_points_that_fit_tells_a_pose_from_one_gone_astray() -> None:
    random = np.random.default_rng(3)
    tree = IkdTree(_faces(random, 8000))
    x = _pose(random)
    points = _look(_faces(random, 600), x)
    measurement = _measure(points, tree)
    measurement.at(x.pack(), rematch=True)
    assert measurement.fitting_share > 0.95
    shift = np.zeros(24)
    shift[3:6] = [0.6, 0.6, 0.5]
    information = measurement.at(x.boxplus(shift).pack(), rematch=True)
    used, gated = information.used, measurement.rejected()["too far from the plane"]
    assert measurement.fitting_share == used / (used + gated) < 0.5


def test_the_number_of_threads_does_not_change_a_bit() -> None:
    random = np.random.default_rng(0)
    tree, x = IkdTree(_faces(random, 4000)), _pose(random)
    points = _look(_faces(random, 1300) + 0.02 * random.normal(size=(1300, 3)), x)
    one, two = (_measure(points, tree, threads=threads).at(x.pack(), rematch=True) for threads in (1, 2))
    assert one.A.tobytes() == two.A.tobytes()
    assert one.b.tobytes() == two.b.tobytes()


def test_reusing_the_neighbours_where_nothing_moved() -> None:
    random = np.random.default_rng(1)
    tree, x = IkdTree(_faces(random, 4000)), _pose(random)
    measurement = _measure(_look(_faces(random, 300), x), tree)
    first = measurement.at(x.pack(), rematch=False)
    again = measurement.at(x.pack(), rematch=False)
    rematched = measurement.at(x.pack(), rematch=True)
    for other in (again, rematched):
        assert other.A.tobytes() == first.A.tobytes()
        assert other.residual_rms == first.residual_rms


def test_the_parts_add_up() -> None:
    random = np.random.default_rng(2)
    tree, x = IkdTree(_faces(random, 4000)), _pose(random)
    measurement = _measure(_look(_faces(random, 300), x), tree)
    whole = measurement.at(x.pack(), rematch=True)
    said, A, b = measurement.in_parts(x.pack(), (0, 40, 40, measurement.points), rematch=True)
    assert said.used == whole.used and not A[1].any()
    np.testing.assert_allclose(A.sum(axis=0), whole.A, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(b.sum(axis=0), whole.b, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(said.directions.ratios, whole.directions.ratios, rtol=1e-9)


@settings(max_examples=10)
@given(seeds)
def test_aligning_finds_the_pose(seed: int) -> None:
    random = np.random.default_rng(seed)
    tree, truth = IkdTree(_faces(random, 6000)), _pose(random)
    points = _look(_faces(random, 600), truth)
    off = np.zeros(24)
    off[:6] = 0.03 * random.normal(size=6)
    packed = truth.boxplus(off).pack()
    measurement = PlaneMeasurement(points, tree, RegistrationConfig(), with_extrinsic=False)
    assert align(packed, measurement, RegistrationConfig()) is not None
    found = NavState.unpack(packed).boxminus(truth)
    assert np.abs(found[:6]).max() < 2e-3
    assert not found[6:18].any()


def test_aligning_to_nothing_is_refused() -> None:
    nothing = PlaneMeasurement(np.ones((50, 3), np.float32), IkdTree(), RegistrationConfig(), with_extrinsic=False)
    assert align(NavState.identity().pack(), nothing, RegistrationConfig()) is None


@pytest.mark.parametrize("seed", range(3))
def test_a_corridor_is_weak_along_its_axis_only(seed: int) -> None:
    random = np.random.default_rng(seed)
    faces = _faces(random, 6000, open_x=True)
    tree, x = IkdTree(faces + 0.01 * random.normal(size=faces.shape)), _pose(random)
    points = _look(_faces(random, 600, open_x=True) * [0.8, 1.0, 1.0], x)
    measurement = _measure(points, tree)
    information = measurement.at(x.pack(), rematch=True)
    directions = information.directions
    assert directions.weak.tolist() == [True] + [False] * 5
    assert abs(directions.vectors[3, 0]) > 0.99  # x of the world


def test_no_points_give_no_information() -> None:
    information = _measure(np.zeros((0, 3), np.float32), IkdTree()).at(NavState.identity().pack(), rematch=True)
    assert information.used == 0
    assert information.residual_rms == 0.0
    assert not information.A.any()


@settings(max_examples=20)
@given(seeds, st.floats(0.0, 3.1))
def test_where_a_scan_faces(seed: int, half_angle: float) -> None:
    """The mean of unit vectors, whatever the distances: (1 + cos α) / 2 along the axis of a cone of half the angle α."""
    random = np.random.default_rng(seed)
    across = random.uniform(np.cos(half_angle), 1.0, 20000)
    around, distance = random.uniform(0.0, 2.0 * np.pi, 20000), random.uniform(0.5, 80.0, 20000)
    side = np.sqrt(1.0 - across**2)
    rays = np.stack([across, side * np.cos(around), side * np.sin(around)], axis=1)
    points = (distance[:, None] * rays).astype(np.float32)
    facing = _measure(points, IkdTree()).facing
    np.testing.assert_allclose(facing, [0.5 * (1.0 + np.cos(half_angle)), 0.0, 0.0], atol=0.02)


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_what_a_scan_sees_of_the_map_is_new_where_its_planes_rest_on_the_last_scan(share: float) -> None:
    """A corridor whose floor the last scan has brought, and whose walls stand long since; along it nothing tells."""
    random = np.random.default_rng(7)
    faces = _faces(random, 30_000, open_x=True)
    floor = faces[:, 2] < -1.99
    tree, arrivals = IkdTree(cell_size=0.25), FirstArrivals(0.25)
    arrivals.insert_into(tree, faces[~floor & (faces[:, 2] < 1.99)], 0)
    arrivals.insert_into(tree, faces[floor], 2_000_000_000)
    x = NavState.identity()
    world = _faces(random, 3000, open_x=True)
    measurement = _measure(_look(world, x), tree)
    measurement.at(x.pack(), rematch=True)
    F = measurement.renewal(x.pack(), arrivals, share)
    assert F[5, 5] > 0.9 and F[0, 0] < 0.9  # height; roll is held by the walls too
    assert abs(F[4, 4]) < 0.1 and abs(F[2, 2]) < 0.2
    assert F[3, 3] == pytest.approx(share, abs=0.1)
    anew = FirstArrivals(0.25)
    anew.insert_into(IkdTree(cell_size=0.25), tree.points(), 0)
    assert np.allclose(measurement.renewal(x.pack(), anew, 1.0), np.eye(6), atol=1e-9)
