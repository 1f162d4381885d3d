"""The live view: the viewer it starts listens to this machine only. A stand-in for rerun, which needs a screen."""

from __future__ import annotations

import subprocess
import sys
import types
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from boxplus import InputError
from boxplus.report.live_view import LiveView

_VIEWER = """
import socket, sys
options = dict(argument.partition("=")[::2] for argument in sys.argv[1:])
with open(__file__ + ".seen", "w") as seen:
    seen.write(" ".join(sys.argv[1:]))
if {ends}:
    sys.exit(3)
server = socket.create_server((options["--bind"], int(options["--port"])))
server.accept()
"""


@pytest.fixture
def rerun(monkeypatch: pytest.MonkeyPatch) -> MagicMock:
    module = MagicMock(spec=types.ModuleType("rerun"))
    for name in ("init", "connect_grpc", "log", "ViewCoordinates"):
        setattr(module, name, MagicMock())
    monkeypatch.setitem(sys.modules, "rerun", module)
    return module


def _install(folder: Path, monkeypatch: pytest.MonkeyPatch, *, ends: bool = False) -> Path:
    """What `python -m rerun` runs."""
    (folder / "rerun.py").write_text(_VIEWER.format(ends=ends))
    monkeypatch.setenv("PYTHONPATH", str(folder))
    return folder / "rerun.py.seen"


def test_the_viewer_listens_on_the_loopback_interface_only(
    rerun: MagicMock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = _install(tmp_path, monkeypatch)
    LiveView("walk.bag")
    assert "spawn" not in rerun.init.call_args.kwargs
    bind, port, *_ = seen.read_text().split()
    assert bind == "--bind=127.0.0.1"
    rerun.connect_grpc.assert_called_once_with(f"rerun+http://127.0.0.1:{port.removeprefix('--port=')}/proxy")


def test_a_viewer_that_does_not_open_is_explained(rerun: MagicMock, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _install(tmp_path, monkeypatch, ends=True)
    with pytest.raises(
        InputError, match=r"expected the viewer of rerun in a window – got a process that ended with code 3 – run"
    ):
        LiveView("walk.bag")


def test_nothing_is_started_where_none_is_asked_for(rerun: MagicMock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "Popen", MagicMock(side_effect=AssertionError))
    LiveView("walk.bag", spawn=False)
    rerun.connect_grpc.assert_not_called()
