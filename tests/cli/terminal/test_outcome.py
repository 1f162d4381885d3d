"""`--json` and `--quiet` of every command that has them: one shape, whatever was given and however it came out."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path

import pytest
import typer
from pydantic import BaseModel
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.cli.ground_truth import Comparison
from boxplus.cli.terminal.interrupt import stop_on_interrupt
from boxplus.cli.terminal.outcome import Outcome, reported
from boxplus.cli.terminal.terminal import Terminal
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


@pytest.mark.parametrize("error", [OutputError("a full disk"), ValueError("no ticks")])
@pytest.mark.parametrize(
    ("state", "untrusted", "code"), [("finished", False, 1), ("finished", True, 3), ("interrupted", False, 130)]
)
def test_a_report_that_cannot_be_drawn_hides_no_run(
    error: Exception, state: str, untrusted: bool, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(typer.Exit) as end, reported("walk.bag", "out", as_json=True) as told:
        with told.drawing(Terminal(quiet=True, as_json=True)):
            raise error
        told.end(Facts(), state, untrusted=untrusted)
        told.compare(Comparison("close", {"ate": 0.1}))
        told.compare(Comparison("not compared", error="other times"))
    printed = capsys.readouterr()
    found = Outcome.model_validate_json(printed.out)
    assert end.value.exit_code == found.exit_code == code and found.run is not None
    assert found.error is not None and found.error.startswith("the report could not be drawn: ")
    assert str(error) in found.error and found.error.endswith("; other times")
    assert ("Traceback" in printed.err) == (not isinstance(error, OutputError))


@pytest.mark.parametrize("untrusted", [False, True])
def test_an_interrupt_leaves_the_report_out_and_not_the_results(untrusted: bool, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(typer.Exit) as end, reported("walk.bag", "out", as_json=True) as told:
        with told.drawing(Terminal(quiet=True, as_json=True)):
            raise KeyboardInterrupt
        told.end(Facts(), "finished", untrusted=untrusted)
    printed = capsys.readouterr()
    found = Outcome.model_validate_json(printed.out)
    outcome, code = ("not to be trusted", 3) if untrusted else ("interrupted", 130)
    assert end.value.exit_code == found.exit_code == code and found.outcome == outcome and found.run is not None
    assert found.error == "interrupted: the report was not drawn, all other results are there"
    assert "Traceback" not in printed.err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_leaves_the_report_where_a_run_would_come_to_its_end(number: signal.Signals) -> None:
    """The first one only asks a run to stop; nothing asks that of a drawing, and several runs are not to go on after it."""
    told, announced, drawn = Outcome(input="walk.bag", output="out"), [], []
    before = signal.getsignal(number)
    with stop_on_interrupt(lambda: announced.append(True)) as should_stop:
        with told.drawing(Terminal(quiet=True, as_json=True)):
            os.kill(os.getpid(), number)
            time.sleep(5.0)
            drawn.append(True)
        assert should_stop() and announced and not drawn
    told.end(Facts())
    assert told.outcome == "interrupted" and told.exit_code == 130 and signal.getsignal(number) is before


def test_pgo_writes_its_results_where_the_report_cannot_be_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from boxplus.formats.graphs.g2o import write_g2o
    from boxplus.report.optimization import graph_report
    from tests.small_problems import loop_graph

    def fail(*arguments: object) -> None:
        raise OutputError("no room for pictures")

    monkeypatch.setattr(graph_report, "write_graph_report", fail)
    write_g2o(tmp_path / "loops.g2o", loop_graph(2))
    result = CliRunner().invoke(app, ["pgo", str(tmp_path / "loops.g2o"), "-o", str(tmp_path / "out"), "--json", "-q"])
    found = json.loads(result.stdout)
    assert result.exit_code == found["exit_code"] == 1 and found["outcome"] == "finished" and found["run"]["cost"] >= 0.0
    assert found["error"] == "the report could not be drawn: no room for pictures"
    assert {"run.json", "optimized.g2o"} <= {path.name for path in (tmp_path / "out").iterdir()}


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
