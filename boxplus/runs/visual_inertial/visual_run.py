"""Visual-inertial odometry over a whole recording, with every result on disk as soon as it is known."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from boxplus._arguments import as_settings
from boxplus.errors import InputError, printable
from boxplus.recordings.cameras.events import CameraEvent, CameraRecording
from boxplus.runs.cameras.camera_run import CameraRun
from boxplus.runs.cameras.causes import BEFORE_S, MAY_BE, calibration_doubts, likely_causes, sentence
from boxplus.runs.cameras.folder import VioFolder, claim_camera_folder
from boxplus.runs.cameras.image_gaps import ImageGaps
from boxplus.runs.cameras.landmark_file import LandmarkFile, LandmarksById, write_lines
from boxplus.runs.cameras.turning import Turning
from boxplus.runs.inspection.imu_checks import doubt_of_gravity
from boxplus.runs.run_facts import StartFacts, State, WarningFacts
from boxplus.runs.run_loop import Progress
from boxplus.runs.vague_pose import is_unknown, is_vague, largest_sigmas, length_text
from boxplus.runs.visual_inertial.config import VioRunConfig, dump_vio_config
from boxplus.runs.visual_inertial.frame_log import FrameLogWriter
from boxplus.runs.visual_inertial.rig_of_recording import rig_of_recording
from boxplus.runs.visual_inertial.summary import CameraFacts, LengthFacts, VioSummary
from boxplus.sensors.images.camera_image import CameraImage
from boxplus.systems.visual_inertial_odometry.corners.carried import CARRIED
from boxplus.systems.visual_inertial_odometry.estimate import VioEstimate
from boxplus.systems.visual_inertial_odometry.odometry import REPEATED, VisualInertialOdometry
from boxplus.systems.visual_inertial_odometry.start.start import Start

_AT_REST = "mean specific force [m/s²]"
_TOLD = {
    "duration [s]": "over {:.2f} s",
    "image motion [px]": "images move by {:.2f} px",
    _AT_REST: "specific force {:.2f} m/s²",
    "acceleration, variation [m/s²]": "acceleration varies by {:.2f} m/s²",
    "sightings, deviation [px]": "corners deviate by {:.2f} px",
    "gravity, deviation [deg]": "gravity is known to {:.2f} deg",
    "scale, deviation [%]": "scale to {:.1f} %",
}  # of the tests of a start; `run.json` has all of them
_OWN_STATE = (
    "_images", "_rejected", "_lines_rejected", "_keyframes", "_before_start", "_mountings", "_time_offset_s",
    "_troubled_ns", "_turning", "_image_gaps", "_refusal", "_worst_sigma_m",
)  # fmt: skip
_MUCH_LOST, _MUCH_DOUBTED = 0.15, 0.5  # shares of the frames, of the second those that are weak as well: a cause is looked for
_MOST_LOST = 0.5  # share of the frames from which on the whole run is not to be trusted
_CARRIED = 10  # corners that moved along with the camera, which are no accident
_LATE_S = 5.0  # one camera that moves from the first image on finds its start within four seconds
_EARLIER = "let a recording start at rest, or with a motion that changes, in view of corners at all distances"
_VAGUE_M = 0.5  # standard deviation of the distance beyond which a landmark does not enter the map


class View(Protocol):
    """Is shown every frame of a run: `boxplus.report.LiveCameraView`."""

    def show(self, estimate: VioEstimate) -> None: ...


def run_visual_odometry(
    recording: CameraRecording,
    folder: str | Path | VioFolder,
    config: VioRunConfig | None = None,
    *,
    overwrite: bool = False,
    resume: bool = False,
    progress: Callable[[Progress], None] | None = None,
    view: View | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> VioSummary:
    """Run visual-inertial odometry over a recording and write trajectory, frames, landmarks and facts to a folder.

    Every estimate goes to disk at once. A run that is killed leaves everything up to its last frame (of the landmarks what was
    known some seconds before); `run.json` then says so. The report is drawn from the folder, by `boxplus.report.write_report`.

    Args:
        recording: opened.
        folder: created; see docs/output_folder.md for what it holds. Or what `claim_camera_folder` yields.
        config: settings; each has a default.
        overwrite: replace the results of an earlier run in the folder.
        resume: go on with a run that was killed or interrupted, from its last checkpoint.
        progress: called after every event that was read.
        view: shown every frame, those before the start too.
        should_stop: asked between events; True ends the run in good order, with the state "interrupted".

    Returns:
        The facts of the run, as in `run.json`.

    Raises:
        InputError: the calibration or the IMU's noise is not known; the folder holds something else, or another process is
            writing there; no start was found in the whole recording; nothing to resume, or a run over another recording or with
            other settings.
        OutputError: the folder cannot be written or the disk is full; what was written before is intact.
        RecordingError: nothing could be read.

    Example:
        >>> with open_camera_recording("MH_01_easy") as recording:   # doctest: +SKIP
        ...     run_visual_odometry(recording, "out").status
        {'ok': 3638}
    """
    config = as_settings(VioRunConfig, config)
    run = folder if isinstance(folder, VioFolder) else VioFolder(Path(folder))
    claimed = nullcontext(run) if run is folder else claim_camera_folder(run, overwrite=overwrite, resume=resume)
    with claimed as vio_folder:
        run_of_recording = _Run(recording, vio_folder, config, progress or (lambda _: None), view)
        if resume:
            run_of_recording.resume()
        return run_of_recording.execute(should_stop or (lambda: False))


class _Run(CameraRun[VioEstimate, VioSummary]):
    """One run of visual-inertial odometry: its writers and its landmarks."""

    def __init__(
        self,
        recording: CameraRecording,
        folder: VioFolder,
        config: VioRunConfig,
        progress: Callable[[Progress], None],
        view: View | None,
    ) -> None:
        text = dump_vio_config(config, recording.info)
        self._landmarks, self._lines = LandmarksById(), LandmarksById(size=6)
        self._line_file = LandmarkFile(folder.lines, self._lines.points, write_lines)
        super().__init__(recording, folder, text, progress, self._landmarks.points)
        self._rig = rig_of_recording(recording.info, config.odometry)
        self._odometry = VisualInertialOdometry(config.odometry, self._rig)
        self._view = view
        self._images: Counter[int] = Counter()
        self._rejected: Counter[str] = Counter()
        self._lines_rejected: Counter[str] = Counter()
        self._keyframes = self._before_start = 0
        self._push_s = 0.0  # since the frame before
        self._mountings = np.array([camera.T_imu_camera for camera in self._rig.cameras])
        self._time_offset_s = 0.0
        self._troubled_ns: int | None = None
        self._refusal: str | None = None  # why the last frame without a start gave none
        self._worst_sigma_m = 0.0  # of the positions of frames that are called ok
        self._causes: list[str] = []
        self._refuted: str | None = None  # the first cause with which nothing that was measured can be trusted
        self._doubts: list[str] = []
        self._turning, self._image_gaps = Turning(BEFORE_S), ImageGaps()
        self._longest_gap_s = config.odometry.max_imu_gap

    def open(self, stack: ExitStack) -> None:
        """See `RunLoop.open`."""
        super().open(stack)
        self._frames = stack.enter_context(FrameLogWriter(self._folder.frames, go_on=self.written_until_ns is not None))

    def snapshot(self) -> tuple[dict[str, object], dict[str, object]]:
        """See `ResumableRun.snapshot`."""
        own = {name: getattr(self, name) for name in _OWN_STATE}
        return self._odometry.snapshot(), {"own": own, "landmarks": vars(self._landmarks), "lines": vars(self._lines)}

    def restore(self, odometry: dict[str, Any], run: dict[str, Any]) -> None:
        """See `ResumableRun.restore`."""
        self._odometry.restore(odometry)
        vars(self._landmarks).update(run["landmarks"])
        vars(self._lines).update(run["lines"])
        vars(self).update(run["own"])

    def between_events(self) -> None:
        """See `RunLoop.between_events`."""
        super().between_events()
        self.seconds["writing"] += self._line_file.write_if_due()

    def at_end(self, state: State) -> None:
        """See `RunLoop.at_end`."""
        super().at_end(state)
        self.seconds["writing"] += self._line_file.write()
        if state != "finished":
            return
        turning_ns = self._turning.until_ns()
        is_to_be_trusted = self._odometry.contradiction is None and not self._is_unknown() and not self._is_much_doubted()
        if not self.counts.count or not is_to_be_trusted:
            self.stage = "looking for the cause"
            self.show_progress()
            longest = self.counts.longest_imu_gap_s
            if longest > self._longest_gap_s:
                self._causes.append(f"a gap of {longest:.2f} s in the samples of the IMU")
            around_ns = turning_ns if self.counts.count and self._troubled_ns is None else self._troubled_ns
            found = likely_causes(self._info, self.recording.read_again(), len(self._rig.cameras), around_ns)
            self._causes += [sentence(finding) for finding in found]
            self._refuted = next((sentence(finding) for finding in found if finding.verdict == "error"), None)
        elif turning_ns is not None:
            self.stage = "comparing clock, mounting, shutter and focal length with the gyroscope"
            self.show_progress()
            again, offset_s = self.recording.read_again(), self._time_offset_s
            self._doubts = calibration_doubts(self._info, again, turning_ns, time_offset_s=offset_s)

    def push(self, event: CameraEvent) -> list[VioEstimate]:
        """See `RunLoop.push`."""
        began = time.perf_counter()
        if isinstance(event, CameraImage):
            self._images[event.camera] += 1
            if event.camera == 0:
                self._image_gaps.add(event.time_ns)
            estimates = self._odometry.push_image(event) if event.camera < len(self._rig.cameras) else []
        else:
            self.counts.add_imu(event.time_ns)
            self._turning.add(event)
            estimates = self._odometry.push_imu(event)
        self._push_s += time.perf_counter() - began
        return estimates

    def flush(self) -> list[VioEstimate]:
        """See `RunLoop.flush`."""
        return self._odometry.flush()

    def keep(self, estimate: VioEstimate) -> None:
        """Write one estimate; before the start there is none."""
        stages = dict(estimate.timing_s)
        stages["window"] = max(self._push_s - sum(stages.values()), 0.0)
        self._push_s, self.status = 0.0, estimate.status
        if self._troubled_ns is None and (self._odometry.contradiction is not None or estimate.status == "lost"):
            self._troubled_ns = estimate.time_ns
        self._rejected.update(estimate.rejected)
        self._lines_rejected.update(estimate.lines_rejected)
        if self._view is not None:
            self._view.show(estimate)
        if estimate.status == "starting":
            self._before_start += 1
            self._refusal = estimate.reasons[0]
            return
        began = time.perf_counter()
        T, covariance = estimate.T_world_imu, estimate.covariance[:6, :6]
        if self.is_new(estimate.time_ns):
            self._trajectory.append(estimate.time_ns, T[:3, :3], T[:3, 3], covariance, estimate.status)
            self._frames.append(estimate, stages)
        if estimate.status == "ok":
            self._worst_sigma_m = max(self._worst_sigma_m, largest_sigmas(covariance)[1])
        trouble = f"began with: {'; '.join(estimate.reasons)}"
        self.counts.add_estimate(estimate.time_ns, T[:3, 3], estimate.status, stages, trouble)
        if estimate.is_keyframe:
            self._keyframes += 1
            good = estimate.landmark_sigmas < _VAGUE_M
            self._landmarks.update(estimate.landmark_ids[good], estimate.landmarks[good])
            self._lines.update(estimate.line_ids, estimate.line_ends)
        self._mountings, self._time_offset_s = estimate.T_imu_camera, estimate.time_offset_s
        self.seconds["writing"] += time.perf_counter() - began

    def nothing_found(self) -> InputError:
        """See `RunLoop.nothing_found`."""
        rejected = self.recording.rejected | dict(self._odometry.counters)
        reasons = [f"{count} × {reason}" for reason, count in rejected.items()]
        if self._odometry.start_problem:
            reasons.append(self._odometry.start_problem)
        cause = f"; {MAY_BE}: {'; '.join(self._causes)}" if self._causes else ""
        images = ", ".join(str(count) for _, count in sorted(self._images.items())) or "no"
        return InputError(
            "frames that IMU samples cover, and a start that can be found",
            f"{images} images and {self.counts.imu_samples_read} IMU samples, and no start "
            f"({'; '.join(reasons) or 'no reason counted'}){cause}",
            "see 'boxplus inspect' for what is wrong with the recording; one camera needs accelerations that change",
        )

    def summarize(self, state: State, error: str | None) -> VioSummary:
        """See `RunLoop.summarize`."""
        counts, start = self.counts, self._odometry.start
        shared = self.shared_facts(state, error, with_imu=True)
        shared["warnings"] += self._gap_warnings()
        shared["warnings"] += counts.imu_warnings(self._odometry.counters)
        shared["warnings"] += counts.told_of_late_start(
            self._before_start, self._images[0], self._image_gaps.first_ns, _LATE_S, _EARLIER, self._refusal
        )
        repeated = self._odometry.counters.get(REPEATED, 0)
        if repeated:
            text = f"{repeated} {REPEATED}: a driver or the recording delivers images again with new stamps; they are left out"
            shared["warnings"].append(WarningFacts(text=text, count=repeated))
        carried = self._rejected[CARRIED]
        if carried >= _CARRIED:
            text = (
                f"{carried} corners stood still in the image while the camera turned: dirt on the lens, text in the image, a "
                "part of the platform in view, or the middle of a circle that it moved on; they were left out"
            )
            shared["warnings"].append(WarningFacts(text=text, count=carried))
        if is_vague(self._worst_sigma_m, counts.path_length_m) and not self._is_unknown():
            shared["warnings"].append(WarningFacts(text=self._told_of_position(), count=1))
        doubts = self._doubts if start is None else [*gravity_doubts(start, len(self._rig.cameras)), *self._doubts]
        shared["warnings"] += [WarningFacts(text=doubt, count=1) for doubt in doubts]
        shared["warnings"] += [WarningFacts(text=f"{MAY_BE}: {cause}", count=1) for cause in self._causes]
        return VioSummary(
            **shared,
            cameras=self._cameras(),
            start=None if start is None else _start_facts(start),
            start_facts={} if start is None else {name: float(value) for name, value in start.facts.items()},
            start_problem=self._odometry.start_problem,
            keyframes=self._keyframes,
            frames_before_start=self._before_start,
            contradiction=self._contradiction(),
            imu_samples_read=counts.imu_samples_read,
            rejected={
                "recording": self.recording.rejected,
                "odometry": dict(self._odometry.counters),
                "corners": dict(self._rejected),
            }
            | ({"lines": dict(self._lines_rejected)} if self._lines_rejected else {}),
            imu_gaps=counts.imu_gaps(),
            time_offset_s=self._time_offset_s,
            landmarks=len(self._landmarks),
            lengths=None if start is None else _length_facts(*self._odometry.lengths),
            lines=len(self._lines),
        )

    def _share(self, *status: str) -> float:
        """Of the frames, 0 to 1."""
        return sum(self.counts.status.get(one, 0) for one in status) / max(self.counts.count, 1)

    def _is_much_doubted(self) -> bool:
        return self._share("lost") > _MUCH_LOST or self._share("lost", "weak") > _MUCH_DOUBTED

    def _is_unknown(self) -> bool:
        return is_unknown(self._worst_sigma_m, self.counts.path_length_m)

    def _told_of_position(self) -> str:
        return (
            f"by its own covariance the run knows some positions to {length_text(self._worst_sigma_m)} (1 sigma) only, of a way "
            f"of {length_text(self.counts.path_length_m)}, in frames that are called ok: its start, its IMU and what it saw tell "
            "no more"
        )

    def _contradiction(self) -> str | None:
        """Why the run is not to be trusted, whatever the status of its frames; None where nothing says so."""
        if self._odometry.contradiction is not None:
            return self._odometry.contradiction
        lost, weak = self._share("lost"), self._share("weak")
        if self._refuted is not None and self._is_much_doubted():
            return f"{lost:.0%} of the frames are lost and {weak:.0%} weak, and {self._refuted}"
        if self._is_unknown():
            return self._told_of_position()
        return f"{lost:.0%} of the frames are lost ({_MOST_LOST:.0%} at most)" if lost > _MOST_LOST else None

    def _gap_warnings(self) -> list[WarningFacts]:
        """Times on the way at which the IMU was silent, or the first camera was, and enough was known to go on."""
        if self.counts.first_time_ns is None or self._odometry.contradiction is not None:
            return []
        silent = [gap for gap in self.counts.imu_gaps() if gap.duration_s > self._longest_gap_s]
        told = [
            (silent, "samples of the IMU: images alone tell the way across it"),
            (self._image_gaps.gaps(self.counts.first_time_ns), "images of the first camera: the IMU tells the way across it"),
        ]
        warnings = []
        for gaps, text in told:
            gaps = [gap for gap in gaps if gap.begin_s + gap.duration_s > 0.0 and gap.begin_s < self.counts.duration_s]
            if gaps:
                longest = max(gap.duration_s for gap in gaps)
                warnings.append(
                    WarningFacts(text=f"a gap of {longest:.2f} s in the {text}", count=len(gaps), first_s=gaps[0].begin_s)
                )
        return warnings

    def _cameras(self) -> list[CameraFacts]:
        facts = []
        for number, mounted in enumerate(self._rig.cameras):
            stream = self._info.cameras[number]
            facts.append(
                CameraFacts(
                    name=printable(stream.name),
                    model=type(mounted.model).__name__,
                    width=mounted.width,
                    height=mounted.height,
                    images=self._images[number],
                    T_imu_camera_start=mounted.T_imu_camera.tolist(),
                    T_imu_camera_end=self._mountings[number].tolist() if self.counts.count else None,
                    sources={name: printable(source) for name, source in stream.sources.items()},
                )
            )
        return facts


def gravity_doubts(start: Start, cameras: int) -> list[str]:
    """What a start at rest says against the accelerometer, a sentence: the lengths of one camera are all from it."""
    doubt = doubt_of_gravity(start.facts[_AT_REST]) if start.kind == "at rest" else ""
    lengths = "; the lengths of one camera are off by as much where it is the scale" if cameras == 1 else ""
    return [f"at rest the accelerometer measured {start.facts[_AT_REST]:.2f} m/s² of 9.81{doubt}{lengths}"] if doubt else []


def _length_facts(longer: float, sigma: float) -> LengthFacts:
    return LengthFacts(longer=longer, sigma=sigma) if np.isfinite(sigma) else LengthFacts(longer=None, sigma=None)


def _start_facts(start: Start) -> StartFacts:
    text = ", ".join(phrase.format(start.facts[name]) for name, phrase in _TOLD.items() if name in start.facts)
    return StartFacts(kind=start.kind, text=text, duration_s=float((start.time_ns[-1] - start.time_ns[0]) * 1e-9))
