"""`--json` and `--quiet` of every command that has them: one shape, whatever was given and however it came out."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest
import typer
from pydantic import BaseModel
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.cli.outcome import Outcome, reported
from boxplus.errors import InputError, OutputError

KEYS = ["input", "output", "outcome", "exit_code", "error", "evaluation", "run"]
NOWHERE = {
    "lio": ["nowhere.bag"],
    "slam": ["nowhere.bag"],
    "localize": ["nowhere.bag", "--map", "nowhere"],
    "refine": ["nowhere"],
    "vio": ["nowhere.bag"],
    "vo": ["nowhere"],
    "ba": ["nowhere.txt"],
    "pgo": ["nowhere.g2o"],
    "map merge": ["nowhere", "nowhere_else"],
    "fleet run": ["nowhere"],
    "map update": ["nowhere", "nowhere_else"],
    "calibrate lidar-imu": ["nowhere.bag"],
    "calibrate cameras": ["nowhere.csv", "--target", "nowhere.yaml", "--resolution", "752x480"],
}


class Facts(BaseModel):
    path_length_m: float = 3.0


@pytest.mark.parametrize("path", NOWHERE)
def test_bad_input_is_a_line_of_json_and_an_error(path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, [*path.split(), *NOWHERE[path], "--json", "--quiet"])
    assert result.exit_code == 2
    found = json.loads(result.stdout)
    assert list(found) == KEYS
    assert found["outcome"] == "failed" and found["exit_code"] == 2 and found["run"] is None
    assert "nowhere" in found["input"] and found["error"].startswith("expected ")
    assert result.stderr == f"error: {found['error']}\n"


@pytest.mark.parametrize(
    ("state", "untrusted", "outcome", "code"),
    [
        ("finished", False, "finished", 0),
        ("finished", True, "not to be trusted", 3),
        ("interrupted", True, "interrupted", 130),
    ],
)
def test_an_end_and_its_code(state: str, untrusted: bool, outcome: str, code: int, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        with reported("walk.bag", "out", as_json=True) as told:
            told.end(Facts(), state, untrusted=untrusted)
        left = 0
    except typer.Exit as end:
        left = end.exit_code
    found = json.loads(capsys.readouterr().out)
    assert (found["outcome"], found["exit_code"], left) == (outcome, code, code)
    assert found["run"] == {"path_length_m": 3.0}


@pytest.mark.parametrize(
    ("error", "outcome", "code", "text"),
    [
        (InputError("a", "b", "c"), "failed", 2, "expected a – got b – c"),
        (OutputError("a full disk"), "failed", 1, "a full disk"),
        (KeyError("no\x1b such"), "failed", 1, "KeyError: "),
        (KeyboardInterrupt(), "interrupted", 130, "stopped at once"),
    ],
)
def test_what_is_raised_is_told_and_raised_on(
    error: BaseException, outcome: str, code: int, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(type(error)), reported("walk.bag", None, as_json=True):
        raise error
    found = Outcome.model_validate_json(capsys.readouterr().out)
    assert (found.outcome, found.exit_code, found.output) == (outcome, code, None)
    assert found.error is not None and found.error.startswith(text) and "\x1b" not in found.error


def test_a_number_that_is_none_is_null_for_a_script(capsys: pytest.CaptureFixture[str]) -> None:
    with reported("walk.bag", "out", as_json=True) as told:
        told.end(Facts(path_length_m=float("nan")))
    assert json.loads(capsys.readouterr().out)["run"] == {"path_length_m": None}


@pytest.mark.skipif(os.name == "nt", reason="SIGINT is sent differently on Windows")
def test_a_quiet_solver_answers_ctrl_c(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from boxplus.formats.graphs.g2o import write_g2o
    from boxplus.systems.pose_graph import pose_graph
    from tests.small_problems import loop_graph

    write_g2o(tmp_path / "loops.g2o", loop_graph(2))
    solve = pose_graph.optimize_pose_graph

    def interrupted(*arguments: object, **words: object) -> object:
        os.kill(os.getpid(), signal.SIGINT)
        return solve(*arguments, **words)  # type: ignore[arg-type]

    monkeypatch.setattr(pose_graph, "optimize_pose_graph", interrupted)
    result = CliRunner().invoke(app, ["pgo", str(tmp_path / "loops.g2o"), "-o", str(tmp_path / "out"), "--no-report", "-q"])
    assert result.exit_code == 130 and result.stdout == ""
    assert result.stderr.startswith("interrupted: stopping after this step; Ctrl-C again stops at once\n")
