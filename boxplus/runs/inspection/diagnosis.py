"""A diagnosis: the findings about a recording, from both of its passes."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import as_path, as_settings
from boxplus.errors import RecordingError
from boxplus.recordings.bags.gnss import NAV_SAT_FIX
from boxplus.recordings.cameras.open import has_cameras_only, open_camera_recording
from boxplus.recordings.cameras.options import CameraRecordingOptions
from boxplus.recordings.gnss_source import read_fixes
from boxplus.recordings.info import Evidence, Topic, Verdict
from boxplus.recordings.open import open_recording
from boxplus.recordings.options import NO_GNSS, RecordingOptions
from boxplus.recordings.recording import Recording
from boxplus.recordings.stream_checks import StreamLog, check_cover, check_points, check_rate, check_rejected
from boxplus.runs.inspection.agreement_checks import Compared, check_agreement
from boxplus.runs.inspection.cameras.examination import examine_cameras
from boxplus.runs.inspection.gnss_checks import check_gnss, check_receivers
from boxplus.runs.inspection.imu_checks import check_rest, check_saturation, check_values, first_second, quiet_stretch
from boxplus.runs.inspection.lidar_checks import examine_other_lidars
from boxplus.runs.inspection.stretches import Stretch, gather_scans, lively_stretches
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import in_order
from boxplus.systems.lidar_inertial_agreement.agreement import compare_sensors, usable
from boxplus.systems.lidar_inertial_agreement.hypotheses import judges_clocks, judges_rotation
from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import lidar_path
from boxplus.systems.lidar_inertial_agreement.rest import Rest, judge_rest
from boxplus.systems.lidar_inertial_odometry.config import LioConfig

_STRETCH_S = 8.0
_STRETCHES = 3
_REST_NS = 2_000_000_000
_FEWEST_REST_SCANS = 4
_SLOW_IMU_HZ = 50.0


@dataclass(slots=True)
class Diagnosis:
    """The findings about a recording.

    Attributes:
        path: the recording.
        format: its format, empty when it could not be opened.
        topics: its streams.
        duration_s: its length [s].
        evidence: the findings, in the order of the examination.
        R_imu_lidar: (3, 3) estimated rotation from LiDAR to IMU coordinates, None where the motion does not show it.
        time_offset_s: estimated offset to add to the LiDAR's times as they are read [s], or None.

    Example:
        >>> diagnosis = bp.diagnose("flight.bag", bp.RecordingOptions(duration_s=0.5))
        >>> [finding.value for finding in diagnosis.evidence if finding.key == "point_time_unit"]
        ['s']
    """

    path: Path
    format: str = ""
    topics: list[Topic] = field(default_factory=list)
    duration_s: float = 0.0
    evidence: list[Evidence] = field(default_factory=list)
    R_imu_lidar: NDArray[np.float64] | None = None
    time_offset_s: float | None = None

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of all findings."""
        verdicts = {finding.verdict for finding in self.evidence}
        return "error" if "error" in verdicts else "warning" if "warning" in verdicts else "ok"

    def to_json(self) -> str:
        """Everything, as JSON."""
        return json.dumps(
            {
                "path": str(self.path),
                "format": self.format,
                "verdict": self.verdict,
                "duration_s": self.duration_s,
                "topics": [asdict(topic) for topic in self.topics],
                "evidence": [asdict(finding) for finding in self.evidence],
                "R_imu_lidar": None if self.R_imu_lidar is None else self.R_imu_lidar.tolist(),
                "time_offset_s": self.time_offset_s,
            },
            indent=1,
        )


def diagnose(
    path: str | Path,
    options: RecordingOptions | None = None,
    on_progress: Callable[[float], None] | None = None,
    *,
    T_imu_lidar: NDArray[np.float64] | None = None,
    camchain: Path | None = None,
    frame_rate_hz: float | None = None,
) -> Diagnosis:
    """Examine a recording. Whatever is wrong with it becomes a finding; nothing is raised for bad data.

    Args:
        path: a recording that `open_recording` takes, or, of cameras without a LiDAR, `open_camera_recording`.
        options: what is decided by the user.
        on_progress: called with the fraction done, in [0, 1].
        T_imu_lidar: (4, 4) a mounting to check, LiDAR coordinates to IMU coordinates; the recording's own when None.
        camchain: Kalibr camchain of a recording of cameras.
        frame_rate_hz: of a recording of cameras without times of its images [Hz].

    Example:
        >>> diagnosis = bp.diagnose("flight.bag", bp.RecordingOptions(duration_s=1.0))
        >>> sorted({finding.verdict for finding in diagnosis.evidence})
        ['ok']
    """
    path = as_path(path, "a recording")
    diagnosis = Diagnosis(path)
    report = on_progress or (lambda _: None)
    options = as_settings(RecordingOptions, options)
    if options.lidar_topic is None and T_imu_lidar is None and path.exists() and has_cameras_only(path):
        _examine_cameras(path, options, camchain, frame_rate_hz, diagnosis, report)
        report(1.0)
        return diagnosis
    # Of several LiDARs the first one by itself, then the others and all together.
    first, share = options.model_copy(update={"other_lidars": None}), 0.6 if options.other_lidars else 1.0
    try:
        recording = open_recording(path, first)
    except RecordingError as error:
        diagnosis.evidence.append(Evidence("recording", "cannot be read", "error", str(error)))
        return diagnosis
    with recording:
        _examine(recording, first, T_imu_lidar, diagnosis, lambda done: report(share * done))
    if options.other_lidars:
        diagnosis.evidence += examine_other_lidars(path, options, lambda done: report(share + (1.0 - share) * done))
    report(1.0)
    return diagnosis


def _examine_cameras(
    path: Path,
    options: RecordingOptions,
    camchain: Path | None,
    frame_rate_hz: float | None,
    diagnosis: Diagnosis,
    report: Callable[[float], None],
) -> None:
    asked = CameraRecordingOptions(
        imu_topic=options.imu_topic,
        calibration=camchain,
        frame_rate_hz=frame_rate_hz,
        gyro_unit=options.gyro_unit,
        accel_unit=options.accel_unit,
        start_s=options.start_s,
        duration_s=options.duration_s,
    )
    found = diagnosis.evidence
    try:
        recording = open_camera_recording(path, asked)
    except RecordingError as error:
        found.append(Evidence("recording", "cannot be read", "error", str(error)))
        return
    with recording:
        info = recording.info
        diagnosis.format, diagnosis.topics, diagnosis.duration_s = info.format, info.topics, info.duration_s
        listed = ", ".join(f"{topic.name} [{topic.type}] {topic.count}" for topic in info.topics)
        found.append(Evidence("topics", str(len(info.topics)), "ok", f"{info.duration_s:.2f} s: {listed}"))
        found += examine_cameras(recording, report)


def _examine(
    recording: Recording,
    options: RecordingOptions,
    T_given: NDArray[np.float64] | None,
    diagnosis: Diagnosis,
    report: Callable[[float], None],
) -> None:
    info = recording.info
    diagnosis.format, diagnosis.topics, diagnosis.duration_s = info.format, info.topics, info.duration_s
    found = diagnosis.evidence
    listed = ", ".join(f"{topic.name} [{topic.type}] {topic.count}" for topic in info.topics)
    found.append(Evidence("topics", str(len(info.topics)), "ok", f"{info.duration_s:.2f} s: {listed}"))
    log = StreamLog()
    try:
        for event in recording:
            log.add(event)
            report(0.4 * recording.progress)
    except RecordingError as error:
        found.append(Evidence("recording", "cannot be read", "error", str(error)))
        return
    rejected = recording.rejected
    T_declared, given = info.T_imu_lidar, [*info.evidence]
    if T_given is not None:
        T_declared = T_given
        given = [evidence for evidence in given if evidence.key != "T_imu_lidar"]
        given.append(Evidence("T_imu_lidar", "given", "ok", "LiDAR pose in the IMU frame as given; checked below"))
    found += given
    found += check_rejected(rejected)
    found += check_rate("lidar", np.array(log.scan_start_ns, np.int64), gap_factor=1.5)
    found += check_points(log)
    imu = log.all_imu()
    if info.gnss_topic:
        found += check_gnss(recording.fixes(), np.array(log.scan_start_ns, np.int64), usable(imu))
    receivers = [topic.name for topic in info.topics if topic.type == NAV_SAT_FIX and topic.count]
    if len(receivers) > 1 and options.gnss_topic != NO_GNSS:
        found += check_receivers({topic: read_fixes(info.path, topic) for topic in receivers})
    if not len(imu):
        return
    found += check_rate("imu", imu.time_ns, gap_factor=3.0, slow_hz=_SLOW_IMU_HZ)
    found.append(check_cover(log, imu))
    found += check_values(imu)
    clean = usable(imu)
    if len(clean) < 10:
        found.append(
            Evidence("imu_values", "unusable", "error", f"{len(clean)} of {len(imu)} IMU samples are finite and in order")
        )
        return
    quiet = quiet_stretch(clean)
    still = first_second(clean) if quiet is None else quiet
    resting = _beginning(clean, still)
    lively = lively_stretches(clean, _STRETCH_S, _STRETCHES)
    gather_scans(recording, [resting, *lively], lambda done: report(0.4 + 0.1 * done))
    config = LioConfig()  # type: ignore[call-arg]
    found += check_rest(clean, still, quiet=quiet is not None, rest=_rest(resting, config))
    found.append(check_saturation(clean))
    compared = []
    for number, stretch in enumerate(lively):
        agreement = compare_sensors(stretch.scans, stretch.imu, config, T_declared=T_declared, refine=True)
        compared.append(Compared.judged((stretch.begin_ns - int(clean.time_ns[0])) * 1e-9, agreement, T_declared))
        report(0.5 + 0.5 * (number + 1) / len(lively))
    found += check_agreement(compared, info, T_declared, options.lidar_time_offset_s)
    shown = [one.agreement.rotation for one in compared if judges_rotation(one.agreement)]
    best = min((fit for fit in shown if fit is not None), key=lambda fit: float(fit.rotation_std[0][-1]), default=None)
    if best is not None:
        diagnosis.R_imu_lidar = best.R_imu_lidar
        diagnosis.time_offset_s = best.offset_s if judges_clocks(best) else None


def _beginning(imu: ImuSamples, part: slice) -> Stretch:
    """As much of a stretch as is needed to see whether the LiDAR moves."""
    begin_ns, end_ns = int(imu.time_ns[part.start]), int(imu.time_ns[part.stop - 1])
    return Stretch.between(imu, begin_ns, min(end_ns, begin_ns + _REST_NS))


def _rest(stretch: Stretch, config: LioConfig) -> Rest | None:
    """What the LiDAR says about a standstill, None where its scans do not overlap."""
    if len(stretch.scans) < _FEWEST_REST_SCANS:
        return None
    scans = in_order(stretch.scans)
    path = lidar_path(scans, config)
    if path.failed or path.segment[-1] != path.segment[0]:
        return None
    return judge_rest(path, scans, config)
