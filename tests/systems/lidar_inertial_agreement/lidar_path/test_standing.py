"""What stands on the ground stays at rest and goes by in motion; a rail is the same from every place and counts as neither."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.sensors.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.standing import shows_rest, stay_and_go

AHEAD, UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


def sweep(posts: NDArray[np.float64], p_lidar: NDArray[np.float64], number: int) -> Scan:
    """Posts (N, 2) and a rail along x, seen at one instant from a LiDAR at (2,)."""
    z = np.arange(-1.5, 1.0, 0.2)
    standing = np.concatenate([np.column_stack([np.tile(post - p_lidar, (len(z), 1)), z]) for post in posts])
    along = np.arange(-30.0, 30.0, 0.5)
    rail = np.concatenate([np.column_stack([along, np.full(len(along), 5.0), np.full(len(along), height)]) for height in z[:4]])
    p = np.concatenate([standing, rail]).astype(np.float32)
    return Scan.from_arrays(p, np.full(len(p), 100_000_000 * number))


@pytest.mark.parametrize("speed", [0.0, 12.0])
def test_what_stands_stays_at_rest_and_goes_by_in_motion(speed: float) -> None:
    """A rail is the same from every place and counts as neither."""
    random = np.random.default_rng(2)
    posts = np.column_stack([np.arange(-26.0, 28.0, 4.0) + random.uniform(-0.5, 0.5, 14), random.choice([-8.0, 9.0, 13.0], 14)])
    scans = sweep(posts, np.zeros(2), 0), sweep(posts, np.array([0.1 * speed, 0.0]), 1)
    stay, go = stay_and_go(
        scans, lambda times: np.tile(np.eye(3), (len(times), 1, 1)), np.array([12.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    )
    assert (stay > 60, stay == 0) == (speed == 0.0, speed > 0.0)
    assert (go > 60, go == 0) == (speed > 0.0, speed == 0.0)


def drive(posts: NDArray[np.float64], speed: float) -> list[Scan]:
    return [sweep(posts, np.array([0.1 * speed * number, 0.0]), number) for number in range(11)]


@pytest.mark.parametrize("speed", [0.0, 0.3, 3.0, 40.0])
def test_what_stands_shows_rest_and_no_slow_speed(speed: float) -> None:
    random = np.random.default_rng(4)
    posts = np.column_stack([np.arange(-26.0, 28.0, 4.0) + random.uniform(-0.5, 0.5, 14), random.choice([-8.0, 9.0, 13.0], 14)])
    assert shows_rest(drive(posts, speed), AHEAD, UP) == (speed == 0.0)


def test_the_same_few_things_show_no_rest() -> None:
    """They may be parts of the platform; nor does a single scan, nor nothing that stands."""
    near = np.column_stack([np.linspace(-4.0, 4.0, 5), np.full(5, 2.0)])
    one = np.column_stack([np.linspace(8.0, 8.4, 3), np.full(3, 6.5)])
    assert not shows_rest(drive(near, 0.0), AHEAD, UP)
    assert not shows_rest(drive(one, 0.0), AHEAD, UP)
    assert not shows_rest(drive(one, 0.0)[:1], AHEAD, UP)
