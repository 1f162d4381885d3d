"""What is not what a public function asks for is refused there, in one form, and never taken for something."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import boxplus as bp

POSES = np.array([[1.0, 0, 0, 0, 0, 0, 0], [1.0, 0, 0, 0, 1, 2, 3]])
CAMERA = bp.Pinhole(500.0, 500.0, 320.0, 240.0)
WAY = bp.Trajectory(10**9 * np.arange(5), np.random.default_rng(0).normal(size=(5, 3)), np.tile([1.0, 0, 0, 0], (5, 1)))
GREY, COLOURS = np.zeros((24, 32), np.uint8), np.zeros((2, 3, 4))
OTHERS = [
    None,
    "a",
    {"a": 1},
    object(),
    3,
    10**400,
    [[1, 2], [3]],
    np.array(["a"]),
    np.array([None, 1], object),
    COLOURS,
]


def problem() -> bp.Problem:
    made = bp.Problem()
    x = made.add_variables(bp.SE2, np.zeros((3, 3)), name="x")
    made.add_residuals(bp.residuals.Prior(bp.SE2, np.zeros((3, 3)), sigma=1.0), x, name="g")
    return made


Door = Callable[[object], object]
DOORS: dict[str, tuple[Door, tuple[object, ...]]] = {  # what is called, and which of `OTHERS` it takes
    "fx": (lambda v: bp.Pinhole(v, 500.0, 320.0, 240.0), (3,)),
    "cx": (lambda v: bp.Pinhole(500.0, 500.0, v, 240.0), (3,)),
    "z_min": (lambda v: bp.Pinhole(500.0, 500.0, 320.0, 240.0, z_min=v), (3,)),
    "distortion": (lambda v: bp.Pinhole(500.0, 500.0, 320.0, 240.0, v), (None,)),
    "k1": (lambda v: bp.Radial(v, 0.0), (None, 3)),
    "equidistant": (lambda v: bp.Equidistant(500.0, 500.0, 320.0, 240.0, v), (3,)),
    "double sphere": (lambda v: bp.DoubleSphere(500.0, 500.0, v, 240.0, 0.1, 0.5), (3,)),
    "tags": (lambda v: bp.AprilGrid(v, 6, 0.08, 0.3), (3,)),
    "estimate": (lambda v: bp.evaluate(v, WAY), ()),
    "truth": (lambda v: bp.evaluate(WAY, v), ()),
    "alignment": (lambda v: bp.evaluate(WAY, WAY, alignment=v, min_matches=3), ()),
    "method": (lambda v: bp.evaluate(WAY, WAY, method=v, min_matches=3), ()),
    "matches": (lambda v: bp.evaluate(WAY, WAY, min_matches=v), (3,)),
    "plane": (lambda v: bp.evaluate(WAY, WAY, plane=v, min_matches=3), (None,)),
    "pairs": (lambda v: bp.evaluate(WAY, WAY, rpe_pairs=v, min_matches=3), ()),
    "path": (lambda v: bp.evaluate(WAY, WAY, rpe_path_of=v, min_matches=3), ()),
    "deltas": (lambda v: bp.evaluate(WAY, WAY, deltas=v, min_matches=3), ()),
    "poses": (lambda v: bp.Trajectory(WAY.time_ns, v, WAY.q_wxyz), ()),
    "stamps": (lambda v: bp.Trajectory(v, WAY.p, WAY.q_wxyz), (None,)),
    "trajectory file": (bp.read_trajectory, ()),
    "graph file": (bp.read_pose_graph, ()),
    "reconstruction file": (bp.read_reconstruction, ()),
    "recording": (bp.open_recording, ()),
    "camera recording": (bp.open_camera_recording, ()),
    "to write": (lambda v: bp.formats.write_tum("x.tum", v), ()),
    "graph": (bp.optimize_pose_graph, ()),
    "reconstruction": (bp.adjust_bundle, ()),
    "corners": (lambda v: bp.calibrate_cameras(v, bp.AprilGrid(6, 6, 0.08, 0.3)), ()),
    "lio config": (bp.LidarInertialOdometry, (None,)),
    "lo config": (bp.LidarOdometry, (None,)),
    "lio imu": (lambda v: bp.LidarInertialOdometry().push_imu(v), ()),
    "lio scan": (lambda v: bp.LidarInertialOdometry().push_scan(v), ()),
    "lo imu": (lambda v: bp.LidarOdometry().push_imu(v), ()),
    "rig": (lambda v: bp.VisualInertialOdometry(None, v), ()),
    "camera": (bp.DirectOdometry, ()),
    "pixels": (lambda v: bp.CameraImage(0, "cam0", 0, v), ()),
    "time of an image": (lambda v: bp.CameraImage(0, "cam0", v, GREY), (3, 10**400)),
    "image": (bp.Image.from_array, (COLOURS,)),
    "scenario": (bp.simulate, ()),
    "seed": (lambda v: bp.simulate("spin", seed=v), (3, 10**400)),
    "duration": (lambda v: bp.simulate("spin", duration_s=v), (None, 3)),
    "cell": (lambda v: bp.IkdTree(cell_size=v), (None, 3)),
    "manifold": (lambda v: bp.Problem().add_variables(v, POSES), ()),
    "incremental manifold": (lambda v: bp.IncrementalProblem().add_variables(v, POSES), ()),
    "name": (lambda v: bp.Problem().add_variables(bp.SE3, POSES, name=v), (None, "a")),
    "residual": (lambda v: problem().add_residuals(v), ()),
    "rows": (lambda v: problem().blocks[0][v], ()),
    "options": (lambda v: problem().solve(v), (None,)),
    "start": (lambda v: problem().solve(start=v), (None,)),
    "incremental options": (bp.IncrementalProblem, (None,)),
    "checked": (bp.check_jacobian, ()),
    "prior": (lambda v: bp.residuals.Prior(v, POSES, sigma=1.0), ()),
    "reprojection": (lambda v: bp.residuals.Reprojection(v, np.zeros((2, 2))), ()),
    "graduated": (lambda v: bp.graduate(problem(), v), ()),
    "graduated problem": (lambda v: bp.graduate(v, ()), ()),
    "leaving": (lambda v: bp.marginalize(problem(), v, at=None), ()),
    "gauge": (lambda v: bp.marginalize((p := problem()), p.blocks[0][0], at=None, gauge=v), (None,)),
    "meanings": (bp.world_gauge, ()),
}


def _is_among(value: object, taken: tuple[object, ...]) -> bool:
    return any(value is one or (isinstance(one, (int, str)) and type(value) is type(one) and value == one) for one in taken)


@pytest.mark.parametrize("door", DOORS)
def test_another_kind_of_thing_is_refused_in_one_form(door: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    call, taken = DOORS[door]
    for value in OTHERS:
        if _is_among(value, taken):
            continue
        with pytest.raises(bp.InputError) as error:
            call(value)
        assert error.value.expected and error.value.got and error.value.advice


@pytest.mark.parametrize("manifold", [bp.SE3, bp.SE3Left, bp.BodyPose, bp.CameraPose, bp.UnitQuaternion, bp.UnitQuaternionLeft])
def test_quaternions_of_zeros_are_no_points(manifold: bp.Manifold) -> None:
    good = np.tile(manifold.identity(), (2, 1))
    none = good.copy()
    none[1, :4] = 0.0
    with pytest.raises(bp.InputError, match="x with unit quaternions wxyz first – got length 0 in row 1"):
        manifold.boxplus(none, np.zeros(manifold.dof))
    with pytest.raises(bp.InputError, match="base with unit quaternions"):
        manifold.boxminus(good, none)
    unknown = good.copy()
    unknown[1] = np.nan  # what is not known stays so
    assert np.isnan(manifold.boxplus(unknown, np.zeros(manifold.dof))).any(axis=1).tolist() == [False, True]


def test_a_few_sentences() -> None:
    for call, text in (
        (lambda: bp.Pinhole("a", 500.0, 320.0, 240.0), "expected fx positive and finite [px] – got 'a' – "),
        (lambda: bp.open_recording(3), "expected the path of a recording, as text – got 3 – give its name"),
        (
            lambda: bp.LidarInertialOdometry({"scan_voxel": 0.5}),
            "expected a LioConfig – got {'scan_voxel': 0.5} – write LioConfig(…), with settings by name",
        ),
        (lambda: bp.evaluate("a.tum", WAY), "expected a Trajectory as estimate – got 'a.tum' – read it with read_trajectory"),
    ):
        with pytest.raises(bp.InputError) as error:
            call()
        assert str(error.value).startswith(text)


def test_numbers_of_numpy_are_numbers() -> None:
    K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]], dtype=np.float32)
    assert bp.Pinhole(K[0, 0], K[1, 1], np.array(320), np.int64(240)).fx == 500.0
