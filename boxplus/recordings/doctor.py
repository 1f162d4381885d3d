"""The data doctor: examines a recording before an estimator believes it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError, RecordingError
from boxplus.recordings.info import Evidence, RecordingInfo, Topic, Verdict
from boxplus.recordings.motion_checks import (
    check_alignment,
    check_finite,
    check_force_sign,
    check_rest,
    check_saturation,
    liveliest_stretch,
)
from boxplus.recordings.open import open_recording
from boxplus.recordings.options import RecordingOptions
from boxplus.recordings.recording import Recording
from boxplus.recordings.stream_checks import StreamLog, check_cover, check_points, check_rate, check_rejected
from boxplus.sensors.imu import ImuSamples
from boxplus.sensors.lidar_rotation import align_rotations
from boxplus.sensors.scan import Scan
from boxplus.sensors.scan_registration import lidar_rotations

_STRETCH_S = 12.0
_MARGIN_NS = 300_000_000
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
        R_imu_lidar: (3, 3) estimated rotation from LiDAR to IMU coordinates, or None.
        time_offset_s: estimated offset to add to LiDAR times, or None.
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
    path: str | Path, options: RecordingOptions | None = None, on_progress: Callable[[float], None] | None = None
) -> Diagnosis:
    """Examine a recording. Whatever is wrong with it becomes a finding; nothing is raised for bad data.

    Args:
        path: a recording that `open_recording` takes.
        options: what is decided by the user.
        on_progress: called with the fraction done, in [0, 1].
    """
    path = Path(path)
    diagnosis = Diagnosis(path)
    report = on_progress or (lambda _: None)
    try:
        recording = open_recording(path, options)
    except RecordingError as error:
        diagnosis.evidence.append(Evidence("recording", "cannot be read", "error", str(error)))
        return diagnosis
    with recording:
        _examine(recording, diagnosis, report)
    report(1.0)
    return diagnosis


def _examine(recording: Recording, diagnosis: Diagnosis, report: Callable[[float], None]) -> None:
    info = recording.info
    diagnosis.format, diagnosis.topics, diagnosis.duration_s = info.format, info.topics, info.duration_s
    found = diagnosis.evidence
    listed = ", ".join(f"{topic.name} [{topic.type}] {topic.count}" for topic in info.topics)
    found.append(Evidence("topics", str(len(info.topics)), "ok", f"{info.duration_s:.2f} s: {listed}"))
    log = StreamLog()
    try:
        for event in recording:
            log.add(event)
            report(0.6 * recording.progress)
    except RecordingError as error:
        found.append(Evidence("recording", "cannot be read", "error", str(error)))
        return
    rejected = recording.rejected
    found += info.evidence
    found += check_rejected(rejected)
    found += check_rate("lidar", np.array(log.scan_start_ns, np.int64), gap_factor=1.5)
    found += check_points(log)
    imu = log.all_imu()
    if not len(imu):
        return
    found += check_rate("imu", imu.time_ns, gap_factor=3.0, slow_hz=_SLOW_IMU_HZ)
    found.append(check_cover(log, imu))
    found += check_finite(imu)
    clean = _clean(imu)
    if len(clean) < 10:
        found.append(
            Evidence("imu_values", "unusable", "error", f"{len(clean)} of {len(imu)} IMU samples are finite and in order")
        )
        return
    found += check_rest(clean)
    found.append(check_saturation(clean))
    _compare(recording, info, clean, diagnosis, report)


def _clean(imu: ImuSamples) -> ImuSamples:
    """Finite samples, in order of time, each time once."""
    finite = np.isfinite(imu.gyro).all(axis=1) & np.isfinite(imu.accel).all(axis=1)
    _, first = np.unique(imu.time_ns[finite], return_index=True)
    return ImuSamples(imu.time_ns[finite][first], imu.gyro[finite][first], imu.accel[finite][first])


def _compare(
    recording: Recording, info: RecordingInfo, imu: ImuSamples, diagnosis: Diagnosis, report: Callable[[float], None]
) -> None:
    """LiDAR against IMU over the stretch with the liveliest rotation."""
    begin_ns, end_ns = liveliest_stretch(imu, _STRETCH_S)

    def scans() -> Iterator[Scan]:
        for event in recording:
            if not isinstance(event, Scan):
                continue
            if event.start_ns > end_ns + _MARGIN_NS:
                return
            if event.end_ns >= begin_ns - _MARGIN_NS:
                done = (event.start_ns - begin_ns) / max(end_ns - begin_ns, 1)
                report(0.6 + 0.4 * min(max(done, 0.0), 1.0))
                yield event

    lidar = lidar_rotations(scans())
    inside = (imu.time_ns >= begin_ns - 3 * _MARGIN_NS) & (imu.time_ns <= end_ns + 3 * _MARGIN_NS)
    part = ImuSamples(imu.time_ns[inside], imu.gyro[inside], imu.accel[inside])
    try:
        alignment = align_rotations(lidar, part)
    except InputError as error:
        diagnosis.evidence.append(Evidence("R_imu_lidar", "unchecked", "warning", str(error)))
        return
    diagnosis.R_imu_lidar = alignment.R_imu_lidar
    diagnosis.time_offset_s = alignment.time_offset_s if np.isfinite(alignment.time_offset_std_s) else None
    diagnosis.evidence += check_alignment(info, alignment)
    diagnosis.evidence.append(check_force_sign(lidar, part, alignment))
