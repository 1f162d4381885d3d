"""Moves of poses against what a run claimed to know of them, also where nothing holds the first one."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.manifolds import se3
from boxplus.runs.refinement.moved import moved_by
from boxplus.runs.slam.summary import GnssFacts

COUNT = 30
WAY = np.tile([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], (COUNT, 1))
WAY[:, 4] = np.arange(COUNT)
T_ENU_MAP = np.array([0.8, 0.0, 0.0, 0.6, 5.0, -3.0, 1.0])
SIGMA_M, PLACE_M, HEADING = 0.01, 0.5, 0.02
COVARIANCE = np.zeros((COUNT, 6, 6))
COVARIANCE[1:, 3:, 3:] = SIGMA_M**2 * np.eye(3)


def on_earth() -> GnssFacts:
    covariance = np.diag([0.005, 0.005, HEADING, PLACE_M, PLACE_M, PLACE_M]) ** 2
    return GnssFacts(topic="/fix", T_enu_map=T_ENU_MAP.tolist(), covariance=covariance.tolist())


def moved(xi: list[float], T: np.ndarray) -> np.ndarray:
    return np.asarray(se3.compose(np.broadcast_to(se3.exp(np.array(xi)), T.shape), T))


def test_a_place_on_the_earth_moves_by_what_it_is_known_to() -> None:
    """As a whole: the covariance of the first pose against itself is zero, by which it was 26 standard deviations."""
    before = se3.compose(np.broadcast_to(T_ENU_MAP, WAY.shape), WAY)
    after = moved([0.0, 0.0, 0.5 * HEADING, 0.2, -0.1, 0.15], before)
    assert moved_by(before, after, COVARIANCE, on_earth()) < 2.0


@pytest.mark.parametrize("xi", [[0.0, 0.0, 0.0, 4.0, 0.0, 0.0], [0.0, 0.0, 10 * HEADING, 0.0, 0.0, 0.0]])
def test_a_place_that_is_another_is_seen(xi: list[float]) -> None:
    before = se3.compose(np.broadcast_to(T_ENU_MAP, WAY.shape), WAY)
    assert moved_by(before, moved(xi, before), COVARIANCE, on_earth()) > 5.0


@pytest.mark.parametrize("place", [None, on_earth()])
def test_a_way_that_bends_is_measured_against_the_first_pose(place: GnssFacts | None) -> None:
    after = WAY.copy()
    after[20:, 5] += 0.12
    assert moved_by(WAY, after, COVARIANCE, place) == pytest.approx(0.12 / (SIGMA_M + 0.002))
    assert moved_by(WAY, WAY, COVARIANCE, place) == 0.0
