"""Trajectories moved into other frames and laid into planes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from boxplus.errors import InputError
from boxplus.evaluation.evaluation import evaluate
from boxplus.evaluation.frames import projected, transformed
from boxplus.formats.trajectory import Trajectory
from boxplus.runs.transform import parse_transform
from tests.evaluation.smooth_paths import SmoothPath, disturbed, moved

T = np.arange(0.0, 20.0, 0.1)


def rigid(rng: np.random.Generator) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    return matrix


@given(seed=st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_poses_are_multiplied_from_both_sides(seed: int) -> None:
    rng = np.random.default_rng(seed)
    path, left, right = SmoothPath(seed % 5).sample(T[::20]), rigid(rng), rigid(rng)
    poses = np.tile(np.eye(4), (len(path), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = path.R, path.p
    found = transformed(path, left=left, right=right)
    expected = left @ poses @ right
    np.testing.assert_allclose(found.R, expected[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(found.p, expected[:, :3, 3], atol=1e-12)
    assert transformed(path) is path


def test_ground_truth_of_another_body_gives_the_errors_of_the_same_body() -> None:
    rng = np.random.default_rng(2)
    truth = SmoothPath(1).sample(T)
    estimate = disturbed(truth, 1)
    T_truth_body = rigid(rng)
    marker = transformed(truth, right=np.linalg.inv(T_truth_body))  # where the marker of the tracking system was
    plain, given_frame = evaluate(estimate, truth), evaluate(estimate, transformed(marker, right=T_truth_body))
    assert evaluate(estimate, marker).ate.rmse > 3 * plain.ate.rmse
    np.testing.assert_allclose(given_frame.translation_error_m, plain.translation_error_m, atol=1e-9)
    np.testing.assert_allclose(given_frame.rotation_error_deg, plain.rotation_error_deg, atol=1e-6)


def test_the_rotation_that_a_warning_proposes_explains_the_difference() -> None:
    truth = SmoothPath(1).sample(T)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.3, -1.0, 0.6]).as_matrix()
    estimate = transformed(disturbed(truth, 1), right=turn)
    (warning,) = (text for text in evaluate(estimate, truth).warnings if "--transform-right" in text)
    found = evaluate(
        estimate, transformed(truth, right=parse_transform(warning.partition("--transform-right '")[2].removesuffix("'")))
    )
    assert found.ate_rotation.rmse < 2.0
    assert not found.warnings


@pytest.mark.parametrize("plane", ["xy", "xz", "yz"])
def test_motion_in_a_plane_is_left_alone_and_other_motion_taken_out(plane: str) -> None:
    axis = {"xy": 2, "xz": 1, "yz": 0}[plane]
    angles = np.linspace(-3.0, 3.0, len(T))
    p, turns = np.random.default_rng(0).normal(size=(len(T), 3)), np.zeros((len(T), 3))
    p[:, axis], turns[:, axis] = 0.0, angles
    time_ns = np.round(T * 1e9).astype(np.int64)
    flat = Trajectory(time_ns, p, Rotation.from_rotvec(turns).as_quat()[:, [3, 0, 1, 2]])
    found = projected(flat, plane)
    np.testing.assert_allclose(found.R, flat.R, atol=1e-12)
    np.testing.assert_array_equal(found.p, flat.p)
    lifted = Trajectory(time_ns, p + 5.0 * np.eye(3)[axis], flat.q_wxyz)
    np.testing.assert_array_equal(projected(lifted, plane).p, flat.p)
    assert projected(lifted, None) is lifted


def test_errors_out_of_the_plane_do_not_count_in_it() -> None:
    truth = SmoothPath(1).sample(T)
    estimate = Trajectory(truth.time_ns, truth.p + np.stack([0 * T, 0 * T, np.sin(T)], axis=1), truth.q_wxyz)
    assert evaluate(estimate, truth, alignment="none").ate.rmse > 0.5
    result = evaluate(estimate, truth, alignment="none", plane="xy")
    assert result.ate.max < 1e-12
    assert "no alignment, in the xy plane" in result.title
    assert result.to_dict()["plane"] == "xy"


def test_alignment_by_the_first_poses_and_by_the_first_pose() -> None:
    truth = SmoothPath(1).sample(T)
    drifting = Trajectory(truth.time_ns, truth.p + np.maximum(T - 10.0, 0.0)[:, None] * [0.1, 0.0, 0.0], truth.q_wxyz)
    turned = moved(drifting, Rotation.from_rotvec([0.1, 0.2, 2.0]), np.array([3.0, 2.0, 1.0]))
    for options in ({"align_by_first": 90}, {"alignment": "origin"}):
        result = evaluate(turned, truth, **options)
        assert result.translation_error_m[:90].max() < 1e-9
        assert result.translation_error_m[-1] == pytest.approx(0.1 * (T[-1] - 10.0))
        np.testing.assert_allclose(result.brought(turned).p, drifting.p, atol=1e-9)
    assert "by the first 90 poses" in evaluate(turned, truth, align_by_first=90).summary()
    with pytest.raises(InputError, match="3 to 200 matched poses to align by – got 2"):
        evaluate(turned, truth, align_by_first=2)
