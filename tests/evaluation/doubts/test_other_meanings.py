"""Files that mean something else than a comparison takes them for, and large errors that are none of the estimate's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.evaluation.evaluation import evaluate
from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import quaternion, so3

ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
FLU_FRD = np.diag([1.0, -1.0, -1.0])


def path(seed: int = 0, noise_m: float = 0.0) -> Trajectory:
    """A minute along a path that is flatter than wide and turns about every axis, with noise or without."""
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(600)
    p = np.stack([10 * np.cos(0.1 * t) + 3 * np.sin(0.23 * t), 10 * np.sin(0.13 * t) + 2 * np.cos(0.31 * t), np.sin(0.2 * t)], 1)
    yaw = 0.13 * t + np.sin(0.2 * t)
    R = so3.exp(np.stack([0.0 * t, 0.0 * t, yaw], 1)) @ so3.exp(
        np.stack([0.15 * np.cos(0.3 * t), 0.2 * np.sin(0.4 * t), 0.0 * t], 1)
    )
    R = R @ so3.exp(0.1 * noise_m * rng.standard_normal((600, 3)))
    stamps = (1_700_000_000_000_000_000 + np.round(1e9 * t)).astype(np.int64)
    return Trajectory(stamps, p + noise_m * rng.standard_normal(p.shape), quaternion.from_matrix(R))


def moved(trajectory: Trajectory, p: np.ndarray, R: np.ndarray | None = None) -> Trajectory:
    return replace(trajectory, p=p, q_wxyz=trajectory.q_wxyz if R is None else quaternion.from_matrix(np.ascontiguousarray(R)))


def told(estimate: Trajectory, **settings) -> str:
    return " // ".join(evaluate(estimate, path(), **settings).warnings)


@pytest.mark.parametrize("alignment", ["none", "origin", "yaw", "se3", "sim3"])
def test_a_sound_estimate_is_not_doubted(alignment):
    assert told(path(1, 0.03), alignment=alignment) == ""


def test_worlds_that_were_not_laid_over_each_other_are_no_other_columns():
    """A run that begins with a heading of its own was told to reorder its columns with --align none."""
    truth = path()
    tilted = np.array([[-0.388, 0.006, -0.922], [0.006, 1.0, 0.004], [0.922, -0.004, -0.388]])
    t = 0.1 * np.arange(len(truth.time_ns))[:, None]
    R = tilted @ so3.exp(0.05 * np.sin(t * [0.3, 0.5, 0.7]))
    R_world_estimate = so3.exp(np.radians([[-0.5, 0.5, -130.0]]))[0]
    truth, estimate = moved(truth, truth.p, R_world_estimate @ R), moved(truth, truth.p @ R_world_estimate, R)
    said = " // ".join(evaluate(estimate, truth, alignment="none").warnings)
    assert "reorder the columns" not in said and "body frames are not the same" not in said
    assert "the orientations differ by 130.0° in the world (scatter 0.0°): the worlds are not the same" in said


@pytest.mark.parametrize("swing", [0.0, 1.0], ids=["straight on", "as a car"])
@pytest.mark.parametrize("heading_deg", [8.0, 130.0])
def test_of_a_body_that_turns_about_one_axis_positions_tell_worlds_from_bodies(swing, heading_deg):
    """A car with a heading of its own was told that its body frame is another, with --transform-right to mend that."""
    truth = path()
    R = so3.exp(swing * np.sin(0.02 * np.arange(len(truth.time_ns)))[:, None] * [0.0, 0.0, 2.0])
    turn = so3.exp(np.radians([[0.0, 0.0, heading_deg]]))[0]
    body = moved(truth, truth.p, R)
    said = " // ".join(evaluate(moved(truth, truth.p @ turn, turn.T @ R), body, alignment="none").warnings)
    assert f"differ by {heading_deg:.1f}° in the world (scatter 0.0°): the worlds are not the same" in said
    assert "body frames are not the same" not in said and "reorder the columns" not in said
    said = " // ".join(evaluate(moved(truth, truth.p, R @ turn), body, alignment="none").warnings)
    assert "the body frames are not the same" in said and "worlds are not the same" not in said


@pytest.mark.parametrize("alignment", ["none", "yaw", "se3", "sim3"])
@pytest.mark.parametrize("change", [lambda p: p * [1, -1, 1], lambda p: p * [1, 1, -1], lambda p: p[:, [1, 0, 2]]])
def test_a_mirrored_path_is_told(change, alignment):
    estimate = path(1, 0.03)
    assert "a mirror image would fit better" in told(moved(estimate, change(estimate.p)), alignment=alignment)


def test_body_frames_half_a_turn_apart_are_told():
    estimate = path(1, 0.03)
    assert "the orientations differ by a constant 180.0" in told(moved(estimate, estimate.p, estimate.R @ FLU_FRD))


@pytest.mark.parametrize("alignment", ["none", "origin", "yaw"])
def test_north_east_down_against_east_north_up_is_told(alignment):
    estimate = path(1, 0.03)
    ned = moved(estimate, estimate.p @ ENU_NED.T, ENU_NED @ estimate.R @ FLU_FRD)
    assert "differ in axes (ENU, NED)" in told(ned, alignment=alignment)


@pytest.mark.parametrize("offset_s", [-3.0, 3.0, 9.0])
def test_clocks_seconds_apart_are_told(offset_s):
    estimate = path(1, 0.003)
    later = replace(estimate, time_ns=estimate.time_ns + int(1e9 * offset_s))
    advised = float(told(later).split("with --offset ")[1].split()[0])
    assert advised == pytest.approx(-offset_s, abs=0.01)  # a tenth of the time between poses


@pytest.mark.parametrize("alignment", ["se3", "sim3"])
def test_another_point_of_the_body_is_told(alignment):
    estimate = path(1, 0.01)
    point = np.array([0.5, 0.0, 0.3])
    result = evaluate(moved(estimate, estimate.p + estimate.R @ point), path(), alignment=alignment)
    (text,) = (text for text in result.warnings if "another point of the body" in text)
    numbers = np.array(text.split("(")[1].split(")")[0].split(","), dtype=float)
    np.testing.assert_allclose(numbers, -point, atol=0.05)


@pytest.mark.parametrize("offset_s", [-2.5, 3.0])
@pytest.mark.parametrize("seed", [1, 3, 5])
def test_a_lever_along_the_way_may_be_stamps_that_are_off(seed, offset_s):
    """Even speed on winding roads does not show where in time it is, as no motion correlates."""
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(1200)
    p = np.stack([12.0 * t, 30.0 * np.sin(t / 15.0 + rng.uniform(0.0, 6.0)), 0.0 * t], 1)
    v = np.gradient(p, 0.1, axis=0)
    R = so3.exp(np.stack([0.05 * np.sin(t), 0.05 * np.cos(0.7 * t), np.arctan2(v[:, 1], v[:, 0])], 1))
    stamps = (1_700_000_000_000_000_000 + np.round(1e9 * t)).astype(np.int64)
    truth = Trajectory(stamps, p, quaternion.from_matrix(R))
    estimate = replace(moved(truth, p + 0.02 * rng.normal(size=p.shape)), time_ns=stamps + int(1e9 * offset_s))
    for applied_s in (0.0, -0.2 * offset_s):
        warnings = evaluate(estimate, truth, offset_s=applied_s).warnings
        (text,) = (text for text in warnings if "another point of the body" in text)
        advised_s = float(text.split("stamps are off, as that lies along the way: with about --offset ")[1].rstrip(")"))
        assert advised_s == pytest.approx(-offset_s, rel=0.15)  # in all; the alignment takes the rest


def test_an_estimate_without_orientations_is_told_where_the_ground_truth_hardly_turns():
    truth = path()
    slight = moved(
        truth, truth.p, so3.exp(np.stack([np.zeros(600), np.zeros(600), 0.06 * np.sin(np.linspace(0.0, 9.0, 600))], 1))
    )
    still = moved(path(1, 0.03), path(1, 0.03).p, np.broadcast_to(np.eye(3), (600, 3, 3)))
    assert not any("never change" in text for text in evaluate(still, slight).warnings)  # by three degrees
    turns = moved(truth, truth.p, so3.exp(np.stack([np.zeros(600), np.zeros(600), 0.12 * np.sin(np.linspace(0.0, 9.0, 600))], 1)))
    assert any("orientations of the estimate never change" in text for text in evaluate(still, turns).warnings)


@pytest.mark.parametrize("row", [0, 200])
def test_one_wrong_orientation_of_the_ground_truth_says_nothing_of_a_body_that_does_not_turn(row: int) -> None:
    truth, estimate = path(), path(1, 0.03)
    still = moved(estimate, estimate.p, np.broadcast_to(np.eye(3), (600, 3, 3)))
    turned = 0.01 * np.random.default_rng(3).normal(size=(600, 3))
    turned[row] = [0.0, 0.0, 0.15]
    assert not any("never change" in text for text in evaluate(still, moved(truth, truth.p, so3.exp(turned))).warnings)


def _drive(seed: int, turned: np.ndarray) -> tuple[Trajectory, Trajectory]:
    """A minute on a nearly straight way, and an estimate in another world that drifts, of a body turned by a rotation vector."""
    rng = np.random.default_rng(seed)
    t, none = 0.1 * np.arange(600), np.zeros(600)
    yaw = 0.01 * np.sin(0.1 * t + rng.uniform(0.0, 6.0))
    p = np.cumsum(np.stack([np.cos(yaw), np.sin(yaw), 0.003 * np.cos(0.2 * t)], 1), axis=0)
    R = so3.exp(np.stack([none, none, yaw], 1)) @ so3.exp(0.01 * np.sin(np.outer(t, [1.1, 1.7, 0.0])))
    stamps = (1_700_000_000_000_000_000 + np.round(1e9 * t)).astype(np.int64)
    drift = np.cumsum(0.01 * rng.standard_normal(p.shape), axis=0)
    world, body = so3.exp(rng.normal(size=(1, 3)))[0], so3.exp(turned[None])[0]
    orientations = world @ R @ so3.exp(0.005 * rng.standard_normal(p.shape)) @ body
    estimate = Trajectory(stamps, (p + drift) @ world.T, quaternion.from_matrix(orientations))
    return estimate, Trajectory(stamps, p, quaternion.from_matrix(R))


@pytest.mark.slow
@pytest.mark.parametrize("alignment", ["se3", "sim3"])
@pytest.mark.parametrize("axis", [1, 2])
def test_another_body_frame_is_told_on_a_straight_way_about_every_axis_that_it_shows(axis, alignment):
    for seed in range(6):
        turned = np.radians(10.0) * np.eye(3)[axis]
        told = [text for text in evaluate(*_drive(seed, turned), alignment=alignment).warnings if "body frames" in text]
        assert len(told) == 1


@pytest.mark.slow
def test_no_other_body_frame_is_told_on_a_straight_way_where_there_is_none():
    wrong = 0.0
    for seed in range(20):
        result = evaluate(*_drive(seed, np.zeros(3)))
        wrong = max(wrong, float(result.rotation_error_deg.mean()))
        assert not any("body frames" in text for text in result.warnings)
    assert wrong > 2.0  # about the way, which such a path leaves open


@pytest.mark.parametrize("late_s", [0.008, 0.015])
def test_clocks_less_than_20_ms_apart_are_told_where_that_is_most_of_the_error(late_s):
    estimate = path(1, 0.001)
    fast = replace(path(), p=20.0 * path().p)
    late = replace(estimate, p=20.0 * estimate.p, time_ns=estimate.time_ns + round(1e9 * late_s))
    assert not any("motions" in text for text in evaluate(replace(late, time_ns=estimate.time_ns), fast).warnings)
    (text,) = (text for text in evaluate(late, fast, method="interpolate").warnings if "motions fit best" in text)
    assert float(text.split("with --offset ")[1].split()[0]) == pytest.approx(-late_s, abs=0.001)


def test_many_poses_take_no_square_of_memory():
    count = 60_000
    t = 0.01 * np.arange(count)
    p = np.stack([10 * np.cos(0.1 * t), 10 * np.sin(0.13 * t), np.sin(0.2 * t)], 1)
    stamps = (1_700_000_000_000_000_000 + np.round(1e9 * t)).astype(np.int64)
    R = so3.exp(np.stack([0.0 * t, 0.1 * np.sin(t), 0.1 * t], 1))
    way = Trajectory(stamps, p, quaternion.from_matrix(R))
    assert evaluate(way, way, deltas=()).warnings == ()


def corridor(seed: int, *, drift_m: float) -> Trajectory:
    """Two minutes along a corridor and back, with a turn on the spot, sways of a few degrees, and drift."""
    rng = np.random.default_rng(seed)
    t = 0.05 * np.arange(2400)
    p = np.stack([40.0 * (1.0 - np.abs(t / 60.0 - 1.0)), 0.1 * np.sin(0.5 * t), 0.0 * t], 1)
    yaw = np.pi / (1.0 + np.exp(-8.0 * (t - 60.0)))
    R = so3.exp(np.stack([0.0 * t, 0.0 * t, yaw], 1)) @ so3.exp(
        np.stack([0.05 * np.sin(1.3 * t), 0.04 * np.sin(1.1 * t), 0.0 * t], 1)
    )
    steps = rng.standard_normal((2, len(t), 3)) * [[[0.22 * drift_m]], [[0.02 * drift_m]]]
    p, R = p + np.cumsum(0.1 * steps[0], axis=0), so3.exp(np.cumsum(0.1 * steps[1], axis=0)) @ R
    stamps = (1_700_000_000_000_000_000 + np.round(1e9 * t)).astype(np.int64)
    return Trajectory(stamps, p, quaternion.from_matrix(R))


@pytest.mark.parametrize("seed", [1, 3, 5, 7, 9, 11])
@pytest.mark.parametrize("is_cut", [False, True])
def test_a_straight_way_back_and_forth_is_not_taken_for_other_columns(seed, is_cut):
    """The alignment's rotation about it is drift, and turns the bodies apart by as much one way as the other."""
    truth, estimate = corridor(seed, drift_m=0.0), corridor(seed, drift_m=0.1)
    if is_cut:
        seen = np.r_[0:600, 1600:2400]
        estimate = Trajectory(estimate.time_ns[seen], estimate.p[seen], estimate.q_wxyz[seen])
    told = " // ".join(evaluate(estimate, truth).warnings)
    assert "are taken for qw" not in told and "conjugate" not in told
    swapped = replace(estimate, q_wxyz=np.ascontiguousarray(estimate.q_wxyz[:, [3, 0, 1, 2]]))
    assert "quaternions of the estimate are taken for qw" in " // ".join(evaluate(swapped, truth).warnings)


@pytest.mark.parametrize("seed", [20, 21, 22, 23, 24])
def test_nor_for_another_convention_where_it_drifts_farther(seed):
    truth, estimate = corridor(seed, drift_m=0.0), corridor(seed, drift_m=0.3)
    seen = np.r_[0:600, 1600:2400]
    estimate = Trajectory(estimate.time_ns[seen], estimate.p[seen], estimate.q_wxyz[seen])
    told = " // ".join(evaluate(estimate, truth).warnings)
    assert "another convention" not in told and "are taken for qw" not in told and "conjugate" not in told
