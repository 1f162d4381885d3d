"""The live view: the viewer it starts listens to this machine only. A stand-in for rerun, which needs a screen."""

from __future__ import annotations

import subprocess
import sys
import types
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest

from boxplus import InputError, VioConfig
from boxplus.report.live_view import LiveCameraView, LiveView
from boxplus.runs.slam.loop_search import Closure
from tests.systems.visual_inertial_odometry.simulated_rays import PIXEL_SIGMA, Flight, rig, run

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
    shapes = ("Transform3D", "Quaternion", "Arrows3D", "LineStrips3D", "Points3D", "Scalars")
    for name in ("init", "connect_grpc", "log", "set_time", "ViewCoordinates", *shapes):
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


def test_frames_of_cameras_are_shown_with_pose_path_and_landmarks(rerun: MagicMock) -> None:
    _, estimates = run(Flight(3, 2.5), rig(), VioConfig(pixel_sigma=PIXEL_SIGMA))
    view = LiveCameraView("room", spawn=False)
    logged = []
    for estimate in estimates:
        rerun.log.reset_mock()
        view.show(estimate)
        names = [call.args[0] for call in rerun.log.call_args_list]
        if estimate.status == "starting":
            assert not names  # there is no pose
            continue
        assert {"world/imu", "world/path", "world/landmarks", "world/lines", "tracked"} <= set(names)
        assert any(name.startswith("world/map/") for name in names) == estimate.is_keyframe
        logged.append(estimate)
    assert len(logged) > 5
    points, last = rerun.Points3D.call_args_list, logged[-1]
    assert any(np.array_equal(call.args[0], last.landmarks) for call in points)
    paths = [call.args[0] for call in rerun.LineStrips3D.call_args_list if isinstance(call.args[0], list)]
    assert np.array_equal(paths[-1][0][-1], view._path[-1])
    assert np.linalg.norm(view._path[-1] - last.T_world_imu[:3, 3]) <= 0.02


def test_loops_are_shown_when_they_close(rerun: MagicMock) -> None:
    view = LiveView("city", spawn=False)
    rerun.log.reset_mock()
    view.show_loops(Closure([[2, 0], [3, 1]], [[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [0.5, 0.0, 0.0], [5.0, 1.0, 0.0]]))
    assert [call.args[0] for call in rerun.log.call_args_list] == ["world/corrected", "world/loops"]
    path, loops = (call.args[0] for call in rerun.LineStrips3D.call_args_list)
    assert np.shape(path) == (1, 4, 3)
    np.testing.assert_array_equal(loops, [[[0.5, 0, 0], [0, 0, 0]], [[5, 1, 0], [5, 0, 0]]])
