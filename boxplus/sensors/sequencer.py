"""Bring IMU samples and scans together: each scan with the samples that cover it, in order of time.

Everything that cannot be used is counted by reason; nothing is dropped silently and nothing is half accepted.
"""

from __future__ import annotations

import hashlib
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.checked import checked_imu, checked_scan
from boxplus.sensors.inertial.glitch_filter import GlitchFilter
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.inertial.imu_values import measurements
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.time_steps import TimeSteps

_COMPARED = 500  # points, of scans that have as many
_TURNS, _PUSHED = 0.05, 0.3  # rad/s, m/s²: largest rate and standard deviation of an IMU that may rest
_EARLIER = 1.5  # intervals between samples: as long before the first one its values are held


@dataclass(frozen=True, slots=True)
class Frame:
    """A scan and the IMU samples around it.

    Attributes:
        scan: the scan.
        imu: samples from the last one at or before `begin_ns` to the first one at or after the scan's end, where they exist.
        begin_ns: end of the previous frame (for the first one: start of the scan, which the samples cover).
        covered: whether a sample at or after the scan's end exists.
        largest_gap_s: longest time between neighbouring samples within (begin_ns, scan.end_ns], ends included.
    """

    scan: Scan
    imu: ImuSamples
    begin_ns: int
    covered: bool
    largest_gap_s: float

    @property
    def duration_s(self) -> float:
        """Time from the end of the previous frame to the end of the scan [s]."""
        return (self.scan.end_ns - self.begin_ns) * 1e-9


BEFORE_START = "scan before a start could be found"
"""Why an odometry that could not begin gave up a scan, among what was rejected."""
REPEATED = "scan with all points of the one before"
"""A driver, or the recording, delivers it again with new stamps."""
AFTER_GAP = "scan after a gap, before another start could be found"
"""The same of one that could not go on."""


class Sequencer:
    """Pairs scans with IMU samples.

    Args:
        max_wait_s: a scan not covered by IMU samples is released once data this much later has arrived [s].
        max_jump_s: times further ahead than this of everything before are rejected until they prove to be the new time
            (ten in a row) [s].
    """

    _MAX_JUMP_PROOF = 10

    def __init__(self, max_wait_s: float = 0.5, max_jump_s: float = 1.0) -> None:
        self.rejected: Counter[str] = Counter()
        self._max_wait_ns = int(max_wait_s * 1e9)
        self._max_jump_ns = int(max_jump_s * 1e9)
        self._imu: deque[ImuSamples] = deque()
        self._glitches = GlitchFilter()
        self._last_imu_ns: int | None = None
        self._known_until_ns: int | None = None  # by samples that are no glitches
        self._scans: deque[Scan] = deque()
        self._last_end_ns: int | None = None
        self._newest_scan_end_ns: int | None = None
        self._imu_jumps = 0
        self._scan_jumps = 0
        self._imu_taken = 0
        self._scans_taken = 0
        self._newest_points = ""  # digest of some of the scan before
        self._imu_steps, self._scan_steps = TimeSteps("IMU"), TimeSteps("LiDAR")

    @property
    def time_steps(self) -> list[str]:
        """Where times stepped back for a second or more, and how much was left out: one sentence each."""
        return self._scan_steps.sentences() + self._imu_steps.sentences()

    def add_imu(self, samples: ImuSamples) -> None:
        """Take samples in; non-finite ones and those that do not move forward in time are counted and left out.

        Raises:
            InputError: as `checked_imu`.
        """
        samples = measurements(checked_imu(samples), self.rejected)
        if not len(samples):
            return
        if self._in_order(samples.time_ns):
            self._imu_jumps = 0
            self._imu_steps.went_on()
            self._last_imu_ns = int(samples.time_ns[-1])
            self._keep(self._glitches.take(samples))
            self._imu_taken += len(samples)
        else:
            self._add_one_by_one(samples)

    def _in_order(self, time_ns: NDArray[np.int64]) -> bool:
        """Whether nothing is wrong with any time: the usual case, which costs no loop."""
        last = self._last_imu_ns
        if last is not None and not 0 < int(time_ns[0]) - last <= self._max_jump_ns:
            return False
        steps = time_ns[1:] - time_ns[:-1]
        return not len(steps) or bool(steps.min() > 0 and steps.max() <= self._max_jump_ns)

    def _add_one_by_one(self, samples: ImuSamples) -> None:
        time = samples.time_ns
        keep = np.zeros(len(samples), dtype=bool)
        for i in range(len(samples)):
            now, last = int(time[i]), self._last_imu_ns
            if last is not None and now == last:
                self.rejected["IMU sample with a repeated time"] += 1
                continue
            if last is not None and last - now > self._max_jump_ns and self._imu_taken + keep.sum() == 1:
                # The first sample of all was the one that is wrong: nothing else is near it.
                self.rejected["IMU sample far ahead of all that follow"] += 1
                self._imu.clear()
                self._glitches = GlitchFilter()
                keep[:] = False
                self._imu_taken, last = 0, None
            if last is not None and now < last:
                self.rejected["IMU sample going back in time"] += 1
                self._imu_steps.went_back(now, last)
                continue
            if last is not None and now - last > self._max_jump_ns and self._imu_jumps < self._MAX_JUMP_PROOF:
                self._imu_jumps += 1
                self.rejected["IMU sample jumping ahead in time"] += 1
                continue
            self._imu_jumps = 0
            self._imu_steps.went_on()
            self._last_imu_ns = now
            keep[i] = True
        self._imu_taken += int(keep.sum())
        self._keep(self._glitches.take(samples.where(keep)))

    def _keep(self, samples: ImuSamples) -> None:
        for reason, count in self._glitches.rejected.items():
            self.rejected[reason] = count
        if len(samples):
            self._imu.append(samples)
            self._known_until_ns = int(samples.time_ns[-1])

    def add_scan(self, scan: Scan) -> None:
        """Take a scan in; one that is empty, or does not end after the one before, is counted and left out.

        Raises:
            InputError: as `checked_scan`.
        """
        scan = checked_scan(scan)
        if not len(scan):
            self.rejected["scan without a valid point"] += 1
            return
        without_strays = scan.without_strays()
        if len(without_strays) < len(scan):
            self.rejected["point with a time far from its scan"] += len(scan) - len(without_strays)
        scan = without_strays
        newest = self._newest_scan_end_ns
        if newest is not None and self._scans_taken == len(self._scans) == 1 and newest - scan.end_ns > self._max_jump_ns:
            # The first scan of all was the one that is wrong: nothing else is near it.
            self.rejected["scan far ahead of all that follow"] += 1
            self._scans.clear()
            self._scans_taken, newest = 0, None
        if newest is not None:
            if scan.end_ns == newest:
                self.rejected["scan with a repeated time"] += 1
                return
            if scan.end_ns < newest:
                self.rejected["scan going back in time"] += 1
                self._scan_steps.went_back(scan.end_ns, newest)
                return
            # Where the IMU has gone as far, the time has really passed.
            ahead = scan.end_ns - max(newest, self._last_imu_ns or newest)
            if ahead > self._max_jump_ns and self._scan_jumps < self._MAX_JUMP_PROOF:
                self._scan_jumps += 1
                self.rejected["scan jumping ahead in time"] += 1
                return
        self._scan_jumps = 0
        self._scans_taken += 1
        self._scan_steps.went_on()
        self._newest_scan_end_ns = scan.end_ns
        self._scans.append(scan)

    def frames(self, *, flush: bool = False) -> list[Frame]:
        """The frames that are complete by now; with `flush`, also those that never will be."""
        if flush:
            self._keep(self._glitches.rest())
        ready = []
        while self._scans:
            scan = self._scans[0]
            covered = self._known_until_ns is not None and self._known_until_ns >= scan.end_ns
            waited = (self._newest_scan_end_ns or 0) - scan.end_ns >= self._max_wait_ns
            if not (covered or waited or flush):
                break
            self._scans.popleft()
            frame = self._frame(scan, covered)
            if frame is not None:
                ready.append(frame)
        return ready

    def take_scans(self) -> list[Scan]:
        """The scans so far, whatever the IMU covers: for who estimates without one."""
        scans = list(self._scans)
        self._scans.clear()
        return scans

    def imu_since(self, time_ns: int) -> ImuSamples:
        """Samples from the last one at or before `time_ns` on; they stay in the sequencer."""
        block = self._joined()
        first = max(int(np.searchsorted(block.time_ns, time_ns, side="right")) - 1, 0)
        return block.where(slice(first, None))

    def _repeats(self, scan: Scan, begin_ns: int) -> bool:
        """Whether a scan has the points of the one before, to the bit, while the IMU moved.

        A simulated LiDAR without noise gives the same points as long as it rests.
        """
        before, self._newest_points = self._newest_points, _digest(scan.p_lidar)
        if not before or before != self._newest_points:
            return False
        imu = self._joined()
        first, stop = np.searchsorted(imu.time_ns, [begin_ns, scan.end_ns], side="right")
        gyro, accel = imu.gyro[first:stop], imu.accel[first:stop]
        return bool(np.abs(gyro).max(initial=0.0) > _TURNS or (len(accel) and accel.std(axis=0).max() > _PUSHED))

    def _frame(self, scan: Scan, covered: bool) -> Frame | None:
        begin = scan.start_ns if self._last_end_ns is None else self._last_end_ns
        if self._repeats(scan, begin):
            self.rejected[REPEATED] += 1
            return None
        imu = self._take_until(begin, scan.end_ns)
        if not len(imu):
            self.rejected["scan without any IMU sample"] += 1
            return None
        if self._last_end_ns is None and self._began_unseen(scan, imu):
            self.rejected["scan that began before the first IMU sample"] += 1
            return None
        self._last_end_ns = scan.end_ns
        # A gap that began before the frame, or has not ended yet, is a gap in all of it.
        spans = [int(imu.time_ns[0]) - begin, scan.end_ns - int(imu.time_ns[-1]), int(np.diff(imu.time_ns).max(initial=0))]
        return Frame(scan, imu, begin, covered, max(spans) * 1e-9)

    @staticmethod
    def _began_unseen(scan: Scan, imu: ImuSamples) -> bool:
        """Whether nothing tells how the platform moved at the beginning of a scan: as where a recording is read from its middle.

        The map that such a scan begins would be as distorted as it is.
        """
        unseen_ns = min(int(imu.time_ns[0]), scan.end_ns) - scan.start_ns
        return unseen_ns > (_EARLIER * float(np.median(np.diff(imu.time_ns))) if len(imu) > 1 else 0)

    def _take_until(self, begin_ns: int, end_ns: int) -> ImuSamples:
        """Samples from the last at or before `begin_ns` to the first at or after `end_ns`; older ones are forgotten."""
        block = self._joined()
        stop = min(int(np.searchsorted(block.time_ns, end_ns, side="left")) + 1, len(block))
        first = max(int(np.searchsorted(block.time_ns, begin_ns, side="right")) - 1, 0)
        # Two samples at or before the end stay: the next frame needs the last one before its begin.
        self._imu = deque([block.where(slice(max(stop - 2, 0), None))])
        return block.where(slice(first, stop))

    def _joined(self) -> ImuSamples:
        """All samples kept, as one block."""
        if len(self._imu) != 1:
            self._imu = deque([ImuSamples.joined(self._imu)])
        return self._imu[0]


def _digest(p_lidar: NDArray[np.float32]) -> str:
    """Of some points; empty where there are few, which may be the same by chance."""
    if len(p_lidar) < _COMPARED:
        return ""
    return hashlib.blake2b(p_lidar[:: len(p_lidar) // _COMPARED].tobytes(), digest_size=16).hexdigest()


def joined_imu(frames: Sequence[Frame]) -> ImuSamples:
    """The IMU samples of several frames, each once."""
    imu = ImuSamples.joined(frame.imu for frame in frames)
    time, first = np.unique(imu.time_ns, return_index=True)
    return ImuSamples(time, imu.gyro[first], imu.accel[first])
