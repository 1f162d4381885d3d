"""What `run.json` holds after `boxplus refine`."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Literal

from pydantic import Field

from boxplus.formats.output import atomic_file
from boxplus.runs.run_facts import Part, State


class MapSharpness(Part):
    """How sharp a map is, by points that took no part in refining."""

    thickness_m: float = Field(description="root mean square distance of points from their planes [m]")
    entropy: float = Field(description="of the points about the middle of their plane [nats]")
    points: int
    planes: int


class RefinedReceiver(Part):
    """What positions by satellite came to."""

    fixes: int = Field(description="that the result rests on")
    heading_sigma_deg: float
    position_sigma_m: float = Field(description="of a horizontal axis of the first pose on the Earth [m]")
    lever_arm_m: tuple[float, float, float] = Field(description="antenna in the IMU's frame")
    lever_arm_sigma_m: tuple[float, float, float] = Field(description="zero where it was given")
    delay_s: float = Field(description="by which fixes are stamped late")
    delay_sigma_s: float


class RefineSummary(Part):
    """The facts of a refined run."""

    program: Literal["boxplus refine"] = "boxplus refine"
    versions: dict[str, str]
    state: State
    error: str | None = None
    started: datetime
    updated: datetime
    run: str = Field(description="folder of the run that was refined")
    recording: str = Field(description="path of the recording")
    accepted: bool = Field(False, description="trajectory and map are the refined ones; else they are those of the run")
    refusal: str | None = Field(None, description="why it was not accepted")
    doubt: str | None = Field(None, description="why what was accepted is not to be trusted before somebody has looked at it")
    scans: int = 0
    keyframes: int = 0
    planes: int = 0
    cost: list[tuple[float, float]] = Field(default=[], description="of the keyframes at the begin and end of each round")
    before: MapSharpness | None = None
    after: MapSharpness | None = None
    largest_shift_m: float = Field(0.0, description="by which a pose moved at most, the first one held [m]")
    largest_turn_deg: float = Field(0.0, description="by which a pose turned at most [deg]")
    gravity_tilt_deg: float = Field(0.0, description="of the vertical in the world of the run, as refined [deg]")
    T_imu_lidar_before: list[list[float]] = Field(default=[])
    T_imu_lidar_after: list[list[float]] = Field(default=[])
    extrinsic: str = Field("", description="whether the mounting was refined, and why not")
    extrinsic_sigma: list[float] = Field(default=[], description="of T_imu_lidar, [w, v] [rad, m]; zero where it was held")
    time_offset: str = Field("", description="whether the time offset was refined, and why not")
    time_offset_s: float = Field(0.0, description="clock of the IMU minus that of the LiDAR, as refined [s]")
    time_offset_sigma_s: float = Field(0.0, description="zero where it was held")
    loops: int = Field(0, description="of a run of 'boxplus slam' that it began with")
    loops_told_by_planes: int = Field(0, description="in the place of which planes stood that both visits see")
    loops_contradicted: int = Field(0, description="that lie beyond their covariance from where refining has put the visits")
    receiver: RefinedReceiver | None = Field(None, description="None: without positions by satellite")
    ate_before_m: float | None = Field(None, description="against the ground truth that was given [m]")
    ate_after_m: float | None = None
    map_points: int = 0
    seconds: dict[str, float] = Field(default={}, description="spent by stage")
    peak_memory_mb: float | None = None
    warnings: list[str] = Field(default=[])

    def write(self, path: Path) -> None:
        """Replace the file in one step.

        Raises:
            OutputError: it cannot be written; the file before stays.
        """
        with atomic_file(path) as file:
            file.write(self.model_dump_json(indent=2).encode())

    def verdict(self) -> str:
        """One sentence on what became of it."""
        if self.state != "finished":
            return f"{self.state}: nothing was refined" + (f". {self.error}" if self.error else "")
        if self.before is None or self.after is None:
            return "finished"
        change = f"thickness of planes {1e3 * self.before.thickness_m:.3f} → {1e3 * self.after.thickness_m:.3f} mm"
        if self.accepted:
            return f"accepted: {change}"
        return f"NOT accepted, the trajectory is that of the run: {self.refusal} ({change})"
