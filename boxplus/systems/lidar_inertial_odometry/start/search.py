"""The search for a start among the scans that wait for it: again and again, while more of them come."""

from __future__ import annotations

from boxplus.sensors.sequencer import Frame
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.start.grown_paths import GrownPaths
from boxplus.systems.lidar_inertial_odometry.start.start import Start, find_start
from boxplus.systems.lidar_inertial_odometry.start.unstarted import UnstartedScans

_MOST_SCANS, _FEWER = 40, 30  # with so many, a refusal leaves no more than that
_NEW = 0.3  # share of them that is new in every try


class StartSearch:
    """Keeps the scans that wait for a start, and looks for it.

    Args:
        config: of the odometry.

    Attributes:
        frames: that wait, in order of time; where they end, the next one is appended.
        forgotten: how many scans no start will begin with, since it was last set to zero.
        problem: why there was no start at the last try that found none, a sentence.
    """

    def __init__(self, config: LioConfig) -> None:
        self._config = config
        self.frames: list[Frame] = []
        self.forgotten = 0
        self.problem: str | None = None
        self._next_try = 0  # when so many wait
        self._grown, self._unstarted = GrownPaths(), UnstartedScans(config)

    @property
    def due(self) -> bool:
        """Whether enough scans are new to try again."""
        if len(self.frames) < self._next_try:
            return False
        return (self.frames[-1].scan.end_ns - self.frames[0].scan.start_ns) * 1e-9 >= self._config.start_duration

    def find(self) -> Start | None:
        """A start with what waits; then `frames` begins with its first scan."""
        found = find_start(self.frames, self._config, self._grown)
        if isinstance(found, Start):
            self._forget(sum(frame.scan.end_ns < found.time_ns for frame in self.frames))
            return found
        self.problem = found
        seen = len(self.frames)
        self._forget(self._outlived())
        self._next_try = len(self.frames) + 1 + int(_NEW * seen)
        return None

    def give_up(self) -> None:
        """No more scans will come: what the sensors contradict is added to the problem."""
        self._forget(len(self.frames))
        self._next_try = 0
        self.problem = self._unstarted.named(self.problem)

    def _outlived(self) -> int:
        """How many of the oldest scans make room, so that a start that takes long stays cheap: up to where another path began."""
        begun = [k for k, frame in enumerate(self.frames) if self._grown.is_whole_from(frame.scan)]
        if begun and begun[0] > 0:  # the oldest path is torn, and stays so; the last that began has been gone on with just now
            return begun[-1]
        if len(self.frames) < _MOST_SCANS:
            return 0
        fewest = len(self.frames) - _FEWER
        return min((k for k in begun if k >= fewest), default=fewest)

    def _forget(self, oldest: int) -> None:
        self.forgotten += self._unstarted.add(self.frames[:oldest])
        del self.frames[:oldest]
        if self.frames:
            self._grown.forget_before(self.frames[0].scan)
        else:
            self._grown = GrownPaths()
