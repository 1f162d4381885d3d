"""One camera alone: the start and its refusals, the path up to scale, and what happens when the view is lost."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import InputError
from boxplus.evaluation.alignment import align
from boxplus.manifolds import quaternion, se3, so3
from boxplus.sensors.images.image import Image
from boxplus.simulation.cameras import make_rig, simulate_cameras
from boxplus.systems.direct_odometry import direct_odometry
from boxplus.systems.direct_odometry.config import DirectOdometryConfig
from boxplus.systems.direct_odometry.direct_odometry import DirectOdometry
from boxplus.systems.direct_odometry.estimate import Estimate
from boxplus.systems.direct_odometry.two_view_start import TwoViews, TwoViewStart
from tests.systems.direct_odometry.scenes import CAMERA, SHAPE, Room

pytest.importorskip("cv2")
Matrix = NDArray[np.float64]


def sideways(seed: int, frames: int) -> Matrix:
    """(frames, 7) past a corner of the room, so that depths differ, with slow turns."""
    t, rng = np.arange(frames)[:, None], np.random.default_rng(seed)
    turns = np.array([0.0, 0.65, 0.0]) + 0.02 * np.sin(0.15 * t) * rng.normal(size=3)
    T: Matrix = se3.exp(np.concatenate([turns, np.zeros((frames, 3))], axis=1))
    T[:, 4:] = np.array([0.5, 0.0, -0.5]) + t * np.array([-0.025, 0.004, 0.012]) + 0.02 * np.sin(0.2 * t) * rng.normal(size=3)
    return T


def images(room: Room, T: Matrix, seed: int, noise: float = 1.5) -> list[Matrix]:
    rng = np.random.default_rng([seed, 9])
    return [np.clip(np.rint(room.render(pose)[0] + rng.normal(0.0, noise, SHAPE)), 0.0, 255.0) for pose in T]


def start_of(greys: list[Matrix]) -> tuple[TwoViews | None, str]:
    start = TwoViewStart(CAMERA)
    for k, grey in enumerate(greys):
        found = start.push(k, Image.from_array(grey))
        if found is not None:
            return found, ""
    return None, start.problem


@pytest.mark.slow
@pytest.mark.parametrize("seed", [5, 7, 9])
def test_two_views_give_the_motion_up_to_scale(seed: int) -> None:
    room, T = Room(seed), sideways(seed, 25)
    found, problem = start_of(images(room, T, seed))
    assert found is not None, problem
    first, last = found.time_ns
    T_true = se3.compose(se3.inverse(T[last]), T[first])
    turned = se3.log(se3.compose(found.T_21, se3.inverse(T_true)))[:3]
    t, t_true = (x[4:] / np.linalg.norm(x[4:]) for x in (found.T_21, T_true))
    assert np.degrees(np.linalg.norm(turned)) < 1.0
    assert np.degrees(np.arccos(t @ t_true)) < 6.0
    depth = room.render(T[first])[1]
    unit = np.linalg.norm(T_true[4:]) / np.linalg.norm(found.T_21[4:])
    assert 0.6 < unit / np.median(depth) < 1.6  # about: that of the corners
    low, high = unit / found.within[1], unit / found.within[0]
    assert low < np.quantile(depth, 0.05) and high > np.quantile(depth, 0.95)


def test_a_turn_alone_is_refused_with_the_parallax_that_is_missing() -> None:
    T = sideways(0, 25)
    T[:, 4:] = T[0, 4:]
    T[:, :4] = se3.exp(np.arange(25)[:, None] * np.array([0.002, 0.006, 0.001, 0.0, 0.0, 0.0]))[:, :4]
    found, problem = start_of(images(Room(0), T, 0))
    assert found is None
    assert "of which a rotation leaves" in problem and "(1.7 are needed)" in problem


@pytest.mark.parametrize(("texture", "gain"), [(0.2, 1.0), (35.0, 0.01)], ids=["no texture", "dark"])
def test_nothing_to_see_is_refused_with_the_corners_that_are_missing(texture: float, gain: float) -> None:
    greys = [gain * grey for grey in images(Room(0, texture), sideways(0, 6), 0)]
    found, problem = start_of(greys)
    assert found is None
    assert "corners are seen (40 are needed)" in problem


def run(greys: list[Matrix]) -> tuple[DirectOdometry, list[Estimate | None]]:
    odometry = DirectOdometry(CAMERA)
    return odometry, [odometry.push_mono(round(k * 1e9 / 30.0), grey) for k, grey in enumerate(greys)]


@pytest.mark.slow
def test_the_path_is_true_up_to_scale() -> None:
    simulation = simulate_cameras("room_moving", 1, duration_s=2.6, rig=make_rig("mono", None, 0.45, 20.0))
    frames = [simulation.image(0, k) for k in range(simulation.image_count)]
    camera = simulation.scenario.rig.cameras[0].sensor.lens.model()
    assert isinstance(camera, Pinhole)
    odometry = DirectOdometry(camera)
    estimates = [odometry.push_mono(frame.time_ns, frame.grey()) for frame in frames]
    assert estimates[0] is None and odometry.start_problem
    begun = [k for k, estimate in enumerate(estimates) if estimate is not None]
    found = [estimate for estimate in estimates if estimate is not None]
    assert len(found) > 25 and estimates[begun[0] :] == found  # no frame without an estimate from the start on
    assert {estimate.status for estimate in found} == {"ok"}
    T = simulation.T_world_camera(0, [frames[k].time_ns for k in begun])
    p, truth = np.array([e.p_world_camera for e in found]), T[:, :3, 3]
    aligned = align(p, truth, "sim3")
    error = truth - (aligned.scale * p @ aligned.R_world_estimate.T + aligned.p_world_estimate)
    way = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    assert np.sqrt((error**2).sum(axis=1).mean()) < 0.01 * way
    turned = found[0].R_world_camera.T @ found[-1].R_world_camera
    turned_true = T[0, :3, :3].T @ T[-1, :3, :3]
    assert np.degrees(np.linalg.norm(so3.log(turned.T @ turned_true))) < 0.7
    assert np.linalg.eigvalsh(found[-1].pose_covariance)[0] > 0.0


def test_the_unit_of_length_is_held() -> None:
    odometry, estimates = run(images(Room(7), sideways(7, 18), 7))
    assert estimates[-1] is not None
    first, second = odometry.window.keyframes[:2]
    way = second.T_world_camera[4:] - first.T_world_camera[4:]
    along = quaternion.to_matrix(second.T_world_camera[:4]).T @ way
    share = np.sqrt(along @ odometry.window.covariance(second)[3:, 3:] @ along) / (way @ way)
    assert share < 2e-3  # the rest is known far less well
    assert np.sqrt(np.trace(odometry.window.covariance(second)[3:, 3:])) > 2.0 * share * np.linalg.norm(way)


@pytest.mark.slow
def test_after_a_view_that_was_lost_for_good_nothing_is_trusted() -> None:
    greys = images(Room(7), sideways(7, 75), 7)
    greys[25:60] = [np.full(SHAPE, 20.0)] * 35
    odometry, estimates = run(greys)
    assert all(e is not None and e.status == "lost" for e in estimates[25:60])
    assert odometry.gaps == 1
    assert any("no two views tell depths again" in reason for e in estimates[25:60] if e is not None for reason in e.reasons)
    again = [e for e in estimates[60:] if e is not None]
    assert {e.status for e in again} <= {"lost", "weak"}


@pytest.mark.slow
@pytest.mark.parametrize("adjustments", [0, 5])
def test_a_new_start_knows_its_pose_no_better_than_the_loss_allows(adjustments: int) -> None:
    """35 frames of 1/30 s without light, at 1 m/s and 1 rad/s; both keyframes rest on the first."""
    greys = images(Room(7), sideways(7, 75), 7)
    greys[25:60] = [np.full(SHAPE, 20.0)] * 35
    odometry = DirectOdometry(CAMERA, DirectOdometryConfig(adjustments=adjustments))
    estimates = [odometry.push_mono(round(k * 1e9 / 30.0), grey) for k, grey in enumerate(greys)]
    weak = [e for e in estimates[60:] if e is not None and e.status == "weak"]
    assert weak and "for 1.2 s no pose" in weak[0].reasons[0]
    for estimate in weak:
        assert np.sqrt(np.linalg.eigvalsh(estimate.pose_covariance[3:, 3:])[0]) > 1.1
    assert odometry.gaps == 1


def test_views_that_are_rejected_are_no_keyframes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(direct_odometry, "_LEAST_FOUND", 10.0)
    odometry, estimates = run(images(Room(7), sideways(7, 18), 7))
    assert "patches are found where corners say" in odometry.start_problem
    assert estimates == [None] * 18
    assert odometry.keyframes == 0


def test_little_depth_of_a_sensor_is_filled_by_the_motion() -> None:
    """Where only half of the image has depths, the window has points in the other half too, at true distances."""
    T, room = sideways(2, 30), Room(2)
    odometry = DirectOdometry(CAMERA, T_world_camera=T[0])
    for k, (grey, pose) in enumerate(zip(images(room, T, 2), T, strict=True)):
        depth = room.render(pose)[1]
        if k:
            depth[:, 80:] = 0.0
        assert odometry.push_rgbd(k, grey, depth).status == "ok"
    newest = odometry.window.keyframes[-1]
    u, v = newest.patches.pixels.astype(np.int64).T
    assert newest.number > 0 and (u > 90).sum() > 20
    depth = room.render(T[round(newest.time_ns)])[1]
    assert np.median(np.abs(1.0 / newest.patches.rho / depth[v, u] - 1.0)[u > 90]) < 0.02


def test_an_image_of_another_size_is_refused_before_the_start_too() -> None:
    odometry, grey = DirectOdometry(CAMERA), Room(7).render(sideways(7, 1)[0])[0]
    assert odometry.push_mono(0, grey) is None
    with pytest.raises(InputError, match="images of shape"):
        odometry.push_mono(1, grey[:100])
    assert odometry.push_mono(1, grey) is None
