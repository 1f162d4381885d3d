"""Direct odometry between two frames, so that another process can go on from there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from boxplus.systems.direct_odometry.direct_odometry import DirectOdometry
from boxplus.systems.direct_odometry.two_view_start import TwoViewStart

_GIVEN = ("camera", "config", "stereo", "_start")


def snapshot_of(odometry: DirectOdometry) -> dict[str, object]:
    """All that later estimates depend on beside camera and config; only to be read, before anything is pushed."""
    start = vars(odometry)["_start"]
    own = {name: value for name, value in vars(odometry).items() if name not in _GIVEN}
    return {"own": own, "start": None if start is None else start.snapshot()}


def restore(odometry: DirectOdometry, snapshot: Mapping[str, Any]) -> None:
    """Go on from where another odometry with the same camera and config was: estimates are the same to the bit."""
    vars(odometry).update(snapshot["own"])
    if snapshot["start"] is not None:
        start = TwoViewStart(odometry.camera)
        start.restore(snapshot["start"])
        vars(odometry)["_start"] = start
