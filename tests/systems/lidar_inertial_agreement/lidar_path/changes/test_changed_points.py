"""What changes between two scans, and the shift that lays it there again."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import ImuModel, RosetteLidar, Scenario, Simulation, SpinningLidar
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.worlds import sites
from boxplus.systems.lidar_inertial_agreement.lidar_path.changes.changed_points import ChangedPoints, changed_share


def street(lidar: SpinningLidar | RosetteLidar, speed: float) -> tuple[Scan, Scan]:
    motion = manoeuvres.constant_velocity(2.0, (-30.0, 0.3, 1.7), (speed, 0.0, 0.0), np.eye(3))
    drive = Simulation(Scenario("street", sites.street(seed=6), motion, lidar, ImuModel(), np.eye(4)), 6, 1.0)
    return drive.scan(0), drive.scan(1)


def unturned(time_ns: np.ndarray) -> np.ndarray:
    return np.tile(np.eye(3), (len(time_ns), 1, 1))


def test_the_shift_that_is_missing_is_found() -> None:
    random = np.random.default_rng(1)
    p = random.uniform(-20.0, 20.0, (200, 3))
    since = random.uniform(-0.05, 0.05, 200)
    velocity = np.array([15.0, 2.0, 0.0])
    # Standing points, as seen from where the LiDAR is when it sees them.
    pair = ChangedPoints(p - since[:, None] * velocity, p - (since + 0.1)[:, None] * velocity, since, since + 0.1, 0.1)
    again, missing = pair.shifts(velocity)
    assert again.all()
    np.testing.assert_allclose(missing, 0.0, atol=1e-3)  # the map keeps single precision
    again, missing = pair.shifts(velocity - [0.5, 0.0, 0.0])
    np.testing.assert_allclose(np.median(missing, axis=0), [0.5, 0.0, 0.0], atol=1e-3)
    none = ChangedPoints(p[:0], p, since[:0], since, 0.1)
    assert not none.shifts(velocity)[0].any() and none.shifts(velocity)[1].shape == (0, 3)


@pytest.mark.parametrize(
    "lidar",
    [SpinningLidar(channels=32, azimuth_steps=512, vertical_fov_deg=(-25.0, 15.0)), RosetteLidar(), RosetteLidar(fov_deg=40.0)],
    ids=["spinning", "rosette of 70 degrees", "rosette of 40 degrees"],
)
def test_only_a_drive_changes_what_a_lidar_sees(lidar: SpinningLidar | RosetteLidar) -> None:
    """A rosette looks elsewhere in every scan: at rest that is no change."""
    assert changed_share(*street(lidar, 0.0), unturned) < 0.0025
    assert changed_share(*street(lidar, 15.0), unturned) > 0.0025


def test_second_returns_make_no_rosette_of_a_spinning_lidar() -> None:
    drive = [street(SpinningLidar(azimuth_steps=600), 15.0)[k] for k in range(2)]
    twice = [Scan.from_arrays(np.repeat(scan.p_lidar, 2, axis=0), np.repeat(scan.time_ns, 2)) for scan in drive]
    assert changed_share(twice[0], twice[1], unturned) > 0.5 * changed_share(drive[0], drive[1], unturned) > 0.01


def test_what_is_alone_in_its_scan_is_no_change() -> None:
    first, second = street(SpinningLidar(azimuth_steps=600), 0.0)
    drops = np.random.default_rng(3).uniform(-25.0, 25.0, (len(second) // 40, 3)).astype(np.float32)
    second.p_lidar[: 40 * len(drops) : 40] = drops
    assert changed_share(first, second, unturned) < 0.0025


def test_next_to_nothing_changes_nothing() -> None:
    few = Scan.from_arrays(np.ones((3, 3), np.float32), np.zeros(3, np.int64))
    assert changed_share(few, street(SpinningLidar(azimuth_steps=600), 0.0)[1], unturned) == 0.0
