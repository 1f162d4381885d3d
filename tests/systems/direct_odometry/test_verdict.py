"""What a frame's residuals are compared with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.systems.direct_alignment.keyframe import Keyframe
from boxplus.systems.direct_alignment.tracking import Alignment, track
from boxplus.systems.direct_odometry.config import DirectOdometryConfig
from boxplus.systems.direct_odometry.verdict import Tracked, Watch
from boxplus.systems.direct_odometry.window_system import WindowKeyframe
from tests.systems.direct_odometry.scenes import CAMERA, drive

AT_REST, MOVED = np.zeros(3), np.array([0.1, 0.0, 0.0])


@pytest.fixture(scope="module")
def found() -> tuple[WindowKeyframe, Alignment]:
    """A keyframe, and an image aligned to it."""
    seen = drive(20, 2)
    tracker = Keyframe.prepare(seen.grey[0], seen.depth[0], CAMERA)
    keyframe = WindowKeyframe(0, 0, seen.grey[0].astype(np.float32), seen.T[0], 0.0, tracker, None)  # type: ignore[arg-type]
    return keyframe, track(tracker, seen.grey[1])


def judged(watch: Watch, found: tuple[WindowKeyframe, Alignment], sigma: float, shift: np.ndarray) -> str:
    """The status of a frame with residuals of this size [grey values], whose camera moved by this much [m]."""
    keyframe, alignment = found
    alignment = replace(alignment, sigma=sigma, T_21=np.concatenate([[1.0, 0.0, 0.0, 0.0], shift]))
    verdict = watch.judge(alignment, keyframe.tracker)
    watch.keep(Tracked(keyframe, alignment, verdict))
    return verdict.status


def test_after_a_rest_a_motion_is_not_held_against_noise_alone(found: tuple[WindowKeyframe, Alignment]) -> None:
    """Residuals as of a recorded view: 1.5 of noise while the camera stands, 3 to 6.6 on the way from keyframe to keyframe."""
    watch = Watch(DirectOdometryConfig())
    assert {judged(watch, found, 1.5, AT_REST) for _ in range(30)} == {"ok"}
    assert [judged(watch, found, sigma, MOVED) for sigma in (3.0, 4.0, 4.9, 3.4, 4.6, 5.8, 4.2, 5.7, 6.6)] == ["ok"] * 9


def test_frames_that_moved_are_held_against_each_other(found: tuple[WindowKeyframe, Alignment]) -> None:
    watch = Watch(DirectOdometryConfig())
    for _ in range(60):  # a rest forgets no motion
        judged(watch, found, 4.0, MOVED)
        judged(watch, found, 1.5, AT_REST)
    assert [judged(watch, found, sigma, MOVED) for sigma in (7.9, 8.1, 16.1)] == ["ok", "weak", "lost"]


def test_at_rest_anything_that_fits_worse_is_held_against_all_before(found: tuple[WindowKeyframe, Alignment]) -> None:
    watch = Watch(DirectOdometryConfig())
    for _ in range(10):
        judged(watch, found, 1.5, AT_REST)
    assert [judged(watch, found, sigma, AT_REST) for sigma in (2.9, 3.1, 6.1)] == ["ok", "weak", "lost"]
