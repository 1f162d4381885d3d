"""What stands on the ground stays at rest and goes by in motion; a rail is the same from every place and counts as neither."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.changes.standing import shows_rest, stay_and_go

AHEAD, UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


def sweep(posts: NDArray[np.float64], p_lidar: NDArray[np.float64], seconds: float) -> Scan:
    """Posts (N, 2) and a rail along x, seen at one instant [s] from a LiDAR at (2,)."""
    z = np.arange(-1.5, 1.0, 0.2)
    standing = np.concatenate([np.column_stack([np.tile(post - p_lidar, (len(z), 1)), z]) for post in posts])
    along = np.arange(-30.0, 30.0, 0.5)
    rail = np.concatenate([np.column_stack([along, np.full(len(along), 5.0), np.full(len(along), height)]) for height in z[:4]])
    p = np.concatenate([standing, rail]).astype(np.float32)
    return Scan.from_arrays(p, np.full(len(p), round(seconds * 1e9)))


@pytest.mark.parametrize("speed", [0.0, 12.0])
def test_what_stands_stays_at_rest_and_goes_by_in_motion(speed: float) -> None:
    """A rail is the same from every place and counts as neither."""
    random = np.random.default_rng(2)
    posts = np.column_stack([np.arange(-26.0, 28.0, 4.0) + random.uniform(-0.5, 0.5, 14), random.choice([-8.0, 9.0, 13.0], 14)])
    scans = sweep(posts, np.zeros(2), 0.0), sweep(posts, np.array([0.1 * speed, 0.0]), 0.1)
    stay, go = stay_and_go(
        scans, lambda times: np.tile(np.eye(3), (len(times), 1, 1)), np.array([12.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    )
    assert (stay > 60, stay == 0) == (speed == 0.0, speed > 0.0)
    assert (go > 60, go == 0) == (speed > 0.0, speed == 0.0)


def test_the_ring_at_the_foot_of_a_rail_does_not_stand() -> None:
    """It goes along with the platform, and the rail above it makes its neighbours upright."""
    angle = np.arctan2(8.0, 6.0) + np.linspace(-0.06, 0.06, 40)
    ring = np.column_stack([10.0 * np.cos(angle), 10.0 * np.sin(angle), np.full(40, -1.6)])
    x = np.arange(5.7, 6.4, 0.1)
    rail = np.concatenate([np.column_stack([x, np.full(len(x), 8.05), np.full(len(x), z)]) for z in (-1.2, -0.9)])
    p = np.concatenate([ring, rail]).astype(np.float32)
    scans = [Scan.from_arrays(p, np.full(len(p), k * 10**8)) for k in range(2)]
    stay, go = stay_and_go((scans[0], scans[1]), lambda t: np.tile(np.eye(3), (len(t), 1, 1)), 12.0 * AHEAD, UP)
    assert stay <= len(rail) and go == 0


def drive(posts: NDArray[np.float64], speed: float, rate_hz: float = 10.0, count: int = 11) -> list[Scan]:
    seconds = 1.0 / rate_hz
    return [sweep(posts, np.array([seconds * speed * number, 0.0]), seconds * number) for number in range(count)]


def alley(spacing: float, jitter: float, sides: tuple[float, ...]) -> NDArray[np.float64]:
    random = np.random.default_rng(4)
    x = np.arange(-60.0, 100.0, spacing)
    return np.column_stack([x + random.uniform(-jitter, jitter, len(x)), np.resize(sides, len(x))])


@pytest.mark.parametrize("speed", [0.0, 0.3, 3.0, 40.0])
def test_what_stands_shows_rest_and_no_slow_speed(speed: float) -> None:
    assert shows_rest(drive(alley(4.0, 0.5, (-8.0, 9.0, 13.0)), speed), AHEAD, UP) == (speed == 0.0)


@pytest.mark.parametrize(("rate_hz", "speed"), [(5.0, 20.0), (5.0, 25.0), (10.0, 35.0)])
def test_posts_at_equal_distances_that_pass_from_scan_to_scan_show_no_rest(rate_hz: float, speed: float) -> None:
    posts = alley(speed / rate_hz, 0.0, (8.0,))
    posts = np.concatenate([posts, posts * [1.0, -1.0]])
    assert not shows_rest(drive(posts, speed, rate_hz), AHEAD, UP)


def test_what_may_keep_pace_with_the_platform_shows_no_rest() -> None:
    """Vehicles on the lanes beside it and its own parts; things on one side; and nothing at all in less than 0.8 s."""
    around = alley(4.0, 0.5, (-8.0, 9.0, 13.0))
    assert shows_rest(drive(around, 0.0), AHEAD, UP)
    assert not shows_rest(drive(around * [1.0, 0.4], 0.0), AHEAD, UP)  # 3.2 to 5.2 m aside
    assert not shows_rest(drive(np.abs(around), 0.0), AHEAD, UP)
    assert not shows_rest(drive(around, 0.0, count=8), AHEAD, UP)
    assert not shows_rest(drive(around, 0.0, rate_hz=1.0, count=5), AHEAD, UP)


def test_one_thing_is_one_place_however_tall() -> None:
    pair = np.array([[7.0, 7.0], [7.0, -7.0]])
    tall = np.concatenate([pair + np.array([0.1 * k, 0.0]) for k in range(3)])
    assert not shows_rest(drive(tall, 0.0), AHEAD, UP)
