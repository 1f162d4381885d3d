"""ATE, RPE and the report: invariances, known errors, doubts and reference numbers."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from boxplus.errors import InputError
from boxplus.evaluation.evaluation import evaluate
from boxplus.evaluation.plots import write_plots
from boxplus.evaluation.rpe import Delta
from boxplus.formats.trajectory import Trajectory, read_trajectory
from tests.evaluation.smooth_paths import SmoothPath, disturbed, moved

T = np.arange(0.0, 28.0, 0.1)


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 1000))
def test_errors_do_not_depend_on_the_frames(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = SmoothPath(seed).sample(T)
    estimate = disturbed(truth, seed)
    plain = evaluate(estimate, truth)
    R, p = Rotation.random(rng=rng), 100 * rng.normal(size=3)
    other = evaluate(moved(estimate, R, p), truth)
    np.testing.assert_allclose(other.translation_error_m, plain.translation_error_m, atol=1e-9)
    np.testing.assert_allclose(other.rotation_error_deg, plain.rotation_error_deg, atol=1e-6)
    for a, b in zip(other.relative, plain.relative, strict=True):
        np.testing.assert_allclose(a.translation_m, b.translation_m, atol=1e-9)
        np.testing.assert_allclose(a.rotation_deg, b.rotation_deg, atol=1e-6)
    scaled = evaluate(moved(estimate, R, p, 3.0), truth, alignment="sim3")
    assert scaled.alignment.scale == pytest.approx(1 / 3, rel=0.01)
    assert scaled.ate.rmse <= plain.ate.rmse + 1e-9


def test_a_perfect_estimate_has_no_error_and_no_warning() -> None:
    truth = SmoothPath(1).sample(T)
    result = evaluate(truth, truth)
    assert result.ate.max < 1e-9
    assert result.ate_rotation.max < 1e-5
    assert all(errors.translation.max < 1e-9 for errors in result.relative)
    assert result.warnings == ()


def test_known_errors_without_alignment() -> None:
    truth = SmoothPath(1).sample(T)
    turned = (Rotation.from_quat(truth.q_wxyz[:, [1, 2, 3, 0]]) * Rotation.from_rotvec([0.0, np.radians(1.5), 0.0])).as_quat()
    estimate = Trajectory(truth.time_ns, truth.p + np.array([0.3, 0.0, 0.4]), turned[:, [3, 0, 1, 2]])
    result = evaluate(estimate, truth, alignment="none", deltas=())
    np.testing.assert_allclose(result.translation_error_m, 0.5)
    np.testing.assert_allclose(result.rotation_error_deg, 1.5)
    assert (result.ate.rmse, result.ate.std) == (pytest.approx(0.5), pytest.approx(0.0, abs=1e-12))
    assert result.relative == ()


def test_files_that_mean_something_else_are_told() -> None:
    truth = SmoothPath(3).sample(T)
    estimate = moved(disturbed(truth, 3), Rotation.random(rng=np.random.default_rng(3)), np.array([5.0, 1.0, 2.0]))

    def told(one: Trajectory, other: Trajectory) -> str:
        return "; ".join(evaluate(one, other).warnings)

    def swapped(poses: Trajectory) -> Trajectory:
        return Trajectory(poses.time_ns, poses.p, poses.q_wxyz[:, [3, 0, 1, 2]])

    assert "quaternions of the estimate are taken for qw" in told(swapped(estimate), truth)
    assert "quaternions of the ground truth are taken for qw" in told(estimate, swapped(truth))
    assert "quaternions of both files are taken for qw" in told(swapped(estimate), swapped(truth))
    turned = Rotation.from_rotvec([0.0, 0.0, 0.05] * np.sin(np.arange(len(truth)))[:, None]) * Rotation.from_rotvec(
        [0.3, 1.0, 0.2]
    )
    little = Trajectory(truth.time_ns, truth.p, turned.as_quat()[:, [3, 0, 1, 2]])
    assert "quaternions of the estimate are taken for qw" in told(swapped(little), little)
    assert "body frames are not the same" not in told(swapped(little), little)
    still = Trajectory(estimate.time_ns, estimate.p, np.tile(estimate.q_wxyz[0], (len(estimate), 1)))
    assert "never change" in told(still, truth)
    R = Rotation.from_quat(estimate.q_wxyz[:, [1, 2, 3, 0]]).inv()
    inverted = Trajectory(estimate.time_ns, -R.apply(estimate.p), R.as_quat()[:, [3, 0, 1, 2]])
    assert told(inverted, truth).count("seem to be those of the world in the body") == 1
    smaller = Trajectory(estimate.time_ns, 0.8 * estimate.p, estimate.q_wxyz)
    assert "1.25 times as large" in told(smaller, truth)
    plain = told(estimate, truth)
    assert not any(word in plain for word in ("quaternions", "never", "inverted", "as large", "scatter by"))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("alignment", ["none", "origin", "yaw", "se3", "sim3"])
def test_a_wrong_scale_is_told_however_the_frames_are_aligned(alignment: str, seed: int) -> None:
    truth = SmoothPath(seed).sample(T)
    estimate = disturbed(truth, seed)
    larger = Trajectory(estimate.time_ns, 1.5 * estimate.p, estimate.q_wxyz)
    told = {name: "; ".join(evaluate(one, truth, alignment=alignment).warnings) for name, one in (("", estimate), ("x", larger))}
    assert "as large" not in told[""]
    assert ("0.66" in told["x"] and "times as large" in told["x"]) == (alignment != "sim3")


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("file", ["estimate", "ground truth"])
def test_of_two_files_the_one_that_is_inverted_is_named_or_none(file: str, seed: int) -> None:
    """Where the poses are inverted of one file, inverting the other helps as well."""
    rng = np.random.default_rng(seed)
    truth = SmoothPath(seed).sample(T)
    drifted = Trajectory(truth.time_ns, truth.p + 0.02 * np.cumsum(rng.normal(size=truth.p.shape), axis=0), truth.q_wxyz)

    def inverted(poses: Trajectory) -> Trajectory:
        R = Rotation.from_quat(poses.q_wxyz[:, [1, 2, 3, 0]]).inv()
        return Trajectory(poses.time_ns, -R.apply(poses.p), R.as_quat()[:, [3, 0, 1, 2]])

    pair = (inverted(drifted), truth) if file == "estimate" else (drifted, inverted(truth))
    told = [text for text in evaluate(*pair).warnings if "world in the body" in text]
    assert len(told) == 1 and any(f"poses of {which} seem" in told[0] for which in (f"the {file}", "one of the files"))


def test_a_heading_that_the_positions_do_not_determine_is_told() -> None:
    rng = np.random.default_rng(4)
    truth = SmoothPath(4).sample(T)
    at_rest = Trajectory(truth.time_ns, 0.001 * rng.normal(size=truth.p.shape), truth.q_wxyz)
    estimate = Trajectory(truth.time_ns, 0.02 * rng.normal(size=truth.p.shape), truth.q_wxyz)
    warnings = evaluate(estimate, at_rest, alignment="yaw").warnings
    assert any("heading of the alignment is mostly noise" in warning for warning in warnings)
    assert not any("body frames" in warning for warning in warnings)


def test_doubts_are_said() -> None:
    truth = SmoothPath(4).sample(np.arange(0.0, 30.0, 0.01))
    sparse = SmoothPath(4).sample(np.arange(2.0, 12.0, 0.1))
    late = Trajectory(sparse.times - 150_000_000, sparse.p, sparse.q_wxyz)
    result = evaluate(late, truth, deltas=[Delta(1e6, "m"), Delta(1.0, "s")])
    text = "\n".join(result.warnings)
    assert re.search(r"the estimate covers 33 % of the ground truth's time", text)
    assert re.search(
        r"fit best with \+0\.1(49|50)\d* ± 0\.00\d+ s added .*: with --offset 0\.1[45]\d the ATE is \S+ m instead of 0\.\S* m",
        text,
    )
    assert "no relative error over 1e+06 m: expected poses 1e+06 m apart" in text
    assert all(warning in result.summary() for warning in result.warnings)


@pytest.mark.slow
def test_an_offset_is_advised_only_where_the_error_gets_smaller_with_it() -> None:
    advised, withheld = 0, 0
    for seed in range(7):
        path = SmoothPath(seed)
        truth = path.sample(np.arange(0.0, 30.0, 0.01))
        sampled = disturbed(path.sample(np.arange(2.0, 28.0, 0.1)), seed, sigma_m=0.3)
        estimate = Trajectory(sampled.times - 40_000_000, sampled.p, sampled.q_wxyz)
        result = evaluate(estimate, truth, deltas=())
        found = result.association.time_offset
        if found is None or abs(found.offset_s) <= 0.02:
            continue
        (warning,) = (text for text in result.warnings if "the motions fit best" in text)
        other = evaluate(estimate, truth, deltas=(), offset_s=found.offset_s).ate.rmse
        assert ("no offset is advised" in warning) == (other >= 0.99 * result.ate.rmse)
        assert f"{result.ate.rmse:.4g} m" in warning
        told = re.search(r"the ATE is (?:no better with that \()?(\S+) m", warning)
        assert told is not None and float(told[1]) <= float(f"{other:.4g}")
        withheld += "no offset is advised" in warning
        advised += "with --offset" in warning
    assert advised and withheld


def _wandering(seed: int, turning: float) -> tuple[Trajectory, Trajectory]:
    """Ground truth over 120 s at 20 Hz, which turns little, and an estimate with noise that drifts."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 120.0, 0.05)
    waves = [
        sum(rng.normal() * np.sin(2.0 * np.pi * f * t + a) for f, a in rng.uniform((0.006, 0.0), (0.02, 6.0), (6, 2)))
        for _ in "xyz"
    ]
    p = np.column_stack(waves) * (6.0, 6.0, 1.0)
    tilts = [
        sum(rng.normal() * np.sin(2.0 * np.pi * f * t + a) for f, a in rng.uniform((0.06, 0.0), (0.2, 6.0), (6, 2)))
        for _ in "xyz"
    ]
    R = Rotation.from_rotvec(turning * np.column_stack(tilts))
    time_ns = 1_500_000_000_000_000_000 + np.round(t * 1e9).astype(np.int64)
    truth = Trajectory(time_ns, p, R.as_quat()[:, [3, 0, 1, 2]])
    drifting = Trajectory(time_ns, p + np.cumsum(rng.normal(scale=0.004, size=p.shape), axis=0), truth.q_wxyz)
    return truth, disturbed(drifting, seed, sigma_m=0.02, sigma_rad=0.003)


def _of(trajectory: Trajectory, rows: slice) -> Trajectory:
    return Trajectory(trajectory.time_ns[rows], trajectory.p[rows], trajectory.q_wxyz[rows])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_clocks_that_agree_are_not_doubted(seed: int) -> None:
    truth, estimate = _wandering(seed, turning=0.03)
    halves = _of(truth, slice(None, 1600)), _of(estimate, slice(800, None))
    for one, other in (halves, (truth, _of(estimate, slice(None, None, 10))), (_of(truth, slice(None, None, 20)), estimate)):
        result = evaluate(other, one, deltas=())
        assert not any("the motions fit best" in warning or "were matched" in warning for warning in result.warnings)
        found = result.association.time_offset
        assert found is None or found.deviation_s > 0.0
    truth, estimate = _wandering(seed, turning=0.3)
    late = Trajectory(estimate.time_ns + 300_000_000, estimate.p, estimate.q_wxyz)
    told = " ".join(evaluate(late, truth, deltas=()).warnings)
    assert re.search(r"with --offset -0\.(299|30\d) the ATE", told)


def test_ground_truth_with_a_gap_matches_only_some() -> None:
    truth, estimate = _wandering(1, turning=0.03)
    rows = np.r_[0:800:20, 1600:2400:20]
    result = evaluate(estimate, Trajectory(truth.time_ns[rows], truth.p[rows], truth.q_wxyz[rows]), deltas=())
    assert any("were matched" in warning for warning in result.warnings)


def test_a_rotation_that_the_alignment_leaves_open_is_no_other_body_frame() -> None:
    told = 0
    for seed in range(10):
        truth, estimate = _wandering(seed, turning=0.03)
        short = evaluate(_of(estimate, slice(1000, 1160)), _of(truth, slice(1000, 1160)), deltas=())
        told += np.degrees(np.linalg.norm(Rotation.from_matrix(short.alignment.R_world_estimate).as_rotvec())) > 2.0
        assert not any("body frames" in warning for warning in short.warnings)
    assert told  # without the limit such a rotation would be named


def test_another_body_frame_is_noticed() -> None:
    truth = SmoothPath(4).sample(T)
    turned = (Rotation.from_quat(truth.q_wxyz[:, [1, 2, 3, 0]]) * Rotation.from_euler("z", 90, degrees=True)).as_quat()
    result = evaluate(Trajectory(truth.time_ns, truth.p, turned[:, [3, 0, 1, 2]]), truth)
    assert any(warning.startswith("the orientations differ by a constant 90.0°") for warning in result.warnings)


def test_nearly_straight_path_is_doubted() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 20.0, 0.1)
    p = np.stack([10.0 * t, 0.3 * np.sin(t), np.zeros_like(t)], axis=1)
    truth = Trajectory(np.round(t * 1e9).astype(np.int64), p, np.tile([1.0, 0, 0, 0], (len(t), 1)))
    estimate = Trajectory(truth.times, p + rng.normal(scale=0.3, size=p.shape), truth.q_wxyz)
    assert any("less than the error of" in warning for warning in evaluate(estimate, truth).warnings)


@pytest.mark.parametrize("factor", [0.001, 0.01, 100.0, 1000.0])
def test_another_unit_of_length_is_refused(factor: float) -> None:
    truth = SmoothPath(0).sample(T)
    estimate = moved(disturbed(truth, 0), Rotation.identity(), np.zeros(3), factor)
    with pytest.raises(InputError, match="positions in metres in both files"):
        evaluate(estimate, truth)
    assert evaluate(estimate, truth, alignment="sim3").alignment.scale == pytest.approx(1 / factor, rel=0.05)


def test_poor_matching_is_doubted() -> None:
    path = SmoothPath(0)
    truth = path.sample(np.arange(0.0, 28.0, 0.2))
    estimate = path.sample(np.arange(0.0, 27.9, 0.13))
    result = evaluate(estimate, truth, max_difference_s=0.02)
    assert any("poses within the ground truth's time were matched" in warning for warning in result.warnings)


def test_dictionary_holds_the_figures_of_the_text() -> None:
    truth = SmoothPath(0).sample(T)
    result = evaluate(disturbed(truth, 0), truth)
    data = json.loads(json.dumps(result.to_dict()))
    assert data["ate_translation_m"]["rmse"] == result.ate.rmse
    assert data["association"]["matches"] == len(T)
    assert f"rmse {data['rpe'][0]['translation_m']['rmse']:.6f}" in result.summary()


def test_plots_are_drawn(tmp_path: Path) -> None:
    truth = SmoothPath(0).sample(T)
    estimate = disturbed(truth, 0)
    paths = write_plots(evaluate(estimate, truth), tmp_path / "plots", estimate, truth)
    assert [path.name for path in paths] == ["trajectories.png", "errors.png", "association.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths)


def test_kitti_reference_numbers(shared_data: Path) -> None:
    folder = shared_data / "trajectories"
    truth, estimate = read_trajectory(folder / "KITTI_00_gt.txt"), read_trajectory(folder / "KITTI_00_ORB.txt")
    printed = {"none": "7.790289", "se3": "1.303450", "sim3": "0.937709"}
    for alignment, rmse in printed.items():
        result = evaluate(estimate, truth, alignment=alignment)
        assert f"{result.ate.rmse:.6f}" == rmse
        assert f"{len(result.association)} poses (by index)" in result.summary()
        if alignment == "none":
            assert f"{result.relative[0].translation.rmse:.6f}" == "0.236763"
            assert result.relative[0].delta == Delta(10.0, "m")
    assert any("no relative error over 1 s" in warning for warning in result.warnings)


def test_freiburg_reference_numbers(shared_data: Path) -> None:
    folder = shared_data / "trajectories"
    truth = read_trajectory(folder / "freiburg1_xyz-groundtruth.txt")
    estimate = read_trajectory(folder / "freiburg1_xyz-rgbdslam.txt")
    for alignment, rmse in {"none": "0.020078", "se3": "0.013473", "sim3": "0.013394"}.items():
        result = evaluate(estimate, truth, alignment=alignment, max_difference_s=0.02)
        assert f"{result.ate.rmse:.6f}" == rmse
        assert len(result.association) == 786
