"""`--overwrite` keeps the results that are there until the new ones are finished, wherever the new run ends before."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from boxplus.errors import InputError
from boxplus.runs.run_folder import RunFolder, claim_run_folder
from boxplus.runs.slam.folder import SlamFolder, claim_slam_folder

HEAD = "time_ns,status\n"


def content(folder: Path) -> dict[str, str]:
    return {path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*") if path.is_file()}


def write(run: RunFolder, what: str, state: str, *, estimates: bool = True) -> None:
    """What a run leaves of itself, as far as it came."""
    program = "boxplus slam" if isinstance(run, SlamFolder) else "boxplus lio"
    tile = run.tiles / "tiles" / "x+0_y+0_z+0"
    tile.mkdir(parents=True, exist_ok=True)
    (tile / "0.ply").write_text(what)
    run.config.write_text(what)
    rows = HEAD + f"1,{what}\n" * estimates
    run.trajectory.write_text(rows)
    if isinstance(run, SlamFolder):
        run.local_maps.mkdir(exist_ok=True)
        (run.local_maps / "000000.npz").write_text(what)
        run.odometry.path.mkdir(exist_ok=True)
        run.odometry.trajectory.write_text(rows)
        run.odometry.checkpoint.write_text(what)
    run.checkpoint.write_text(what)
    run.summary.write_text(json.dumps({"program": program, "state": state}))


CLAIMS: dict[str, Callable[..., AbstractContextManager[RunFolder]]] = {"lio": claim_run_folder, "slam": claim_slam_folder}


@pytest.fixture(params=["lio", "slam"])
def command(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    name: str = request.param
    with CLAIMS[name](tmp_path) as run:
        write(run, "old", "finished")
    (tmp_path / "map" / "notes.txt").write_text("mine")
    return name


def test_the_earlier_results_go_when_the_new_ones_are_finished(command: str, tmp_path: Path) -> None:
    before = content(tmp_path)
    with CLAIMS[command](tmp_path, overwrite=True) as run:
        assert content(tmp_path / "results.boxplus-earlier") == {name: text for name, text in before.items() if text != "mine"}
        assert set(content(tmp_path)) - {f"results.boxplus-earlier/{name}" for name in before} == {"run.lock", "map/notes.txt"}
        write(run, "new", "finished")
    assert set(content(tmp_path)) == set(before) and set(content(tmp_path).values()) - {"mine"} != set(before.values())
    assert (tmp_path / "config.yaml").read_text() == "new" and not (tmp_path / "results.boxplus-earlier").exists()


@pytest.mark.parametrize("state", ["failed", "interrupted", "running"])
def test_they_are_put_back_where_the_new_run_left_none(
    command: str, tmp_path: Path, state: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Once a full disk at the first scan, or Ctrl-C before it, left neither of the two."""
    before = content(tmp_path)
    with pytest.raises(KeyboardInterrupt), CLAIMS[command](tmp_path, overwrite=True) as run:
        write(run, "new", state, estimates=False)
        raise KeyboardInterrupt
    assert content(tmp_path) == before
    assert [record.getMessage() for record in caplog.records] == [f"the earlier results in {tmp_path} stay as they were"]


def test_they_are_kept_beside_a_new_run_that_did_not_end(command: str, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    kept = tmp_path / "results.boxplus-earlier"
    with CLAIMS[command](tmp_path, overwrite=True) as run:
        write(run, "new", "interrupted")
    old = content(kept)
    assert set(old.values()) >= {"old"} and (tmp_path / "config.yaml").read_text() == "new"
    assert f"the earlier results are kept in {kept} until a run there comes to its end" in caplog.text
    with pytest.raises(InputError, match="the results of an earlier run"), CLAIMS[command](tmp_path):
        raise AssertionError
    with CLAIMS[command](tmp_path, overwrite=True) as run:  # those that did not end go, those that did stay
        assert not (tmp_path / "config.yaml").exists() and content(kept) == old
        write(run, "newer", "interrupted")
    with CLAIMS[command](tmp_path, resume=True) as run:
        assert (tmp_path / "config.yaml").read_text() == "newer" and content(kept) == old
        write(run, "newer", "finished")
    assert not kept.exists() and (tmp_path / "config.yaml").read_text() == "newer"


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_process_that_is_killed_at_any_step_leaves_one_of_both_whole(
    command: str, tmp_path: Path, overwrite: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, copies = content(tmp_path), list[Path]()
    for name in ("replace", "rename"):
        real = getattr(os, name)

        def seen(*paths: Path, real: Callable[..., None] = real) -> None:
            real(*paths)
            copies.append(tmp_path.with_name(f"{tmp_path.name}_{len(copies)}"))
            shutil.copytree(tmp_path, copies[-1])

        monkeypatch.setattr(os, name, seen)
    with pytest.raises(ZeroDivisionError), CLAIMS[command](tmp_path, overwrite=True):
        raise ZeroDivisionError  # nothing was written: they are moved to and fro
    monkeypatch.undo()
    assert len(copies) == 2 * len([text for text in before.values() if text != "mine"]) + 2
    for copy in copies:
        if overwrite:
            with pytest.raises(ZeroDivisionError), CLAIMS[command](copy, overwrite=True):
                raise ZeroDivisionError
        else:
            with pytest.raises(InputError, match="the results of an earlier run"), CLAIMS[command](copy):
                raise AssertionError
        left = content(copy)
        left.pop("run.lock", None)
        assert left == before, copy
