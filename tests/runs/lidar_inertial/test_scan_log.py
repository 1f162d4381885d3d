"""`scans.csv` read again."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.runs.lidar_inertial.scan_log import SCAN_COLUMNS, unmeasured
from boxplus.runs.storage.row_log import RowLog
from boxplus.systems.lidar_inertial_odometry.estimate import WeakDirection


def log(*texts: str) -> RowLog:
    count = len(texts)
    status, numbers = np.full(count, "weak"), np.zeros((count, len(SCAN_COLUMNS.numbers)))
    return RowLog(np.arange(count), status, numbers, {"weak_directions": list(texts)}, SCAN_COLUMNS)


def test_directions_that_move_are_found_and_those_that_turn_are_not() -> None:
    along_y, turn = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 0.9])
    moves, turns = WeakDirection(np.zeros(3), along_y, 1.0), WeakDirection(turn, 0.1 * along_y, 1.0)
    both = WeakDirection(turn, 0.4 * along_y, 1.0)
    found = unmeasured(log("", str(moves), str(turns), f"{both}; {moves}"))
    expected = np.zeros((4, 3, 3))
    expected[[1, 3], 1, 1] = 1.0, 1.16
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_direction_that_is_none_is_named() -> None:
    with pytest.raises(InputError, match=r"directions of three numbers in scans.csv – got \(1, up\)"):
        unmeasured(log("position along (1, up) in the world frame"))
