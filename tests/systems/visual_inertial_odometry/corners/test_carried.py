"""Corners that the camera carries along are let go and not found again; landmarks are kept, whatever the images do."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from boxplus.manifolds import so3
from boxplus.systems.visual_inertial_odometry import VioConfig
from boxplus.systems.visual_inertial_odometry.corners.carried import CARRIED, CarriedCorners
from boxplus.systems.visual_inertial_odometry.corners.tracking import FeatureTracker
from tests.systems.visual_inertial_odometry.corners.test_tracking import CAMERA, SIZE, pair, stereo, wall

F, N = 220.0, 40


def found(moved: np.ndarray, by_turn: np.ndarray, steps: int, kept: np.ndarray | None = None) -> np.ndarray:
    """After how many steps each of N corners, moving by `moved` (N, 2) px a step, counts as carried (N,); -1 if never."""
    carried, ids, when = CarriedCorners(F), np.arange(N), np.full(N, -1)
    pixels = np.random.default_rng(0).uniform(20, 200, (N, 2))
    for step in range(steps):
        is_carried = carried.find(ids, pixels, pixels + by_turn, pixels + moved, np.ones(N, bool) if kept is None else kept, 0.01)
        when[is_carried & (when < 0)] = step
        pixels = pixels + moved
    return when


@given(share=st.floats(0.3, 1.0), px=st.floats(3.0, 40.0))
def test_corners_that_stand_still_while_the_camera_turns_are_told_after_some_degrees(share: float, px: float) -> None:
    moved, turn = np.zeros((N, 2)), np.array([px, 0.0])
    moving = np.arange(N) < share * N
    moved[moving] = turn
    steps = max(20.0, 0.1 * F) / px
    assume(abs(steps - round(steps)) > 1e-9)  # else rounding decides
    when = found(moved, np.broadcast_to(turn, (N, 2)), 20)
    assert (when[moving] == -1).all()
    assert (when[~moving] == int(np.ceil(steps)) - 1).all()


@given(scale=st.floats(0.05, 3.0), angle=st.floats(-3.1, 3.1))
def test_landmarks_that_a_translation_slows_are_kept(scale: float, angle: float) -> None:
    turn = np.array([12.0, 0.0])
    off = 12.0 * max(scale, 0.1) * np.array([np.cos(angle), np.sin(angle)])
    assert (found(np.broadcast_to(off, (N, 2)), np.broadcast_to(turn, (N, 2)), 20) == -1).all()


def test_images_that_stand_as_a_whole_say_nothing_of_single_corners() -> None:
    moved, turn = np.zeros((N, 2)), np.broadcast_to(np.array([15.0, 0.0]), (N, 2))
    assert (found(moved, turn, 20) == -1).all()
    assert (found(moved, np.full((N, 2), np.nan), 20) == -1).all()


def test_no_place_is_kept_from_corners_for_ever() -> None:
    carried, pixels = CarriedCorners(F), np.random.default_rng(1).uniform(20, 200, (N, 2))
    turn, moved = np.array([30.0, 0.0]), np.zeros((N, 2))
    moved[: N // 2] = turn
    is_carried = carried.find(np.arange(N), pixels, pixels + turn, pixels + moved, np.ones(N, bool), 0.13)
    assert is_carried.sum() == len(carried.places) == N - N // 2
    none = np.zeros((0, 2))
    carried.find(np.zeros(0, np.int64), none, none, none, np.zeros(0, bool), 25.0)
    assert not len(carried.places)


def test_an_arm_in_the_view_holds_no_corners_once_the_camera_has_turned() -> None:
    picture, arm = wall(), wall(1)[::4, ::4][: SIZE[1] // 3, : SIZE[0]]
    tracker = FeatureTracker(VioConfig(features=80, cell_size=30), stereo())
    R, rows, rejected = np.eye(3), SIZE[1] - len(arm), 0

    def views(R: np.ndarray) -> dict[int, np.ndarray]:
        seen = pair(picture, R, np.zeros(3))
        for image in seen.values():
            image[rows:] = np.rint(arm)
        return seen

    tracks = tracker.detect(tracker.track(0, views(R), np.eye(3)))
    assert (tracks.pixels[:, 0, 1] > rows + 12).sum() > 10
    for k in range(1, 15):
        turn = so3.exp(np.array([0.0, -0.06, 0.01]) * (-1) ** (k // 3))
        R = R @ turn
        tracks = tracker.track(k * 10**8, views(R), turn)
        rejected += tracks.rejected.get(CARRIED, 0)
        tracks = tracker.detect(tracks)
    on_arm = tracks.pixels[:, 0, 1] > rows + 12
    assert rejected > 10 and on_arm.sum() <= 2 and (~on_arm).sum() > 25
    assert CAMERA.fx == pytest.approx(F)
