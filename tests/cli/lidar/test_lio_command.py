"""`boxplus lio` and its relatives as a user calls them."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from boxplus._extras import installation
from boxplus.cli import app
from boxplus.formats.trajectory import read_trajectory
from boxplus.runs.lidar_inertial.summary import read_summary
from boxplus.simulation import SpinningLidar, faults, simulate
from boxplus.simulation.recording_writer import write_recording
from tests.systems.lidar_inertial_agreement.small_platforms import handheld

LIDAR = SpinningLidar(azimuth_steps=200)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(simulate("walk", duration_s=3.0, lidar=LIDAR), tmp_path_factory.mktemp("bag") / "walk", "ros1")


def call(*words: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "200"})
    return result.exit_code, re.sub(r"\s+", " ", result.stdout), re.sub(r"\s+", " ", result.stderr)


@pytest.mark.slow
def test_lio_without_configuration(bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = call("lio", bag)
    assert code == 0, err
    assert "point_time_unit s ok field time spans" in out
    assert "T_imu_lidar recording ok T_imu_lidar from static transforms" in out
    assert "finished: 29 scans" in out
    assert re.search(r"per scan median \d+\.\d ms, 99th percentile \d+\.\d ms", out)
    assert re.search(r"speed \d+\.\d × real time", out)
    folder = tmp_path / "walk_boxplus"
    for name in ("report.html", "trajectory.tum", "trajectory.csv", "map.ply", "run.json"):
        assert f"walk_boxplus/{name}" in out
        assert (folder / name).is_file()
    assert {path.name for path in (folder / "plots").iterdir()} == {"trajectory.png", "status.png", "timing.png", "biases.png"}

    code, _, err = call("lio", bag)
    assert code == 2
    assert err.startswith("error: expected a new or empty output folder – got the results of an earlier run in walk_boxplus – ")

    code, out, err = call("report", folder)
    assert code == 0, err
    assert out.startswith("finished: 29 scans")


@pytest.mark.slow
def test_a_recording_whose_sensors_contradict_each_other_ends_with_exit_code_3(tmp_path: Path) -> None:
    """Trajectory and report are there all the same, and the first line says that they are not to be trusted, and why."""
    faulty = write_recording(handheld(4), tmp_path / "faulty", "ros1", faults.flip_accel())
    out = tmp_path / "out"
    code, printed, err = call("lio", faulty, "-o", out)
    assert code == 3, err
    summary = read_summary(out / "run.json")
    assert summary.state == "finished" and summary.contradiction is not None
    assert "its sign is flipped, gravity instead of specific force (negate the accelerations)" in summary.contradiction
    assert f"finished: {summary.scans} scans" in printed and f"not to be trusted: {summary.contradiction}" in printed
    assert len(read_trajectory(out / "trajectory.csv")) == summary.scans
    assert "not to be trusted" in (out / "report.html").read_text(encoding="utf-8")
    assert "out/report.html" in printed


def test_options_reach_the_run(bag: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["--no-map", "--no-report", "--threads", "1", "--set", "scan_voxel=0.5", "--duration", "2", "--min-range", "1"]
    words += ["--save-scans", "body", "--set", "scans.ending=ply"]
    code, _, err = call("lio", bag, "-o", out, "--T-imu-lidar", "xyz_rpy_deg: 0.06 -0.03 0.11 1.5 -2 25", *words)
    assert code == 0, err
    assert not (out / "map").exists()
    assert not (out / "report.html").exists()
    config = (out / "config.yaml").read_text(encoding="utf-8")
    for line in ("scan_voxel: 0.5", "threads: 1", "duration_s: 2.0", "min_range: 1.0"):
        assert line in config
    summary = read_summary(out / "run.json")
    assert summary.extrinsic.source == "given"
    assert len(list((out / "scans").glob("*.ply"))) == summary.scans
    assert summary.duration_s < 2.0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere.bag"], "error: expected a recording – got no file or folder nowhere.bag – check the path"),
        (
            ["BAG", "--set", "scan_voxl=1"],
            "error: expected the name of a setting – got 'scan_voxl' – did you mean odometry.scan_voxel?",
        ),
        (["BAG", "--config", "none.yaml"], "error: expected a readable configuration file – got none.yaml"),
        (["BAG", "--T-imu-lidar", "1 2 3"], "error: expected T_imu_lidar as 16 numbers row by row"),
        (["BAG", "--lidar-topic", "/nothing"], "error: expected"),
        (["BAG", "--threads", "0"], "Invalid value for"),
    ],
)
def test_bad_input_is_one_paragraph_and_exit_code_2(bag: Path, tmp_path: Path, words: list[str], message: str) -> None:
    code, _, err = call("lio", *(str(bag) if word == "BAG" else word for word in words), "-o", tmp_path / "out")
    assert code == 2
    assert message in err
    assert "Traceback" not in err
    assert not (tmp_path / "out").exists()


def test_truncated_recording_gives_a_result_and_a_warning(bag: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.bag"
    cut.write_bytes(bag.read_bytes()[: bag.stat().st_size * 2 // 3])
    code, out, err = call("lio", cut, "-o", tmp_path / "out", "--no-report")
    assert code == 0, err
    assert "warning:" in out
    assert 10 < read_summary(tmp_path / "out" / "run.json").scans < 29


def test_unwritable_output_has_exit_code_1(bag: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    code, _, err = call("lio", bag, "-o", tmp_path / "file" / "out")
    assert code == 1
    assert "error: expected to write" in err


def test_view_without_the_extra(bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    code, _, err = call("lio", bag, "-o", tmp_path / "out", "--view", "window")
    assert code == 2
    text = f"error: expected rerun-sdk, which shows a run in 3D – got it is not installed – {installation('view')}"
    assert err.strip() == text
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="SIGINT is sent differently on Windows")
def test_ctrl_c_finishes_the_files_with_exit_code_130(tmp_path: Path) -> None:
    long = write_recording(simulate("walk", duration_s=30.0, lidar=LIDAR), tmp_path / "long", "ros1")
    out = tmp_path / "out"
    code = "import boxplus.runs.lidar_inertial.odometry_run as r; r._SUMMARY_EVERY_S = 0.0; from boxplus.cli import main; main()"
    process = subprocess.Popen([sys.executable, "-c", code, "lio", str(long), "-o", str(out)], stdout=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 300.0
    while process.poll() is None and time.monotonic() < deadline:
        if (out / "run.json").exists() and read_summary(out / "run.json").scans >= 15:
            break
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    printed, _ = process.communicate(timeout=300.0)
    assert process.returncode == 130, printed
    assert "interrupted: finishing the files" in printed
    summary = read_summary(out / "run.json")
    assert summary.state == "interrupted"
    assert len(read_trajectory(out / "trajectory.csv")) == summary.scans >= 15
    assert (out / "map.ply").is_file()
    assert '<span class="state interrupted">' in (out / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="SIGTERM ends a process at once on Windows")
def test_a_signal_before_the_first_scan_leaves_a_word(bag: Path, tmp_path: Path) -> None:
    """It comes while the extrinsic is looked for, which takes seconds; the process used to end without a trace."""
    code = """
import os, signal, boxplus.runs.lidar_inertial.extrinsic as module
choose = module.choose_extrinsic
def interrupted(*arguments, **options):
    os.kill(os.getpid(), signal.SIGTERM)
    return choose(*arguments, **options)
module.choose_extrinsic = interrupted
from boxplus.cli import main
main()
"""
    out = tmp_path / "out"
    done = subprocess.run(
        [sys.executable, "-c", code, "lio", str(bag), "-o", str(out)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 130, done.stderr
    summary = read_summary(out / "run.json")
    assert (summary.state, summary.scans) == ("interrupted", 0)
    code, _, err = call("lio", bag, "-o", out, "--no-report")
    assert code == 0, err


def test_report_of_another_folder(tmp_path: Path) -> None:
    code, _, err = call("report", tmp_path)
    assert code == 2
    assert "error: expected the output folder of a run, with run.json – got" in err


@pytest.mark.slow
def test_demo_ends_with_accuracy_speed_and_report(tmp_path: Path) -> None:
    code, out, err = call("demo", "-o", tmp_path, "--duration", "5")
    assert code == 0, err
    found = re.search(r"accuracy (\d+\.\d+) cm position, .* speed (\d+\.\d) ms per scan .*report (\S+report.html)", out)
    assert found is not None
    assert float(found[1]) < 3.0
    assert Path(found[3].strip()).is_file()
    assert "warning" not in out + err
    summary = read_summary(tmp_path / "walk_5s_results" / "run.json")
    assert summary.warnings == [] and summary.contradiction is None and set(summary.status) == {"ok"}
    code, out, err = call("demo", "-o", tmp_path, "--duration", "5")
    assert code == 0, err
    assert "simulated before, used again" in out


@pytest.mark.slow
def test_warmup_says_what_it_did() -> None:
    code, out, err = call("warmup")
    assert code == 0, err
    assert re.search(r"(\d+ kernels compiled|nothing to compile, all kernels were ready) in \d+\.\d s, kept in ", out)


def test_lio_of_a_lidar_alone(bag: Path, tmp_path: Path) -> None:
    code, out, err = call("lio", bag, "-o", tmp_path / "out", "--imu-topic", "none")
    assert code == 0, err
    assert "imu_topic none ok left out, as asked for: odometry of the LiDAR alone" in out
    assert "T_imu_lidar none ok no IMU takes part: poses are those of the LiDAR" in out
    assert "finished: 29 scans" in out
    code, out, err = call("lio", bag, "-o", tmp_path / "again", "--config", tmp_path / "out" / "config.yaml", "--no-report")
    assert code == 0, err
    first, second = (read_trajectory(tmp_path / name / "trajectory.csv") for name in ("out", "again"))
    assert (first.p == second.p).all()
    code, _, err = call("lio", bag, "-o", tmp_path / "no", "--imu-topic", "none", "--T-imu-lidar", "xyz_rpy_deg: 0 0 0 0 0 90")
    assert code == 2 and "settings of a LiDAR alone – got T_imu_lidar" in err
