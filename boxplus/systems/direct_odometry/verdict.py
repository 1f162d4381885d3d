"""Whether to believe the alignment of a frame: what it says of itself, and how it compares with the frames before.

Residuals grow with the way from the keyframe: seen from elsewhere, errors of depths, edges and reflections are in them, of a
camera that stands nothing but noise. A frame that has moved is compared with others that have, as otherwise a rest at the
beginning, in which residuals are smaller than ever after, would make doubtful all that follows.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from boxplus.systems.direct_alignment.keyframe import Keyframe
from boxplus.systems.direct_alignment.tracking import Alignment
from boxplus.systems.direct_odometry.config import DirectOdometryConfig
from boxplus.systems.direct_odometry.estimate import Status
from boxplus.systems.direct_odometry.image_motion import image_motion
from boxplus.systems.direct_odometry.window_system import WindowKeyframe

_MEMORY = 50  # frames
_FEWEST = 5
_MOVED = 0.25  # share of the motion of the image that asks for a keyframe, from which on a frame is one that has moved
_LOST_RATIO = 2.0  # times the ratio that makes a pose weak


class Verdict(NamedTuple):
    """Of one frame; see `Estimate`."""

    status: Status
    reasons: tuple[str, ...]
    residual_ratio: float


class Tracked(NamedTuple):
    """A frame aligned to a keyframe."""

    keyframe: WindowKeyframe
    alignment: Alignment
    verdict: Verdict


class Watch:
    """The residuals of the frames so far.

    Attributes:
        lost: whether the frame before had no pose.
        past_reasons: why no pose since can be believed.
        contradiction: why no pose at all can be.
    """

    def __init__(self, config: DirectOdometryConfig) -> None:
        self._config = config
        self._at_rest: deque[float] = deque(maxlen=_MEMORY)
        self._moved: deque[float] = deque(maxlen=_MEMORY)
        self.lost = False
        self.past_reasons: list[str] = []
        self.contradiction = ""

    @property
    def reasons(self) -> tuple[str, ...]:
        """What stands against every pose from here on."""
        return (*self.past_reasons, *([self.contradiction] if self.contradiction else []))

    def judge(self, alignment: Alignment, keyframe: Keyframe) -> Verdict:
        """Status and reasons of a frame with this alignment to this keyframe."""
        ratio = np.nan
        before = [*self._moved] if self._has_moved(alignment, keyframe) else [*self._at_rest, *self._moved]
        if len(before) >= _FEWEST and alignment.pixels:
            ratio = alignment.sigma / float(np.median(before))
        if alignment.status in ("little overlap", "large residual") or not np.isfinite(alignment.covariance).all():
            return Verdict("lost", (alignment.reason,), ratio)
        reasons = [*self.reasons]
        if alignment.status == "iteration limit":
            reasons.append(alignment.reason)
        reasons += self._doubts_of_covariance(alignment, keyframe.median_depth)
        if ratio > self._config.residual_ratio:
            reasons.append(
                f"grey values differ by {alignment.sigma:.3g}, {ratio:.1f} times as much as in the frames before "
                f"({self._config.residual_ratio:g} at most): something moves by itself, "
                "light changed unevenly, or the image is blurred"
            )
            if ratio > _LOST_RATIO * self._config.residual_ratio:
                return Verdict("lost", tuple(reasons), ratio)
        return Verdict("weak" if reasons else "ok", tuple(reasons), ratio)

    def _doubts_of_covariance(self, alignment: Alignment, median_depth: float) -> list[str]:
        turn_deg = float(np.degrees(np.sqrt(np.linalg.eigvalsh(alignment.covariance[:3, :3])[-1])))
        share = float(np.sqrt(np.linalg.eigvalsh(alignment.covariance[3:, 3:])[-1])) / median_depth
        most_deg, most = self._config.weak_rotation_deg, self._config.weak_translation
        if turn_deg <= most_deg and share <= most:
            return []
        return [
            f"the image determines the rotation to {turn_deg:.2g} degrees ({most_deg:g} at most) and the translation to "
            f"{share:.2g} of the depth ({most:g} at most): there is little texture, or none along one direction"
        ]

    def _has_moved(self, alignment: Alignment, keyframe: Keyframe) -> bool:
        return image_motion(keyframe, alignment.T_21).flow > _MOVED * self._config.keyframe_flow

    def keep(self, tracked: Tracked) -> None:
        """This was the frame's alignment."""
        alignment, verdict = tracked.alignment, tracked.verdict
        self.lost = verdict.status == "lost"
        if verdict.status == "ok" or (verdict.status == "weak" and not verdict.residual_ratio > self._config.residual_ratio):
            sigmas = self._moved if self._has_moved(alignment, tracked.keyframe.tracker) else self._at_rest
            sigmas.append(alignment.sigma)

    def begin_anew(self, gone_s: float) -> None:
        """Nothing connects the poses that follow with those before."""
        self.lost = False
        self._at_rest.clear()
        self._moved.clear()
        self.past_reasons = [
            f"for {gone_s:.1f} s no pose followed from the images: how the camera moved then is a guess, "
            "and all poses since rest on it"
        ]
