"""The iterated update as a whole: closed form, policy of the searches, and what is left alone.

Derivation: docs/lidar_inertial_odometry.md, section 7.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.filtering.degeneracy import PoseDirections
from boxplus.filtering.iterated_update import Information, iterated_update
from boxplus.filtering.nav_state import PL, TANGENT, NavState, P
from tests.filtering.random_states import random_covariance, random_state

seeds = st.integers(0, 2**32 - 1)
POSITIONS = [3, 4, 5, 9, 10, 11]  # of p and p_L among the twelve components
IN_TANGENT = [3, 4, 5, 21, 22, 23]


def _directions(weak: np.ndarray | None = None) -> PoseDirections:
    """The axes of the pose, of which some are weak, and none has noise."""
    return PoseDirections(np.full(6, np.inf), np.eye(6), 1.0, np.zeros(6, bool) if weak is None else weak, np.eye(6))


@dataclass
class LinearMeasurement:
    """y = H [p, p_L] + noise of variance r: the state enters linearly, so one step is exact."""

    H: np.ndarray
    y: np.ndarray
    r: np.ndarray
    directions: PoseDirections = field(default_factory=_directions)
    moved: bool = False
    rematched: list[bool] = field(default_factory=list)

    def at(self, x: np.ndarray, *, rematch: bool) -> Information:
        self.rematched.append(rematch)
        z = self.H @ np.concatenate([x[P : P + 3], x[PL : PL + 3]]) - self.y
        A, b = np.zeros((12, 12)), np.zeros(12)
        A[np.ix_(POSITIONS, POSITIONS)] = self.H.T @ (self.H / self.r[:, None])
        b[POSITIONS] = self.H.T @ (z / self.r)
        return Information(A, b, np.zeros(12), self.directions, len(self.y), float(np.sqrt(np.mean(z**2))))

    def has_moved(self, x: np.ndarray) -> bool:
        del x
        return self.moved


def _random_measurement(random: np.random.Generator, rows: int = 5) -> LinearMeasurement:
    return LinearMeasurement(random.normal(size=(rows, 6)), random.normal(size=rows), 10.0 ** random.uniform(-2, 0, rows))


def _linear_prior(random: np.random.Generator) -> tuple[NavState, np.ndarray]:
    """A prior whose rotations are independent of all else: the rest of the state is a vector space."""
    cov = random_covariance(random)
    rotations = np.isin(np.arange(TANGENT), [0, 1, 2, 18, 19, 20])
    cov[rotations[:, None] != rotations[None, :]] = 0.0
    return random_state(random), cov


@settings(max_examples=50)
@given(seeds, st.integers(1, 20))
def test_a_linear_measurement_gives_the_kalman_update(seed: int, rows: int) -> None:
    random = np.random.default_rng(seed)
    measurement = _random_measurement(random, rows)
    prior, cov = _linear_prior(random)
    posterior = iterated_update(prior.pack(), cov, measurement)
    H = np.zeros((rows, TANGENT))
    H[:, IN_TANGENT] = measurement.H
    K = cov @ H.T @ np.linalg.inv(H @ cov @ H.T + np.diag(measurement.r))
    expected = K @ (measurement.y - measurement.H @ np.concatenate([prior.p_world_imu, prior.p_imu_lidar]))
    sigma = np.sqrt(cov.diagonal())
    assert posterior.valid
    assert posterior.converged
    assert posterior.steps == 2  # the second one is zero
    assert np.allclose(NavState.unpack(posterior.x).boxminus(prior) / sigma, expected / sigma, atol=1e-5)
    assert np.allclose(
        posterior.cov / np.outer(sigma, sigma), (np.eye(TANGENT) - K @ H) @ cov / np.outer(sigma, sigma), atol=1e-6
    )


def test_without_information_the_prior_stays() -> None:
    random = np.random.default_rng(0)
    nothing = LinearMeasurement(np.zeros((4, 6)), np.zeros(4), np.ones(4))
    prior, cov = random_state(random), random_covariance(random)
    posterior = iterated_update(prior.pack(), cov, nothing)
    assert posterior.valid
    assert posterior.steps == 1
    assert np.allclose(posterior.x, prior.pack(), atol=1e-12)
    assert np.allclose(posterior.cov, cov, rtol=1e-6, atol=1e-9)


def test_what_is_weak_keeps_the_prior() -> None:
    random = np.random.default_rng(1)
    measurement = _random_measurement(random, 8)
    measurement.directions = _directions(np.array([False, False, False, True, False, False]))  # x of the position
    prior = random_state(random)
    cov = np.diag(np.linspace(0.5, 2.0, TANGENT))  # independent: nothing else moves x
    posterior = iterated_update(prior.pack(), cov, measurement)
    moved = NavState.unpack(posterior.x).boxminus(prior)
    assert moved[3] == pytest.approx(0.0, abs=1e-12)
    assert np.abs(moved[4:6]).min() > 1e-3
    assert posterior.cov[3, 3] == pytest.approx(cov[3, 3])
    assert not posterior.A[3].any()
    assert posterior.A[4, 4] > 0


@pytest.mark.parametrize("broken", ["few", "not positive definite"])
def test_an_update_that_cannot_be_is_said_and_changes_nothing(broken: str) -> None:
    random = np.random.default_rng(2)
    measurement = _random_measurement(random, 5)
    prior, cov = random_state(random), random_covariance(random)
    if broken != "few":
        cov = -cov
    before = prior.pack(), cov.copy()
    posterior = iterated_update(*before, measurement, min_used=6 if broken == "few" else 1)
    assert not posterior.valid
    assert posterior.steps == 0
    assert np.array_equal(posterior.x, prior.pack())
    assert np.array_equal(posterior.cov, cov)
    assert not posterior.A.any()
    assert posterior.last.used == 5


def test_the_prior_is_not_changed() -> None:
    random = np.random.default_rng(3)
    x, cov = random_state(random).pack(), random_covariance(random)
    before = x.copy(), cov.copy()
    iterated_update(x, cov, _random_measurement(random))
    assert np.array_equal(x, before[0])
    assert np.array_equal(cov, before[1])


@pytest.mark.parametrize(("moved", "searches"), [
    (False, [True, False]),  # the second step is small, and no search could find anything else
    (True, [True, False, True]),  # the points moved: search again, then the second small step ends it
], ids=["settled", "moved"])  # fmt: skip
def test_correspondences_are_searched_first_and_after_a_small_step(moved: bool, searches: list[bool]) -> None:
    random = np.random.default_rng(4)
    measurement = _random_measurement(random)
    measurement.moved = moved
    prior = random_state(random)
    cov = np.eye(TANGENT)
    posterior = iterated_update(prior.pack(), cov, measurement)
    assert measurement.rematched == searches
    assert posterior.steps == len(searches)
    assert posterior.converged


class RunningAway(LinearMeasurement):
    """Finds itself a metre off at every iterate: the iteration cannot end by itself."""

    def at(self, x: np.ndarray, *, rematch: bool) -> Information:
        self.y = self.H @ np.concatenate([x[P : P + 3], x[PL : PL + 3]]) + 1e6
        return LinearMeasurement.at(self, x, rematch=rematch)


@pytest.mark.parametrize("most", [1, 4])
def test_it_ends_after_so_many_steps_and_searches_once_before_the_last(most: int) -> None:
    measurement = RunningAway(np.eye(6), np.zeros(6), np.ones(6))
    posterior = iterated_update(NavState.identity().pack(), np.eye(TANGENT), measurement, max_iterations=most)
    assert posterior.steps == most + 1
    assert not posterior.converged
    assert posterior.valid
    assert measurement.rematched == [True] + [False] * (most - 1) + [True]
