"""Corners of two instants: which both saw, what a turn leaves of their motion, and how many a second camera finds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.systems.visual_inertial_odometry.corners.partners import few_are_found, share_found
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks, shared_rows
from boxplus.systems.visual_inertial_odometry.corners.turning import distances, turn_between
from boxplus.systems.visual_inertial_odometry.start.turn_on_the_spot import turn_on_the_spot

IDS = st.lists(st.integers(0, 60), unique=True, max_size=40)
FOCAL_PX = 200.0


def tracks(time_s: float, rays: NDArray[np.float64], contrast: float = 40.0) -> Tracks:
    """Of corners (n, c, 3), as they are."""
    count, cameras = rays.shape[:2]
    grey = np.full(cameras, 100.0), np.full(cameras, contrast)
    pixels = FOCAL_PX * rays[:, :, :2]
    return Tracks(round(1e9 * time_s), np.arange(count), pixels, rays, np.zeros(count, np.bool_), {}, 0.0, *grey)


def seen_along(turn: NDArray[np.float64], step: NDArray[np.float64], **other: Any) -> list[Tracks]:
    """Frames of a camera that turns and moves by so much in half a second, among points 2 to 6 m away."""
    random = np.random.default_rng(4)
    p = np.column_stack([random.uniform(-2.0, 2.0, (80, 2)), random.uniform(2.0, 6.0, 80)])
    frames = []
    for k in range(12):
        there = (p - 0.2 * k * step) @ so3.exp(0.2 * k * turn)
        frames.append(tracks(0.1 * k, (there / there[:, 2:])[:, None], **other))
    return frames


@given(IDS, IDS)
def test_shared_rows_are_those_of_numpy(ids: list[int], others: list[int]) -> None:
    a, b = np.array(ids, np.int64), np.array(sorted(others), np.int64)
    _, i, j = np.intersect1d(a, b, assume_unique=True, return_indices=True)
    found = shared_rows(a, b)
    assert found[0].tolist() == i.tolist() and found[1].tolist() == j.tolist()


def test_the_turn_that_explains_corners_is_found_in_spite_of_some_that_move() -> None:
    random, R = np.random.default_rng(1), so3.exp(np.array([0.1, -0.2, 0.3]))
    m1 = np.column_stack([random.uniform(-0.6, 0.6, (60, 2)), np.ones(60)])
    m2 = m1 @ R.T
    m2 /= m2[:, 2:]
    m2[:10, :2] += 0.05
    found = turn_between(m1, m2)
    assert np.allclose(found, R, atol=2e-3)
    assert np.median(distances(found, m1, m2)) < 1e-3 and (distances(found, m1, m2)[:10] > 0.03).all()


def test_a_turn_on_the_spot_is_told_from_other_motions_and_from_rest() -> None:
    turn, still = np.array([0.0, 0.25, 0.1]), np.zeros(3)
    said = turn_on_the_spot(seen_along(turn, still), FOCAL_PX)
    assert said is not None and "the camera turns on the spot" in said and "a rotation leaves 0.0 px" in said
    assert turn_on_the_spot(seen_along(turn, np.array([0.2, 0.0, 0.0])), FOCAL_PX) is None
    assert turn_on_the_spot(seen_along(still, np.array([0.2, 0.0, 0.0])), FOCAL_PX) is None
    assert turn_on_the_spot(seen_along(still, still), FOCAL_PX) is None
    assert turn_on_the_spot(seen_along(turn, still)[:4], FOCAL_PX) is None  # less than half a second
    partly = seen_along(turn, still)
    for frame in partly:
        frame.rays[:9] = np.nan
    again = turn_on_the_spot(partly, FOCAL_PX)
    assert again is not None and "a rotation leaves 0.0 px" in again


def test_the_share_that_a_second_camera_finds_is_told_where_all_show_something() -> None:
    rays = np.ones((40, 2, 3))
    rays[3:, 1] = np.nan
    share = share_found(tracks(0.0, rays))
    assert share == pytest.approx(3.0 / 40.0) and few_are_found(share).startswith("8 % of the corners are found")
    assert share_found(tracks(0.0, rays, contrast=2.0)) is None
    assert share_found(tracks(0.0, rays[:5])) is share_found(tracks(0.0, rays[:, :1])) is None
