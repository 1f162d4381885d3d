"""What changes between two scans, and the shift that lays it there again."""

from __future__ import annotations

import numpy as np

from boxplus.systems.lidar_inertial_agreement.lidar_path.changed_points import ChangedPoints


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
