"""Scans of several LiDARs on one body, merged by time: one stream of scans, in the frame of the first LiDAR.

A scan of the first LiDAR takes every point of the others that was measured since the scan before; each keeps its own time, so
that it is corrected for motion as any other. How the others lie in the frame of the first one is constant: a rigid body. Where
the first LiDAR falls silent the next one gives the scans. What cannot be merged is counted by reason.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.time_steps import TimeSteps

_LONGEST_LEAD_NS = 200_000_000  # before the scan that takes them in, where no scan came before
_MAX_JUMP_NS = 1_000_000_000
_JUMP_PROOF = 10
_MOST_SILENCES = 1000


@dataclass(slots=True)
class LidarShare:
    """What one LiDAR has given.

    Attributes:
        name: its topic.
        scans, points: that arrived.
        merged: points that became part of a scan.
        absent: merged scans without a point of it.
        silences: (begin, end) between which it gave nothing, though another one did, for longer than the wait [ns].
    """

    name: str
    scans: int = 0
    points: int = 0
    merged: int = 0
    absent: int = 0
    silences: list[tuple[int, int]] = field(default_factory=list)


@dataclass(slots=True)
class _Stream:
    """The scans of one LiDAR that wait."""

    share: LidarShare
    T_first_lidar: NDArray[np.float64]
    steps: TimeSteps
    waiting: deque[Scan] = field(default_factory=deque)
    newest_ns: int | None = None
    seen_ns: int | None = None  # of a merged scan, the last with a point of it


class ScanMerger:
    """Merges the scans of several LiDARs.

    Args:
        names: of the LiDARs, the first one first; for the counts.
        T_first_lidar: (4, 4) each: coordinates of a LiDAR to those of the first one; of the first itself the identity.
        rejected: where to count what is left out, by reason.
        max_wait_s: a scan waits so long, in times of the sensors, for the points of the others; a LiDAR that is silent for
            longer is done without [s]. Clocks must not lie further apart.

    Attributes:
        shares: one for each LiDAR.
    """

    def __init__(
        self,
        names: Sequence[str],
        T_first_lidar: Sequence[NDArray[np.float64]],
        rejected: Counter[str] | None = None,
        max_wait_s: float = 1.0,
    ) -> None:
        self.rejected = Counter() if rejected is None else rejected
        self._streams = [
            _Stream(LidarShare(name), np.array(T, dtype=np.float64), TimeSteps(f"LiDAR {name}"))
            for name, T in zip(names, T_first_lidar, strict=True)
        ]
        self._max_wait_ns = round(max_wait_s * 1e9)
        self._begin_ns: int | None = None
        self._cut_ns: int | None = None
        self._first_end_ns: int | None = None  # of the last scan of the first LiDAR that was handed on
        self._imu_ns: int | None = None
        self._jumps = 0
        self._dropped: Counter[str] = Counter()

    @property
    def shares(self) -> list[LidarShare]:
        """What each LiDAR has given."""
        return [stream.share for stream in self._streams]

    @property
    def time_steps(self) -> list[str]:
        """Where the times of a LiDAR stepped back for good: one sentence each."""
        return [text for stream in self._streams for text in stream.steps.sentences()]

    def saw_imu(self, time_ns: int) -> None:
        """Samples of an IMU up to this time have come [ns]: so much time has really passed."""
        self._imu_ns = time_ns if self._imu_ns is None else max(self._imu_ns, time_ns)

    def add(self, lidar: int, scan: Scan) -> list[Scan]:
        """Take a scan of one LiDAR in, in its own frame; returns the merged scans that are complete by now."""
        stream = self._streams[lidar]
        share = stream.share
        share.scans += 1
        share.points += len(scan)
        self._dropped.update(scan.rejected)
        if not len(scan):
            self.rejected[f"scans of {share.name}: without a valid point"] += 1
            return []
        near = scan.without_strays()
        self._count(share, "far from the time of their scan", len(scan) - len(near))
        if stream.newest_ns is not None and near.end_ns <= stream.newest_ns:
            self.rejected[f"scans of {share.name}: going back in time, or repeated"] += 1
            stream.steps.went_back(near.end_ns, stream.newest_ns)
            return []
        known = [time for time in (self._newest_ns, self._imu_ns) if time is not None]
        if self._newest_ns is not None and near.end_ns - max(known) > _MAX_JUMP_NS and self._jumps < _JUMP_PROOF:
            self._jumps += 1
            self.rejected[f"scans of {share.name}: jumping ahead in time"] += 1
            return []
        self._jumps = 0
        stream.steps.went_on()
        self._begin_ns = near.start_ns if self._begin_ns is None else self._begin_ns
        stream.newest_ns = near.end_ns
        stream.waiting.append(_turned(near, stream.T_first_lidar, lidar))
        return self._complete(flush=False)

    def flush(self) -> list[Scan]:
        """No more scans will come; what follows the last scan of all is counted and left out."""
        merged = self._complete(flush=True)
        for stream in self._streams:
            self._count(stream.share, "after the last scan", sum(map(len, stream.waiting)))
            stream.waiting.clear()
            if self._cut_ns is not None:
                self._note_silence(stream, self._cut_ns)
        return merged

    @property
    def _newest_ns(self) -> int | None:
        return max((stream.newest_ns for stream in self._streams if stream.newest_ns is not None), default=None)

    def _count(self, share: LidarShare, reason: str, points: int) -> None:
        if points:
            self.rejected[f"points of {share.name}: {reason}"] += points

    def _complete(self, *, flush: bool) -> list[Scan]:
        merged: list[Scan] = []
        while (carrier := self._carrier()) is not None:
            end_ns = self._streams[carrier].waiting[0].end_ns
            others = [stream for k, stream in enumerate(self._streams) if k != carrier]
            covered = all(stream.newest_ns is not None and stream.newest_ns >= end_ns for stream in others)
            if not (covered or flush or (self._newest_ns or 0) - end_ns >= self._max_wait_ns):
                break
            scan = self._streams[carrier].waiting.popleft()
            if carrier == 0:
                self._first_end_ns = end_ns
            if self._cut_ns is not None and end_ns <= self._cut_ns:
                self._count(self._streams[carrier].share, "later than the scan they belong to", len(scan))
                continue
            merged.append(self._merged(carrier, scan))
        return merged

    def _carrier(self) -> int | None:
        """The LiDAR whose oldest scan is next: the first, or where that is silent for long, another one that has any."""
        own = self._streams[0].waiting
        until_ns = own[0].start_ns if own else self._newest_ns
        since_ns = self._begin_ns if self._first_end_ns is None else self._first_end_ns
        if until_ns is not None and since_ns is not None and until_ns - since_ns >= self._max_wait_ns:
            oldest = [(stream.waiting[0].end_ns, k) for k, stream in enumerate(self._streams) if k and stream.waiting]
            if oldest and min(oldest)[0] <= until_ns:
                return min(oldest)[1]
        return 0 if own else None

    def _merged(self, carrier: int, scan: Scan) -> Scan:
        """The scan with the points of the others up to its end."""
        end_ns = scan.end_ns
        since_ns = scan.start_ns - _LONGEST_LEAD_NS
        since_ns = since_ns if self._cut_ns is None else max(since_ns, self._cut_ns)
        parts = [scan]
        for k, stream in enumerate(self._streams):
            if k != carrier:
                parts += self._taken(stream, since_ns, end_ns)
        self._cut_ns = end_ns
        for stream, count in zip(self._streams, np.bincount(_joined_lidar(parts), minlength=len(self._streams)), strict=True):
            stream.share.merged += int(count)
            if not count:
                stream.share.absent += 1
                continue
            self._note_silence(stream, end_ns)
            stream.seen_ns = end_ns
        dropped, self._dropped = dict(self._dropped), Counter()
        return _joined(parts, end_ns, dropped)

    def _taken(self, stream: _Stream, since_ns: int, end_ns: int) -> list[Scan]:
        """The points of a LiDAR in (since, end]; those before are counted, those after go on waiting."""
        taken: list[Scan] = []
        while stream.waiting and stream.waiting[0].time_ns.min() <= end_ns:
            scan = stream.waiting.popleft()
            due = scan.time_ns <= end_ns
            if not due.all():
                stream.waiting.appendleft(scan.where(~due))
            early = due & (scan.time_ns <= since_ns)
            late = self._cut_ns is not None and since_ns == self._cut_ns
            self._count(stream.share, "later than the scan they belong to" if late else "between two scans", int(early.sum()))
            taken.append(scan.where(due & ~early))
            if not due.all():
                break
        return [part for part in taken if len(part)]

    def _note_silence(self, stream: _Stream, now_ns: int) -> None:
        since_ns = stream.seen_ns if stream.seen_ns is not None else self._begin_ns
        if since_ns is None or now_ns - since_ns < self._max_wait_ns or len(stream.share.silences) >= _MOST_SILENCES:
            return
        stream.share.silences.append((since_ns, now_ns))


def _turned(scan: Scan, T: NDArray[np.float64], lidar: int) -> Scan:
    """The scan in the frame of the first LiDAR."""
    p = scan.p_lidar
    if lidar:
        p = np.ascontiguousarray((p.astype(np.float64) @ T[:3, :3].T + T[:3, 3]).astype(np.float32))
    return replace(scan, p_lidar=p, lidar=np.full(len(scan), lidar, np.uint8))


def _joined_lidar(parts: Sequence[Scan]) -> NDArray[np.uint8]:
    return np.concatenate([part.lidar for part in parts if part.lidar is not None])


def _joined(parts: Sequence[Scan], end_ns: int, rejected: dict[str, int]) -> Scan:
    """One scan of all parts. A LiDAR without intensities gives NaN where another one has some: nobody measured them."""
    intensity = None
    if any(part.intensity is not None for part in parts):
        missing = np.float32(np.nan)
        intensity = np.concatenate(
            [np.full(len(part), missing) if part.intensity is None else part.intensity for part in parts], dtype=np.float32
        )
    time_ns = np.concatenate([part.time_ns for part in parts])
    start_ns = min(parts[0].start_ns, int(time_ns.min()))
    p_lidar = np.concatenate([part.p_lidar for part in parts])
    return Scan(p_lidar, time_ns, intensity, start_ns, end_ns, rejected, _joined_lidar(parts))
