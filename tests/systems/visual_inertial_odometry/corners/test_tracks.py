"""Corners of two instants: which both saw, what a turn leaves of their motion, and when a second camera is another one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.systems.visual_inertial_odometry.corners.partners import Partners, swapped
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks, shared_rows
from boxplus.systems.visual_inertial_odometry.corners.turning import distances, turn_between
from boxplus.systems.visual_inertial_odometry.start.turn_on_the_spot import turn_on_the_spot

IDS = st.lists(st.integers(0, 60), unique=True, max_size=40)
FOCAL_PX = 200.0


def tracks(time_s: float, rays: NDArray[np.float64]) -> Tracks:
    """Of corners (n, c, 3), as they are."""
    count, cameras = rays.shape[:2]
    grey = np.full(cameras, 100.0), np.full(cameras, 40.0)
    pixels = FOCAL_PX * rays[:, :, :2]
    return Tracks(round(1e9 * time_s), np.arange(count), pixels, rays, np.zeros(count, np.bool_), {}, 0.0, *grey)


def seen_along(turn: NDArray[np.float64], step: NDArray[np.float64]) -> list[Tracks]:
    """Frames of a camera that turns and moves by so much in half a second, among points 2 to 6 m away."""
    random = np.random.default_rng(4)
    p = np.column_stack([random.uniform(-2.0, 2.0, (80, 2)), random.uniform(2.0, 6.0, 80)])
    frames = []
    for k in range(12):
        there = (p - 0.2 * k * step) @ so3.exp(0.2 * k * turn)
        frames.append(tracks(0.1 * k, (there / there[:, 2:])[:, None]))
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


def test_a_turn_among_far_points_is_not_told_from_one_on_the_spot_and_both_are_named() -> None:
    frames = seen_along(np.array([0.0, 0.25, 0.1]), np.array([0.01, 0.0, 0.0]))
    said = turn_on_the_spot(frames, FOCAL_PX)
    assert said is not None and "the camera turns on the spot, or all that it sees is far away" in said


def test_both_numbers_of_a_turn_are_of_one_half_second() -> None:
    turned = seen_along(np.array([0.0, 0.25, 0.1]), np.zeros(3))
    still = seen_along(np.zeros(3), np.array([0.01, 0.0, 0.0]))[:6]  # turns less, with more parallax
    later = [replace(frame, time_ns=frame.time_ns + 2_000_000_000, ids=frame.ids + 1000) for frame in still]
    alone, both = turn_on_the_spot(turned, FOCAL_PX), turn_on_the_spot(turned + later, FOCAL_PX)
    assert turn_on_the_spot(still, FOCAL_PX) is None
    assert alone is not None and alone == both


def test_swapped_cameras_are_told_where_images_exchanged_find_what_calibrated_ones_do_not() -> None:
    said = swapped([None, Partners(0.02, 0.96), Partners(0.04, 0.98)])
    assert said is not None and said.startswith("3 % of the corners are found") and "exchanged 97 % are found" in said
    assert swapped([Partners(0.02, 0.1), Partners(0.04)]) is None  # nothing says so
    assert swapped([Partners(0.02, 0.9), Partners(0.9), Partners(0.9)]) is None
    assert swapped([None]) is swapped([]) is None
