"""`boxplus calibrate cameras`: files in, camchain, report and exit codes out, and what it refuses."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from boxplus.cli import app
from boxplus.errors import InputError, RecordingError
from boxplus.recordings.cameras.calibration import inverse, read_camchain
from boxplus.report.cameras.calibration_report import write_calibration_report
from boxplus.runs.camera_calibration.camchain import camchain_text
from boxplus.runs.camera_calibration.corner_file import read_corner_file, write_corner_file
from boxplus.runs.camera_calibration.inputs import read_imu, read_target
from boxplus.runs.camera_calibration.summary import CalibrationSummary, FindingFacts, as_matrix, camera_facts
from boxplus.simulation.cameras.target_session import TargetSession
from boxplus.simulation.imu import ImuModel
from boxplus.systems.camera_calibration.calibration import CameraCalibration, calibrate_cameras
from boxplus.systems.camera_calibration.config import CameraCalibrationConfig
from boxplus.systems.camera_calibration.findings import judge
from tests.systems.camera_calibration.sessions import GRID, RADTAN, SIZE, T_CAM0_CAM1, T_IMU_CAM0, session

TARGET = f"""target_type: 'aprilgrid'
tagCols: {GRID.columns}
tagRows: {GRID.rows}
tagSize: {GRID.tag_size}
tagSpacing: {GRID.spacing}
"""
PUBLISHED = ((458.654, 457.296, 367.215, 248.375), (457.587, 456.134, 379.999, 255.238))
"""fx, fy, cx, cy in the sensor.yaml of both cameras."""
NOISE = """gyroscope_noise_density: 1.7e-4
accelerometer_noise_density: 2.0e-3
gyroscope_random_walk: 1.9e-5
accelerometer_random_walk: 3.0e-3
"""


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["calibrate", "cameras", *map(str, arguments)])


def write(folder: Path, seen: TargetSession) -> list[object]:
    """The files of a session; returns the arguments that name them."""
    write_corner_file(folder / "corners.csv", seen.corners)
    (folder / "target.yaml").write_text(TARGET)
    (folder / "imu.yaml").write_text(NOISE)
    rows = np.hstack([seen.imu.gyro, seen.imu.accel]).tolist()
    table = "\n".join(f"{time}," + ",".join(map(repr, row)) for time, row in zip(seen.imu.time_ns.tolist(), rows, strict=True))
    (folder / "imu.csv").write_text(table)
    return [folder / "corners.csv", "--target", folder / "target.yaml", "--resolution", f"{SIZE[0]}x{SIZE[1]}"]


@pytest.mark.slow
def test_a_rig_with_an_imu_is_calibrated_written_read_back_and_reported(tmp_path: Path) -> None:
    seen = session(RADTAN, RADTAN, frames=60, rate_hz=5.0, time_offset_s=0.004, imu=ImuModel())
    given = [*write(tmp_path, seen), "--lens", "pinhole-radtan", "--max-views", 16]
    done = call(*given, "--imu", tmp_path / "imu.csv", "--imu-noise", tmp_path / "imu.yaml", "-o", tmp_path / "out")
    assert done.exit_code == 0, done.output
    rig = read_camchain(tmp_path / "out" / "camchain.yaml")
    assert rig.on_imu and rig.noise is not None and list(rig.cameras) == ["cam0", "cam1"]
    first, second = rig.cameras.values()
    assert first.size == SIZE and first.model is not None and first.time_offset_s == pytest.approx(0.004, abs=2e-4)
    np.testing.assert_allclose(first.model.parameters[:4], RADTAN.parameters[:4], atol=1.0)
    assert first.T_body_camera is not None and second.T_body_camera is not None
    np.testing.assert_allclose(first.T_body_camera, as_matrix(T_IMU_CAM0), atol=2e-3)
    np.testing.assert_allclose(inverse(first.T_body_camera) @ second.T_body_camera, as_matrix(T_CAM0_CAM1), atol=1e-3)
    summary = json.loads((tmp_path / "out" / "run.json").read_text())
    assert summary["state"] == "trusted" and np.array(summary["cameras"][0]["covariance"]).shape == (8, 8)
    assert summary["cameras"][1]["mounting_sigma_m"] is not None and summary["imu"]["sigma_s"] < 1e-4
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Residuals over the image" in page and "All lengths scale with the size of the target" in page
    assert "Corners left out" in page and "T_cam_imu of cam0" in page
    again = call(*given, "-o", tmp_path / "out", "--no-report")
    assert again.exit_code == 2 and "--overwrite" in again.output
    swapped = replace(seen.corners, camera_of=1 - seen.corners.camera_of)
    write_corner_file(tmp_path / "corners.csv", swapped)
    compared = call(*given, "-o", tmp_path / "swapped", "--compare", tmp_path / "out" / "camchain.yaml", "--no-report")
    assert compared.exit_code == 0 and "cam1 to cam0:" in compared.output and not (tmp_path / "swapped" / "report.html").exists()


def test_frontal_views_end_with_exit_code_1_and_no_camchain(tmp_path: Path) -> None:
    done = call(
        *write(tmp_path, session(RADTAN, tilt_deg=0.0, frames=10)), "-o", tmp_path / "out", "--lens", "pinhole-radtan", "--quiet"
    )
    assert done.exit_code == 1 and "do not determine the focal length" in " ".join(done.stderr.split())
    assert done.stdout == "" and "error: the views do not determine a lens: no camchain.yaml" in done.stderr
    assert not (tmp_path / "out" / "camchain.yaml").exists() and (tmp_path / "out" / "report.html").exists()


def test_a_doubtful_rig_ends_with_exit_code_3_and_lenses_without_mounting(tmp_path: Path) -> None:
    seen = session(RADTAN, RADTAN, late_s=(0.0, 0.02), frames=10)
    done = call(*write(tmp_path, seen), "-o", tmp_path / "out", "--lens", "pinhole-radtan", "--no-report", "--json")
    assert done.exit_code == 3 and json.loads(done.stdout)["outcome"] == "not to be trusted"
    assert json.loads(done.stdout)["run"] == json.loads((tmp_path / "out" / "run.json").read_text())
    text = (tmp_path / "out" / "camchain.yaml").read_text()
    assert "# NOT TO BE TRUSTED: the cameras together" in text and "T_cn_cnm1" not in text


@pytest.fixture(scope="module")
def rig() -> CameraCalibration:
    """Two cameras, sound."""
    return calibrate_cameras(
        session(RADTAN, RADTAN, frames=10).corners, GRID, CameraCalibrationConfig(lens="pinhole-radtan", max_views=10)
    )


def summary_of(found: CameraCalibration, left_out: list[str]) -> CalibrationSummary:
    findings = [FindingFacts.model_validate(asdict(finding)) for finding in judge(found)]
    return CalibrationSummary(
        program="boxplus calibrate cameras", versions={}, started=datetime.now(UTC), state="doubtful", input="corners.csv",
        target=GRID.describe(), lens=found.lens, sigma_by_lens={}, sigma_px=0.2, cameras=camera_facts(found), outliers=left_out,
        compared=[], findings=findings,
    )  # fmt: skip


def chain_of(found: CameraCalibration, file: Path) -> str:
    file.write_text(camchain_text(found, summary_of(found, []), None))
    assert len(read_camchain(file).cameras) == 2
    return file.read_text()


def test_mountings_that_a_finding_doubts_are_left_out(rig: CameraCalibration, tmp_path: Path) -> None:
    file = tmp_path / "camchain.yaml"
    assert "T_cn_cnm1" in chain_of(rig, file) and rig.rig is not None
    wide = rig.rig.covariance.copy()
    wide[rig.rig.mounting(1), rig.rig.mounting(1)] *= 1e6
    pair = rig.pairs[0]
    for doubted, words in (
        (replace(rig, rig=replace(rig.rig, covariance=wide)), "the mounting of cam1 is open"),
        (replace(rig, pairs=(replace(pair, late_frames=1),)), "cam1 is 1 frame behind cam0"),
        (replace(rig, pairs=(replace(pair, swapped=(3,)),)), "cam0 and cam1 are swapped"),
    ):
        text = chain_of(doubted, file)
        assert f"# NOT TO BE TRUSTED: {words}" in text and "T_cn_cnm1" not in text


def test_the_report_lists_the_worst_corners_and_counts_all(rig: CameraCalibration, tmp_path: Path) -> None:
    left_out = [f"frame 1, cam0, corner {k}: {90 - k}.00 px" for k in range(78)]
    summary = summary_of(rig, left_out).model_copy(update={"versions": {"boxplus": "0"}})
    page = write_calibration_report(tmp_path / "report.html", summary, rig).read_text()
    assert "Corners left out: 78" in page and "The worst 10; all are in run.json" in page
    assert page.count("frame 1, cam0, corner ") == 10 and left_out[9] in page and left_out[10] not in page


def test_a_comparison_that_cannot_be_read_is_refused_before_anything_is_cleared(tmp_path: Path) -> None:
    given = write(tmp_path, session(RADTAN, frames=10))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "run.json").write_text("{}")
    (tmp_path / "other.yaml").write_text("a: 1\n")
    done = call(*given, "-o", tmp_path / "out", "--overwrite", "--compare", tmp_path / "other.yaml")
    assert done.exit_code == 2 and "a Kalibr camchain" in " ".join(done.output.split())
    assert (tmp_path / "out" / "run.json").read_text() == "{}"


def test_what_of_an_imu_table_is_not_used_is_counted(tmp_path: Path) -> None:
    write(tmp_path, session(RADTAN, frames=10))
    lines = (tmp_path / "imu.csv").read_text().splitlines()
    plain = read_imu(tmp_path / "imu.csv", tmp_path / "imu.yaml")
    assert plain.left_out == () and any(note.startswith("rad/s: ") for note in plain.notes)
    lines[5:7] = [lines[6], lines[5]]
    (tmp_path / "imu.csv").write_text("\n".join([*lines[:20], lines[19], "lost", *lines[20:]]))
    found = read_imu(tmp_path / "imu.csv", tmp_path / "imu.yaml")
    np.testing.assert_array_equal(found.samples.time_ns, plain.samples.time_ns)
    np.testing.assert_array_equal(found.samples.gyro, plain.samples.gyro)
    assert [text.split(" of imu.csv ")[0] for text in found.left_out] == ["1 lines", "1 samples", "1 samples"]


@pytest.mark.slow
def test_the_corners_of_euroc_give_the_published_rig(shared_data: Path, tmp_path: Path) -> None:
    corners = shared_data / "cameras" / "euroc_april_calib" / "detected_corners.json"
    (tmp_path / "target.yaml").write_text("target_type: aprilgrid\ntagCols: 6\ntagRows: 6\ntagSize: 0.088\ntagSpacing: 0.3\n")
    given = [corners, "--target", tmp_path / "target.yaml", "--resolution", "752x480", "--max-views", 14, "--no-report"]
    done = call(*given, "-o", tmp_path / "out", "--lens", "pinhole-radtan")
    assert done.exit_code == 0
    summary = json.loads((tmp_path / "out" / "run.json").read_text())
    for facts, published in zip(
        summary["cameras"], ((458.654, 457.296, 367.215, 248.375), (457.587, 456.134, 379.999, 255.238)), strict=True
    ):
        found = list(facts["parameters"].values())[:4]
        np.testing.assert_allclose(found, published, atol=2.0)  # another session of the same cameras
        assert facts["rms_px"] < 0.25
    T = np.array(summary["cameras"][1]["T_cn_cnm1"])
    assert np.linalg.norm(T[:3, 3]) == pytest.approx(0.11008, abs=3e-4)
    codes = {finding["code"] for finding in summary["findings"]}
    assert "lens_pattern" in codes  # four coefficients do not quite describe these lenses
    assert summary["sigma_by_lens"]["pinhole-equi"] < 0.8 * summary["sigma_by_lens"]["pinhole-radtan"]


def test_corner_files_of_both_forms_are_the_same(tmp_path: Path) -> None:
    corners = session(RADTAN, frames=3).corners
    write_corner_file(tmp_path / "corners.csv", corners)
    images = []
    for frame, name in enumerate(corners.names):
        rows = corners.frame_of == frame
        seen = [{"value0": u, "value1": v} for u, v in corners.pixels[rows].tolist()]
        value = {"value0": seen, "value1": corners.corner_of[rows].tolist()}
        images.append({"key": {"first": int(name), "second": 0}, "value": value})
    (tmp_path / "corners.json").write_text(json.dumps({"value0": images}))
    for name in ("corners.csv", "corners.json"):
        read = read_corner_file(tmp_path / name, SIZE)
        np.testing.assert_array_equal(read.pixels, corners.pixels)
        np.testing.assert_array_equal(read.time_ns, corners.time_ns)
        np.testing.assert_array_equal(read.corner_of, corners.corner_of)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "nothing in corners.csv"),
        ("time,u,v\n", "a first line time_ns,camera,corner,u,v"),
        ("time_ns,camera,corner,u,v\n", "none in corners.csv"),
        ("time_ns,camera,corner,u,v\n1700000000,0,0,1,1\n", "multiply seconds by 1e9"),
        ("frame,camera,corner,u,v\n0,0,0,1\n", "line 2"),
        ("frame,camera,corner,u,v\n0,1,0,1,1\n", "cameras numbered from 0"),
        ("frame,camera,corner,u,v\n0,0,0,1,1\n0,0,0,2,2\n", "at most once in an image"),
        ("frame,camera,corner,u,v\n0,0,0,800,1\n", "outside"),
        ('{"value0": [{"key": 3}]}', "corners as Basalt writes them"),
    ],
)
def test_corner_files_of_another_form_are_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "corners.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        read_corner_file(tmp_path / "corners.csv", SIZE)


def test_other_targets_and_noise_that_is_missing_are_refused(tmp_path: Path) -> None:
    (tmp_path / "target.yaml").write_text("target_type: checkerboard\n")
    with pytest.raises(InputError, match=r"'checkerboard' in target\.yaml"):
        read_target(tmp_path / "target.yaml")
    (tmp_path / "target.yaml").write_text("target_type: aprilgrid\ntagRows: 6\n")
    with pytest.raises(InputError, match=r"tagRows, tagCols, tagSize \[m\] and tagSpacing"):
        read_target(tmp_path / "target.yaml")
    for size in ("88", "0.0022"):  # in millimetres; in no unit at all
        (tmp_path / "target.yaml").write_text(
            f"target_type: aprilgrid\ntagRows: 6\ntagCols: 6\ntagSize: {size}\ntagSpacing: 0.3\n"
        )
        with pytest.raises(InputError, match=r"tagSize from 0\.004 to 2 m"):
            read_target(tmp_path / "target.yaml")
    (tmp_path / "imu.csv").write_text("".join(f"{k * 5_000_000 + 10**18},0,0,0,0,0,9.81\n" for k in range(10)))
    (tmp_path / "imu.yaml").write_text("update_rate: 200\n")
    with pytest.raises(RecordingError, match="accelerometer_random_walk"):
        read_imu(tmp_path / "imu.csv", tmp_path / "imu.yaml")
    refused = call(tmp_path / "no.csv", "--target", tmp_path / "target.yaml", "--resolution", "752")
    assert refused.exit_code == 2 and "such as 752x480" in refused.output
