"""The command line as a whole: help, version, and what it imports."""

from __future__ import annotations

import gc
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

import boxplus
from boxplus.cli import _COMMANDS, app, uncollected
from boxplus.recordings import RecordingOptions
from boxplus.simulation import SpinningLidar, simulate
from boxplus.simulation.recording_writer import write_recording


def test_help_lists_every_command() -> None:
    result = CliRunner().invoke(app, ["--help"])
    assert result.exit_code == 0
    for name in _COMMANDS:
        assert f" {name} " in result.stdout


@pytest.mark.parametrize("name", list(_COMMANDS))
def test_every_command_has_help_of_its_own(name: str) -> None:
    result = CliRunner().invoke(app, [name, "--help"], env={"COLUMNS": "120"})
    assert result.exit_code == 0, result.output
    assert f" {name} " in result.stdout


def test_help_keeps_what_stands_in_brackets() -> None:
    result = CliRunner().invoke(app, ["lio", "--help"], env={"COLUMNS": "120"})
    assert "[m]" in result.stdout


def test_version() -> None:
    result = CliRunner().invoke(app, ["--version"])
    assert (result.exit_code, result.stdout) == (0, f"boxplus {boxplus.__version__}\n")


def test_the_package_is_the_command() -> None:
    found = subprocess.run([sys.executable, "-m", "boxplus", "--version"], capture_output=True, text=True, check=False)
    assert (found.returncode, found.stdout) == (0, f"boxplus {boxplus.__version__}\n")
    assert subprocess.run([sys.executable, "-m", "boxplus", "oi"], capture_output=True, check=False).returncode == 2


def test_unknown_command() -> None:
    result = CliRunner().invoke(app, ["oi"])
    assert result.exit_code == 2
    assert "No such command 'oi'" in result.stderr


@pytest.mark.parametrize(
    "words",
    [
        *(f"{name} nowhere" for name in ("lio", "slam", "vio", "vo", "refine", "ba", "pgo", "inspect", "report")),
        "localize nowhere --map nowhere",
        "calibrate lidar-imu nowhere",
        "calibrate cameras nowhere --target nowhere --resolution 752x480",
        "eval nowhere nowhere",
        *(f"map {name} nowhere" for name in ("info", "export", "grid", "height", "merge")),
        "map update nowhere nowhere",
        "fleet run nowhere",
        "simulate nowhere",
        *(f"{name} --no-such-option" for name in _COMMANDS),
    ],
)
def test_what_is_not_there_has_exit_code_2_and_says_what_to_do(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, words.split())
    assert result.exit_code == 2, result.output
    if "--no-such-option" not in words:
        assert re.fullmatch(r"error: expected [^–]+ – got [^–]+ – [^–]+\n", result.stderr), result.stderr
    assert list(tmp_path.iterdir()) == []


def test_every_field_of_the_recording_is_an_option() -> None:
    for name in ("lio", "inspect"):
        text = CliRunner().invoke(app, [name, "--help"], env={"COLUMNS": "120"}).stdout
        for field in RecordingOptions.model_fields:
            assert f"--{field.removesuffix('_s').replace('_', '-')} " in text


def test_a_value_out_of_range_names_its_option() -> None:
    result = CliRunner().invoke(app, ["inspect", "nothing.bag", "--start", "-1"])
    assert result.exit_code == 2
    assert "expected a valid value for --start" in result.stderr


def test_a_recording_that_does_not_exist_is_bad_input() -> None:
    result = CliRunner().invoke(app, ["inspect", "nowhere.bag"])
    assert (result.exit_code, result.stderr.strip()) == (
        2,
        "error: expected a recording – got no file or folder nowhere.bag – check the path",
    )


def test_exit_codes_of_paths_that_cannot_be_written(tmp_path: Path) -> None:
    recording = write_recording(simulate("walk", duration_s=1.0, lidar=SpinningLidar(azimuth_steps=100)), tmp_path / "walk")
    (tmp_path / "file").write_text("mine")
    result = CliRunner().invoke(app, ["inspect", str(recording), "-o", str(tmp_path / "file" / "out.json")])
    assert (result.exit_code, result.stderr.strip().split(" – ")[0]) == (1, f"error: expected to write {tmp_path / 'file'}")
    result = CliRunner().invoke(app, ["simulate", "walk", "--duration", "1", "-o", str(tmp_path)])
    assert (result.exit_code, result.stderr.strip().split(", ")[0]) == (
        2,
        "error: expected the path of a new recording – got one that exists",
    )


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; sys.argv = ['boxplus', '--help']\n"
        "from boxplus.cli import main\n"
        "try: main()\nexcept SystemExit: pass\n"
        "print('heavy:', *sorted({'numpy', 'numba', 'scipy', 'rosbags', 'plotly', 'matplotlib', 'pydantic'} & set(sys.modules)))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert out.splitlines()[-1].strip() == "heavy:"


@pytest.mark.parametrize("enabled", [True, False])
def test_imports_leave_the_collector_as_it_was(enabled: bool) -> None:
    before = gc.isenabled()
    try:
        (gc.enable if enabled else gc.disable)()
        with uncollected():
            assert not gc.isenabled()
        assert gc.isenabled() == enabled
    finally:
        (gc.enable if before else gc.disable)()


def test_an_output_that_knows_few_letters_gets_the_others_replaced(tmp_path: Path) -> None:
    (tmp_path / "x.bag").touch()
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    command = [sys.executable, "-m", "boxplus", "inspect", str(tmp_path / "x.bag")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and not done.stderr.strip()
    assert "got x.bag, which is empty ? give the recording" in done.stdout


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_an_output_without_room_is_a_sentence(unbuffered: str, tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered}
    path = tmp_path / "a.tum"
    path.write_text("".join(f"{i} {i} {i % 3} 0 0 0 0 1\n" for i in range(20)))
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "boxplus", "eval", str(path), str(path)]
        done = subprocess.run(command, env=environment, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("error: expected to write to the standard output – got No space left on device – make room")
    assert "Traceback" not in done.stderr and "Exception ignored" not in done.stderr


def test_the_threads_of_blas_that_a_user_asked_for_stay() -> None:
    code = (
        "import os; from boxplus.cli import main\ntry: main()\nexcept SystemExit: print(os.environ.get('OPENBLAS_NUM_THREADS'))"
    )

    def threads(**given: str) -> str:
        environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")} | given
        program = [sys.executable, "-c", code, "--version"]
        return subprocess.run(program, env=environment, capture_output=True, text=True, check=True).stdout.split()[-1]

    assert threads() == "1"
    assert threads(OPENBLAS_NUM_THREADS="3") == "3"
    assert threads(OMP_NUM_THREADS="3") == "None"


def test_a_bar_leaves_no_trace_in_a_pipe(tmp_path: Path) -> None:
    """A bar that nobody sees left an empty line, on the standard error of one command and before the results of another."""
    (tmp_path / "a.bag").write_bytes(b"")
    result = CliRunner().invoke(app, ["inspect", str(tmp_path / "a.bag")])
    assert (result.exit_code, result.stderr) == (1, "") and result.stdout.startswith("a.bag")
    result = CliRunner().invoke(app, ["simulate", "at_rest", "--duration", "0.3", "-o", str(tmp_path)])
    assert (result.exit_code, result.stderr) == (0, "") and result.stdout.startswith(str(tmp_path))


def test_the_folder_one_stands_in_has_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "notes.txt").touch()
    monkeypatch.chdir(tmp_path)
    shown = CliRunner().invoke(app, ["inspect", "."], env={"COLUMNS": "200"}).stdout
    assert shown.startswith(f"{tmp_path.name}\n") and f"got {tmp_path.name} with notes.txt" in " ".join(shown.split())
    assert f"got {tmp_path.name} with notes.txt" in CliRunner().invoke(app, ["lio", "."]).stderr


def test_that_there_is_no_imu_comes_before_what_else_is_missing(tmp_path: Path) -> None:
    sequence = tmp_path / "00"
    for name in ("image_0", "image_1"):
        (sequence / name).mkdir(parents=True)
        (sequence / name / "000000.png").touch()
    (sequence / "calib.txt").write_text("P0: 700 0 600 0 0 700 180 0 0 0 1 0\n")
    result = CliRunner().invoke(app, ["vio", str(sequence), "-o", str(tmp_path / "out")])
    assert result.exit_code == 2 and "expected a recording with an IMU – got cameras alone in 00 – without" in result.stderr
    assert not (tmp_path / "out").exists()
