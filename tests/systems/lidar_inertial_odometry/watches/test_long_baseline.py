"""Scans seconds apart, laid upon each other: they find a drift that single scans do not show, and nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from boxplus.filtering.nav_state import TANGENT, NavState
from boxplus.filtering.pose_covariance.map_datum import MapDatum
from boxplus.manifolds import so3
from boxplus.runs.storage.state_codec import read_state, write_state
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.watches.long_baseline import Drift, LongBaseline

PERIOD_NS, BASELINE_S = 100_000_000, 1.25
SIGMA_M = 0.01
SMALL = np.diag(np.repeat([1e-6, 1e-5], 3) ** 2)


def surfaces(random: np.random.Generator, count: int, half: tuple[float, float, float]) -> np.ndarray:
    """Points (count, 3) on the sides of a box about the origin; a side farther away than 20 m is open."""
    points = random.uniform(-1.0, 1.0, (count, 3)) * np.minimum(half, 12.0)
    closed = [axis for axis in range(3) if half[axis] < 20.0]
    axes = random.choice(closed, count)
    points[np.arange(count), axes] = random.choice((-1.0, 1.0), count) * np.array(half)[axes]
    return points + random.normal(0.0, SIGMA_M, points.shape)


def drive(
    drift: np.ndarray,
    half: tuple[float, float, float] = (5.0, 4.0, 2.0),
    *,
    seed: int = 0,
    turn: float = 0.3,
    shared: np.ndarray = SMALL,
    seconds: float = 6.0,
    period_s: float = 0.1,
    checkpoint: tuple[int, Path] | None = None,
) -> list[Drift]:
    """A platform on its way through a box, placed wrongly by drift (6,) a second; `shared`: what all poses share.

    At a `checkpoint`, a scan's number and a file, everything is written and read again.
    """
    random = np.random.default_rng(seed)
    baseline, found = LongBaseline(LioConfig(threads=1)), []
    x, cov = NavState.identity().pack(), np.zeros((TANGENT, TANGENT))
    datum = MapDatum(x, cov)
    for scan in range(round(seconds / period_s)):
        t = scan * period_s
        R, p = so3.exp(np.array([0.0, 0.0, turn * t])), np.array([0.2 * t, 0.1 * np.sin(t), 0.02 * t])
        p_lidar = ((surfaces(random, 900, half) - p) @ R).astype(np.float32)
        x = NavState.identity().pack()
        R_placed, p_placed = R @ so3.exp(drift[:3] * t), p + drift[3:] * t
        x[:9], x[9:12] = R_placed.ravel(), p_placed
        cov = cov + np.pad(SMALL, (0, TANGENT - 6))
        datum.follow(x, cov, cov)
        result = baseline.follow(round(t * 1e9), x, p_lidar, p_lidar @ R_placed.T + p_placed, datum)
        datum.insert(900)
        if scan == 0:
            datum.widen(shared, x)
        found += [result] if result is not None else []
        if checkpoint is not None and scan == checkpoint[0]:
            write_state(checkpoint[1], {"baseline": baseline, "datum": datum})
            state = read_state(checkpoint[1])
            baseline, datum = state["baseline"], state["datum"]
    return found


@pytest.mark.parametrize("scan", [16, 18, 22, 26])  # of 13 between two marks: with none of the old scans laid down, some, all
def test_goes_on_from_a_checkpoint_with_the_same_bits(tmp_path: Path, scan: int) -> None:
    drift = np.array([0.0, 0.0, 0.0, 0.02, 0.0, 0.0])
    whole, resumed = drive(drift), drive(drift, checkpoint=(scan, tmp_path / "state.npz"))
    assert len(resumed) == len(whole) > 2
    for one, other in zip(resumed, whole, strict=True):
        assert np.array_equal(one.excess, other.excess) and one.deviations == other.deviations > 0.0


@pytest.mark.parametrize("seed", [1, 2])
def test_scans_where_they_were_seen_fit_each_other(seed: int) -> None:
    found = drive(np.zeros(6), seed=seed)
    assert len(found) == 4
    for drift in found:
        assert not drift.warnings
        assert np.sqrt(drift.excess[3:, 3:].trace()) < SIGMA_M


@pytest.mark.parametrize("axis", range(6))
def test_a_drift_is_told_and_covered(axis: int) -> None:
    """1 degree or 8 cm in a baseline, less in a scan than the noise of a point."""
    drift = np.zeros(6)
    drift[axis] = np.deg2rad(0.8) if axis < 3 else 0.064
    found = drive(drift, seed=axis)
    assert len(found) == 4
    for last in found:
        assert "scans 1.3 s apart do not fit each other" in last.warnings[0]
        # A tilt that grows while the platform turns changes its axis; the others are what they were made.
        if axis >= 2:
            assert np.sqrt(last.excess[axis, axis]) > 0.5 * drift[axis] * BASELINE_S


def test_nothing_is_said_along_what_the_old_scans_do_not_determine() -> None:
    """Along a corridor without an end, drift is nobody's to see; across it, it is."""
    corridor = (1000.0, 3.0, 2.0)
    for drift in drive(np.array([0.0, 0.0, 0.0, 0.05, 0.0, 0.0]), corridor):
        assert not drift.warnings
        assert np.sqrt(drift.excess[3, 3]) < SIGMA_M
    assert all(drift.warnings for drift in drive(np.array([0.0, 0.0, 0.0, 0.05, 0.08, 0.0]), corridor))


@pytest.mark.parametrize("turn", [0.0, 0.9])
def test_what_all_poses_share_does_not_hide_a_drift(turn: float) -> None:
    """A heading that is off by degrees from the first pose on, straight on and in turns: the same is found as without."""
    heading = np.diag(np.array([1e-6, 1e-6, np.deg2rad(5.0), 1e-5, 1e-5, 1e-5]) ** 2)
    steady = np.array([0.0, 0.0, 0.0, 0.05, 0.0, 0.0])
    for known, unknown in zip(drive(steady, turn=turn), drive(steady, turn=turn, shared=heading), strict=True):
        assert known.warnings == unknown.warnings != []
        np.testing.assert_allclose(known.deviations, unknown.deviations, rtol=1e-3)
        np.testing.assert_allclose(known.excess, unknown.excess, atol=1e-8)


def test_a_steady_drift_is_told_and_added_every_time() -> None:
    """What the covariance was widened by for the baselines before does not explain the next one."""
    found = drive(np.array([0.0, 0.0, 0.0, 0.064, 0.0, 0.0]), seconds=11.0)
    assert len(found) == 8
    sizes = [np.sqrt(drift.excess[3, 3]) for drift in found]
    assert all(drift.warnings for drift in found)
    np.testing.assert_allclose(sizes, 0.064 * BASELINE_S, rtol=0.3)


def test_a_small_drift_is_covered_and_told_once_it_has_come_to_five_centimetres() -> None:
    found = drive(np.array([0.0, 0.0, 0.0, 0.016, 0.0, 0.0]), seconds=16.0)  # 2 cm in a baseline
    beyond = [drift for drift in found if drift.deviations > 4.0]
    told = [number for number, drift in enumerate(beyond) if drift.warnings]
    assert len(beyond) >= 8 and all(np.sqrt(drift.excess[3, 3]) > 0.01 for drift in beyond)
    assert told and told[0] == 2 and np.diff(told).max() <= 4  # three make 6 cm


def test_a_motion_as_uncertain_as_it_is_stated_is_not_told() -> None:
    """Errors drawn as the covariance between the two says: within its band, and hardly widened."""
    random, rounds = np.random.default_rng(7), 12
    spread = np.repeat([np.deg2rad(0.4), 0.03], 3)
    squared = []
    for _ in range(rounds):
        baseline, x, cov = LongBaseline(LioConfig(threads=1)), NavState.identity().pack(), np.zeros((TANGENT, TANGENT))
        datum, p_world = MapDatum(x, cov), []
        for scan in range(15):
            off = spread * random.normal(size=6) if scan == 14 else np.zeros(6)
            p_lidar = surfaces(random, 900, (5.0, 4.0, 2.0)).astype(np.float32)
            x[:9], x[9:12] = so3.exp(off[:3]).ravel(), off[3:]
            cov_prior = cov.copy()
            cov_prior[:6, :6] += np.diag(spread**2) * (scan == 14)
            datum.follow(x, cov_prior, cov_prior)
            p_world = p_lidar @ so3.exp(off[:3]).T + off[3:]
            drift = baseline.follow(round(scan * 0.125e9), x, p_lidar, p_world, datum)
            datum.insert(900)
        assert drift is not None and not drift.warnings
        squared.append(drift.deviations**2)
    # The larger one of two means of three squares of a normal: 4.3 in the mean.
    assert 2.5 < np.mean(squared) < 6.5


def test_the_interval_is_told_as_it_was() -> None:
    """At one scan a second five of them last longer than a baseline."""
    found = drive(np.array([0.0, 0.0, 0.0, 0.03, 0.0, 0.0]), seconds=12.0, period_s=1.0)
    told = [text for drift in found for text in drift.warnings]
    assert told and all("scans 2 s apart" in text for text in told)


def test_no_baseline_has_passed() -> None:
    baseline, x = LongBaseline(LioConfig(threads=1)), NavState.identity().pack()
    datum = MapDatum(x, np.zeros((TANGENT, TANGENT)))
    points = surfaces(np.random.default_rng(0), 900, (5.0, 4.0, 2.0))
    for scan in range(16):
        assert baseline.follow(scan * PERIOD_NS, x, points.astype(np.float32), points, datum) is None
