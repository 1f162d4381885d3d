"""The mounting of the LiDAR as a terminal shows it: looked for before the run, and told with what else the recording shows."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from boxplus.cli.terminal.run_terminal import RunTerminal
    from boxplus.recordings.recording import Recording
    from boxplus.runs.lidar_inertial.extrinsic import Extrinsic
    from boxplus.systems.lidar_inertial_odometry.config import LioConfig


def find_mounting(
    terminal: RunTerminal, recording: Recording, config: LioConfig, should_stop: Callable[[], bool] | None
) -> Extrinsic:
    """The mounting that the run begins with; it may have to be estimated, which takes seconds."""
    from boxplus.runs.lidar_inertial.extrinsic import choose_extrinsic

    with terminal.status("comparing gyroscope and LiDAR to find the extrinsic"):
        return choose_extrinsic(recording, config, should_stop=should_stop)


def print_evidence(terminal: RunTerminal, recording: Recording, extrinsic: Extrinsic) -> None:
    """What the recording shows, with the mounting that was chosen in place of the one that it states."""
    from boxplus.recordings.info import Evidence

    mounting = Evidence(
        "T_imu_lidar", extrinsic.source, "warning" if extrinsic.warning else "ok", extrinsic.warning or extrinsic.text
    )
    found = [entry for entry in recording.info.evidence if entry.key != "T_imu_lidar"]
    terminal.print_evidence(recording.info, [*found, mounting])
