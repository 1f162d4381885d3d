"""When a start is looked for: soon enough, and not for ever as often."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus import VioConfig
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks
from boxplus.systems.visual_inertial_odometry.start import search as module
from boxplus.systems.visual_inertial_odometry.start.search import StartSearch
from boxplus.systems.visual_inertial_odometry.start.start import Start
from tests.systems.visual_inertial_odometry.simulated_rays import rig

FRAME_S, LOOK_S = 0.05, 0.15
NO_IMU = ImuSamples.joined([])


def frame(time_s: float) -> Tracks:
    nothing = np.zeros((0, 1, 2)), np.zeros((0, 1, 3)), np.zeros(0, np.bool_)
    grey = np.full(1, 100.0)
    return Tracks(10**18 + round(1e9 * time_s), np.zeros(0, np.int64), *nothing, {}, 0.0, grey, grey)


def looked(possible_from_s: float, seconds: float = 60.0) -> tuple[float | None, list[float]]:
    """When a start was found that becomes possible at some time, and when it was attempted; it never rests."""
    attempts: list[float] = []
    found = Start("moving mono", *[np.zeros(0)] * 9, {})  # type: ignore[arg-type]

    def attempt(seen: Sequence[Tracks], *_: object) -> Start | str:
        attempts.append(1e-9 * (seen[-1].time_ns - 10**18))
        return found if attempts[-1] >= possible_from_s else "too early"

    search = StartSearch()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "find_rest", lambda *_: "it moves")
        patch.setattr(module, "moving_start", attempt)
        for time_s in np.arange(0.0, seconds, FRAME_S):
            search.add(frame(float(time_s)), VioConfig())
            if search.look(NO_IMU, rig(1), VioConfig()) is not None:
                return float(time_s), attempts
    assert search.problem == "not at rest: it moves; moving: too early"
    return None, attempts


@pytest.mark.slow
@given(st.floats(0.0, 50.0))
def test_a_start_is_found_a_fifth_of_the_wait_after_it_became_possible_and_two_seconds_at_most(possible_from_s: float) -> None:
    found_s, attempts = looked(possible_from_s)
    assert found_s is not None and attempts[0] == pytest.approx(1.0, abs=LOOK_S)
    waited_s = max(possible_from_s - attempts[0], 0.0)
    assert found_s - max(possible_from_s, attempts[0]) <= min(0.2 * waited_s, 2.0) + LOOK_S + 2 * FRAME_S


def test_attempts_get_rarer_and_frames_outlast_the_longest_wait() -> None:
    _, attempts = looked(np.inf)
    assert len([time_s for time_s in attempts if time_s < 11.0]) < 25 and len(attempts) < 50
    assert (np.diff(attempts) < 2.0 + LOOK_S + FRAME_S).all()
    search = StartSearch()
    for time_s in np.arange(0.0, 20.0, FRAME_S):
        search.add(frame(float(time_s)), VioConfig())
    assert 1e-9 * (search.seen[-1].time_ns - search.seen[0].time_ns) == pytest.approx(4.0, abs=FRAME_S)


@given(st.sampled_from([0.3, 0.4, 0.5, 1.0, 2.0]), st.sampled_from([0.02, 0.05]))
def test_every_motion_as_long_as_a_start_is_within_the_frames_of_an_attempt(start_duration: float, frame_s: float) -> None:
    spans: list[tuple[int, int]] = []

    def attempt(seen: Sequence[Tracks], *_: object) -> str:
        spans.append((seen[0].time_ns, seen[-1].time_ns))
        return "too early"

    config, search = VioConfig(start_duration=start_duration), StartSearch()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "find_rest", lambda *_: "it moves")
        patch.setattr(module, "moving_start", attempt)
        for time_s in np.arange(0.0, 30.0, frame_s):
            search.add(frame(float(time_s)), config)
            search.look(NO_IMU, rig(1), config)
    assert len(spans) > 10
    shared = [before[1] - after[0] for before, after in itertools.pairwise(spans)]  # of two attempts in a row
    assert min(shared) >= 1e9 * (start_duration - 2 * frame_s)
