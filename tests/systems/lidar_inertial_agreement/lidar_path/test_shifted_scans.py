"""Whether scans at rest would fit one another worse, had the LiDAR moved."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.maps.registration_config import RegistrationConfig
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import ImuModel, OmniLidar, RosetteLidar, Scenario, Simulation, SpinningLidar, World
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.worlds import sites, worlds
from boxplus.systems.lidar_inertial_agreement.lidar_path import shifted_scans
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


def test_few_points_beyond_what_is_near_say_nothing() -> None:
    near = worlds.room((4.0, 4.0, 2.6), seed=1)
    motion = manoeuvres.constant_velocity(2.0, (0.0, 0.0, 1.3), (0.0, 0.0, 0.0), np.eye(3))
    simulation = Simulation(Scenario("near", near, motion, SPINNING, ImuModel(), np.eye(4)), 5, 1.2)
    assert not shifts_show([simulation.scan(k) for k in range(SCANS)], np.eye(3)[0], CONFIG)
