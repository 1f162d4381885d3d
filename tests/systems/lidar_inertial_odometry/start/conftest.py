"""What tests of a start share."""

from __future__ import annotations

import pytest

from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import GrowingPath


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """When the scans began that have been registered, in that order."""
    begins: list[int] = []
    add = GrowingPath.add

    def counted(self: GrowingPath, scan: Scan, expected: object = None) -> None:
        begins.append(scan.start_ns)
        add(self, scan)

    monkeypatch.setattr(GrowingPath, "add", counted)
    return begins
