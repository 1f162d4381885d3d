"""Whether scans at rest would fit one another worse, had the LiDAR moved."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import ImuModel, OmniLidar, RosetteLidar, Scenario, Simulation, SpinningLidar, World
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.worlds import sites, worlds
from boxplus.systems.lidar_inertial_agreement.lidar_path import shifted_scans
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import with_cells_for_all
from boxplus.systems.lidar_inertial_agreement.lidar_path.shifted_scans import shifts_show

CONFIG = RegistrationConfig()
SPINNING = SpinningLidar(channels=16, azimuth_steps=900)
ROSETTE, OMNI = RosetteLidar(points_per_scan=10_000), OmniLidar(points_per_scan=10_000)
SCANS = 10


def scans_of(world: World, lidar: SpinningLidar | RosetteLidar | OmniLidar, speed: float, y: float = 0.4) -> list[Scan]:
    """A second of a LiDAR that looks along the way, 1.5 m above the ground."""
    motion = manoeuvres.constant_velocity(2.0, (-10.0, y, 1.5), (speed, 0.0, 0.0), np.eye(3))
    simulation = Simulation(Scenario("shifted", world, motion, lidar, ImuModel(), np.eye(4)), 5, 1.2)
    return [simulation.scan(k) for k in range(SCANS)]


@pytest.mark.parametrize("lidar", [SPINNING, ROSETTE, OMNI], ids=["spinning", "rosette", "omni"])
@pytest.mark.parametrize("axis", np.eye(3)[:2], ids=["along", "aside"])
def test_a_place_with_things_in_it_shows_every_shift(lidar: SpinningLidar | RosetteLidar | OmniLidar, axis: np.ndarray) -> None:
    room = worlds.room((30.0, 18.0, 6.0), seed=4)
    assert shifts_show(scans_of(room, lidar, 0.0), axis, CONFIG)


@pytest.mark.parametrize("lidar", [SPINNING, ROSETTE, OMNI], ids=["spinning", "rosette", "omni"])
@pytest.mark.parametrize("speed", [0.0, 2.0, 15.0])
def test_a_smooth_tunnel_shows_none_along_it(lidar: SpinningLidar | RosetteLidar | OmniLidar, speed: float) -> None:
    """Whether the LiDAR rests there or drives through."""
    assert not shifts_show(scans_of(sites.tunnel(), lidar, speed), np.eye(3)[0], CONFIG)


@pytest.mark.parametrize(("y", "yaw", "pitch", "seed"), [(1.1, 90, 5, 2), (1.1, 90, 5, 5), (2.2, 125, 0, 0), (2.2, 125, 0, 2)])
def test_a_narrow_view_of_the_wall_of_a_tunnel_shows_none_along_it(y: float, yaw: float, pitch: float, seed: int) -> None:
    """Where nearly every point lies on the wall, the few that do not are half of what a shift costs."""
    R = so3.exp(np.deg2rad(yaw) * np.eye(3)[2]) @ so3.exp(np.deg2rad(pitch) * np.eye(3)[1])
    T = np.eye(4)
    T[:3, :3] = R
    motion = manoeuvres.constant_velocity(2.0, (-10.0, y, 1.8), (7.5, 0.0, 0.0), np.eye(3))
    lidar = RosetteLidar(points_per_scan=20_000, fov_deg=62.0, range_sigma_m=0.0106, max_range=90.0)
    world = sites.tunnel(500.0, lamp_spacing=17.53)
    simulation = Simulation(Scenario("aside", world, motion, lidar, ImuModel(), T), seed, 1.2)
    scans = [simulation.scan(k) for k in range(SCANS)]
    assert not shifts_show(scans, R[0], with_cells_for_all(scans, CONFIG))


def test_what_goes_along_with_the_lidar_shows_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cage around a LiDAR that drives through a tunnel fits at rest, and at rest only, whatever moves."""
    random = np.random.default_rng(2)
    towards = random.normal(size=(20_000, 3))
    cage = 2.5 * towards / np.abs(towards).max(axis=1, keepdims=True)
    cage = cage[np.linalg.norm(cage, axis=1) < 2.9]
    scans = []
    for scan in scans_of(sites.tunnel(), SPINNING.model_copy(update={"max_range": 15.0}), 5.0):
        noisy = (cage + random.normal(0.0, 0.01, cage.shape)).astype(np.float32)
        time_ns = np.concatenate([scan.time_ns, np.full(len(cage), scan.time_ns[-1])])
        scans.append(Scan.from_arrays(np.concatenate([scan.p_lidar, noisy]), time_ns))
    assert not shifts_show(scans, np.eye(3)[0], CONFIG)
    monkeypatch.setattr(shifted_scans, "_NEAR_M", 0.0)
    assert shifts_show(scans, np.eye(3)[0], CONFIG)


def test_scans_are_not_compared_with_themselves_or_their_neighbours() -> None:
    """Half a second between the first and the last: else a slow walk lies upon itself."""
    room = worlds.room((30.0, 18.0, 6.0), seed=4)
    scans = scans_of(room, SPINNING, 0.0)
    axis = np.eye(3)[0]
    for few in (scans[:0], scans[:1], scans[:3], scans[:5], scans[:6]):
        assert not shifts_show(few, axis, CONFIG)
    assert shifts_show([scans[0], scans[9]], axis, CONFIG)
    assert not shifts_show([scans[0], scans[5]], axis, CONFIG)


@pytest.mark.parametrize(("costs", "shown"), [(1.45, True), (1.35, False)])
def test_every_shift_has_to_cost_more_than_rings_that_lie_askew(
    costs: float, shown: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Either way and at each distance: 1.3 was reached in motion."""
    asked = []

    def cost(_: object, shift: np.ndarray, __: object) -> float:
        asked.append(shift)
        return costs if shift.any() else 1.0

    monkeypatch.setattr(shifted_scans, "_cost", cost)
    scans = scans_of(worlds.room((30.0, 18.0, 6.0), seed=4), SPINNING, 0.0)
    axis = np.array([0.6, 0.0, -0.8])
    assert shifts_show(scans, axis, CONFIG) is shown
    if shown:
        along = np.sort([float(shift @ axis) for shift in asked])
        np.testing.assert_allclose(along, [-12.8, -6.4, -3.2, -1.6, -0.8, -0.4, -0.2, 0.0, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8])
        np.testing.assert_allclose(np.cross(asked, axis), 0.0, atol=1e-12)


@pytest.mark.parametrize("worse", range(14))
def test_one_shift_that_fits_leaves_the_axis_open(worse: int, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = [0]

    def cost(_: object, shift: np.ndarray, __: object) -> float:
        asked[0] += 1
        return 1.0 if not shift.any() or asked[0] == worse + 2 else 9.0

    monkeypatch.setattr(shifted_scans, "_cost", cost)
    assert not shifts_show(scans_of(worlds.room((30.0, 18.0, 6.0), seed=4), SPINNING, 0.0), np.eye(3)[0], CONFIG)


def test_few_points_beyond_what_is_near_say_nothing() -> None:
    near = worlds.room((4.0, 4.0, 2.6), seed=1)
    motion = manoeuvres.constant_velocity(2.0, (0.0, 0.0, 1.3), (0.0, 0.0, 0.0), np.eye(3))
    simulation = Simulation(Scenario("near", near, motion, SPINNING, ImuModel(), np.eye(4)), 5, 1.2)
    assert not shifts_show([simulation.scan(k) for k in range(SCANS)], np.eye(3)[0], CONFIG)
