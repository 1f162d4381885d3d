"""Where a view goes: a window, a viewer that is open, a file; on this machine, bounded, and never in the way of the run."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from boxplus import InputError
from boxplus.report import viewer as viewers
from boxplus.report.viewer import Viewer, check_target
from tests.report.rerun_stand_in import stand_in

_VIEWER = """
import socket, sys, time
options = dict(argument.partition("=")[::2] for argument in sys.argv[1:])
with open(__file__ + ".seen", "w") as seen:
    seen.write(" ".join(sys.argv[1:]))
if {ends} == "before":
    sys.exit(3)
server = socket.create_server((options["--bind"], int(options["--port"])))
server.accept()
if {ends} == "after":
    sys.exit(4)
time.sleep(30)
"""


@pytest.fixture
def rerun(monkeypatch: pytest.MonkeyPatch) -> MagicMock:
    monkeypatch.setenv("DISPLAY", ":0")
    return stand_in(monkeypatch)


@pytest.fixture
def ended(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[subprocess.Popen[bytes]]]:
    """The viewers that a test starts, ended with it: they outlive what started them."""
    started: list[subprocess.Popen[bytes]] = []
    start = subprocess.Popen

    def remember(*words: object, **options: object) -> subprocess.Popen[bytes]:
        started.append(start(*words, **options))  # type: ignore[call-overload]
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", remember)
    yield started
    for process in started:
        process.kill()
        process.wait()


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, ends: str = "never") -> Path:
    """What `python -m rerun` runs."""
    (folder / "rerun.py").write_text(_VIEWER.format(ends=repr(ends)))
    monkeypatch.setenv("PYTHONPATH", str(folder))
    return folder / "rerun.py.seen"


def test_a_window_listens_on_the_loopback_interface_only_and_has_bounded_memory(
    rerun: MagicMock, ended: list[subprocess.Popen[bytes]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = install(tmp_path, monkeypatch)
    view = Viewer("walk.bag")
    assert "spawn" not in rerun.init.call_args.kwargs
    bind, port, memory, *_ = seen.read_text().split()
    assert (bind, memory) == ("--bind=127.0.0.1", "--memory-limit=2GB")
    rerun.connect_grpc.assert_called_once_with(f"rerun+http://127.0.0.1:{port.removeprefix('--port=')}/proxy")
    # The window is closed: the run goes on, and what is shown goes nowhere.
    assert view.look_after()
    ended[0].kill()
    ended[0].wait()
    assert [view.look_after() for _ in range(40)][-1] is False
    assert view.note == "the window was closed; the run went on without it"
    rerun.log.reset_mock()
    view.log("world", 1)
    rerun.log.assert_not_called()
    view.close()
    rerun.disconnect.assert_called_once()


@pytest.mark.parametrize(("ends", "code"), [("before", 3), ("after", 4)])
def test_a_window_that_does_not_stay_open_is_explained(
    rerun: MagicMock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends: str, code: int
) -> None:
    install(tmp_path, monkeypatch, ends)
    with pytest.raises(
        InputError, match=rf"viewer of rerun in a window – got a process that ended with code {code} – write a file"
    ):
        Viewer("walk.bag")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems always have a screen")
def test_without_a_screen_nothing_is_started(rerun: MagicMock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(subprocess, "Popen", MagicMock(side_effect=AssertionError))
    with pytest.raises(InputError, match=r"neither DISPLAY nor WAYLAND_DISPLAY is set – write a file with --view FILE\.rrd"):
        Viewer("walk.bag")
    Viewer("walk.bag", where=None)
    rerun.connect_grpc.assert_not_called()


def test_a_viewer_that_is_open_is_used_and_its_end_noticed(rerun: MagicMock) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        where = f"rerun+http://127.0.0.1:{server.getsockname()[1]}/proxy"
        view = Viewer("walk.bag", where)
        rerun.connect_grpc.assert_called_once_with(where)
        assert all(view.look_after() for _ in range(40))
    assert not all(view.look_after() for _ in range(40))
    assert view.note == "the viewer does not answer any more; the run went on without it"
    with pytest.raises(
        InputError, match=r"a viewer that listens at rerun.* – got none – start one with 'rerun --bind 127\.0\.0\.1"
    ):
        Viewer("walk.bag", where)


def test_a_file_does_not_grow_without_bound(rerun: MagicMock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewers, "FILE_LIMIT", 1000)
    path = tmp_path / "run.rrd"
    view = Viewer("walk.bag", str(path))
    rerun.save.assert_called_once_with(str(path))
    shown = []
    for size in (0, 500, 900, 1000):
        os.truncate(path, size)
        shown.append((all(view.look_after() for _ in range(20)), view.thinned(20_000)))
    assert shown == [(True, 20_000), (True, 5_000), (True, 199), (False, 1)]
    assert view.note is not None and "run.rrd has reached" in view.note
    with pytest.raises(InputError, match=r"a new file for the view – got .*run\.rrd, which exists"):
        Viewer("walk.bag", str(path))
    with pytest.raises(InputError, match="a file that the view can be written to"):
        Viewer("walk.bag", str(tmp_path / "nowhere" / "run.rrd"))


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ("walk.bag", r"--view with 'window', FILE\.rrd, or the address .* – got 'walk\.bag' – write --view window behind"),
        ("rerun+http://10.0.0.7:9876/proxy", r"nothing of a run is sent over the network – got the host '10\.0\.0\.7'"),
        ("http://127.0.0.1:9876/proxy", "--view with"),
        ("rerun+http://127.0.0.1/proxy", "--view with"),
    ],
)
def test_other_places_are_refused(where: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        check_target(where)


def test_a_missing_library_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(InputError, match=r"pip install .*rerun-sdk"):
        Viewer("walk.bag", "run.rrd")
