"""`boxplus fleet run` as a user calls it: what is printed, and which exit code says that not all of it is to be trusted."""

from __future__ import annotations

import json
from pathlib import Path
from types import TracebackType
from typing import Any

import pytest
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.runs.fleet import executor, fleet_run
from boxplus.runs.fleet.executor import InProcess
from boxplus.runs.fleet.status import RecordingStatus


class Here(InProcess):
    """In place of a cluster."""

    def __init__(self, *_: object) -> None:
        pass

    def __enter__(self) -> Here:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        pass


@pytest.fixture
def recordings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    def run(store: str, name: str, recording: str, config: Any) -> RecordingStatus:
        if name == "broken":
            return RecordingStatus(
                name=name, recording=recording, state="failed", error="expected a bag – got dust – look for it"
            )
        (Path(store) / "runs" / name).mkdir(parents=True, exist_ok=True)
        (Path(store) / "runs" / name / "run.json").touch()
        doubt = "gyroscope and LiDAR contradict each other" if name == "tilted" else None
        return RecordingStatus(name=name, recording=recording, state="finished", doubt=doubt, seconds=2.0, path_length_m=12.0)

    monkeypatch.setattr(executor, "RayExecutor", Here)
    monkeypatch.setattr(fleet_run, "run_recording", run)
    return tmp_path / "recordings"


def _fleet(folder: Path, *names: str, words: tuple[str, ...] = ()) -> Any:
    folder.mkdir(exist_ok=True)
    for name in names:
        (folder / f"{name}.bag").touch()
    return CliRunner().invoke(app, ["fleet", "run", str(folder), "-o", str(folder.with_name("out")), *words])


def test_one_sound_recording_is_a_fleet_that_is_done(recordings: Path) -> None:
    result = _fleet(recordings, "sound")
    assert result.exit_code == 0 and "1/1 sound: finished, 2 s: 12 m, 0 loops" in result.stdout


def test_what_failed_or_is_not_to_be_trusted_is_named_in_the_exit_code_and_in_json(recordings: Path) -> None:
    result = _fleet(recordings, "sound", "broken", "tilted")
    assert result.exit_code == 3
    assert "not to be trusted: broken failed: expected a bag – got dust" in result.stdout
    assert "not to be trusted: tilted is left out of the joint map: gyroscope and LiDAR contradict" in result.stdout
    again = _fleet(recordings, words=("--json",))
    outcome = json.loads(again.stdout)
    assert again.exit_code == outcome["exit_code"] == 3 and outcome["outcome"] == "not to be trusted"
    assert [own["state"] for own in outcome["run"]["recordings"]] == ["failed", "finished", "finished"]
    quiet = _fleet(recordings, words=("--quiet",))
    assert quiet.stdout == "" and "broken failed" in quiet.stderr


def test_a_place_that_cannot_be_is_refused_before_anything_runs(recordings: Path) -> None:
    result = _fleet(recordings, "sound", words=("-o", "nothing://bucket/fleet"))
    assert result.exit_code == 2 and "a URL that fsspec has a driver for" in result.stderr
