"""`boxplus slam` as a user calls it."""

from __future__ import annotations

import os
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

import boxplus.recordings
import boxplus.runs.slam.slam_run
from boxplus.cli import app
from boxplus.errors import InputError


@pytest.mark.parametrize(
    ("words", "threads"),
    [([], 3), (["--threads", "1"], 1), (["--set", "odometry.threads=4"], 4), (None, min(2, os.cpu_count() or 1))],
)
def test_threads_are_those_of_the_file_unless_an_option_says_otherwise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str] | None, threads: int
) -> None:
    used: list[Any] = []

    def run_slam(recording: object, folder: object, config: Any, **options: object) -> None:
        used.append(config.odometry.threads)
        raise InputError("a run", "enough of it", "stop")

    info = SimpleNamespace(path=Path("walk.bag"), format="ros1", duration_s=1.0, message_count=1, evidence=[])
    monkeypatch.setattr(boxplus.recordings, "open_recording", lambda *_: nullcontext(SimpleNamespace(info=info)))
    monkeypatch.setattr(boxplus.runs.slam.slam_run, "run_slam", run_slam)
    (tmp_path / "settings.yaml").write_text("odometry: {threads: 3}\n")
    given = [] if words is None else ["--config", str(tmp_path / "settings.yaml"), *words]
    result = CliRunner().invoke(app, ["slam", "walk.bag", "-o", str(tmp_path / "out"), *given])
    assert result.exit_code == 2 and "enough of it" in result.stderr
    assert used == [threads]
