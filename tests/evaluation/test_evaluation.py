"""ATE, RPE and the report: invariances, known errors, reference numbers, and the field's own tool as an oracle."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from boxplus.errors import InputError
from boxplus.evaluation.evaluation import evaluate
from boxplus.evaluation.plots import write_plots
from boxplus.evaluation.rpe import pairs_by_distance, pairs_by_time, relative_errors
from boxplus.formats.trajectory import Trajectory, read_trajectory, write_kitti, write_tum
from tests.evaluation.smooth_paths import SmoothPath, disturbed, moved

T = np.arange(0.0, 28.0, 0.1)


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
    result = evaluate(estimate, truth, alignment="none", rpe_distance_m=None, rpe_time_s=None)
    np.testing.assert_allclose(result.translation_error_m, 0.5)
    np.testing.assert_allclose(result.rotation_error_deg, 1.5)
    assert (result.ate.rmse, result.ate.std) == (pytest.approx(0.5), pytest.approx(0.0, abs=1e-12))
    assert result.relative == ()


@given(seed=st.integers(0, 1000), delta=st.floats(0.05, 8.0))
@settings(max_examples=50, deadline=None)
def test_pairs_by_distance_against_their_definition(seed: int, delta: float) -> None:
    p = np.cumsum(np.random.default_rng(seed).normal(size=(30, 3)), axis=0)
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    first = {i: next((j for j in range(i, 30) if path[j] - path[i] >= delta), None) for i in range(30)}
    every = [(i, j) for i, j in first.items() if j is not None]
    chain, at = [], 0
    while first[at] is not None:
        chain.append((at, first[at]))
        at = first[at]
    assert [tuple(pair) for pair in pairs_by_distance(p, delta, "all").tolist()] == every
    assert [tuple(pair) for pair in pairs_by_distance(p, delta).tolist()] == chain


def test_pairs_by_time_pass_over_gaps() -> None:
    t = np.concatenate([np.arange(0, 50), np.arange(80, 130)]) * 100_000_000  # 10 Hz, 3 s missing
    for mode in ("all", "consecutive"):
        pairs = pairs_by_time(t, 1.0, mode)
        np.testing.assert_array_equal(t[pairs[:, 1]] - t[pairs[:, 0]], 1_000_000_000)
    assert len(pairs_by_time(t, 1.0, "all")) == 80
    assert pairs_by_time(t, 1.0).tolist() == [[0, 10], [10, 20], [20, 30], [30, 40], [50, 60], [60, 70], [70, 80], [80, 90]]
    assert len(pairs_by_time(t, 60.0)) == 0


def test_relative_errors_refuse_what_they_cannot_compute() -> None:
    path = SmoothPath(0).sample(T)
    with pytest.raises(InputError, match="one positive distance_m or time_s"):
        relative_errors(path, path)
    with pytest.raises(InputError, match="one positive distance_m or time_s"):
        relative_errors(path, path, distance_m=-1.0)
    with pytest.raises(InputError, match=r"poses 100 s apart – got a matched trajectory of 27\.900 s – use a smaller delta"):
        relative_errors(path, path, time_s=100.0)


def test_doubts_are_said() -> None:
    truth = SmoothPath(4).sample(np.arange(0.0, 30.0, 0.01))
    sparse = SmoothPath(4).sample(np.arange(2.0, 12.0, 0.1))
    late = Trajectory(sparse.times - 150_000_000, sparse.p, sparse.q_wxyz)
    result = evaluate(late, truth, rpe_distance_m=1e6)
    text = "\n".join(result.warnings)
    assert re.search(r"the estimate covers 33 % of the ground truth's time", text)
    assert re.search(r"the clocks may differ by \+0\.1[45]\d s .*; try --offset 0\.1[45]", text)
    assert "no relative error by distance: expected poses 1e+06 m apart" in text
    assert all(warning in result.summary() for warning in result.warnings)


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
            assert result.relative[0].delta == 10.0
    assert any("no relative error by time" in warning for warning in result.warnings)


def test_freiburg_reference_numbers(shared_data: Path) -> None:
    folder = shared_data / "trajectories"
    truth = read_trajectory(folder / "freiburg1_xyz-groundtruth.txt")
    estimate = read_trajectory(folder / "freiburg1_xyz-rgbdslam.txt")
    for alignment, rmse in {"none": "0.020078", "se3": "0.013473", "sim3": "0.013394"}.items():
        result = evaluate(estimate, truth, alignment=alignment, max_difference_s=0.02)
        assert f"{result.ate.rmse:.6f}" == rmse
        assert len(result.association) == 786


def tool(name: str, *arguments: str) -> dict[str, float]:
    """Figures that the field's own tool prints for the same files."""
    program = shutil.which(name)
    if program is None:
        pytest.skip(f"{name} (pip install evo) is not on the path")
    text = subprocess.run([program, *arguments], check=True, capture_output=True, text=True).stdout
    return {key: float(value) for key, value in re.findall(r"(rmse|mean|median|max|min|std)\s+([\d.]+)", text)}


@pytest.mark.parametrize("seed", range(2))
def test_against_the_field_s_tool(tmp_path: Path, seed: int) -> None:
    path = SmoothPath(seed)
    truth = path.sample(np.arange(0.0, 28.0, 0.01))
    jitter = np.random.default_rng(seed).uniform(-0.003, 0.003, len(T))
    estimate = moved(disturbed(path.sample(T[5:] + jitter[5:]), seed), Rotation.random(rng=seed), np.array([1.0, 2.0, 3.0]), 1.1)
    files = [str(tmp_path / "truth.tum"), str(tmp_path / "estimate.tum")]
    write_tum(files[0], truth)
    write_tum(files[1], estimate)
    for flags, alignment in (([], "none"), (["-a"], "se3"), (["-as"], "sim3")):
        theirs = tool("evo_ape", "tum", *files, "--t_max_diff", "0.02", *flags)
        ours = evaluate(estimate, truth, alignment=alignment, rpe_distance_m=3.0, rpe_time_s=None)
        for figure, value in theirs.items():
            assert getattr(ours.ate, figure) == pytest.approx(value, abs=2e-6), (alignment, figure)
        for relation, name in (("trans_part", "translation"), ("angle_deg", "rotation")):
            theirs = tool("evo_rpe", "tum", *files, "--t_max_diff", "0.02", "-d", "3", "-u", "m", "-r", relation, *flags)
            for figure, value in theirs.items():
                assert getattr(getattr(ours.relative[0], name), figure) == pytest.approx(value, abs=2e-5), (alignment, figure)


def test_kitti_against_the_field_s_tool(tmp_path: Path) -> None:
    truth = SmoothPath(7).sample(T)
    estimate = disturbed(truth, 7)
    files = [str(tmp_path / "truth.txt"), str(tmp_path / "estimate.txt")]
    write_kitti(files[0], truth)
    write_kitti(files[1], estimate)
    theirs = tool("evo_ape", "kitti", *files, "-a")
    ours = evaluate(read_trajectory(files[1]), read_trajectory(files[0])).ate
    assert {figure: pytest.approx(value, abs=2e-6) for figure, value in theirs.items()} == {
        figure: getattr(ours, figure) for figure in theirs
    }
