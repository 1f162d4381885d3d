"""What `run.json` holds after `boxplus slam`; that of the odometry is in the folder `odometry`."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Literal

from pydantic import Field

from boxplus.formats.output import atomic_file
from boxplus.runs.run_facts import Part, State, read_facts

LEFT_IN_PLACE = "no loop was closed: trajectory and map are those of the odometry"


class GnssFacts(Part):
    """What positions by satellite came to."""

    topic: str
    refusal: str | None = Field(None, description="why the map is not laid onto the Earth")
    used: int = Field(0, description="fixes the result rests on")
    left_out: dict[str, int] = Field(default={}, description="how many others, by reason")
    stretches: list[tuple[float, float, float]] = Field(
        default=[], description="of fixes that fit nothing: begin since the first fix [s], duration [s], distance [m]"
    )
    origin: tuple[float, float, float] | None = Field(None, description="latitude, longitude [deg], height [m], WGS84")
    epsg: int | None = Field(None, description="of the UTM zone of the origin")
    T_enu_map: list[float] | None = Field(None, description="qw, qx, qy, qz, x, y, z")
    covariance: list[list[float]] | None = Field(None, description="(6, 6) of T_enu_map, [w, v] on the right [rad, m]")
    T_map_odo: list[float] | None = Field(None, description="at the newest local map")
    heading_sigma_deg: float | None = None
    position_sigma_m: float | None = Field(None, description="of a horizontal axis, root mean square over the local maps")
    rms_m: float | None = Field(None, description="of the fixes that are used, to the ground track [m]")
    lever_arm_m: tuple[float, float, float] | None = Field(None, description="antenna in the IMU's frame")
    lever_arm_sigma_m: tuple[float, float, float] | None = Field(None, description="zero where it was given")
    delay_s: float | None = Field(None, description="by which fixes are stamped late")
    delay_sigma_s: float | None = None
    noise_scale: float | None = Field(None, description="factor of the standard deviations that the receiver states")
    height_scale: float | None = Field(None, description="and that of the heights beside it; 1 but where they scatter far more")
    unshown_slide_m: float | None = Field(
        None, description="less than this fixes may slide over the recording, and nothing is said: the odometry may drift as much"
    )
    unshown_turn_deg: float | None = Field(None, description="and so much they may be turned half way")


class SlamSummary(Part):
    """The facts of a run with loop closure."""

    program: Literal["boxplus slam"] = "boxplus slam"
    versions: dict[str, str]
    state: State
    error: str | None = None
    resumed: int = Field(0, description="how often the run went on after it had been killed or interrupted")
    started: datetime
    updated: datetime
    recording: str = Field(description="path of the recording")
    contradiction: str | None = Field(
        None, description="why the result is not to be trusted: how sensors contradict each other, or loops the odometry"
    )
    scans: int = 0
    path_length_m: float = Field(0.0, description="along the odometry [m]")
    local_maps: int = 0
    loops_looked_at: int = 0
    loops_accepted: int = 0
    loops_forced: int = Field(0, description="believed because the user said so")
    loops_refused: dict[str, int] = Field(default={}, description="how many, by what spoke against them")
    gnss: GnssFacts | None = Field(None, description="None: the recording has no positions by satellite, or they were left out")
    largest_shift_m: float = Field(0.0, description="by which closing loops moved a local map at most [m]")
    last_shift_m: float = Field(0.0, description="and the last one [m]")
    map_points: int = Field(0, description="in the corrected map")
    spool_bytes: int | None = Field(None, description="size of scans.spool; null where no scans were kept")
    slam_s: float = Field(0.0, description="seconds spent on local maps and loops")
    writing_s: float = Field(0.0, description="and on writing the corrected trajectory and map")
    warnings: list[str] = Field(default=[])

    def describe_state(self) -> str:
        """One sentence on how far the run came, and whether its result is to be trusted."""
        doubt = "" if self.contradiction is None else f"; not to be trusted: {self.contradiction}"
        if self.state in ("finished", "interrupted"):
            closed = f"{self.loops_accepted} loops closed, of {self.loops_looked_at} looked at"
            return f"{self.state}: {self.scans} scans, {self.local_maps} local maps, {closed}{doubt}"
        how = f"stopped by an error: {self.error}" if self.state == "failed" else "still running, or ended without a word"
        return f"{how}; see the folder odometry for how far it came, and go on with --resume"

    def write(self, path: Path) -> None:
        """Replace the file in one step.

        Raises:
            OutputError: it cannot be written; the file before stays.
        """
        with atomic_file(path) as file:
            file.write(self.model_dump_json(indent=2).encode())


def read_slam_summary(path: Path) -> SlamSummary:
    """Read `run.json` of 'boxplus slam'.

    Raises:
        InputError: missing, cut, not of this version, or of another kind of run.
    """
    return read_facts(SlamSummary, path)
