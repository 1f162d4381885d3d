"""Errors that few poses make, and paths that have nothing in common."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.evaluation.evaluation import evaluate
from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import quaternion, so3
from tests.evaluation.doubts.test_other_meanings import moved, path, told

KINDS = ["none", "origin", "yaw", "se3", "sim3"]


@pytest.mark.parametrize("alignment", ["yaw", "se3", "sim3"])
def test_poses_far_off_are_counted(alignment: str) -> None:
    estimate = path(1, 0.03)
    p = estimate.p.copy()
    p[[100, 101, 350]] += [30.0, -20.0, 5.0]
    assert "3 of the 600 poses are off by more than 10 times the median error" in told(moved(estimate, p), alignment=alignment)


@pytest.mark.parametrize("share", [0.1, 0.2])
@pytest.mark.parametrize("seed", [1, 3, 5])
def test_many_poses_far_off_are_counted_as_well(share: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    estimate = path(seed, 0.03)
    p = estimate.p.copy()
    bad = rng.random(len(p)) < share
    p[bad] += rng.choice([-100.0, 100.0], (np.count_nonzero(bad), 3))
    said = told(moved(estimate, p), alignment="none")
    assert f"{np.count_nonzero(bad)} of the 600 poses are off by more than 10 times the median error" in said


@pytest.mark.parametrize("alignment", KINDS)
def test_a_jump_is_told_with_its_time(alignment: str) -> None:
    estimate = path(1, 0.02)
    p = estimate.p.copy()
    p[300:] += [3.0, 2.0, 0.0]
    assert "the estimate jumps 1 time against the ground truth, by 3.6" in told(moved(estimate, p), alignment=alignment)
    assert "at 30.00 s" in told(moved(estimate, p), alignment=alignment)


@pytest.mark.parametrize("alignment", KINDS)
def test_an_estimate_that_stops_is_told(alignment: str) -> None:
    estimate = path(1, 0.03)
    p = estimate.p.copy()
    p[400:] = p[400]
    assert "the estimate repeats one position from 40.00 s to 59.90 s" in told(moved(estimate, p), alignment=alignment)


@pytest.mark.parametrize("alignment", KINDS)
def test_a_start_that_stands_in_a_noisy_ground_truth_is_no_stop(alignment: str) -> None:
    """Fifteen seconds on the ground, then a flight through a room; the noise adds up to more than the room's tenth."""
    rng = np.random.default_rng(1)
    stamps = 10_000_000 * np.arange(7500)
    t = np.maximum(1e-9 * stamps - 15.0, 0.0)
    p = np.stack([2.0 * np.sin(0.3 * t), 1.5 * np.sin(0.43 * t), 0.5 * np.sin(0.2 * t)], 1)
    q = quaternion.from_matrix(so3.exp(np.stack([0.2 * np.sin(0.5 * t), 0.2 * np.sin(0.7 * t), 0.5 * np.sin(0.33 * t)], 1)))
    truth = Trajectory(stamps, p + 1e-3 * rng.normal(size=p.shape), q)
    drift = np.where(t[::10, None] > 0.0, rng.normal(size=(750, 3)), 0.0).cumsum(axis=0) * 2e-3
    estimate = Trajectory(stamps[::10], p[::10] + drift, q[::10])
    assert evaluate(estimate, truth, alignment=alignment).warnings == ()


@pytest.mark.parametrize("alignment", ["none", "se3"])
def test_paths_of_different_runs_are_told(alignment: str) -> None:
    rng = np.random.default_rng(5)
    other = np.cumsum(rng.normal(size=(600, 3)), axis=0)
    assert "have nothing in common" in told(moved(path(), other), alignment=alignment)


@pytest.mark.parametrize("alignment", ["none", "se3"])
def test_few_poses_of_a_different_run_are_told(alignment: str) -> None:
    """Far apart, so that the way between them looks like noise."""
    for seed in range(4):
        other = np.cumsum(np.random.default_rng(seed).normal(size=(600, 3)), axis=0)
        few = moved(path(), other).select(np.arange(0, 600, 15))
        assert "have nothing in common" in told(few, alignment=alignment)


@pytest.mark.parametrize("alignment", ["none", "origin", "se3"])
def test_inverted_poses_are_told_however_the_frames_are_aligned(alignment: str) -> None:
    estimate = path(1, 0.03)
    R = estimate.R.transpose(0, 2, 1)
    inverted = moved(estimate, -np.einsum("nij,nj->ni", R, estimate.p), R)
    assert "seem to be those of the world in the body" in told(inverted, alignment=alignment)


@pytest.mark.parametrize("alignment", ["none", "se3"])
def test_conjugate_quaternions_are_told(alignment: str) -> None:
    estimate = path(1, 0.03)
    conjugate = replace(estimate, q_wxyz=estimate.q_wxyz * [1.0, -1.0, -1.0, -1.0])
    assert "if those of one file are inverted and its positions are not: conjugate" in told(conjugate, alignment=alignment)
    assert "of the world in the body" not in told(conjugate, alignment=alignment)


@pytest.mark.parametrize("alignment", ["se3", "sim3"])
def test_of_conjugate_quaternions_it_is_told_whose(alignment: str) -> None:
    """Where the worlds differ, only those of the right file can be undone."""
    truth, sound = path(), path(1, 0.03)
    world = so3.exp(np.array([[0.3, 0.2, 1.2]]))[0]
    estimate = moved(sound, sound.p @ world.T, world @ sound.R)
    for one in ("estimate", "ground truth"):
        files = {"estimate": estimate, "ground truth": truth}
        if one == "ground truth":
            files[one] = moved(truth, truth.p @ world.T, world @ truth.R)
            files["estimate"] = sound
        files[one] = replace(files[one], q_wxyz=files[one].q_wxyz * [1.0, -1.0, -1.0, -1.0])
        said = " // ".join(evaluate(files["estimate"], files["ground truth"], alignment=alignment).warnings)
        assert f"if those of the {one} are inverted and its positions are not: conjugate" in said


def _hovering(noise_m: float) -> tuple[Trajectory, Trajectory]:
    """An estimate of a minute within millimetres and the ground truth of that."""
    rng = np.random.default_rng(1)
    whole = path()
    wander = 1e-4 * rng.normal(size=whole.p.shape).cumsum(axis=0)
    truth = moved(whole, wander + 5e-4 * rng.normal(size=wander.shape))
    return moved(whole, wander + noise_m * rng.normal(size=wander.shape)), truth


@pytest.mark.parametrize("alignment", ["none", "se3"])
def test_noise_in_hovering_is_no_other_path(alignment: str) -> None:
    for noise_m in (3e-3, 1e-2, 5e-2):
        assert "nothing in common" not in " ".join(evaluate(*_hovering(noise_m), alignment=alignment).warnings)


@pytest.mark.parametrize("alignment", KINDS)
def test_another_point_of_the_body_is_told_of_a_body_that_only_turns_about_one_axis(alignment: str) -> None:
    flat = path()
    yaw = np.linspace(0.0, 9.0, 600)
    R = so3.exp(np.stack([0.0 * yaw, 0.0 * yaw, yaw], 1))
    truth = Trajectory(flat.time_ns, flat.p, quaternion.from_matrix(R))
    noise = 0.01 * np.random.default_rng(0).standard_normal(flat.p.shape)
    estimate = replace(truth, p=flat.p + noise + R @ np.array([0.6, -0.3, 0.0]))
    warnings = evaluate(estimate, truth, alignment=alignment).warnings
    (said,) = (text for text in warnings if "another point of the body" in text)
    numbers = np.array(said.split("at (")[1].split(")")[0].split(","), dtype=float)
    np.testing.assert_allclose(numbers, [-0.6, 0.3, 0.0], atol=0.02)


@pytest.mark.parametrize("alignment", ["none", "origin"])
def test_of_straight_ways_scale_and_direction_are_told(alignment: str) -> None:
    t = 0.1 * np.arange(300)
    p = np.stack([5.0 * t + np.sin(t), 0.0 * t, 0.0 * t], 1)
    stamps = np.round(1e9 * t).astype(np.int64)
    truth = Trajectory(stamps, p, np.tile([1.0, 0.0, 0.0, 0.0], (300, 1)))
    noise = 0.01 * np.random.default_rng(0).standard_normal(p.shape)
    (said,) = (
        text for text in evaluate(replace(truth, p=p / 1.2 + noise), truth, alignment=alignment).warnings if "scale" in text
    )
    assert said.startswith("1.2 times as large the estimate has")
    turned = replace(truth, p=(p + noise) @ so3.exp(np.array([[0.0, 0.0, 0.3]]))[0].T)
    said = " ".join(evaluate(turned, truth, alignment=alignment).warnings)
    assert "both ways are straight, in directions that differ by 17.2°" in said
    assert evaluate(replace(truth, p=p + noise), truth, alignment="none").warnings == ()


def test_rounded_stamps_are_told() -> None:
    truth = replace(path(), time_ns=path().times + 12_345_678)
    fast = replace(truth, p=10.0 * truth.p)
    rows = np.arange(5, 590, 3)
    stamps = truth.time_ns[rows] + np.random.default_rng(0).integers(0, 150_000_000, len(rows))
    p = np.stack([np.interp(stamps, truth.time_ns, axis) for axis in fast.p.T], 1)
    estimate = Trajectory(stamps, p, truth.q_wxyz[rows])
    rounded = replace(estimate, time_ns=np.round(stamps * 1e-8).astype(np.int64) * 100_000_000)
    said = " ".join(evaluate(rounded, fast, method="interpolate").warnings)
    assert "all stamps of the estimate are multiples of 0.1 s" in said
    assert "multiples" not in " ".join(evaluate(estimate, fast, method="interpolate").warnings)


@pytest.mark.parametrize("seed", range(1, 8, 2))
@pytest.mark.parametrize("of", ["estimate", "ground truth"])
def test_stamps_of_whole_seconds_are_told_by_errors_along_the_way(seed: int, of: str) -> None:
    """Nearly all of their steps are 1 s, as those of a clock are; only the errors say that they were rounded."""
    rng = np.random.default_rng(seed)
    dense = path(seed)
    dense = replace(dense, p=10.0 * dense.p, time_ns=dense.times + 12_345_678)
    stamps = np.sort(dense.time_ns[0] + (1.1e9 * np.arange(1, 54) + rng.uniform(0, 1e8, 53)).astype(np.int64))
    p = np.stack([np.interp(stamps, dense.time_ns, axis) for axis in dense.p.T], 1) + 0.02 * rng.standard_normal((53, 3))
    rows = np.searchsorted(dense.time_ns, stamps)
    sparse = Trajectory(np.round(stamps * 1e-9).astype(np.int64) * 1_000_000_000, p, dense.q_wxyz[rows])
    pair = (sparse, dense) if of == "estimate" else (dense, sparse)
    said = " ".join(evaluate(*pair, max_difference_s=0.06).warnings)
    assert f"all stamps of the {of} are multiples of 1 s, and " in said and "lies along the way" in said and "0.5 s × " in said
    at = np.clip(np.searchsorted(dense.time_ns, sparse.times), 0, len(dense) - 1)
    on_clock = np.stack([np.interp(sparse.times, dense.time_ns, axis) for axis in dense.p.T], 1)
    gnss = replace(sparse, p=on_clock + 0.02 * rng.standard_normal((53, 3)), q_wxyz=dense.q_wxyz[at])
    pair = (gnss, dense) if of == "estimate" else (dense, gnss)
    assert "multiples" not in " ".join(evaluate(*pair, max_difference_s=0.06).warnings)


@pytest.mark.parametrize("seed", range(1, 8, 2))
@pytest.mark.parametrize("clock", ["ten times a second", "whole seconds of a receiver"])
def test_drift_along_a_straight_road_is_none_of_the_stamps(seed: int, clock: str) -> None:
    """It errs along the way by as much as rounding might, pose after pose alike."""
    rng, speed = np.random.default_rng(seed), 10.0
    t = np.arange(0.0, 120.0, 0.1)
    bend = 0.3 * np.sin(2.0 * np.pi * t / 50.0 + rng.uniform(0.0, 6.0))
    q = np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
    road = np.column_stack([speed * t, 2.0 * np.sin(t / 40.0), np.zeros(len(t))])
    drifted = road + np.column_stack([(1.0 if clock.startswith("ten") else 8.0) * bend, np.zeros((len(t), 2))])
    stamps = 1_700_000_000_000_000_000 + np.round(1e9 * t).astype(np.int64)
    between = Trajectory(stamps + 12_345_678, road + 0.012345678 * speed * np.array([1.0, 0.0, 0.0]), q)
    if clock.startswith("ten"):
        said = evaluate(Trajectory(stamps, drifted, q), between, method="interpolate", alignment="none").warnings
    else:
        keep = (np.arange(len(t)) % 10 == 0) & (np.arange(len(t)) != 500)  # one fix is missing
        receiver = Trajectory(stamps, road, q).select(np.flatnonzero(keep))
        odometry = replace(between, p=between.p + drifted - road)
        said = evaluate(odometry, receiver, method="interpolate", alignment="none", max_gap_s=2.5).warnings
    assert "lies along the way" not in " ".join(said)


@pytest.mark.parametrize("method", ["nearest", "interpolate"])
def test_keyframes_on_the_clock_of_the_ground_truth_have_no_rounded_stamps(method: str) -> None:
    truth, sound = (replace(one, p=10.0 * one.p) for one in (path(), path(1, 0.003)))
    rows = np.flatnonzero(np.random.default_rng(0).random(600) < 0.7)
    assert evaluate(sound.select(rows), truth, method=method).warnings == ()


@pytest.mark.slow
@pytest.mark.parametrize("alignment", KINDS)
def test_sound_estimates_have_no_incidents(alignment: str) -> None:
    for seed in range(10, 20):
        assert told(path(seed, 0.03), alignment=alignment) == ""


def test_stamps_that_jump_are_told_and_gaps_are_not() -> None:
    truth, estimate = path(), path(1, 0.003)
    late = estimate.times + np.where(np.arange(600) < 300, 0, 3600 * 10**9)
    said = " ".join(evaluate(replace(estimate, time_ns=late), truth).warnings)
    assert "the stamps of the estimate jump by 3600.1 s after pose 299 of 600" in said
    rows = np.flatnonzero((np.arange(600) < 200) | (np.arange(600) > 350))  # lost for a while
    assert "jump by" not in " ".join(evaluate(estimate.select(rows), truth).warnings)
    parked = [replace(one, time_ns=late) for one in (estimate, truth)]  # two drives, hours apart, in both files
    assert "jump by" not in " ".join(evaluate(*parked).warnings)
    assert "the stamps of the ground truth jump by" in " ".join(evaluate(truth, replace(estimate, time_ns=late)).warnings)
