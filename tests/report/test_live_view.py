"""What a view shows. A stand-in for rerun, which needs a screen."""

from __future__ import annotations

from unittest.mock import MagicMock

import numpy as np
import pytest

from boxplus import VioConfig
from boxplus.report.live_view import LiveCameraView, LiveView, ProblemView
from boxplus.runs.slam.loop_search import Closure
from tests.report.rerun_stand_in import stand_in
from tests.systems.visual_inertial_odometry.simulated_rays import PIXEL_SIGMA, Flight, rig, run


@pytest.fixture
def rerun(monkeypatch: pytest.MonkeyPatch) -> MagicMock:
    return stand_in(monkeypatch)


def test_scans_of_long_runs_cost_as_much_as_those_of_short_ones(rerun: MagicMock) -> None:
    """Of the path only the last piece is sent again, and full files get fewer points."""
    view = LiveView("walk", where=None)
    sizes = []
    for k in range(500):
        view._show_pose(10**9 * k, "ok", np.eye(3), np.array([0.1 * k, 0.0, 0.0]))
        sizes.append(len(rerun.LineStrips3D.call_args.args[0][0]))
    assert max(sizes) == 200
    pieces = {call.args[0] for call in rerun.log.call_args_list if call.args[0].startswith("world/path/")}
    assert pieces == {"world/path/0", "world/path/1", "world/path/2"}


def test_problems_are_shown_before_and_after(rerun: MagicMock) -> None:
    view = ProblemView("square.g2o", where=None)
    p, edges = np.arange(12.0).reshape(4, 3), np.array([[0, 1], [1, 2]])
    view.show_graph(False, p, edges)
    view.show_scene(True, p, p[:1])
    assert [call.args[0] for call in rerun.log.call_args_list] == [
        "before/poses",
        "before/edges",
        "after/points",
        "after/cameras",
    ]
    np.testing.assert_array_equal(rerun.LineStrips3D.call_args.args[0], p[edges])


def test_frames_of_cameras_are_shown_with_pose_path_and_landmarks(rerun: MagicMock) -> None:
    _, estimates = run(Flight(3, 2.5), rig(), VioConfig(pixel_sigma=PIXEL_SIGMA))
    view = LiveCameraView("room", where=None)
    logged = []
    for estimate in estimates:
        rerun.log.reset_mock()
        view.show(estimate)
        names = [call.args[0] for call in rerun.log.call_args_list]
        if estimate.status == "starting":
            assert not names  # there is no pose
            continue
        assert {"world/imu", "world/path/0", "world/landmarks", "world/lines", "tracked"} <= set(names)
        assert any(name.startswith("world/map/") for name in names) == estimate.is_keyframe
        logged.append(estimate)
    assert len(logged) > 5
    points, last = rerun.Points3D.call_args_list, logged[-1]
    assert any(np.array_equal(call.args[0], last.landmarks) for call in points)
    paths = [call.args[0] for call in rerun.LineStrips3D.call_args_list if isinstance(call.args[0], list)]
    assert np.linalg.norm(paths[-1][0][-1] - last.T_world_imu[:3, 3]) <= 0.02


def test_loops_are_shown_when_they_close(rerun: MagicMock) -> None:
    view = LiveView("city", where=None)
    rerun.log.reset_mock()
    view.show_loops(Closure([[2, 0], [3, 1]], [[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [0.5, 0.0, 0.0], [5.0, 1.0, 0.0]]))
    assert [call.args[0] for call in rerun.log.call_args_list] == ["world/corrected", "world/loops"]
    path, loops = (call.args[0] for call in rerun.LineStrips3D.call_args_list)
    assert np.shape(path) == (1, 4, 3)
    np.testing.assert_array_equal(loops, [[[0.5, 0, 0], [0, 0, 0]], [[5, 1, 0], [5, 0, 0]]])
