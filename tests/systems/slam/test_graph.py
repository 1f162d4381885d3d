"""The odometry chain, cycles of loops, the largest consistent set and the robust graph, without any points."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import chi2, kstest

from boxplus.errors import InputError
from boxplus.manifolds import quaternion, se3
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.systems.slam.consistency import cycle_error, largest_clique
from boxplus.systems.slam.correction import Correction
from boxplus.systems.slam.graph import close_graph, vertical_sigmas
from boxplus.systems.slam.loop import Loop
from boxplus.systems.slam.odometry_chain import OdometryChain

SIGMA = np.repeat([2e-3, 0.05], 3)  # of a step
Z_SIGMA = np.repeat([1e-3, 0.02], 3)  # of a loop


def circle(n: int, laps: float = 2.0) -> NDArray[np.float64]:
    angle = 2.0 * np.pi * laps * np.arange(n) / n
    zero = np.zeros(n)
    q = np.column_stack([np.cos(0.5 * angle), zero, zero, np.sin(0.5 * angle)])
    return np.hstack([q, np.column_stack([30.0 * np.sin(angle), 30.0 - 30.0 * np.cos(angle), zero])])


def odometry_of(truth: NDArray[np.float64], random: np.random.Generator) -> NDArray[np.float64]:
    poses = [truth[0]]
    for step in se3.compose(se3.inverse(truth[:-1]), truth[1:]):
        poses.append(se3.compose(se3.compose(poses[-1], step), se3.exp(random.normal(0.0, SIGMA))))
    return np.stack(poses)


def chain_of(poses: NDArray[np.float64]) -> OdometryChain:
    chain, none = OdometryChain(), np.zeros((0, 3), np.float32)
    for k, T in enumerate(poses):
        chain.add(LocalMap(k, k, k, k, T, np.diag(SIGMA**2), float(k), none, 1))
    return chain


def loop_between(truth: NDArray[np.float64], query: int, place: int, noise: NDArray[np.float64]) -> Loop:
    Z = se3.compose(se3.compose(se3.inverse(truth[place]), truth[query]), se3.exp(noise))
    return Loop(query, place, "appearance", 9, Z, Z, np.diag(Z_SIGMA**2), np.diag(Z_SIGMA**-2.0), measured=6)


def test_covariance_between_maps_is_that_of_the_steps() -> None:
    poses = circle(12)
    chain = chain_of(poses)
    for a, b in ((2, 7), (0, 3), (7, 2), (5, 5)):
        T, S = chain.between(a, b)
        np.testing.assert_allclose(
            se3.compose(poses[a], T), poses[b] * np.sign((se3.compose(poses[a], T) * poses[b])[0]), atol=1e-9
        )
        expected, first, last = np.zeros((6, 6)), min(a, b), max(a, b)
        for k in range(first + 1, last + 1):
            Ad = se3.adjoint(se3.compose(se3.inverse(poses[last]), poses[k]))
            expected += Ad @ np.diag(SIGMA**2) @ Ad.T
        if a > b:
            Ad = se3.adjoint(se3.compose(se3.inverse(poses[b]), poses[a]))
            expected = Ad @ expected @ Ad.T
        np.testing.assert_allclose(S, expected, atol=1e-12)


def test_cycles_of_true_loops_close_within_their_noise() -> None:
    """NEES of cycles over simulated odometries: χ² with six degrees of freedom."""
    truth, random = circle(40), np.random.default_rng(0)
    squares = []
    for _ in range(120):
        chain = chain_of(odometry_of(truth, random))
        a, b = (loop_between(truth, q, p, random.normal(0.0, Z_SIGMA)) for q, p in ((21, 1), (32, 12)))
        squares.append(cycle_error(a, b, chain) ** 2)
    assert kstest(squares, chi2(6).cdf).pvalue > 1e-3
    false = loop_between(truth, 32, 3, np.zeros(6))
    wrong = Loop(32, 12, "appearance", 9, false.T_start, false.T_place_query, false.covariance, false.information)
    assert cycle_error(a, wrong, chain) > 20.0


@settings(deadline=None, max_examples=60)
@given(st.integers(1, 11), st.floats(0.0, 1.0), st.integers(0, 2**31))
def test_the_clique_is_a_largest_one(n: int, density: float, seed: int) -> None:
    adjacent = np.random.default_rng(seed).random((n, n)) < density
    adjacent = np.tril(adjacent, -1)
    adjacent = adjacent | adjacent.T
    found = largest_clique(adjacent)
    assert all(adjacent[a, b] for a, b in itertools.combinations(found, 2))
    sizes = [
        len(subset)
        for size in range(1, n + 1)
        for subset in itertools.combinations(range(n), size)
        if all(adjacent[a, b] for a, b in itertools.combinations(subset, 2))
    ]
    assert len(found) == max(sizes)


def test_the_clique_of_many_loops_is_found_in_time() -> None:
    """Two worlds of 110 and 80 loops that contradict each other; and more than are searched exactly."""
    for first, second in ((110, 80), (150, 90)):
        n = first + second
        adjacent = np.zeros((n, n), dtype=bool)
        adjacent[:first, :first] = adjacent[first:, first:] = True
        assert largest_clique(adjacent) == list(range(first))


@pytest.mark.parametrize("seed", range(3))
def test_the_graph_refuses_what_contradicts_the_others(seed: int) -> None:
    random = np.random.default_rng(seed)
    truth = circle(40)
    odometry = odometry_of(truth, random)
    loops = [loop_between(truth, q, q - 20, random.normal(0.0, Z_SIGMA)) for q in range(22, 38, 3)]
    shifted = se3.exp(np.array([0.0, 0.0, 0.0, 4.0, 0.0, 0.0]))
    false = loop_between(truth, 30, 10, np.zeros(6))
    wrong = Loop(30, 10, "nearby", 0, false.T_start, se3.compose(false.T_start, shifted), false.covariance, false.information, 6)
    graph = close_graph(list(odometry), [np.diag(SIGMA**2)] * 40, [*loops, wrong], 0.005)
    np.testing.assert_array_equal(graph.is_kept, [True] * len(loops) + [False])
    before, after = (np.linalg.norm(T[:, 4:] - truth[:, 4:], axis=1)[20:].mean() for T in (odometry, graph.T_map))
    assert after < before
    forced = close_graph(list(odometry), [np.diag(SIGMA**2)] * 40, [*loops, wrong], 0.005, [False] * len(loops) + [True])
    assert forced.is_kept[-1] and forced.errors[-1] > graph.errors[:-1].max()


def test_gravity_keeps_maps_upright() -> None:
    """A loop that is off by tilt bends the graph less with the verticals than without."""
    truth = circle(20, 1.0)
    loop = loop_between(truth, 19, 0, np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))

    def tilt(sigma: float) -> float:
        T = close_graph(list(truth), [np.diag(SIGMA**2)] * 20, [loop], sigma, [True]).T_map
        return float(np.linalg.norm(quaternion.to_matrix(T[:, :4])[:, :2, 2], axis=1).max())

    assert tilt(1e-4) < 0.1 * tilt(10.0)


def test_a_direction_that_was_not_measured_pulls_at_nothing() -> None:
    truth = circle(20, 1.0)
    loop = loop_between(truth, 19, 0, np.array([0.0, 0.0, 0.0, 3.0, 0.0, 0.0]))
    information = loop.information.copy()
    information[3] = information[:, 3] = 0.0
    open_along_x = Loop(19, 0, "nearby", 0, loop.T_start, loop.T_place_query, loop.covariance, information, 5)
    graph = close_graph(list(truth), [np.diag(SIGMA**2)] * 20, [open_along_x], 0.005)
    assert graph.is_kept.all()
    np.testing.assert_allclose(graph.T_map[:, 4:], truth[:, 4:], atol=1e-6)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**31))
def test_corrections_hold_at_maps_and_never_jump(seed: int) -> None:
    random = np.random.default_rng(seed)
    T_odo = odometry_of(circle(6, 0.5), random)
    T_map = se3.compose(T_odo, se3.exp(random.normal(0.0, 0.05, (6, 6))))
    time_ns = np.arange(6) * 10**9
    correction = Correction(time_ns, T_odo, T_map)
    with pytest.raises(InputError, match="a correction with covariances"):
        correction.covariances(time_ns, T_map)
    np.testing.assert_allclose(np.abs((correction.apply(time_ns, T_odo) * T_map)[:, :4].sum(axis=1)), 1.0, atol=1e-9)
    np.testing.assert_allclose(correction.apply(time_ns, T_odo)[:, 4:], T_map[:, 4:], atol=1e-9)
    np.testing.assert_allclose(se3.compose(correction.T_map_odo, T_odo[-1])[4:], T_map[-1, 4:], atol=1e-9)
    fine = np.arange(0, 5 * 10**9 + 1, 10**7)
    body = np.repeat(T_odo[:1], len(fine), axis=0)  # at rest in the odometry's world: only the correction moves it
    steps = np.linalg.norm(np.diff(correction.apply(fine, body)[:, 4:], axis=0), axis=1)
    whole = np.linalg.norm(np.diff(correction.apply(time_ns, body[:6])[:, 4:], axis=0), axis=1).max()
    assert steps.max() < 0.1 * whole + 1e-9
    unmoved = Correction(time_ns, T_odo, T_odo)
    np.testing.assert_allclose(unmoved.apply(fine, body)[:, 4:], body[:, 4:], atol=1e-9)


def test_covariances_of_corrected_poses_are_those_of_their_errors() -> None:
    """NEES of poses at maps, between and beyond them, over simulated odometries whose loops are closed."""
    fine, maps, runs = circle(81), np.arange(0, 80, 4), 50
    truth, sigma = fine[maps], SIGMA / 2.0  # of a fine step: four of them make SIGMA
    steps = [np.zeros((6, 6))]
    for a, b in itertools.pairwise(maps.tolist()):
        Ads = [se3.adjoint(se3.compose(se3.inverse(fine[b]), fine[k])) for k in range(a + 1, b + 1)]
        steps.append(sum(Ad @ np.diag(sigma**2) @ Ad.T for Ad in Ads))
    asked = np.array([8, 30, 44, 66, 80])
    random, squares = np.random.default_rng(5), np.zeros((runs, len(asked)))
    for run in range(runs):
        odometry = [fine[0]]
        for step in se3.compose(se3.inverse(fine[:-1]), fine[1:]):
            odometry.append(se3.compose(se3.compose(odometry[-1], step), se3.exp(random.normal(0.0, sigma))))
        T_odo = np.stack(odometry)
        loops = [loop_between(truth, q, q - 10, random.normal(0.0, Z_SIGMA)) for q in (11, 15, 17)]
        graph = close_graph(list(T_odo[maps]), steps, loops, 10.0, [True] * 3)
        covariance, cross = graph.covariances()
        cross = np.concatenate([np.zeros((1, 6, 6)), cross])
        correction = Correction(maps * 10, T_odo[maps], graph.T_map, covariance, cross, np.stack(steps))
        poses = correction.apply(asked * 10, T_odo[asked])
        errors = se3.log(se3.compose(se3.inverse(fine[asked]), poses))
        squares[run] = np.einsum(
            "ni,ni->n", errors, np.linalg.solve(correction.covariances(asked * 10, poses), errors[..., None])[..., 0]
        )
    low, high = chi2(6 * runs).ppf([0.001, 0.999]) / runs
    assert ((low < squares.mean(axis=0)) & (squares.mean(axis=0) < high)).all(), squares.mean(axis=0)


@given(st.integers(2, 60), st.floats(0.5, 40.0))
@settings(max_examples=30, deadline=None)
def test_verticals_within_a_hundred_metres_weigh_as_one(count: int, spacing: float) -> None:
    """However finely a way is cut into maps; those farther apart than that stand alone."""
    poses = np.tile([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], (count, 1))
    poses[:, 4] = spacing * np.arange(count)
    weight = (0.005 / vertical_sigmas(poses, 0.005)) ** 2
    assert weight.shape == (count, 2)
    np.testing.assert_allclose(weight.sum(axis=0), count * spacing / 100.0)
    poses[:, 4] = 300.0 * np.arange(count)
    np.testing.assert_allclose(vertical_sigmas(poses, 0.005), 0.005)
    np.testing.assert_allclose(vertical_sigmas(poses[:1], 0.005), 0.005)
