"""At rest means at rest: no steady motion passes for it, no shaking hides it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.simulation import ImuModel, RosetteLidar, Scenario, Simulation, World
from boxplus.simulation.motions import manoeuvres, trajectories
from boxplus.simulation.motions.spline import Trajectory
from boxplus.simulation.worlds import sites, worlds
from boxplus.systems.lidar_inertial_agreement import rest as rest_module
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import lidar_path
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import with_cells_for_all
from boxplus.systems.lidar_inertial_agreement.lidar_path.shown_turns import shown_turns
from boxplus.systems.lidar_inertial_agreement.rest import Rest, judge_rest
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, LIDAR, data

ROOM = (24.0, 20.0, 5.0)
START = (-5.0, -2.0, 1.5)


def rest_of(motion: Trajectory, seed: int = 0, imu: ImuModel | None = None) -> Rest:
    simulation = Simulation(Scenario("rest", worlds.room(ROOM, seed=seed), motion, LIDAR, imu or ImuModel()), seed, 1.5)
    scans, _ = data(simulation)
    return judge_rest(lidar_path(scans, CONFIG), scans, CONFIG)


@pytest.mark.parametrize("speed", [1.2, 2.0, 3.0, 8.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_constant_velocity_is_no_rest(speed: float, seed: int) -> None:
    rest = rest_of(manoeuvres.constant_velocity(1.5, START, (speed, 0.0, 0.0), np.eye(3)), seed)
    assert not rest.at_rest and abs(rest.speed / speed - 1.0) < 0.1


def test_a_circle_at_a_constant_rate_is_no_rest() -> None:
    rest = rest_of(manoeuvres.constant_turn(1.5, (0.0, 0.0, 1.5), 3.0, 0.5))
    assert not rest.at_rest and abs(rest.turn_rate - 0.5) < 0.05


@pytest.mark.parametrize("seed", range(3))
def test_a_shaken_platform_rests(seed: int) -> None:
    rest = rest_of(trajectories.at_rest(2.0, START), seed, ImuModel(accel_vibration=1.0, gyro_vibration=0.1))
    assert rest.at_rest and rest.determined and rest.speed < 0.05


def test_a_creep_is_seen() -> None:
    assert not rest_of(manoeuvres.constant_velocity(1.5, START, (0.0, 0.2, 0.0), np.eye(3))).at_rest


def test_a_single_scan_says_nothing() -> None:
    simulation = Simulation(Scenario("rest", worlds.room(ROOM), trajectories.at_rest(2.0, START), LIDAR), 0, 1.0)
    scans, _ = data(simulation)
    rest = judge_rest(lidar_path(scans[:1], CONFIG), scans[:1], CONFIG)
    assert not rest.at_rest and not rest.determined and len(rest.open_axes) == 3


@pytest.mark.parametrize(("reach_m", "noise"), [(2.0, 0.01), (4.0, 0.04)])
def test_one_wall_does_not_show_a_turn_about_its_normal(reach_m: float, noise: float) -> None:
    """Of the other turns it shows rest, as well as points of a cone of 60° on it do: `noise` in rad/s, root mean square."""
    lidar = RosetteLidar(points_per_scan=4000, rate_hz=10.0, fov_deg=60.0)
    scenario = Scenario(
        "wall", worlds.room(ROOM), trajectories.at_rest(2.0, (12.0 - reach_m, 4.0, 2.5)), lidar, T_imu_lidar=np.eye(4)
    )
    rates = []
    for seed in range(4):
        scans, _ = data(Simulation(scenario, seed, 1.0))
        path = lidar_path(scans, CONFIG)
        shown, not_shown = shown_turns(path)
        assert shown.shape == (3, 2) and abs(not_shown[0, 0]) > 0.99
        rest = judge_rest(path, scans, CONFIG)
        assert np.allclose(rest.open_turns, not_shown.T) and not rest.determined
        rates.append(rest.turn_rate)
    assert np.sqrt(np.mean(np.square(rates))) < noise


def all_but_the_least_known(_: object, __: object, ___: object, axes: np.ndarray) -> np.ndarray:
    return np.arange(len(axes)) > 0


@pytest.mark.parametrize("shown", [True, False])
def test_shifts_along_the_one_open_axis_decide(shown: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no surface is told to face it: along the axis that is known least, and nothing is open where they show it."""
    asked = []

    def shifts_show(scans: object, axis: np.ndarray, config: object) -> bool:
        asked.append(axis)
        return shown

    monkeypatch.setattr(rest_module, "faces", all_but_the_least_known)
    monkeypatch.setattr(rest_module, "shifts_show", shifts_show)
    rest = rest_of(trajectories.at_rest(2.0, START))
    assert rest.at_rest and len(asked) == 1
    assert rest.determined is shown
    if not shown:
        np.testing.assert_array_equal(rest.open_axes, asked)


def test_shifts_of_the_scans_themselves_show_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rest_module, "faces", all_but_the_least_known)
    assert rest_of(trajectories.at_rest(2.0, START)).determined
    monkeypatch.setattr(rest_module, "shifts_show", lambda *_: False)
    assert not rest_of(trajectories.at_rest(2.0, START)).determined


def view(world: World, turned: tuple[float, float], speed: float, seed: int, fov_deg: float = 62.0, y: float = 0.0) -> Rest:
    """A second of a narrow view, turned by yaw and pitch [deg] against the way, at a constant speed along x."""
    yaw, pitch = np.deg2rad(turned)
    T = np.eye(4)
    T[:3, :3] = so3.exp(yaw * np.eye(3)[2]) @ so3.exp(pitch * np.eye(3)[1])
    lidar = RosetteLidar(points_per_scan=20_000, fov_deg=fov_deg, max_range=90.0)
    motion = manoeuvres.constant_velocity(1.5, (-10.0, y, 1.4), (speed, 0.0, 0.0), np.eye(3))
    scans, _ = data(Simulation(Scenario("view", world, motion, lidar, T_imu_lidar=T), seed, 1.2))
    config = with_cells_for_all(scans, CONFIG)
    rest = judge_rest(lidar_path(scans, config), scans, config)
    return replace(rest, open_axes=rest.open_axes @ T[:3, :3].T)


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.0, 1.5, 3.0, 7.5])
@pytest.mark.parametrize("turned", [(90.0, 0.0), (90.0, 5.0), (100.0, -5.0), (125.0, 0.0), (90.0, 40.0)])
@pytest.mark.parametrize("fov_deg", [40.0, 62.0])
def test_a_narrow_view_of_a_smooth_wall_leaves_the_way_along_it_open(
    turned: tuple[float, float], speed: float, fov_deg: float
) -> None:
    """However many axes noise seems to show, and however well the wall, seen from where nothing changes, fits unmoved."""
    for seed, y in ((2, 1.1), (5, 0.0)):
        rest = view(sites.tunnel(500.0, lamp_spacing=17.53), turned, speed, seed, fov_deg, y)
        shown = np.eye(3)[0] - (np.linalg.pinv(rest.open_axes) @ rest.open_axes)[0] if len(rest.open_axes) else np.eye(3)[0]
        assert not rest.at_rest or np.linalg.norm(shown) < 0.1


@pytest.mark.parametrize("seed", range(4))
def test_a_narrow_view_of_a_wood_shows_rest(seed: int) -> None:
    """Trunks from ten metres on show it, and what is seen as a surface by ever other curves is one."""
    rest = view(sites.forest(seed=seed), (0.0, 0.0), 0.0, seed)
    assert rest.at_rest and rest.determined
