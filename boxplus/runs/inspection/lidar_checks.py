"""Findings about several LiDARs: each by itself, and each of the others against the first one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from boxplus.errors import RecordingError
from boxplus.recordings.info import Evidence, Verdict
from boxplus.recordings.open import open_recording
from boxplus.recordings.options import RecordingOptions
from boxplus.recordings.recording import Recording
from boxplus.recordings.stream_checks import StreamLog, check_points, check_rate, check_rejected
from boxplus.runs.lidar_inertial.first_lidar_alone import LONGEST_S, compare_by_first_alone
from boxplus.runs.lidar_inertial.lidar_facts import watch_of
from boxplus.sensors.lidar.scan_merger import LidarShare
from boxplus.systems.lidar_inertial_agreement.hypotheses import matrix_text
from boxplus.systems.several_lidars.judgement import PairJudgement

_MANY_LEFT_OUT = 0.01
_VERDICTS: dict[str, Verdict] = {"agree": "ok", "contradicted": "error", "unverified": "warning"}


def examine_other_lidars(path: Path, options: RecordingOptions, report: Callable[[float], None]) -> list[Evidence]:
    """The findings about all LiDARs beside the first one; whatever is wrong becomes a finding.

    Args:
        path, options: of the recording; with other LiDARs.
        report: called with the share done, 0 to 1.
    """
    others = options.other_lidars or ()
    found: list[Evidence] = []
    for k, other in enumerate(others):
        try:
            with open_recording(path, options.alone(other)) as recording:
                log = StreamLog()
                for event in recording:
                    log.add(event)
                    report(0.5 * (k + recording.progress) / len(others))
                own = check_rejected(recording.rejected)
        except RecordingError as error:
            return [*found, Evidence(f"recording of {other.topic}", "cannot be read", "error", str(error))]
        own += [*check_rate("lidar", np.array(log.scan_start_ns, np.int64), gap_factor=1.5), *check_points(log)]
        found += [replace(evidence, key=f"{evidence.key} of {other.topic}") for evidence in own]
    try:
        with open_recording(path, options) as recording:
            names = tuple(f" of {other.topic}" for other in others)
            found += [evidence for evidence in recording.info.evidence if evidence.key.endswith(names)]
            found += compare_lidars(recording, lambda done: report(0.5 + 0.5 * done))
    except RecordingError as error:
        found.append(Evidence("other_lidars", "cannot be merged", "error", str(error)))
    return found


def compare_lidars(recording: Recording, report: Callable[[float], None]) -> list[Evidence]:
    """Each other LiDAR of a merged recording against the first one, which by itself tells the motion: no IMU takes part."""
    watch = watch_of(recording)
    if watch is None:
        return []
    length_s = min(LONGEST_S, max(recording.info.duration_s, 1.0))
    compare_by_first_alone(recording, watch, lambda seconds: report(min(seconds / length_s, 1.0)))
    found = [_finding(name, *judgement) for name, judgement in watch.judgements().items()]
    return found + [_left_out(share, recording.rejected) for share in recording.lidars]


def _left_out(share: LidarShare, rejected: Mapping[str, int]) -> Evidence:
    """What of a LiDAR could not be merged."""
    own = {reason: count for reason, count in rejected.items() if f" of {share.name}: " in reason}
    lost = sum(count for reason, count in own.items() if reason.startswith("points of "))
    many = lost > _MANY_LEFT_OUT * share.points or any(reason.startswith("scans of ") for reason in own)
    reasons = ", ".join(f"{count} {reason}" for reason, count in own.items()) or "none left out"
    text = f"{share.merged} of {share.points} points were merged; {reasons}"
    return Evidence(f"merging of {share.name}", f"{lost} left out", "warning" if many else "ok", text)


def _finding(name: str, judgement: PairJudgement | None, windows: int, contradicted: int) -> Evidence:
    key = f"agreement of {name}"
    if judgement is None:
        text = "the LiDARs could not be compared: the recording is too short, or the first one by itself does not tell the motion"
        return Evidence(key, "unverified", "warning", text)
    verdict = judgement.verdict
    if verdict == "agree" and contradicted:
        text = f"in {contradicted} of {windows} stretches it contradicts the first one; in the last {judgement.text}"
        return Evidence(key, "contradicted at times", "error", text)
    text = judgement.text if verdict == "unverified" else f"{judgement.text}; stretches of some seconds: {windows}"
    if verdict == "contradicted" and judgement.T_first_other is not None:
        T = judgement.T_first_other
        arm = ", ".join(f"{value:.3f}" for value in T[:3, 3])
        text += f"; T_lidar_other that fits: rotation {matrix_text(T[:3, :3])}, translation ({arm}) m"
    value = verdict if not judgement.cause else f"{verdict}: {judgement.cause}"
    return Evidence(key, value, _VERDICTS[verdict], text)
