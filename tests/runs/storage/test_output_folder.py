"""The output folder: one run at a time, by a lock that no process can leave behind, and nothing replaced without being asked."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from boxplus.errors import InputError
from boxplus.runs.run_folder import claim_run_folder
from boxplus.runs.storage.output_folder import output_folder

_HOLDER = """
import sys, time
from pathlib import Path
from boxplus.runs.run_folder import claim_run_folder
with claim_run_folder(sys.argv[1]) as run:
    run.summary.write_text('{"program": "boxplus lio"}')
    run.config.write_text("mine")
    print("held", flush=True)
    sys.stdin.readline()
"""


@contextmanager
def another_run(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that holds the folder."""
    process = subprocess.Popen(
        [sys.executable, "-c", _HOLDER, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        yield process
    finally:
        process.kill()
        process.communicate()


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_second_run_is_refused_and_the_first_one_left_alone(tmp_path: Path, overwrite: bool) -> None:
    with another_run(tmp_path) as process:
        text = (
            rf"expected an output folder that no other run is writing to – got process {process.pid} writing to .* – wait for it"
        )
        with pytest.raises(InputError, match=text), claim_run_folder(tmp_path, overwrite=overwrite):
            raise AssertionError
        assert names(tmp_path) == {"run.json", "config.yaml", "run.lock"}
        process.communicate("\n")
        assert process.returncode == 0
    assert names(tmp_path) == {"run.json", "config.yaml"}


@pytest.mark.skipif(os.name == "nt", reason="there is no SIGKILL")
def test_the_lock_of_a_killed_run_does_not_block(tmp_path: Path) -> None:
    with another_run(tmp_path) as process:
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert "run.lock" in names(tmp_path)
        with claim_run_folder(tmp_path) as run:
            assert names(run.path) == {"run.lock"}
            assert json.loads((tmp_path / "run.lock").read_text()) == {"program": "boxplus lio", "process": os.getpid()}


def test_two_threads_of_one_process_are_two_runs(tmp_path: Path) -> None:
    refused = pytest.raises(InputError, match=f"got process {os.getpid()} writing")
    with claim_run_folder(tmp_path), refused, claim_run_folder(tmp_path):
        raise AssertionError


@pytest.mark.parametrize("state", ["failed", "interrupted", "running"])
def test_a_run_without_an_estimate_is_replaced(tmp_path: Path, state: str) -> None:
    (tmp_path / "run.json").write_text(json.dumps({"program": "boxplus lio", "state": state}))
    (tmp_path / "trajectory.csv").write_text("time_ns,status\n")
    (tmp_path / "map").mkdir()
    (tmp_path / "map" / "manifest.json").write_text("{}")
    (tmp_path / "notes.txt").write_text("mine")
    with claim_run_folder(tmp_path):
        assert names(tmp_path) == {"notes.txt", "run.lock"}


def test_a_run_with_an_estimate_is_not(tmp_path: Path) -> None:
    """Whatever its run.json says: it may be two seconds old."""
    (tmp_path / "run.json").write_text(json.dumps({"program": "boxplus lio", "state": "running", "scans": 0}))
    (tmp_path / "trajectory.csv").write_text("time_ns,status\n1,ok\n")
    with pytest.raises(InputError, match="the results of an earlier run"), claim_run_folder(tmp_path):
        raise AssertionError
    assert names(tmp_path) == {"run.json", "trajectory.csv"}


@contextmanager
def _claimed(folder: Path) -> Iterator[Path]:
    """As `boxplus ba` and `boxplus pgo` do, which write their run.json last."""
    with output_folder(folder, "boxplus ba", lambda: [folder / "adjusted.txt", folder / "run.json"], lambda: []) as path:
        yield path


def test_what_a_failed_run_began_is_replaced(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError), _claimed(tmp_path) as path:
        (path / "adjusted.txt").write_text("half of it")
        (path / "adjusted.txt.boxplus-tmp").write_text("half of it")
        raise ZeroDivisionError
    assert "run.lock" in names(tmp_path)
    with _claimed(tmp_path) as path:
        assert names(path) == {"run.lock"}
        (path / "run.json").write_text(json.dumps({"program": "boxplus ba"}))
    assert names(tmp_path) == {"run.json"}
    with pytest.raises(InputError, match="the results of an earlier run"), _claimed(tmp_path):
        raise AssertionError


def test_a_run_killed_within_a_run_is_replaced(tmp_path: Path) -> None:
    """A localisation that was killed before its odometry had begun blocked its folder, with and without --overwrite."""
    (tmp_path / "odometry").mkdir()
    for folder, program in ((tmp_path, "boxplus ba"), (tmp_path / "odometry", "boxplus lio")):
        (folder / "run.lock").write_text(json.dumps({"program": program, "process": 1}))
    (tmp_path / "adjusted.txt").write_text("half of it")
    with _claimed(tmp_path) as path:
        assert not (path / "adjusted.txt").exists()


@pytest.mark.parametrize("began", [False, True])
def test_files_of_others_are_never_replaced(tmp_path: Path, began: bool) -> None:
    """A file of a user's own may have a name that a run would use: without a sign of a run it is nobody's to remove."""
    (tmp_path / "adjusted.txt").write_text("mine")
    if began:
        (tmp_path / "run.lock").write_text(json.dumps({"program": "boxplus ba", "process": 1}))
        (tmp_path / "notes.txt").write_text("mine")
    before = names(tmp_path)
    with pytest.raises(InputError, match="got other files in"), _claimed(tmp_path):
        raise AssertionError
    assert names(tmp_path) == before
