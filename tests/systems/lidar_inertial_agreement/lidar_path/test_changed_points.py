"""What changes between two scans, and what of it stands and stays."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.sensors.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.changed_points import ChangedPoints, stay_and_go


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
