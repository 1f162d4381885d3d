"""Direct odometry over a whole camera recording, with every result on disk as soon as it is known."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

import boxplus
from boxplus.errors import BoxplusError, InputError, OutputError
from boxplus.formats.output import atomic_file, output_error
from boxplus.formats.trajectory_writer import TrajectoryWriter
from boxplus.recordings.cameras.events import CameraRecording
from boxplus.recordings.cameras.options import CameraRecordingOptions
from boxplus.runs.frame_pairs import ChosenCameras, choose_cameras, frame_pairs
from boxplus.runs.output_folder import SUMMARY, output_folder
from boxplus.systems.direct_odometry.config import DirectOdometryConfig
from boxplus.systems.direct_odometry.direct_odometry import DirectOdometry
from boxplus.systems.direct_odometry.estimate import Estimate

PROGRAM = "boxplus vo"
FILES = ("run.json", "config.yaml", "frames.csv", "report.html", "trajectory.tum", "trajectory.kitti.txt", "trajectory.csv")
COLUMNS = (
    "time_ns",
    "status",
    "keyframe",
    "is_keyframe",
    "overlap",
    "pixels",
    "sigma",
    "residual_ratio",
    "a",
    "b",
    "ms",
    "reasons",
)
_SUMMARY_EVERY_S = 2.0
_MOST_LOST, _MOST_DOUBTED = 0.1, 0.5  # shares of the frames from which on the whole run is not to be trusted


class DirectRunConfig(BaseModel):
    """Settings of a run of direct odometry; this is what `config.yaml` holds. None has to be given."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    recording: CameraRecordingOptions = Field(default_factory=CameraRecordingOptions)
    odometry: DirectOdometryConfig = Field(default_factory=DirectOdometryConfig)


class DirectRunSummary(BaseModel):
    """The content of `run.json`, written from the run's first second on."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    program: Literal["boxplus vo"] = "boxplus vo"
    version: str
    state: Literal["running", "finished", "interrupted", "failed"]
    error: str | None = None
    contradiction: str | None = Field(None, description="why the run is not to be trusted")
    process: int
    started: datetime
    updated: datetime
    recording: str
    format: str
    kind: str = Field(description="rgbd or stereo")
    cameras: tuple[str, str] = Field(description="streams that were used: image and depth, or left and right")
    evidence: list[dict[str, str]] = []
    progress: float = Field(0.0, description="share of the recording that was read, 0 to 1")
    frames: int = 0
    keyframes: int = 0
    status: dict[str, int] = Field(default={}, description="frames by status")
    duration_s: float = 0.0
    path_length_m: float = 0.0
    frame_ms: dict[str, float] | None = Field(
        None, description="processor time of the odometry per frame: median, mean, p99 [ms]"
    )
    rejected: dict[str, int] = {}
    warnings: list[str] = Field(default=[], description="reasons of frames that are not ok, each once, with how often it came")

    def write(self, path: Path) -> None:
        """Replace the file in one step."""
        with atomic_file(path) as file:
            file.write(self.model_dump_json(indent=2).encode())

    def describe_state(self) -> str:
        """One sentence."""
        doubt = "" if self.contradiction is None else f"; not to be trusted: {self.contradiction}"
        reached = f"{self.frames} frames ({self.duration_s:.1f} s)"
        if self.state == "finished":
            return f"finished: {reached}{doubt}"
        return f"{self.state} after {reached}: the trajectory is complete up to there; {self.progress:.0%} was read{doubt}"


@contextmanager
def claim_direct_folder(folder: str | Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A folder to write a run into, locked while the block runs; see `output_folder`."""
    path = Path(folder)

    def own_files() -> Iterator[Path]:
        yield from (path / name for name in FILES if (path / name).is_file())

    def own_folders() -> tuple[Path, ...]:
        return ()

    with output_folder(path, PROGRAM, own_files, own_folders, overwrite=overwrite):
        yield path


def run_direct_odometry(
    recording: CameraRecording,
    folder: Path,
    config: DirectRunConfig | None = None,
    *,
    progress: Callable[[float, int, str], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> DirectRunSummary:
    """Run direct odometry over a recording and write trajectory, frames and facts to a folder.

    Args:
        recording: opened.
        folder: from `claim_direct_folder`.
        config: settings; each has a default.
        progress: called after every frame with the share read, the number of frames and the status.
        should_stop: asked between frames; True ends the run in good order, with the state "interrupted".

    Raises:
        RecordingError: no depth and no second camera, unknown calibration, depths that are not registered, nothing to read.
        InputError: no frame could be used.
        OutputError: the folder cannot be written; what was written before is intact.
    """
    config = config or DirectRunConfig()
    run = _Run(recording, folder, config, choose_cameras(recording.info))
    return run.execute(progress or (lambda share, frames, status: None), should_stop or (lambda: False))


class _Run:
    """One run: its writers and its counts."""

    def __init__(self, recording: CameraRecording, folder: Path, config: DirectRunConfig, cameras: ChosenCameras) -> None:
        self._recording, self._folder, self._config, self._cameras = recording, folder, config, cameras
        self._odometry = DirectOdometry(cameras.camera, config.odometry, stereo=cameras.stereo)
        self._started = datetime.now(UTC)
        self._status: Counter[str] = Counter()
        self._rejected: Counter[str] = Counter()
        self._reasons: dict[str, tuple[str, int]] = {}
        self._ms: list[float] = []
        self._first_ns: int | None = None
        self._last_ns, self._length_m = 0, 0.0
        self._last_p: NDArray[np.float64] | None = None
        self._due = 0.0

    def execute(self, progress: Callable[[float, int, str], None], should_stop: Callable[[], bool]) -> DirectRunSummary:
        """Everything; see `run_direct_odometry`."""
        with atomic_file(self._folder / "config.yaml") as file:
            file.write(yaml.safe_dump(self._config.model_dump(mode="json"), sort_keys=False).encode())
        self._write_summary("running")
        try:
            state = self._process(progress, should_stop)
            if state == "finished" and not self._ms:
                raise InputError(
                    "frames of an image and its depth, or of left and right",
                    f"none ({'; '.join(f'{count} x {what}' for what, count in self._rejected.items()) or 'no images'})",
                    "see 'boxplus inspect' for what is wrong with the recording",
                )
        except BaseException as problem:
            named = str(problem) if isinstance(problem, BoxplusError) else f"{type(problem).__name__}: {problem}"
            with suppress(OutputError):
                if isinstance(problem, KeyboardInterrupt):
                    self._write_summary("interrupted")
                else:
                    self._write_summary("failed", named)
            raise
        return self._write_summary(state)

    def _process(
        self, progress: Callable[[float, int, str], None], should_stop: Callable[[], bool]
    ) -> Literal["finished", "interrupted"]:
        with ExitStack() as stack:
            trajectory = stack.enter_context(TrajectoryWriter(self._folder))
            table = self._folder / "frames.csv"
            try:
                rows = stack.enter_context(table.open("w", encoding="utf-8", buffering=1))
                rows.write(",".join(COLUMNS) + "\n")
                for one, two in frame_pairs(self._recording, self._cameras, self._rejected):
                    began = time.thread_time()
                    if self._cameras.kind == "rgbd":
                        estimate = self._odometry.push_rgbd(one.time_ns, one.grey(), two.depth())
                    else:
                        estimate = self._odometry.push_stereo(one.time_ns, one.grey(), two.grey())
                    self._keep(estimate, 1e3 * (time.thread_time() - began))
                    trajectory.append(
                        estimate.time_ns,
                        estimate.R_world_camera,
                        estimate.p_world_camera,
                        estimate.pose_covariance,
                        estimate.status,
                    )
                    rows.write(_row(estimate, self._ms[-1]))
                    progress(self._recording.progress, len(self._ms), estimate.status)
                    if time.perf_counter() > self._due:
                        self._write_summary("running")
                    if should_stop():
                        return "interrupted"
            except OSError as error:
                if isinstance(error, BoxplusError):
                    raise
                raise output_error(table, error) from error
        return "finished"

    def _keep(self, estimate: Estimate, ms: float) -> None:
        self._status[estimate.status] += 1
        self._ms.append(ms)
        self._first_ns = estimate.time_ns if self._first_ns is None else self._first_ns
        self._last_ns = estimate.time_ns
        if self._last_p is not None:
            self._length_m += float(np.linalg.norm(estimate.p_world_camera - self._last_p))
        self._last_p = estimate.p_world_camera.copy()
        for reason in estimate.reasons:
            key = "".join(c for c in reason if not c.isdigit())
            text, count = self._reasons.get(key, (reason, 0))
            self._reasons[key] = text, count + 1

    def _contradiction(self) -> str | None:
        frames = max(len(self._ms), 1)
        lost, doubted = self._status["lost"] / frames, (self._status["lost"] + self._status["weak"]) / frames
        if self._odometry.contradiction:
            return self._odometry.contradiction
        if self._odometry.gaps:
            return (
                f"{self._odometry.gaps} times the view was lost for so long that poses after it are not related to those before"
            )
        if lost > _MOST_LOST:
            return f"{lost:.0%} of the frames have no pose ({_MOST_LOST:.0%} at most)"
        if doubted > _MOST_DOUBTED:
            return f"{doubted:.0%} of the poses are doubted ({_MOST_DOUBTED:.0%} at most)"
        return None

    def _write_summary(
        self, state: Literal["running", "finished", "interrupted", "failed"], error: str | None = None
    ) -> DirectRunSummary:
        info, ms = self._recording.info, self._ms
        summary = DirectRunSummary(
            version=boxplus.__version__,
            state=state,
            error=error,
            contradiction=self._contradiction() if ms else None,
            process=os.getpid(),
            started=self._started,
            updated=datetime.now(UTC),
            recording=str(info.path.resolve()),
            format=info.format,
            kind=self._cameras.kind,
            cameras=(self._cameras.first.name, self._cameras.second.name),
            evidence=[{"key": e.key, "value": e.value, "verdict": e.verdict, "text": e.text} for e in info.evidence],
            progress=self._recording.progress,
            frames=len(ms),
            keyframes=self._odometry.keyframes,
            status=dict(self._status),
            duration_s=0.0 if self._first_ns is None else (self._last_ns - self._first_ns) * 1e-9,
            path_length_m=self._length_m,
            frame_ms={"median": float(np.median(ms)), "mean": float(np.mean(ms)), "p99": float(np.percentile(ms, 99))}
            if ms
            else None,
            rejected={**self._rejected, **self._recording.rejected},
            warnings=[f"{text} ({count} frames)" for text, count in self._reasons.values()],
        )
        summary.write(self._folder / SUMMARY)
        self._due = time.perf_counter() + _SUMMARY_EVERY_S
        return summary


def _row(estimate: Estimate, ms: float) -> str:
    a, b = estimate.brightness
    reasons = " | ".join(estimate.reasons).replace('"', "'")
    return (
        f"{estimate.time_ns},{estimate.status},{estimate.keyframe},{int(estimate.is_keyframe)},{estimate.overlap:.4f},"
        f'{estimate.pixels},{estimate.sigma:.4f},{estimate.residual_ratio:.4f},{a:.5f},{b:.4f},{ms:.3f},"{reasons}"\n'
    )
