"""When a start is looked for: what is cheap often, what is expensive the less often the longer it has failed.

A body at rest is recognised in milliseconds, so rest is looked for all the time. A start in motion takes as long as ten frames,
and where sensors do not belong together it never comes: the next attempt waits for a fifth of the time that attempts have failed
for, two seconds at most, and at most as long as frames are kept beside those that a start takes: no motion falls between two
attempts, but what comes in the last wait of a recording is not looked at. A start that becomes possible t seconds after the first
attempt is found t / 5 later at the latest (and the 0.15 s between two looks), and ten seconds without one cost some twenty
attempts instead of seventy.
"""

from __future__ import annotations

from collections import deque

from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.visual_inertial_odometry.config import VioConfig
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks
from boxplus.systems.visual_inertial_odometry.rig import Rig
from boxplus.systems.visual_inertial_odometry.start.start import Start, find_rest, moving_start
from boxplus.systems.visual_inertial_odometry.start.turn_on_the_spot import turn_on_the_spot

_EVERY_NS = 150_000_000
_SHARE, _LONGEST_WAIT_NS = 0.2, 2_000_000_000  # of the time since the first attempt
_LONGEST_START = 4.0  # of the times a start takes: frames that wait longer are let go


class StartSearch:
    """The frames without a start, and the search for one in them.

    Attributes:
        seen: frames that wait, in order of time.
        problem: which test the last attempts did not pass; None before there was one.
    """

    def __init__(self) -> None:
        self.seen: deque[Tracks] = deque()
        self.problem: str | None = None
        self._motion_problem = ""
        self._first_attempt_ns: int | None = None
        self._next_look_ns = self._next_attempt_ns = 0

    def add(self, tracks: Tracks, config: VioConfig) -> None:
        """The next frame; those that have waited for too long are let go."""
        self.seen.append(tracks)
        while tracks.time_ns - self.seen[0].time_ns > _LONGEST_START * config.start_duration * 1e9:
            self.seen.popleft()

    def look(self, imu: ImuSamples, rig: Rig, config: VioConfig) -> Start | None:
        """A start from the frames so far, where it is time to look for one; else None, and `problem` says what failed last.

        Args:
            imu: strictly increasing samples that cover the frames, from before the first to the last.
            rig: one camera stands for mono.
        """
        seen, now_ns = list(self.seen), self.seen[-1].time_ns
        if now_ns < self._next_look_ns:
            return None
        self._next_look_ns = now_ns + _EVERY_NS
        if (now_ns - seen[0].time_ns) * 1e-9 < config.start_duration - 1e-6:
            self.problem = f"{(now_ns - seen[0].time_ns) * 1e-9:.2f} s of frames were seen ({config.start_duration:g} are needed)"
            return None
        rest = find_rest(seen, imu, rig, config)
        if isinstance(rest, Start):
            return rest
        if now_ns >= self._next_attempt_ns:
            moving = moving_start(seen, imu, rig, config)
            if isinstance(moving, Start):
                return moving
            turning = turn_on_the_spot(seen, rig.cameras[0].model.fx) if len(rig.cameras) == 1 else None
            self._motion_problem = moving if turning is None else f"{moving}; {turning}"
            self._first_attempt_ns = self._first_attempt_ns or now_ns
            wait_ns = round(_SHARE * (now_ns - self._first_attempt_ns))
            spare_ns = round((_LONGEST_START - 1.0) * config.start_duration * 1e9) - _EVERY_NS
            self._next_attempt_ns = now_ns + max(min(wait_ns, _LONGEST_WAIT_NS, spare_ns), _EVERY_NS)
        self.problem = f"not at rest: {rest}; moving: {self._motion_problem}"
        return None
