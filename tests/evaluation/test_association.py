"""Matching of stamps, interpolation, clock offsets, and the comparisons that are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from boxplus.errors import InputError
from boxplus.evaluation.association import associate
from boxplus.evaluation.clock_fit import MotionPair
from boxplus.formats.trajectory import Trajectory, read_trajectory
from boxplus.manifolds import quaternion, so3
from tests.evaluation.smooth_paths import SmoothPath, disturbed

stamps = st.lists(st.integers(0, 10_000), min_size=1, max_size=40, unique=True).map(sorted)


def still(times: list[int]) -> Trajectory:
    count = len(times)
    return Trajectory(np.array(times, dtype=np.int64), np.zeros((count, 3)), np.tile([1.0, 0, 0, 0], (count, 1)))


def test_too_few_matches_say_which_poses_were_left_out_before(tmp_path: Path) -> None:
    """Stamps with six digits, as programs write numbers by themselves, are all the same."""
    truth = still([1_700_000_000_000_000_000 + 100_000_000 * k for k in range(50)])
    (tmp_path / "short.txt").write_text("".join(f"{time_ns * 1e-9:g} 0 0 0 0 0 0 1\n" for time_ns in truth.times))
    with pytest.raises(InputError, match=r"got 1 of 1 .*; 49 poses of \S+ repeat the time stamp before them and were left out"):
        associate(read_trajectory(tmp_path / "short.txt"), truth)


@settings(max_examples=200, deadline=None)
@given(estimate=stamps, truth=stamps, limit=st.integers(1, 500))
def test_nearest_pairs_against_brute_force(estimate: list[int], truth: list[int], limit: int) -> None:
    # From every pose of the one that has fewer, the nearest of the other, the earlier of two.
    few, many = (truth, estimate) if len(truth) < len(estimate) else (estimate, truth)
    nearest = [(i, min(range(len(many)), key=lambda j: (abs(many[j] - t), j))) for i, t in enumerate(few)]
    kept = [(i, j) for i, j in nearest if abs(few[i] - many[j]) <= limit]
    expected = kept if few is estimate else [(j, i) for i, j in kept]
    try:
        found = associate(still(estimate), still(truth), max_difference_s=limit * 1e-9, min_matches=1)
    except InputError:
        assert not expected or max(estimate[0], truth[0]) > min(estimate[-1], truth[-1])
        return
    assert list(zip(found.estimate_index.tolist(), found.ground_truth_index.tolist(), strict=True)) == expected
    assert found.unmatched_estimate == len(estimate) - len({i for i, _ in expected})
    assert found.repeated == len(expected) - min(len({i for i, _ in expected}), len({j for _, j in expected}))
    assert found.estimate.times.tolist() == found.ground_truth.times.tolist() == [few[i] for i, _ in kept]
    assert found.outside == sum(t < truth[0] or t > truth[-1] for t in estimate)
    np.testing.assert_array_equal(found.difference_s * 1e9 <= limit + 1e-6, True)


def test_poses_taken_twice_are_counted() -> None:
    path = SmoothPath(1)
    found = associate(path.sample(np.arange(0.0, 20.0, 0.02)), path.sample(np.arange(0.0, 25.0, 0.025)))
    assert (len(found), found.repeated) == (1000, 200)
    assert "200 of the 1000 matches repeat a pose: the other trajectory is denser there" in found.lines()


def test_interpolation_follows_the_path() -> None:
    path = SmoothPath(1)
    truth, estimate = path.sample(np.arange(0.0, 30.0, 0.01)), path.sample(np.arange(0.003, 29.9, 0.1))
    found = associate(estimate, truth, "interpolate")
    assert len(found) == len(estimate)
    np.testing.assert_allclose(found.ground_truth.p, estimate.p, atol=2e-4)
    angle = 2 * np.arccos(np.minimum(1.0, np.abs(np.sum(found.ground_truth.q_wxyz * estimate.q_wxyz, axis=1))))
    assert angle.max() < 1e-3
    np.testing.assert_array_equal(found.ground_truth.times, estimate.times)


def test_interpolation_on_a_measured_pose_is_that_pose() -> None:
    truth = SmoothPath(2).sample(np.arange(0.0, 10.0, 0.1))
    found = associate(truth, truth, "interpolate", max_gap_s=0.01)
    assert len(found) == len(truth)
    np.testing.assert_allclose(found.ground_truth.p, truth.p, atol=1e-12)


def test_ground_truth_gaps_are_not_interpolated_and_reported() -> None:
    path = SmoothPath(3)
    t = np.arange(0.0, 20.0, 0.01)
    truth, estimate = path.sample(t[(t < 8.0) | (t > 11.0)]), path.sample(np.arange(0.005, 19.9, 0.05))
    for method in ("nearest", "interpolate"):
        found = associate(estimate, truth, method)
        assert len(found) == pytest.approx(len(estimate) - 60, abs=2)
        ((begin, end),) = found.gaps
        assert (begin, end) == (pytest.approx(8.0, abs=0.06), pytest.approx(11.0, abs=0.06))
        assert any("1 gaps without matches" in line for line in found.lines())


@pytest.mark.parametrize("offset", [-0.7, -0.05, 0.0, 0.013, 0.3])
@pytest.mark.parametrize("seed", [0, 1])
def test_clock_offset_is_found_from_the_motion(offset: float, seed: int) -> None:
    path = SmoothPath(seed)
    truth = path.sample(np.arange(0.0, 30.0, 0.01))
    estimate = path.sample(np.arange(1.0, 29.0, 0.1))
    late = Trajectory(estimate.times - round(offset * 1e9), estimate.p, estimate.q_wxyz)
    found = associate(late, truth).time_offset
    assert found is not None
    assert found.offset_s == pytest.approx(offset, abs=0.01)
    assert found.correlation > 0.95
    again = associate(late, truth, offset_s=offset).time_offset
    assert again is not None
    assert abs(again.offset_s) < 0.01


def test_motions_that_do_not_tell_give_no_offset() -> None:
    t = np.arange(0.0, 20.0, 0.05)
    straight = Trajectory(
        np.round(t * 1e9).astype(np.int64), t[:, None] * np.array([1.0, 0.0, 0.0]), np.tile([1.0, 0, 0, 0], (len(t), 1))
    )
    assert associate(straight, straight).time_offset is None
    other = SmoothPath(5).sample(t, 0)
    assert associate(SmoothPath(6).sample(t, 0), other).time_offset is None


def wandering(seed: int, speed: float, late_s: float = 0.0, noise_m: float = 0.01) -> tuple[Trajectory, Trajectory]:
    """A minute at 20 Hz of slow waves, and an estimate at 10 Hz in another frame with noise, whose clock is late."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 60.0, 0.05)
    waves = rng.uniform((0.02, 0.0), (0.1, 6.3), (5, 3, 2))
    p = speed * np.sum(np.sin(2.0 * np.pi * waves[..., 0] * t[:, None, None] + waves[..., 1]) / waves[..., 0], axis=1)
    start = 1_700_000_000_000_000_000 + np.round(1e9 * t).astype(np.int64)
    R = Rotation.from_rotvec(0.3 * speed * np.sin(0.4 * t)[:, None] * rng.normal(size=3))
    truth = Trajectory(start, p, R.as_quat()[:, [3, 0, 1, 2]])
    turn = Rotation.random(rng=rng)
    q = (turn * R * Rotation.from_rotvec(0.01 * rng.normal(size=p.shape))).as_quat()[:, [3, 0, 1, 2]]
    rows = slice(None, None, 2)
    noisy = turn.apply(p + noise_m * rng.normal(size=p.shape))
    return Trajectory(start[rows] + round(late_s * 1e9), noisy[rows], q[rows]), truth


@pytest.mark.slow
@pytest.mark.parametrize("late_s", [0.0, 0.01, 0.3])
def test_the_offset_of_a_clock_comes_with_a_deviation_that_holds(late_s: float) -> None:
    ratios = []
    for seed in range(20):
        found = associate(*wandering(seed, 0.1, late_s), "interpolate").time_offset
        assert found is not None
        ratios.append((found.offset_s + late_s) / found.deviation_s)
        assert found.deviation_s < 0.05
    assert 0.3 < np.median(np.abs(ratios)) < 1.3  # 0.67 of a Gaussian
    assert np.abs(ratios).max() < 5.0


def test_slow_motion_does_not_hide_an_offset_that_places_show() -> None:
    for seed in range(6):
        found = associate(*wandering(seed, 0.01, 0.3), "interpolate").time_offset
        assert found is not None and found.offset_s == pytest.approx(-0.3, abs=4.0 * found.deviation_s)


def test_it_is_said_which_offset_would_not_show() -> None:
    seen = associate(*wandering(0, 0.001, noise_m=0.003), "interpolate")
    found = seen.time_offset
    assert found is not None and not found.shows
    assert found.least_s > 0.02
    assert f"clock offset: none shows, and none up to {found.least_s:.3g} s would; the motions fit" in seen.lines()[-1]
    still = associate(*wandering(0, 1e-6), "interpolate")
    assert still.time_offset is None
    assert still.lines()[-1] == "clock offset: the motion does not tell, none would show"


def shifted(trajectory: Trajectory, start_ns: int, factor: float = 1.0) -> Trajectory:
    time = start_ns + np.round((trajectory.times - trajectory.times[0]) * factor).astype(np.int64)
    return Trajectory(time, trajectory.p, trajectory.q_wxyz, source="estimate.tum")


def test_no_overlap_says_which_offset_would_make_them_start_together() -> None:
    truth = SmoothPath(0).sample(np.arange(0.0, 20.0, 0.01))
    with pytest.raises(
        InputError,
        match=r"expected two trajectories that overlap in time – got 0\.000 … 19\.990 s \(estimate\.tum\) and 1500000000\.000 … "
        r"1500000019\.990 s \(path\) – give the clocks' difference with offset_s \(equal starts: offset_s=1500000000\.000000\)",
    ):
        associate(shifted(truth, 0), truth)


@pytest.mark.parametrize(("factor", "word"), [(1e-3, "milliseconds"), (1e-6, "microseconds"), (1e-9, "nanoseconds")])
def test_another_unit_of_time_is_suspected(factor: float, word: str) -> None:
    truth = SmoothPath(0).sample(np.arange(0.0, 20.0, 0.5))
    small = shifted(truth, round(truth.times[0] * factor), max(factor, 1e-6))
    with pytest.raises(InputError, match=rf"differ by a factor of about 1e\+0\d: {word} against seconds\? correct the unit"):
        associate(small, truth)


def test_too_few_matches_are_refused_with_a_hint() -> None:
    path = SmoothPath(0)
    truth = path.sample(np.arange(0.0, 20.0, 0.5))
    with pytest.raises(InputError, match=r"at least 10 matched poses – got 0 of 39 .* – raise max_difference_s, use method="):
        associate(path.sample(np.arange(0.25, 19.6, 0.5)), truth)
    with pytest.raises(InputError, match=r"got 1 of 1 "):
        associate(path.sample(np.array([5.0])), truth)


def test_trajectories_without_stamps_go_by_index() -> None:
    path = SmoothPath(0).sample(np.arange(0.0, 20.0, 0.5))
    bare = Trajectory(None, path.p, path.q_wxyz)
    found = associate(bare, bare)
    assert found.method == "index"
    assert found.lines() == ["matched 40 poses by index (the files carry no time stamps)"]
    with pytest.raises(InputError, match=r"of the same length, at least 10 poses – got 40 .* and 39"):
        associate(bare, bare.select(np.arange(39)))
    with pytest.raises(InputError, match="a trajectory with time stamps"):
        associate(bare, path)


def test_settings_are_checked() -> None:
    path = SmoothPath(0).sample(np.arange(0.0, 20.0, 0.5))
    for name, value in (("max_difference_s", 0.0), ("max_difference_s", np.nan), ("max_gap_s", -1.0), ("min_matches", 0)):
        with pytest.raises(InputError, match=f"a positive {name}.* – got {value} – "):
            associate(path, path, **{name: value})
    with pytest.raises(InputError, match="a finite offset_s"):
        associate(path, path, offset_s=np.inf)


def _walked_in_circles(late_s: float, seed: int) -> tuple[Trajectory, Trajectory]:
    """A person who walks a circle of 4 m and rolls with every second step of 0.53 s, and an estimate whose stamps are late."""
    rng = np.random.default_rng(seed)

    def walked(t: np.ndarray) -> Trajectory:
        p = np.column_stack([4.0 * np.cos(0.5 * t), 4.0 * np.sin(0.5 * t), 0.03 * np.sin(2.0 * np.pi * t / 0.53)])
        R = Rotation.from_euler("ZX", np.column_stack([0.5 * t, 0.02 * np.sin(np.pi * t / 0.53)]))
        return Trajectory(np.round(1e9 * t).astype(np.int64), p, R.as_quat()[:, [3, 0, 1, 2]])

    exact = walked(np.arange(2.0, 58.0, 0.1))
    p = exact.p + 0.03 * rng.standard_normal(exact.p.shape)
    return Trajectory(exact.times + round(late_s * 1e9), p, exact.q_wxyz), walked(np.arange(0.0, 60.0, 0.02))


@pytest.mark.slow
@pytest.mark.parametrize("late_s", [0.0, 0.7])
def test_of_motion_that_repeats_itself_all_offsets_are_told(late_s: float) -> None:
    for seed in range(3):
        seen = associate(*_walked_in_circles(late_s, seed))
        found = seen.time_offset
        told = np.array([found.offset_s, *found.others_s])
        assert np.abs(told + late_s).min() < 0.01
        assert abs(found.offset_s) == np.abs(told).min()
        assert "; as the motion repeats itself, " in seen.lines()[-1]


def test_laps_that_differ_tell_a_lap_from_the_next() -> None:
    """Another lap correlates nearly as well, and within the nearer range; the places tell them apart."""
    t = np.arange(0.0, 60.0, 0.02)
    lap = 2.0 * np.pi * t / 3.6
    p = np.column_stack([2.0 * np.cos(lap), np.sin(lap), 0.1 * t])
    R = Rotation.from_rotvec(np.column_stack([0.0 * t, 0.3 * np.sin(lap), lap]))
    truth = Trajectory(
        np.round(1e9 * t).astype(np.int64), p + 0.2 * np.sin(np.outer(t, [0.7, 0.4, 0.3])), R.as_quat()[:, [3, 0, 1, 2]]
    )
    rows = np.arange(500, 2500, 5)
    for late_s in (2.6, -2.6):
        estimate = Trajectory(truth.times[rows] + round(1e9 * late_s), truth.p[rows], truth.q_wxyz[rows])
        found = associate(disturbed(estimate, 1, sigma_m=0.01, sigma_rad=0.002), truth).time_offset
        assert found.offset_s == pytest.approx(-late_s, abs=0.01) and not found.others_s


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 5])
@pytest.mark.parametrize("offset", [0.1, 0.25, 0.0])
def test_of_a_hundred_steps_that_fit_the_nearest_is_found(offset: float, seed: int) -> None:
    """Five minutes of even steps around a circle, whose peaks differ by noise only."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 300.0, 0.05)

    def walk(t: np.ndarray, noise: float) -> Trajectory:
        turn, step = 0.04 * np.pi * t, 2.0 * np.pi * t
        p = np.stack([3.0 * np.cos(turn), 3.0 * np.sin(turn), 0.04 * np.sin(step)], axis=1)
        R = so3.exp(np.stack([0.05 * np.sin(step), 0.03 * np.sin(step + 0.5), 0.0 * t], axis=1))
        R = R @ so3.exp(noise * rng.normal(size=p.shape))
        return Trajectory(time_ns, p + noise * rng.normal(size=p.shape), quaternion.from_matrix(R))

    time_ns = np.round(t * 1e9).astype(np.int64)
    found = associate(walk(t + offset, 1e-3), walk(t, 0.0)).time_offset
    assert found is not None and found.offset_s == pytest.approx(offset, abs=0.002)
    assert np.isclose(found.others_s, offset - 1.0, atol=0.01).any()


def test_an_offset_that_is_not_refined_has_a_deviation_that_holds() -> None:
    """Too few poses for stretches, and errors that swing as slowly as the motion."""
    ratios = []
    for seed in range(40):
        estimate, truth = wandering(seed, 0.5, 0.3, 0.001)
        rng = np.random.default_rng(seed)
        swing = np.sin(0.1 * np.arange(len(estimate))[:, None] * rng.uniform(0.8, 1.6, 3) + rng.uniform(0.0, 6.0, 3))
        rows = np.arange(200, 312, 4)
        p, level = estimate.p[rows] + 0.1 * swing[rows], np.tile([1.0, 0.0, 0.0, 0.0], (len(rows), 1))
        found = associate(Trajectory(estimate.times[rows], p, level), truth).time_offset
        if found is not None:
            ratios.append((found.offset_s + 0.3) / found.deviation_s)
    assert len(ratios) > 10
    assert np.quantile(np.abs(ratios), 0.9) < 3.0  # 5.4 of what white noise would leave


def test_stamps_that_are_there_twice_are_no_division_by_zero() -> None:
    truth = SmoothPath(3).sample(np.arange(0.0, 20.0, 0.1))
    twice = truth.times.copy()
    twice[-1] = twice[-2]
    pair = MotionPair(twice, truth, truth.times, truth)
    end = 1e-9 * (twice[-1] - twice[0])
    with np.errstate(all="raise", under="ignore"):
        assert np.isfinite(pair.signals["rotation"][0](np.array([end - 0.25]))).all()
