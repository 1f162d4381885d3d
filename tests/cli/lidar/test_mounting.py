"""The mounting that a run begins with is told in place of the one that the recording states."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np

from boxplus.cli.lidar.mounting import find_mounting, print_evidence
from boxplus.recordings.info import Evidence
from boxplus.systems.lidar_inertial_odometry.config import LioConfig


def test_what_is_printed_is_what_was_chosen() -> None:
    printed: list[Evidence] = []
    terminal: Any = SimpleNamespace(status=lambda _: nullcontext(), print_evidence=lambda _, evidence: printed.extend(evidence))
    stated = Evidence("T_imu_lidar", "unknown", "ok", "no static transform")
    unit = Evidence("gyro_unit", "rad/s", "ok", "as the message defines")
    info = SimpleNamespace(imu_topic="", T_imu_lidar=None, evidence=[stated, unit])
    recording: Any = SimpleNamespace(info=info)
    extrinsic = find_mounting(terminal, recording, LioConfig(), None)
    np.testing.assert_array_equal(extrinsic.T_imu_lidar, np.eye(4))
    print_evidence(terminal, recording, extrinsic)
    assert printed == [unit, Evidence("T_imu_lidar", "none", "ok", extrinsic.text)]
