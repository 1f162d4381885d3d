"""The scans of a start at rest make the first map together: docs/lidar_inertial_odometry.md, section 9."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.simulation import ImuModel, RosetteLidar, Scenario, Simulation, mounting
from boxplus.simulation.motions import trajectories
from boxplus.simulation.worlds import worlds
from boxplus.systems.lidar_inertial_odometry import odometry as module
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from boxplus.systems.lidar_inertial_odometry.start.resting_scans import resting_scans
from boxplus.systems.lidar_inertial_odometry.start.start import Start, find_start
from tests.systems.lidar_inertial_odometry.small_drives import config, frames, run


@pytest.fixture(scope="module")
def at_rest() -> Simulation:
    world, rest = worlds.room((5.0, 4.0, 3.0), seed=2), trajectories.at_rest(3.5, (-1.0, 0.5, 1.2))
    lidar = RosetteLidar(points_per_scan=3000)
    return Simulation(Scenario("rest", world, rest, lidar, ImuModel(), mounting(0.0, 0.0, 0.0, (0.0, 0.0, 0.1))), 1, 3.0)


def test_none_of_a_start_in_motion_or_one_that_is_not_shown_to_rest(at_rest: Simulation) -> None:
    waiting = frames(at_rest.events())[:12]
    found = find_start(waiting, config(at_rest))
    assert isinstance(found, Start) and found.kind == "static" and not found.warning
    rest = waiting[1:]
    assert [id(frame) for frame in resting_scans(found, rest)] == [id(frame) for frame in rest[:5]]
    assert resting_scans(replace(found, kind="moving"), rest) == []
    assert resting_scans(replace(found, unshown_axes=np.eye(3)[:1]), rest) == []
    assert resting_scans(replace(found, warning="something speaks against it"), rest) == []
    assert resting_scans(found, []) == []


def test_the_first_pose_is_better_known_for_it(at_rest: Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
    sigmas, sizes = [], []
    for patch in (lambda found, waiting: [], resting_scans):
        monkeypatch.setattr(module, "resting_scans", patch)
        odometry = LidarInertialOdometry(config(at_rest))
        estimates = run(odometry, list(at_rest.events()))
        assert estimates[0].pose_covariance.max() < 1e-9  # the first pose is exact by definition
        errors = [np.linalg.norm(estimate.state.p_world_imu) for estimate in estimates]
        assert max(errors) < 0.02
        sigmas.append(np.sqrt(np.linalg.eigvalsh(estimates[-1].pose_covariance[:3, :3])[-1]))
        sizes.append(len(odometry.map))
    assert sigmas[1] < 0.85 * sigmas[0]
    assert sizes[1] > 0.9 * sizes[0]
