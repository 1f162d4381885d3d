"""The joint covariance of pose and map against the filter's own, and against sampled errors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.filtering.degeneracy import pose_directions
from boxplus.filtering.nav_state import MEASURED, NavState
from boxplus.filtering.pose_covariance.correction import Correction
from boxplus.filtering.pose_covariance.map_datum import MapDatum
from boxplus.manifolds import so3

seeds = st.integers(0, 2**32 - 1)
ALL_AROUND = np.zeros(3)


def _state(R_world_imu: np.ndarray, p_world_imu: np.ndarray) -> np.ndarray:
    zero = np.zeros(3)
    return NavState(R_world_imu, p_world_imu, zero, zero, zero, zero, np.eye(3), zero).pack()


def _information(random: np.random.Generator) -> np.ndarray:
    """A (12, 12) of forty points, the mounting not estimated."""
    s, u = random.uniform(-8, 8, (40, 3)), random.normal(size=(40, 3))
    h = np.hstack([np.cross(s, u), u])
    A = np.zeros((12, 12))
    A[:6, :6] = 1e3 * h.T @ h
    return A


def _updated(cov_prior: np.ndarray, A: np.ndarray) -> np.ndarray:
    information = np.linalg.inv(cov_prior)
    information[np.ix_(MEASURED, MEASURED)] += A
    return np.linalg.inv(information)


def _scan(
    datum: MapDatum,
    random: np.random.Generator,
    x: np.ndarray,
    cov: np.ndarray,
    noise: float,
    facing: np.ndarray = ALL_AROUND,
) -> np.ndarray:
    """One scan; returns the filter's covariance after it."""
    cov_prior = cov + noise**2 * np.eye(24)
    A = _information(random)
    posterior = _updated(cov_prior, A)
    datum.follow(x, cov_prior, posterior, Correction.of(posterior, A, pose_directions(A[:6, :6], np.eye(6), 8.0, 0.0), facing))
    return posterior


@settings(max_examples=20)
@given(seeds)
def test_against_an_exact_map_it_is_the_covariance_of_the_filter(seed: int) -> None:
    random = np.random.default_rng(seed)
    x, cov = _state(so3.exp(random.normal(size=3)), np.zeros(3)), 1e-4 * np.eye(24)
    datum = MapDatum(x, cov)
    for _ in range(4):
        cov = _scan(datum, random, x, cov, 1e-2)
        np.testing.assert_allclose(datum.pose_covariance(x), cov[:6, :6], rtol=1e-6, atol=1e-12)
    datum.follow(x, cov + np.eye(24), cov + np.eye(24))  # a scan that was lost
    np.testing.assert_allclose(datum.pose_covariance(x), cov[:6, :6] + np.eye(6), rtol=1e-6, atol=1e-12)


def test_a_map_that_moves_with_the_sensor_loses_the_start() -> None:
    """On the spot the covariance settles; on the way it grows, beyond the filter's, which does not."""
    final = []
    for step in (0.0, 2.0):
        random = np.random.default_rng(0)
        x, cov = _state(np.eye(3), np.zeros(3)), 1e-8 * np.eye(24)
        datum = MapDatum(x, cov)
        datum.insert(1000)
        for k in range(60):
            x = _state(np.eye(3), np.array([step * k, 0.0, 0.0]))
            cov = _scan(datum, random, x, cov, 1e-3)
            datum.insert(1000 if step else 10)
        sigma = np.sqrt(datum.pose_covariance(x).diagonal())
        assert (np.linalg.eigvalsh(datum.pose_covariance(x)) > 0).all()
        assert (sigma >= 0.999 * np.sqrt(cov.diagonal()[:6])).all()
        final.append(sigma)
    assert (final[1][:3] > 2.0 * final[0][:3]).all()
    assert (final[1][4:] > 10.0 * final[0][4:]).all()  # across the way, by the lever of the heading


def test_a_view_that_turns_away_compares_with_what_it_brought_itself() -> None:
    """A cone looks at new places as it turns about what is across it; about its own axis, and all around, it does not."""
    turns = {"aside": np.array([0.0, 0.0, 0.1]), "about its axis": np.array([0.1, 0.0, 0.0])}
    ahead = np.array([0.9, 0.0, 0.0])
    final = {}
    for name, facing in (("aside", ahead), ("about its axis", ahead), ("aside", ALL_AROUND)):
        random = np.random.default_rng(0)
        R, cov = np.eye(3), 1e-8 * np.eye(24)
        datum = MapDatum(_state(R, np.zeros(3)), cov)
        datum.insert(1000)
        for _ in range(150):
            R = R @ so3.exp(turns[name])
            cov = _scan(datum, random, _state(R, np.zeros(3)), cov, 1e-3, facing)
            datum.insert(100)
        key = name if facing is ahead else "all around"
        final[key] = np.sqrt(np.trace(datum.pose_covariance(_state(R, np.zeros(3)))[:3, :3]))
    assert final["aside"] > 2.0 * final["all around"]
    assert final["about its axis"] == pytest.approx(final["all around"], rel=0.2)


def test_sampled_errors_spread_as_it_says() -> None:
    """Errors drawn through the equations of `map_datum`, in a world frame that is not the IMU's."""
    random, runs, share_new = np.random.default_rng(1), 20000, 0.5
    R = so3.exp(np.array([0.3, -0.2, 1.0]))
    turn = np.kron(np.diag([1.0, 0.0]), R) + np.kron(np.diag([0.0, 1.0]), np.eye(3))
    x, cov = _state(R, np.zeros(3)), 1e-4 * np.eye(24)
    datum = MapDatum(x, cov)
    e, d = 1e-2 * random.normal(size=(2, runs, 6))
    e, d, points = e @ turn.T, 0.0 * d, 0.0
    for _ in range(5):
        A, cov_prior = _information(random), cov + 1e-4 * np.eye(24)
        cov = _updated(cov_prior, A)
        points += 100.0
        datum.follow(x, cov_prior, cov, Correction.of(cov, A, pose_directions(A[:6, :6], np.eye(6), 8.0, 0.0), ALL_AROUND))
        noise = np.linalg.cholesky(turn @ np.linalg.inv(A[:6, :6]) @ turn.T)
        if points > 100.0:
            d += np.sqrt(share_new) * random.normal(size=(runs, 6)) @ noise.T
        G = turn @ cov[:6, :6] @ A[:6, :6] @ turn.T
        e = (e + 1e-2 * random.normal(size=(runs, 6))) @ (np.eye(6) - G).T + (d + random.normal(size=(runs, 6)) @ noise.T) @ G.T
        datum.insert(100)
        share_new = 100.0 / points
        d = (1.0 - share_new) * d + share_new * e
    sampled = turn.T @ np.cov(e.T) @ turn
    expected = datum.pose_covariance(x)
    scale = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
    np.testing.assert_allclose(sampled / scale, expected / scale, atol=0.05)


@settings(max_examples=20)
@given(seeds)
def test_an_error_that_pose_and_map_share_stays_with_both(seed: int) -> None:
    """No scan sees it, as it is measured against that map: on the spot it is in the covariance from then on."""
    random = np.random.default_rng(seed)
    x, cov = _state(so3.exp(random.normal(size=3)), np.zeros(3)), 1e-4 * np.eye(24)
    root = random.normal(size=(6, 6))
    datum, plain = MapDatum(x, cov), MapDatum(x, cov)
    excess = 0.01 * root @ root.T
    datum.widen(excess, x)
    for scan in range(3):
        before = cov
        cov, _ = (_scan(each, np.random.default_rng(scan), x, before, 1e-2) for each in (plain, datum))
    np.testing.assert_allclose(datum.pose_covariance(x) - plain.pose_covariance(x), excess, rtol=1e-6, atol=1e-9)


@settings(max_examples=20)
@given(seeds, st.floats(0.0, 2.0), st.floats(0.0, 0.5))
def test_what_all_poses_share_is_not_between_two(seed: int, step: float, turn: float) -> None:
    """On the way and in turns: neither what pose and map share from the first scan on, nor from the mark."""
    between = []
    for shared in (1e-12, 0.1):
        random = np.random.default_rng(seed)
        x, cov = _state(np.eye(3), np.zeros(3)), 1e-6 * np.eye(24)
        datum = MapDatum(x, cov)
        datum.insert(500)
        datum.widen(shared * np.eye(6), x)
        for k in range(12):
            R = so3.exp(np.array([0.0, 0.1 * np.sin(k), turn * k]))
            x = _state(R, np.array([step * k, 0.2 * k, 0.0]))
            cov = _scan(datum, random, x, cov, 1e-3)
            if k == 5:
                datum.widen(shared * np.eye(6), x)
                datum.mark()
                np.testing.assert_allclose(datum.covariance_since_mark(x), np.zeros((6, 6)), atol=1e-9)
            datum.insert(100)
        between.append(datum.covariance_since_mark(x))
    np.testing.assert_allclose(between[0], between[1], rtol=1e-4, atol=1e-9)
    assert (np.linalg.eigvalsh(between[0]) > 0.0).all()


@pytest.mark.parametrize("creeps", [False, True])
def test_a_filter_that_knows_that_its_map_creeps_knows_where_it_is_on_it(creeps: bool) -> None:
    """Sampled errors of the pose against the local map, for a filter that takes it for fixed and one that does not."""
    random, runs = np.random.default_rng(3), 20000
    x, cov = _state(np.eye(3), np.zeros(3)), 1e-8 * np.eye(24)
    datum = MapDatum(x, cov)
    e, d = 1e-4 * random.normal(size=(runs, 6)), np.zeros((runs, 6))
    A, too_sure = _information(random), []
    noise = np.linalg.cholesky(np.linalg.inv(A[:6, :6]))
    datum.insert(100)
    for k in range(1, 9):
        cov_prior = cov + 1e-9 * np.eye(24)
        cov = _updated(cov_prior, A)
        datum.follow(x, cov_prior, cov, Correction.of(cov, A, pose_directions(A[:6, :6], np.eye(6), 8.0, 0.0), ALL_AROUND))
        G = cov[:6, :6] @ A[:6, :6]
        w = 10**-4.5 * random.normal(size=(runs, 6))
        e = (e + w) @ (np.eye(6) - G).T + (d + random.normal(size=(runs, 6)) @ noise.T) @ G.T
        datum.insert(100)
        new = 1.0 / (k + 1)
        d = (1.0 - new) * d + new * e + np.sqrt(new) * random.normal(size=(runs, 6)) @ noise.T
        if creeps:
            datum.creep(cov, x)
        too_sure.append(np.linalg.eigvals(np.linalg.solve(cov[:6, :6], np.cov((e - d).T))).real.max())
    assert (max(too_sure) < 1.05) == creeps


@pytest.mark.parametrize(("facing", "turned_away"), [(0.0, 0.0), (0.8, 0.4)])  # 0.3 rad × 0.8 over a spread of 0.6
def test_sampled_errors_between_two_poses_spread_as_it_says(facing: float, turned_away: float) -> None:
    """Errors drawn through the equations of `map_datum` on a way that turns, the error of the marked pose moved along."""
    random, runs, marked_at = np.random.default_rng(2), 20000, 3
    x, cov = _state(np.eye(3), np.zeros(3)), 1e-8 * np.eye(24)
    datum = MapDatum(x, cov)
    e = 1e-4 * random.normal(size=(runs, 6))
    datum.insert(100)
    d, local, new = e.copy(), 100.0, 1.0
    marked, turn_before = e, np.eye(6)
    for k in range(1, 9):
        R, shift = so3.exp(np.array([0.0, 0.0, 0.3 * k])), np.array([1.0, 0.5 * np.sin(k), 0.1])
        x = _state(R, x[9:12] + shift)
        move = np.block([[np.eye(3), np.zeros((3, 3))], [-so3.hat(shift), np.eye(3)]])
        e, d, marked = e @ move.T, d @ move.T, marked @ move.T
        turn = np.kron(np.diag([1.0, 0.0]), R) + np.kron(np.diag([0.0, 1.0]), np.eye(3))
        A = _information(random)
        # The filter's own prior, moved as `follow` moves it, and noise of the IMU.
        along = move @ _turned(cov[:6, :6], turn_before) @ move.T
        cov_prior = cov.copy()
        cov_prior[:6, :6] = _turned(along, turn.T) + 1e-5 * np.eye(6)
        cov = _updated(cov_prior, A)
        correction = Correction.of(cov, A, pose_directions(A[:6, :6], np.eye(6), 8.0, 0.0), np.array([facing, 0.0, 0.0]))
        datum.follow(x, cov_prior, cov, correction)
        noise = np.linalg.cholesky(turn @ np.linalg.inv(A[:6, :6]) @ turn.T)
        d = d + np.sqrt(new) * random.normal(size=(runs, 6)) @ noise.T
        G = turn @ cov[:6, :6] @ A[:6, :6] @ turn.T
        w = np.sqrt(1e-5) * random.normal(size=(runs, 6))
        e = (e + w) @ (np.eye(6) - G).T + (d + random.normal(size=(runs, 6)) @ noise.T) @ G.T
        if k == marked_at:
            datum.mark()
            marked = e
        local = local * np.exp(-np.linalg.norm(shift) / correction.lever_arm - turned_away) + 100.0
        new = 100.0 / local
        datum.insert(100)
        d = (1.0 - new) * d + new * e
        turn_before = turn
    for errors, expected in ((e, datum.pose_covariance(x)), (e - marked, datum.covariance_since_mark(x))):
        sampled, expected = np.cov(errors.T), _turned(expected, turn)
        scale = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
        np.testing.assert_allclose(sampled / scale, expected / scale, atol=0.05)


def _turned(M: np.ndarray, turn: np.ndarray) -> np.ndarray:
    return turn @ M @ turn.T


@given(seeds)
def test_points_are_laid_down_where_the_pose_was_as_they_were_seen(seed: int) -> None:
    """l = E e − u; a scan that stored nothing has laid nothing down."""
    random = np.random.default_rng(seed)
    datum = MapDatum(_state(np.eye(3), np.zeros(3)), np.eye(24))
    root = random.normal(size=(2, 18, 18))
    datum._joint, datum._local_points = root @ root.swapaxes(1, 2), 100.0
    before = datum._joint.copy()
    datum.insert(300)
    step = np.eye(18)
    step[12:, :6], step[12:, 12:] = np.eye(6), -np.eye(6)
    assert datum.new_share == 0.75
    assert np.allclose(datum._joint, step @ before @ step.T, atol=1e-11)


@given(seeds)
def test_what_a_view_turns_away_from_is_compared_no_more(seed: int) -> None:
    random = np.random.default_rng(seed)
    facing, moved, turned = 0.25 * random.normal(size=3), random.normal(size=3), random.normal(size=3)
    spread = np.sqrt(max(1.0 - facing @ facing, 0.05**2))
    left = Correction(*[np.eye(6)] * 4, 5.0, facing).share_left(moved, turned)
    assert left == pytest.approx(np.exp(-np.linalg.norm(moved) / 5.0 - np.linalg.norm(np.cross(turned, facing)) / spread))


@given(seeds, st.floats(0.05, 1.0))
def test_what_residuals_do_not_bear_out_is_taken_off_and_a_shared_shift_stays(seed: int, scatter: float) -> None:
    """A = (Q⁻¹ + u uᵀ)⁻¹: points of covariance Q⁻¹, and a stamp that moves all of them by u."""
    random = np.random.default_rng(seed)
    shift, Q = 0.01 * random.normal(size=6), _information(random)[:6, :6]
    A, cov = np.zeros((12, 12)), 1e-4 * np.eye(24)
    A[:6, :6] = np.linalg.inv(np.linalg.inv(Q) + np.outer(shift, shift))
    after = _updated(cov, A)
    directions = pose_directions(A[:6, :6], np.eye(6), 8.0, 0.0)
    found = Correction.of(after, A, directions, ALL_AROUND, scatter=scatter, shared_shift=shift)
    really = scatter * np.linalg.inv(Q) + np.outer(shift, shift)
    np.testing.assert_allclose(found.alone, really, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found.noise, found.gain @ really @ found.gain.T, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found.alone_by_weights, np.linalg.inv(A[:6, :6]), rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("walks", [True, False])
def test_points_brought_to_the_end_of_their_scan_by_the_prediction_share_its_error(walks: bool) -> None:
    """Sampled: a walk within the scan, or a velocity that is off; the points, seen all along it, show the mean of what it did.

    They are laid into the map where they were seen: what the walk did after them is in the pose, and not in the map.
    """
    random, runs, steps, marked_at = np.random.default_rng(4), 20000, 40, 4
    x, cov = _state(np.eye(3), np.zeros(3)), 1e-8 * np.eye(24)
    datum, e, d, local = MapDatum(x, cov), 1e-4 * random.normal(size=(runs, 6)), np.zeros((runs, 6)), 100.0
    datum.insert(100)
    d, new, marked = e.copy(), 1.0, e
    for scan in range(12):
        A, cov_prior = _information(random), cov + 1e-4 * np.eye(24)
        cov = _updated(cov_prior, A)
        correction = Correction.of(
            cov, A, pose_directions(A[:6, :6], np.eye(6), 8.0, 0.0), ALL_AROUND, scatter=0.05, deskewed=True
        )
        datum.follow(x, cov_prior, cov, correction)
        noise = np.sqrt(0.05) * np.linalg.cholesky(np.linalg.inv(A[:6, :6]))
        d = d + np.sqrt(new) * random.normal(size=(runs, 6)) @ noise.T
        w, seen = np.zeros((2, runs, 6))
        rate = 1e-2 * random.normal(size=(runs, 6))
        for _ in range(steps):
            w = w + (1e-2 / np.sqrt(steps) * random.normal(size=(runs, 6)) if walks else rate / steps)
            seen += w / steps
        G = cov[:6, :6] @ A[:6, :6]
        laid = e + seen - (e + seen - d + random.normal(size=(runs, 6)) @ noise.T) @ G.T
        e = laid + w - seen
        if scan == marked_at:
            datum.mark()
            marked = e
        local += 100.0
        new = 100.0 / local
        datum.insert(100)
        d = (1.0 - new) * d + new * laid
        ratios = _ratios(datum.pose_covariance(x), e)
        assert ratios.max() < 1.1 and ratios.min() > (0.9 if walks else 0.65)  # 1/4 of what a velocity does, 1/3 of a walk
    of_map = _ratios(_taken_in(datum._joint[0], new), d)
    assert of_map.max() < (1.15 if walks else 1.5) and of_map.min() > 0.8
    if walks:
        ratios = _ratios(datum.covariance_since_mark(x), e - marked)
        assert ratios.min() > 0.85 and ratios.max() < 1.15


def _taken_in(joint: np.ndarray, share: float) -> np.ndarray:
    """The covariance of d once the last scan, of error l, is in it, of which the noise is none."""
    step = np.hstack([np.zeros((6, 6)), (1.0 - share) * np.eye(6), share * np.eye(6)])
    return step @ joint @ step.T


@pytest.mark.parametrize("followed", [18, 6])
def test_a_bias_turns_scan_after_scan_the_same_way(followed: int) -> None:
    """Sampled: errors of the whole state, of a filter whose points are much better than it knows, and learns its bias slowly."""
    random, runs, dt = np.random.default_rng(5), 20000, 0.1
    x, cov = _state(np.eye(3), np.zeros(3)), np.diag(np.repeat([1e-10, 1e-10, 1e-4, 1e-4, 1e-6, 1e-6, 1e-4, 1e-4], 3))
    Phi = np.eye(24)
    Phi[0:3, 9:12], Phi[3:6, 6:9], Phi[6:9, 15:18] = -dt * np.eye(3), dt * np.eye(3), dt * np.eye(3)
    Q = np.diag(np.repeat([1e-10, 1e-10, 1e-9, 0.0, 0.0, 0.0, 0.0, 0.0], 3))
    datum, e = MapDatum(x, cov, followed=followed), random.normal(size=(runs, 24)) @ np.sqrt(cov)
    datum.insert(100)
    d, laid, scatter = np.zeros((runs, 6)), e[:, :6].copy(), 0.05
    for scan in range(15):
        A = 0.05 * _information(random)
        newest = 0.5 * A[:6, :6] if scan else A[:6, :6]
        newest[2] *= 0.1
        newest[:, 2] *= 0.1
        F = np.linalg.solve(A[:6, :6], newest)
        prior = Phi @ cov @ Phi.T + Q
        after = _updated(prior, A)
        found = Correction.of(
            after, A, pose_directions(A[:6, :6], np.eye(6), 8.0, 0.0), ALL_AROUND, scatter=scatter, deskewed=True, renewed=F
        )
        datum.follow(x, prior, after, found, Phi[:18, :18] if followed == 18 else None)
        noise = np.sqrt(scatter) * np.linalg.cholesky(np.linalg.inv(A[:6, :6]))
        of_new = 0.5 * scatter * (F @ np.linalg.inv(A[:6, :6]) + np.linalg.inv(A[:6, :6]) @ F.T)
        d = d + (laid - d) @ F.T + random.normal(size=(runs, 6)) @ np.linalg.cholesky(of_new).T
        u = 0.5 * (e @ Phi.T - e)[:, :6]
        e = e @ Phi.T + random.normal(size=(runs, 24)) @ np.sqrt(Q)
        e = e - (e[:, :6] - u - d + random.normal(size=(runs, 6)) @ noise.T) @ (after[:, :6] @ A[:6, :6]).T
        laid, cov = e[:, :6] - u, after
        datum.insert(50)
    ratios = _ratios(datum.pose_covariance(x), e[:, :6])
    if followed == 18:
        assert ratios.min() > 0.9 and ratios.max() < 1.1
    else:
        assert ratios.max() > 2.0  # what is followed beside the pose is not for nothing


def _ratios(stated: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Of sampled variances to stated ones, along the directions where they differ most."""
    return np.linalg.eigvals(np.linalg.solve(stated, np.cov(errors.T))).real
