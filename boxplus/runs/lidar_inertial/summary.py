"""What `run.json` holds after `boxplus lio`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from boxplus.runs.run_facts import Distribution, Gap, Part, RunFacts, read_facts

Matrix = list[list[float]]


class RecordingFacts(Part):
    """The recording as it was read."""

    path: str
    format: str
    lidar_topic: str
    imu_topic: str
    duration_s: float = Field(description="between its first and last message [s]")
    messages: int = Field(description="LiDAR and IMU messages to read")
    progress: float = Field(0.0, description="share of the recording that was read, 0 to 1")
    first_points: tuple[str | None, ...] | None = Field(
        None, description="digests of the points of its first scan, by shells of distance: by them it is known again"
    )
    evidence: list[dict[str, str]] = Field(default=[], description="every reading found from the data: key, value, verdict, text")


class ExtrinsicFacts(Part):
    """The LiDAR's pose in the IMU frame."""

    source: str
    text: str
    estimation: str
    T_imu_lidar_start: Matrix
    T_imu_lidar_end: Matrix | None = None
    sigma_end_deg: float | None = Field(None, description="of it by the filter's covariance, 1 sigma, about the worst axis")
    sigma_end_m: float | None = Field(None, description="likewise along the worst axis")


class ShownFacts(Part):
    """What the motion has shown of one part of the sensors; see `boxplus.systems.lidar_inertial_agreement.shown.Shown`."""

    part: Literal["gyroscope", "clocks", "mounting", "lengths"]
    shown: bool = Field(description="whether an error of it would have been named, or was")
    value: float | None = Field(description="a factor (gyroscope, lengths), or what the LiDAR's times lack [s]")
    std: float | None = Field(description="standard deviation of it; of the mounting's rotation about its worst axis [deg]")
    unnoticed: float | None = Field(description="how far it may be off without being named; null: any error may")
    text: str


class LidarFacts(Part):
    """One of several LiDARs that were merged; the first one comes first."""

    topic: str
    T_lidar_other: Matrix = Field(description="its pose in the frame of the first one, held while running")
    source: str = Field(description="where that comes from")
    time_offset_s: float = Field(0.0, description="added to its times")
    scans: int = Field(0, description="that were read")
    points: int = Field(0, description="of these")
    merged_points: int = Field(0, description="that became part of a scan")
    absent_scans: int = Field(0, description="merged scans without a point of it")
    silences: list[Gap] = Field(default=[], description="when it gave nothing, though another one did")
    checked: str | None = Field(None, description="against the first one: agree, contradicted or unverified")
    checked_text: str | None = None
    windows: int = Field(0, description="stretches of some seconds in which it could be checked")
    windows_contradicted: int = 0


class TimingFacts(Part):
    """Where the time went."""

    scan_ms: Distribution | None = Field(None, description="the odometry's time per scan, all stages")
    stages_ms: dict[str, Distribution] = Field(default={})
    reading_s: float = Field(0.0, description="waiting for the reader, all in all")
    odometry_s: float = 0.0
    writing_s: float = Field(0.0, description="trajectory and map tiles")
    merging_s: float = Field(0.0, description="map.ply and map.pcd")
    total_s: float = Field(0.0, description="from the start of the run to this writing")
    real_time_factor: float = Field(0.0, description="sensor time by the time of the run until its last scan, reading included")
    compiled_kernels: int = Field(0, description="kernels compiled during the run: more than zero on first use only")


class MapFacts(Part):
    """The map on disk."""

    registered_points: int = Field(0, description="points handed to the map, before thinning")
    stored_points: int = Field(0, description="points in the tiles")
    merged_points: int | None = Field(None, description="points in map.ply and map.pcd")
    rejected_points: int = Field(0, description="not finite, or more than 1000 km from the origin")
    voxel_m: float | None = None


class RunSummary(RunFacts):
    """The content of `run.json`."""

    program: Literal["boxplus lio"] = "boxplus lio"
    resumed: int = Field(0, description="how often the run went on after it had been killed or interrupted")
    recording: RecordingFacts
    extrinsic: ExtrinsicFacts
    unknown_position: str | None = Field(
        None,
        description="that the run itself does not know where it ends, to a fifth of its way: the `contradiction` if no other",
    )
    sensors: list[ShownFacts] = Field(
        default=[], description="what the motion has shown of LiDAR and IMU since the last start; empty without an IMU"
    )
    lidars: list[LidarFacts] = Field(default=[], description="of several that were merged; empty for one alone")
    scans: int = 0
    scans_read: int = 0
    scan_gaps: list[Gap] = Field(default=[])
    timing: TimingFacts = TimingFacts()  # type: ignore[call-arg]
    map: MapFacts = MapFacts()  # type: ignore[call-arg]

    @property
    def estimates(self) -> tuple[int, str]:
        """See `RunFacts.estimates`."""
        return self.scans, "scans"

    @property
    def contradiction_of_sensors(self) -> str | None:
        """`contradiction`, but for a position that the run alone does not know, and something else may."""
        return None if self.contradiction == self.unknown_position else self.contradiction

    @property
    def has_imu(self) -> bool:
        """Whether an IMU took part."""
        return self.extrinsic.source != "none"

    @property
    def not_shown(self) -> str | None:
        """See `RunFacts.not_shown`."""
        open_parts = [part.text for part in self.sensors if not part.shown]
        return "; ".join(open_parts) or None

    @property
    def progress(self) -> float:
        """See `RunFacts.progress`."""
        return self.recording.progress

    @property
    def written(self) -> str:
        """See `RunFacts.written`."""
        return "trajectory and map"


def read_summary(path: str | Path) -> RunSummary:
    """Read `run.json` of 'boxplus lio'; see `read_facts`.

    Raises:
        InputError: missing, cut, not of this version, or of another kind of run.
    """
    return read_facts(RunSummary, path)
