"""How far corners creep, told from residuals; and covariances that know of it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from boxplus.systems.visual_inertial_odometry import VioConfig
from boxplus.systems.visual_inertial_odometry.corners.creep import CornerCreep
from tests.systems.visual_inertial_odometry.simulated_rays import (
    IMAGE_EVERY,
    Flight,
    SimulatedTracker,
    at,
    rig,
    run,
    truth_relative_to_first,
)


def note(creep: CornerCreep, rng: np.random.Generator, walk: float, white: float, cameras: int = 2, tracks: int = 200) -> None:
    """Eight keyframes of residuals, less their mean, which is the landmark's."""
    r = np.cumsum(rng.normal(size=(tracks, 8, 2)) * walk, axis=1) + rng.normal(size=(tracks, 8, 2)) * white
    r -= r.mean(axis=1, keepdims=True)
    landmark, keyframe = np.divmod(np.arange(tracks * 8), 8)
    order = rng.permutation(tracks * 8)
    creep.note(r.reshape(-1, 2)[order], landmark[order], keyframe[order], cameras)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.1, 2.0))
def test_independent_errors_of_any_size_count_as_they_are(seed: int, white: float) -> None:
    creep, rng = CornerCreep(), np.random.default_rng(seed)
    for _ in range(20):
        note(creep, rng, 0.0, white)
    # Sixty thousand differences err by a percent of their variance, which counts 13 / 0.5 times.
    assert 1.0 <= creep.factor**2 < 1.0 + 0.7 * white**2
    assert creep.weight**2 == pytest.approx(creep.factor)


def test_where_the_window_does_not_count_with_it_the_covariance_takes_all() -> None:
    weighing, plain = CornerCreep(), CornerCreep(weigh=False)
    for creep in (weighing, plain):
        note(creep, np.random.default_rng(2), 0.3, 0.2)
    assert weighing.factor == plain.factor > 1.5
    assert (plain.weight, plain.spread) == (1.0, plain.factor**2)
    assert weighing.weight**2 * weighing.spread == pytest.approx(plain.spread)


def test_a_walk_grows_the_factor_by_what_it_is_and_by_how_many_cameras_share_it() -> None:
    factors = []
    for cameras, walk in ((1, 0.3), (2, 0.3), (2, 0.6)):
        creep, rng = CornerCreep(), np.random.default_rng(1)
        for _ in range(3):
            note(creep, rng, walk, 0.2, cameras, tracks=4000)  # so many that chance is small beside the walk
        factors.append(creep.factor**2 - 1.0)
    # q = walk² over what residuals keep of it, n = 8; the mean that was taken off moves no difference.
    assert factors[0] == pytest.approx(65.0 / 10.0 * 0.3**2 / 0.5, rel=0.1)
    assert factors[1] == pytest.approx(2.0 * factors[0]) and factors[2] == pytest.approx(4.0 * factors[1], rel=0.1)


def test_few_corners_and_short_ones_tell_nothing() -> None:
    creep, rng = CornerCreep(), np.random.default_rng(2)
    note(creep, rng, 1.0, 0.1, tracks=5)
    assert creep.factor == 1.0
    creep.note(rng.normal(size=(800, 2)), np.arange(800) // 4, np.arange(800) % 4, 2)
    assert creep.factor == 1.0


class Creeping(SimulatedTracker):
    """Corners that walk away from their points, with a velocity that lasts for three images or so."""

    def __init__(self, flight: Flight, walk: float) -> None:
        super().__init__(flight, rig(), sigma=0.05)
        rng = np.random.default_rng([flight.seed, 9])
        velocity, walks = np.zeros((6000, 2), np.float32), []
        for _ in range(len(flight.time_ns) // IMAGE_EVERY + 1):
            velocity = 0.7 * velocity + 0.3 * walk * rng.normal(size=(6000, 2)).astype(np.float32)
            walks.append(velocity)
        self._walked = np.cumsum(walks, axis=0)

    def _project(self, camera: int, which: NDArray[np.intp]) -> NDArray[np.float64]:
        """Both cameras see the corner where the first one has it."""
        return np.asarray(super()._project(camera, which) + self._walked[self._at // IMAGE_EVERY][which])


@pytest.mark.slow
def test_errors_are_as_large_as_stated_although_corners_creep() -> None:
    """Without it the normalised square is 17 in the mean; 4 is exact. Few and correlated samples spread it widely."""
    means = []
    for seed in range(500, 503):
        flight = Flight(seed, 7.0)
        vio, estimates = run(flight, rig(), VioConfig(pixel_sigma=0.3), Creeping(flight, 0.14))
        assert 1.5 < vio.window._creep.factor < 5.0
        known = [e for e in estimates if e.status != "starting"]
        squares = []
        for e in known[10::10]:
            _, p = truth_relative_to_first(flight, known[0], at(flight, e))
            G = np.zeros((3, 15))
            G[:, 3:6] = np.eye(3)
            off = e.T_world_imu[:3, 3] - p
            squares.append(off @ np.linalg.solve(G @ e.covariance @ G.T, off) / 3.0)
        means.append(np.mean(squares))
    assert 0.2 < np.mean(means) < 2.5
