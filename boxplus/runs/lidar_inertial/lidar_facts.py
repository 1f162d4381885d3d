"""What `run.json` says of several LiDARs that were merged."""

from __future__ import annotations

import numpy as np

from boxplus.errors import printable
from boxplus.recordings.recording import Recording
from boxplus.runs.lidar_inertial.summary import LidarFacts
from boxplus.runs.run_facts import Gap, WarningFacts
from boxplus.systems.several_lidars.watch import LidarWatch


def watch_of(recording: Recording) -> LidarWatch | None:
    """What checks the LiDARs of a recording against each other; None for one alone."""
    others = recording.info.other_lidars
    return LidarWatch([other.topic for other in others], [other.T_lidar_other for other in others]) if others else None


def lidar_facts(recording: Recording, watch: LidarWatch | None, origin_ns: int | None) -> list[LidarFacts]:
    """One for each LiDAR, the first one first; empty for one alone."""
    info, shares = recording.info, recording.lidars
    if watch is None or not shares:
        return []
    judged = watch.judgements()
    facts = []
    for k, share in enumerate(shares):
        other = info.other_lidars[k - 1] if k else None
        found, windows, contradicted = judged[share.name] if k else (None, 0, 0)
        begin_ns = origin_ns or 0
        facts.append(
            LidarFacts(
                topic=printable(share.name),
                T_lidar_other=(np.eye(4) if other is None else other.T_lidar_other).tolist(),
                source="the first one" if other is None else printable(other.source),
                time_offset_s=0.0 if other is None else other.time_offset_s,
                scans=share.scans,
                points=share.points,
                merged_points=share.merged,
                absent_scans=share.absent,
                silences=[
                    Gap(begin_s=(begin - begin_ns) * 1e-9, duration_s=(end - begin) * 1e-9) for begin, end in share.silences
                ],
                checked=None if k == 0 else "unverified" if found is None else found.verdict,
                checked_text=None if found is None else found.text,
                windows=windows,
                windows_contradicted=contradicted,
            )
        )
    return facts


def lidar_warnings(facts: list[LidarFacts], time_steps: list[str]) -> list[WarningFacts]:
    """Who fell silent, and whose clock stepped."""
    warnings = [WarningFacts(text=text, count=1) for text in time_steps]
    for lidar in facts:
        if lidar.points and not lidar.merged_points:
            text = f"none of the {lidar.points} points of {lidar.topic} lies in the time of a scan: look at its clock"
            warnings.append(WarningFacts(text=text, count=1))
        elif lidar.silences:
            longest = max(lidar.silences, key=lambda gap: gap.duration_s)
            text = (
                f"{lidar.topic} gave nothing for up to {longest.duration_s:.1f} s; the scans went on with the other LiDARs alone"
            )
            warnings.append(WarningFacts(text=text, count=len(lidar.silences), first_s=lidar.silences[0].begin_s))
    return warnings
