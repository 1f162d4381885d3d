"""A recording as a stream of scans and IMU samples."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Generic, Protocol, Self, TypeVar

from boxplus.errors import RecordingError
from boxplus.recordings.info import Evidence, RecordingInfo
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.lidar.scan_merger import LidarShare, ScanMerger
from boxplus.sensors.satellites.gnss import GnssFixes

_LOG = logging.getLogger(__name__)

Event = Scan | ImuSamples


def end_ns(event: Event) -> int | None:
    """The last instant of an event [ns]; None of samples without any."""
    if isinstance(event, Scan):
        return event.end_ns
    return int(event.time_ns[-1]) if len(event) else None


@dataclass(slots=True)
class Tally:
    """What a reader counts while it reads.

    Attributes:
        rejected: dropped points and messages by reason (`points: not finite`, `messages: malformed cloud`).
        done: messages read so far, for the progress.
        damage: what of the file could not be read, one sentence each.
        merger: of several LiDARs.
    """

    rejected: Counter[str] = field(default_factory=Counter)
    done: int = 0
    damage: list[str] = field(default_factory=list)
    merger: ScanMerger | None = None

    def count_scan(self, scan: Scan) -> None:
        """Add the points a scan dropped on construction."""
        for reason, count in scan.rejected.items():
            self.rejected[f"points: {reason}"] += count


class _Info(Protocol):
    """What any recording says of itself."""

    path: Path
    message_count: int
    evidence: list[Evidence]


InfoT = TypeVar("InfoT", bound=_Info)
EventT = TypeVar("EventT")


class EventStream(Generic[InfoT, EventT]):
    """An opened file or folder that yields events in constant memory; every iteration starts at the beginning.

    Attributes:
        info: what the recording contains, how it is read, and why.
    """

    delivers = "events"

    def __init__(self, info: InfoT, read: Callable[[Tally], Iterator[EventT]], close: Callable[[], None]) -> None:
        self.info = info
        self._read = read
        self._close = close
        self._tally = Tally()
        self._finished = False

    def _taken(self, event: EventT, tally: Tally) -> EventT:
        """The event as it is handed on; what is counted of it is."""
        return event

    def events(self) -> Iterator[EventT]:
        """The events. What cannot be read is counted in `rejected` and logged.

        Raises:
            RecordingError: nothing at all could be read.
        """
        self._tally = tally = Tally()
        self._finished = False
        seen = 0
        for event in self._read(tally):
            seen += 1
            yield self._taken(event, tally)
        self._finished = True
        self._report_damage(tally)
        if not seen:
            reasons = ", ".join(f"{count} {reason}" for reason, count in tally.rejected.items()) or "; ".join(tally.damage)
            raise RecordingError(
                self.delivers,
                f"none in {self.info.path.name} ({reasons or 'no messages'})",
                "inspect the file with 'boxplus inspect'",
            )

    def __iter__(self) -> Iterator[EventT]:
        return self.events()

    def read_again(self) -> Iterator[EventT]:
        """The events from the beginning, beside an iteration that is over: its `rejected` and `progress` stay."""
        tally = Tally()
        for event in self._read(tally):
            yield self._taken(event, tally)

    @property
    def rejected(self) -> dict[str, int]:
        """Points and messages dropped so far in the current iteration, by reason."""
        return dict(self._tally.rejected)

    @property
    def progress(self) -> float:
        """How much of the current iteration is done, in [0, 1]."""
        if self._finished:
            return 1.0
        return min(self._tally.done / max(self.info.message_count, 1), 1.0)

    def _report_damage(self, tally: Tally) -> None:
        for text in dict.fromkeys(tally.damage):
            tally.rejected["unreadable stretches of the file"] += 1
            evidence = Evidence("file", "damaged", "warning", text)
            if evidence not in self.info.evidence:
                self.info.evidence.append(evidence)
                _LOG.warning("%s: %s", self.info.path.name, text)

    def close(self) -> None:
        """Release the files."""
        self._close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


class Recording(EventStream[RecordingInfo, Event]):
    """An opened recording. Iterating yields its scans and blocks of IMU samples in the order of the file, in constant memory.

    Every iteration starts at the beginning and resets the counters. Times are those of the messages' stamps; neither their
    order nor gaps are touched, that is the sequencer's business.

    Example:
        >>> with bp.open_recording("flight.bag") as recording:
        ...     kinds = {type(event).__name__ for event in recording}  # every iteration begins at the beginning
        ...     print(sorted(kinds), recording.rejected)
        ['ImuSamples', 'Scan'] {}
    """

    delivers = "scans and IMU samples"

    def __init__(
        self,
        info: RecordingInfo,
        read: Callable[[Tally], Iterator[Event]],
        close: Callable[[], None],
        read_fixes: Callable[[], GnssFixes] | None = None,
    ) -> None:
        super().__init__(info, read, close)
        self._lidar_shift_ns = 0
        self._read_fixes = read_fixes

    def fixes(self) -> GnssFixes:
        """All positions by satellite of the stretch that is read, in a pass of their own over the file; none where
        `info.gnss_topic` is empty. What is no position is counted in `rejected` of the result.
        """
        return GnssFixes.from_arrays([], []) if self._read_fixes is None else self._read_fixes()

    def shift_lidar(self, offset_s: float) -> None:
        """Add this to all times of the LiDAR from the next iteration on [s]; `info.evidence` says so."""
        self._lidar_shift_ns = round(offset_s * 1e9)
        text = "given; added to all times of the LiDAR, to bring them to the IMU's clock"
        self.info.evidence.append(Evidence("lidar_time_offset", f"{offset_s * 1e3:+.1f} ms", "ok", text))

    @property
    def lidars(self) -> list[LidarShare]:
        """What each of several LiDARs has given so far in the current iteration, the first one first; empty for one alone."""
        return [] if self._tally.merger is None else self._tally.merger.shares

    @property
    def time_steps(self) -> list[str]:
        """Where the times of one of several LiDARs stepped back for good: one sentence each."""
        return [] if self._tally.merger is None else self._tally.merger.time_steps

    def _taken(self, event: Event, tally: Tally) -> Event:
        if isinstance(event, Scan):
            tally.count_scan(event)
            if self._lidar_shift_ns:
                return event.shifted(self._lidar_shift_ns)
        return event
