"""Direct odometry over a whole camera recording, with every result on disk as soon as it is known."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import as_settings
from boxplus._extras import has
from boxplus.errors import InputError, printable
from boxplus.recordings.cameras.events import CameraEvent, CameraRecording
from boxplus.runs.cameras.camera_run import CameraRun
from boxplus.runs.cameras.causes import MAY_BE, likely_causes, sentence
from boxplus.runs.cameras.folder import DirectFolder, claim_camera_folder
from boxplus.runs.direct.config import DirectRunConfig, dump_direct_config
from boxplus.runs.direct.frame_log import FrameLogWriter
from boxplus.runs.direct.frame_pairs import Frame, FramePairs, choose_cameras
from boxplus.runs.direct.summary import DirectSummary, StreamFacts
from boxplus.runs.run_facts import State, WarningFacts
from boxplus.runs.run_loop import Progress
from boxplus.sensors.images.camera_image import CameraImage
from boxplus.systems.direct_odometry.direct_odometry import DirectOdometry
from boxplus.systems.direct_odometry.estimate import Estimate
from boxplus.systems.direct_odometry.snapshot import restore as restore_odometry
from boxplus.systems.direct_odometry.snapshot import snapshot_of

_NO_SCALE = (
    "one camera alone does not tell the scale: all lengths are in units of about the median depth of the first view, and the "
    "scale may drift along the way; compare with 'boxplus eval --align sim3'"
)
_ROLLS = (
    "line_delay states a rolling shutter, which direct odometry takes for taken at once: where the camera moves fast, it errs"
)
_MOST_LOST, _MOST_DOUBTED = 0.1, 0.5  # shares of the frames from which on the whole run is not to be trusted


def run_direct_odometry(
    recording: CameraRecording,
    folder: str | Path | DirectFolder,
    config: DirectRunConfig | None = None,
    *,
    overwrite: bool = False,
    resume: bool = False,
    progress: Callable[[Progress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> DirectSummary:
    """Run direct odometry over a recording and write trajectory, frames, landmarks and facts to a folder.

    Every estimate goes to disk at once. A run that is killed leaves everything up to its last frame (of the landmarks what was
    known some seconds before); `run.json` then says so. The report is drawn from the folder, by `boxplus.report.write_report`.

    Args:
        recording: opened.
        folder: created; see docs/output_folder.md for what it holds. Or what `claim_camera_folder` yields.
        config: settings; each has a default.
        overwrite: replace the results of an earlier run in the folder.
        resume: go on with a run that was killed or interrupted, from its last checkpoint.
        progress: called after every event that was read.
        should_stop: asked between events; True ends the run in good order, with the state "interrupted".

    Returns:
        The facts of the run, as in `run.json`.

    Raises:
        RecordingError: no camera of intensities, unknown calibration, depths that are not registered, nothing to read.
        InputError: no frame could be used, or one camera alone never saw parallax; the folder holds something else, or another
            process is writing there; nothing to resume, or a run over another recording or with other settings.
        OutputError: the folder cannot be written; what was written before is intact.

    Example:
        >>> with open_camera_recording("rgbd_dataset_freiburg1_desk") as recording:   # doctest: +SKIP
        ...     run_direct_odometry(recording, "out").status
        {'ok': 595}
    """
    config = as_settings(DirectRunConfig, config)
    run = folder if isinstance(folder, DirectFolder) else DirectFolder(Path(folder))
    claimed = nullcontext(run) if run is folder else claim_camera_folder(run, overwrite=overwrite, resume=resume)
    with claimed as direct_folder:
        run_of_recording = _Run(recording, direct_folder, config, progress or (lambda _: None))
        if resume:
            run_of_recording.resume()
        return run_of_recording.execute(should_stop or (lambda: False))


class _Run(CameraRun[Estimate, DirectSummary]):
    """One run of direct odometry: its writers and its landmarks."""

    def __init__(
        self, recording: CameraRecording, folder: DirectFolder, config: DirectRunConfig, progress: Callable[[Progress], None]
    ) -> None:
        text = dump_direct_config(config, recording.info)
        super().__init__(recording, folder, text, progress, self._all_landmarks)
        self._cameras = choose_cameras(recording.info, mono=config.streams.mono)
        self._pairs = FramePairs(self._cameras)
        self._odometry = DirectOdometry(self._cameras.camera, config.odometry, stereo=self._cameras.stereo)
        self._streams = [stream for stream in (self._cameras.first, self._cameras.second) if stream is not None]
        self._images = {stream.index: 0 for stream in self._streams}
        self._before_start, self._start_problem = 0, ""
        self._troubled_ns: int | None = None
        self._causes: list[str] = []
        self._landmarks: list[NDArray[np.float32]] = []  # of keyframes that left the window

    def _all_landmarks(self) -> NDArray[np.float32]:
        return np.concatenate([*self._landmarks, self._odometry.window.points()])

    def open(self, stack: ExitStack) -> None:
        """See `RunLoop.open`."""
        super().open(stack)
        self._frames = stack.enter_context(FrameLogWriter(self._folder.frames, go_on=self.written_until_ns is not None))

    def snapshot(self) -> tuple[dict[str, object], dict[str, object]]:
        """See `ResumableRun.snapshot`."""
        own = {name: getattr(self, name) for name in ("_images", "_before_start", "_start_problem", "_troubled_ns", "_landmarks")}
        return snapshot_of(self._odometry), {"own": own, "pairs": self._pairs.snapshot()}

    def restore(self, odometry: dict[str, Any], run: dict[str, Any]) -> None:
        """See `ResumableRun.restore`."""
        restore_odometry(self._odometry, odometry)
        self._pairs.restore(run["pairs"])
        vars(self).update(run["own"])

    def at_end(self, state: State) -> None:
        """See `RunLoop.at_end`."""
        super().at_end(state)
        if state == "finished" and self.counts.count and self._contradiction() and has("cv2"):
            self.stage = "looking for the cause"
            self.show_progress()
            cameras = 2 if self._cameras.kind == "stereo" else 1
            found = likely_causes(self._info, self.recording.read_again(), cameras, self._troubled_ns, with_imu=False)
            self._causes = [sentence(finding) for finding in found]

    def push(self, event: CameraEvent) -> list[Estimate]:
        """See `RunLoop.push`."""
        if not isinstance(event, CameraImage) or event.camera not in self._images:
            return []
        self._images[event.camera] += 1
        return self._estimates(self._pairs.push(event))

    def flush(self) -> list[Estimate]:
        """See `RunLoop.flush`."""
        return self._estimates(self._pairs.flush())

    def _estimates(self, frames: list[Frame]) -> list[Estimate]:
        estimates = []
        for one, two in frames:
            if two is None:
                estimate = self._odometry.push_mono(one.time_ns, one.grey())
            elif self._cameras.kind == "rgbd":
                estimate = self._odometry.push_rgbd(one.time_ns, one.grey(), two.depth())
            else:
                estimate = self._odometry.push_stereo(one.time_ns, one.grey(), two.grey())
            if estimate is not None:
                estimates.append(estimate)
            else:
                self._before_start, self._start_problem = self._before_start + 1, self._odometry.start_problem
        return estimates

    def keep(self, estimate: Estimate) -> None:
        """Write one estimate."""
        self.status = estimate.status
        if self._troubled_ns is None and (self._odometry.contradiction or estimate.status == "lost"):
            self._troubled_ns = estimate.time_ns
        began = time.perf_counter()
        T, p = estimate.R_world_camera, estimate.p_world_camera
        if self.is_new(estimate.time_ns):
            self._trajectory.append(estimate.time_ns, T, p, estimate.pose_covariance, estimate.status)
            self._frames.append(estimate)
        trouble = f"began with: {'; '.join(estimate.reasons)}"
        self.counts.add_estimate(estimate.time_ns, p, estimate.status, estimate.timing_s, trouble)
        for reason in estimate.reasons:
            self.counts.warnings.add(reason, estimate.time_ns)
        if len(estimate.finished_points):
            self._landmarks.append(estimate.finished_points)
        self.seconds["writing"] += time.perf_counter() - began

    def nothing_found(self) -> InputError:
        """See `RunLoop.nothing_found`."""
        if self._before_start:
            return InputError(
                "two views of one camera from which depths can be told",
                f"none in {self._before_start} frames (at the end: {self._start_problem})",
                "move the camera sideways, or record depth, a second camera or an IMU",
            )
        rejected = "; ".join(
            f"{count} × {what}" for what, count in (self.recording.rejected | dict(self._pairs.rejected)).items()
        )
        return InputError(
            "frames of an image and its depth, or of left and right",
            f"none ({rejected or 'no images'})",
            "see 'boxplus inspect' for what is wrong with the recording",
        )

    def summarize(self, state: State, error: str | None) -> DirectSummary:
        """See `RunLoop.summarize`."""
        facts = self.shared_facts(state, error, with_imu=False)
        rolls = [c.name for c in (self._cameras.first, self._cameras.second) if c is not None and c.readout_s]
        told = self._odometry.remarks | ({"shutter": f"{' and '.join(rolls)}: {_ROLLS}"} if rolls else {})
        facts["warnings"] = [WarningFacts(text=text, count=1) for text in told.values()] + facts["warnings"]
        if self._cameras.kind == "mono":
            facts["warnings"].insert(0, WarningFacts(text=_NO_SCALE, count=1))
        facts["warnings"] += [WarningFacts(text=f"{MAY_BE}: {cause}", count=1) for cause in self._causes]
        return DirectSummary(
            **facts,
            kind=self._cameras.kind,
            scale="unknown" if self._cameras.kind == "mono" else "metric",
            cameras=self._stream_facts(),
            keyframes=self._odometry.keyframes,
            frames_before_start=self._before_start,
            start_problem=self._start_problem,
            landmarks=len(self._all_landmarks()),
            contradiction=self._contradiction() if self.counts.count else None,
            rejected={"recording": self.recording.rejected, "frames": dict(self._pairs.rejected)},
        )

    def _contradiction(self) -> str | None:
        status, frames = self.counts.status, self.counts.count
        lost, doubted = status["lost"] / frames, (status["lost"] + status["weak"]) / frames
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

    def _stream_facts(self) -> list[StreamFacts]:
        uses = ("left", "right") if self._cameras.kind == "stereo" else ("image", "depth")
        return [
            StreamFacts(
                name=printable(stream.name),
                use=use,
                model=type(stream.model).__name__,
                width=stream.width,
                height=stream.height,
                images=self._images[stream.index],
                sources={name: printable(source) for name, source in stream.sources.items()},
            )
            for use, stream in zip(uses, self._streams, strict=False)
        ]
