"""Manoeuvres do what they are called, inside the free space their worlds promise."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.simulation import Motion
from boxplus.simulation.imu import GRAVITY
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.motions.spline import Trajectory
from boxplus.simulation.worlds import sites
from boxplus.simulation.worlds.world import World

LOW, HIGH = np.array([-3.0, -1.0, 1.0]), np.array([2.0, 1.5, 2.0])


def motion_of(trajectory: Trajectory, step_ns: int = 20_000_000) -> tuple[np.ndarray, Motion]:
    times = np.arange(trajectory.start_ns, trajectory.end_ns + 1, step_ns)
    return (times - trajectory.start_ns) * 1e-9, trajectory.evaluate(times)


def test_constant_velocity_from_the_first_sample() -> None:
    R = manoeuvres.level(0.5, 0.1, -0.2)
    time, motion = motion_of(manoeuvres.constant_velocity(6.0, (1.0, 2.0, 3.0), (4.0, 0.0, 0.5), R))
    assert time[-1] >= 6.0
    np.testing.assert_allclose(motion.p_world_imu, [1.0, 2.0, 3.0] + time[:, None] * [4.0, 0.0, 0.5], atol=1e-9)
    np.testing.assert_allclose(motion.R_world_imu, np.broadcast_to(R, motion.R_world_imu.shape), atol=1e-12)
    np.testing.assert_allclose(motion.a_world_imu, 0.0, atol=1e-9)
    np.testing.assert_allclose(motion.omega_imu, 0.0, atol=1e-9)


@pytest.mark.parametrize("rate", [-0.7, 0.4])
def test_constant_turn_at_a_constant_rate(rate: float) -> None:
    _, motion = motion_of(manoeuvres.constant_turn(8.0, (1.0, 0.0, 2.0), 3.0, rate))
    np.testing.assert_allclose(motion.omega_imu, np.broadcast_to([0.0, 0.0, rate], motion.omega_imu.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(motion.p_world_imu - [1.0, 0.0, 2.0], axis=1), 3.0, rtol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(motion.a_world_imu, axis=1), 3.0 * rate**2, rtol=2e-3)
    ahead = np.einsum("ni,ni->n", motion.R_world_imu[:, :, 0], motion.v_world_imu)
    np.testing.assert_allclose(ahead, 3.0 * abs(rate), rtol=1e-3)


def test_a_lift_rides_straight_up() -> None:
    time, motion = motion_of(manoeuvres.lift((1.0, 0.0, 2.0), 6.0, 1.5, 2.0))
    np.testing.assert_allclose(motion.p_world_imu[:, :2], [[1.0, 0.0]] * len(time), atol=1e-12)
    np.testing.assert_allclose(motion.p_world_imu[[0, -1], 2], [2.0, 8.0], atol=1e-6)
    assert np.abs(motion.v_world_imu[time < 1.8]).max() < 1e-12
    assert motion.v_world_imu[:, 2].max() == pytest.approx(1.5, rel=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_handheld_stays_in_its_box_and_in_its_limits(seed: int) -> None:
    time, motion = motion_of(manoeuvres.handheld(12.0, LOW, HIGH, 1.2, 1.5, 2.0, seed))
    assert ((motion.p_world_imu > LOW - 1e-3) & (motion.p_world_imu < HIGH + 1e-3)).all()
    assert np.abs(motion.v_world_imu[time < 1.8]).max() < 1e-12
    assert np.abs(motion.omega_imu[time < 1.8]).max() < 1e-12
    assert 0.5 < np.linalg.norm(motion.v_world_imu, axis=1).max() < 1.25
    assert 0.5 < np.abs(motion.omega_imu).max() < 2.5


def test_handheld_without_rest_begins_in_full_motion() -> None:
    _, motion = motion_of(manoeuvres.handheld(5.0, LOW, HIGH, 1.0, 1.0, 0.0, seed=3))
    assert np.linalg.norm(motion.v_world_imu[0]) > 0.1
    assert np.linalg.norm(motion.omega_imu[0]) > 0.1


def test_a_drone_rests_level_then_pushes_along_its_own_z() -> None:
    time, motion = motion_of(manoeuvres.drone_within(10.0, LOW, HIGH, 2.0, 2.0, seed=1))
    force = np.einsum("nji,nj->ni", motion.R_world_imu, motion.a_world_imu + np.array([0.0, 0.0, GRAVITY]))
    np.testing.assert_allclose(force[:, :2], 0.0, atol=1e-12)
    assert np.abs(motion.v_world_imu[time < 1.6]).max() < 1e-9
    assert np.linalg.norm(motion.a_world_imu, axis=1).max() > 1.0
    assert ((motion.p_world_imu > LOW - 1e-3) & (motion.p_world_imu < HIGH + 1e-3)).all()


def test_climbing_the_stairwell() -> None:
    _, motion = motion_of(manoeuvres.climb(25.0, seed=2))
    assert sites.stairwell().distance(motion.p_world_imu).min() > 0.35
    assert motion.p_world_imu[:, 2].max() - motion.p_world_imu[0, 2] > 5.0
    assert np.linalg.norm(motion.v_world_imu, axis=1).max() < 1.2


@pytest.mark.parametrize(
    ("world", "points"),
    [
        (sites.warehouse(seed=1), [(x, y, z) for x in (-14, 0, 14) for y in (-1.3, 1.3) for z in (1.0, 5.0)]),
        (sites.tunnel(lamp_spacing=12.0), [(x, y, z) for x in (-200, 0, 200) for y in (-3.1, 3.1) for z in (1.0, 5.0)]),
        (sites.street(seed=1), [(x, y, 1.5) for x in range(-130, 131, 5) for y in (-2.6, 0.0, 2.6)]),
        (sites.forest(seed=1), [(x, y, 1.5) for x in range(-38, 39, 2) for y in (-1.4, 1.4)]),
        (sites.open_field(seed=1), [(x, y, 1.5) for x in (-5, 5) for y in (-5, 5)]),
    ],
)
def test_sites_are_free_where_they_say(world: World, points: list[tuple[float, float, float]]) -> None:
    # A ray from the origin's lane to the point meets nothing before it.
    p = np.array(points, dtype=np.float64)
    assert world.distance(p).min() > 0.05
    for target in p:
        start = np.array([target[0], 0.0, target[2]])
        way = target - start
        length = np.linalg.norm(way)
        if length == 0.0:
            continue
        ranges, _ = world.cast((way / length)[None], np.eye(3)[None], start[None], 500.0)
        assert ranges[0] > length


def test_sites_come_from_their_seed() -> None:
    for make in (sites.warehouse, sites.street, sites.forest, sites.open_field):
        np.testing.assert_array_equal(make(seed=3).solids, make(seed=3).solids)
        first, second = make(seed=3).solids, make(seed=4).solids
        assert first.shape != second.shape or (first != second).any()


def test_a_smooth_tunnel_looks_the_same_everywhere() -> None:
    directions = np.random.default_rng(0).standard_normal((50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = [sites.tunnel().cast(directions, np.eye(3)[None], np.array([[x, 0.3, 2.0]]), 50.0)[0] for x in (0.0, 7.7)]
    np.testing.assert_allclose(seen[0], seen[1], atol=1e-9)


def test_refused() -> None:
    with pytest.raises(InputError, match="expected a box"):
        manoeuvres.handheld(5.0, HIGH, LOW)
    with pytest.raises(InputError, match="an even number of half storeys"):
        manoeuvres.climb(5.0, start_half=1)
