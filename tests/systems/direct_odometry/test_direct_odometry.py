"""Whole runs in a rendered room: accuracy, covariance, light, loss and return; and short cuts of recordings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import InputError
from boxplus.manifolds import quaternion, se3
from boxplus.sensors.images.image import Image
from boxplus.systems.direct_odometry.config import DirectOdometryConfig
from boxplus.systems.direct_odometry.depth.sensed_depth import StereoPair
from boxplus.systems.direct_odometry.direct_odometry import DirectOdometry
from boxplus.systems.direct_odometry.estimate import Estimate
from boxplus.systems.direct_odometry.verdict import Tracked
from tests.systems.direct_odometry.scenes import CAMERA, SHAPE, Drive, Room, drive, errors

SHARED = Path(__file__).resolve().parents[4] / "shared" / "data"
Matrix = NDArray[np.float64]


def run(seen: Drive, config: DirectOdometryConfig | None = None) -> tuple[DirectOdometry, list[Estimate]]:
    odometry = DirectOdometry(CAMERA, config)
    return odometry, [odometry.push_rgbd(t, g, z) for t, g, z in zip(seen.time_ns, seen.grey, seen.depth, strict=True)]


def nees(estimate: Estimate, T_true: Matrix) -> float:
    """Of the pose, rotation on the right, position along the world's axes."""
    turned = se3.log(se3.compose(se3.inverse(T_true), estimate.T_world_camera))[:3]
    e = np.concatenate([turned, estimate.p_world_camera - T_true[4:]])
    return float(e @ np.linalg.solve(estimate.pose_covariance, e))


@pytest.fixture(scope="module")
def drives() -> list[Drive]:
    return [drive(seed, 22) for seed in range(20, 26)]


@pytest.mark.slow
def test_poses_are_true_and_covariances_honest(drives: list[Drive]) -> None:
    """Rotation and translation parallel to a wall are hard to tell apart: 2 cm at 3 m are 0.4 degrees."""
    of_end = []
    for seen in drives:
        odometry, estimates = run(seen)
        assert [e.status for e in estimates] == ["ok"] * len(estimates)
        degrees, metres = errors(estimates[-1].T_world_camera, seen.T[-1])
        assert degrees < 0.4
        assert metres < 0.02
        assert odometry.keyframes == sum(e.is_keyframe for e in estimates) >= 1
        of_end.append(nees(estimates[-1], seen.T[-1]) / 6.0)
    # 36 degrees of freedom have a mean of 0.6 to 1.5 in 95 %; the interpolation's own errors come on top.
    assert 0.3 < np.mean(of_end) < 3.0


@pytest.mark.parametrize("again", [1, 3])
def test_an_image_that_comes_again_in_motion_is_no_standstill(drives: list[Drive], again: int) -> None:
    seen, odometry = drives[0], DirectOdometry(CAMERA)
    buffer, estimates = np.empty_like(seen.grey[0]), []
    for k, (t, z) in enumerate(zip(seen.time_ns, seen.depth, strict=True)):
        buffer[:] = seen.grey[9 if 9 <= k <= 9 + again else k]  # a driver that fills one buffer
        estimates.append(odometry.push_rgbd(t, buffer, z))
    frozen = range(10, 10 + again)
    assert [k for k, e in enumerate(estimates) if e.status == "lost"] == list(frozen)
    assert all("to the bit" in estimates[k].reasons[0] and nees(estimates[k], seen.T[k]) < 12.0 for k in frozen)
    assert all(e.status == "ok" for e in estimates[10 + again :])
    degrees, metres = errors(estimates[-1].T_world_camera, seen.T[-1])
    assert degrees < 0.4 and metres < 0.02


def test_a_camera_that_stops_for_good_is_followed_again_and_doubted(drives: list[Drive]) -> None:
    """Nothing tells a source without noise that stops between two images from one that stalls: after `lost_s` it begins anew."""
    seen, odometry, estimates = drives[0], DirectOdometry(CAMERA), []
    for k in range(60):
        i = min(k, 9)
        estimates.append(odometry.push_rgbd(int(seen.time_ns[0]) + k * 33_000_000, seen.grey[i], seen.depth[i]))
    last_lost = max(k for k, e in enumerate(estimates) if e.status == "lost")
    assert 30 < last_lost < 45 and odometry.gaps == 1
    assert all(e.status == "weak" and e.reasons for e in estimates[last_lost + 1 :])


def test_equal_images_at_rest_are_believed(drives: list[Drive]) -> None:
    odometry, seen = DirectOdometry(CAMERA), drives[0]
    estimates = [odometry.push_rgbd(k * 33_000_000, seen.grey[0], seen.depth[0]) for k in range(6)]
    assert [e.status for e in estimates] == ["ok"] * 6
    assert np.linalg.norm(estimates[-1].p_world_camera) < 1e-3


def test_changing_light_costs_little(drives: list[Drive]) -> None:
    """Root mean square over runs, against the same images at their mean brightness."""
    squares = {"unchanged": 0.0, "changing": 0.0}
    for seen in drives:
        gains = {"unchanged": np.ones(len(seen.T)), "changing": 1.0 + 0.3 * np.sin(0.5 * np.arange(len(seen.T)))}
        for name, gain in gains.items():
            grey = [np.clip(np.rint(0.7 * g * k), 0.0, 255.0) for g, k in zip(seen.grey, gain, strict=True)]
            estimates = run(Drive(seen.time_ns, seen.T, grey, seen.depth))[1]
            assert {e.status for e in estimates} == {"ok"}
            squares[name] += sum(errors(e.T_world_camera, T)[1] ** 2 for e, T in zip(estimates, seen.T, strict=True))
    assert squares["changing"] < 1.3**2 * squares["unchanged"]


def test_back_at_the_start_the_pose_is_the_start(drives: list[Drive]) -> None:
    """The first keyframe is still in the window, and is tracked again."""
    seen = drives[1]
    back = Drive(
        seen.time_ns + [t + seen.time_ns[-1] + 33_000_000 for t in seen.time_ns[:-1]],
        np.concatenate([seen.T, seen.T[-2::-1]]),
        seen.grey + [g + np.random.default_rng(k).normal(0.0, 2.0, SHAPE) for k, g in enumerate(seen.grey[-2::-1])],
        seen.depth + seen.depth[-2::-1],
    )
    odometry, estimates = run(back)
    degrees, metres = errors(estimates[-1].T_world_camera, back.T[-1])
    assert degrees < 0.05
    assert metres < 0.002
    assert odometry.keyframes < len(back.T) // 4


@pytest.mark.parametrize("seed", [0, 2, 4])
def test_a_small_thing_of_high_contrast_that_moves_is_not_followed(seed: int) -> None:
    seen = drive(seed, 14)
    paint = np.kron(np.random.default_rng(4).integers(0, 2, (5, 6)), np.ones((5, 5))) * 255.0
    for k in range(1, 14):
        rows, columns = slice(40, 65), slice(max(110 - 8 * k, 0), max(110 - 8 * k, 0) + 30)
        seen.grey[k][rows, columns], seen.depth[k][rows, columns] = paint, 0.8
    _, estimates = run(seen)
    off = [errors(estimate.T_world_camera, T)[1] for estimate, T in zip(estimates, seen.T, strict=True)]
    assert max(off) < 0.06  # 0.13 to 0.19 m where the thing is followed, by half of its way


def test_a_covered_lens_is_lost_and_comes_back(drives: list[Drive]) -> None:
    seen = drives[2]
    rng = np.random.default_rng(0)
    covered = [np.rint(rng.normal(8.0, 2.0, SHAPE)) if 8 <= k < 14 else g for k, g in enumerate(seen.grey)]
    _, estimates = run(Drive(seen.time_ns, seen.T, covered, seen.depth))
    assert [e.status for e in estimates] == ["ok"] * 8 + ["lost"] * 6 + ["ok"] * 8
    assert all(e.reasons for e in estimates[8:14])
    lost = [np.trace(e.pose_covariance) for e in estimates[8:14]]
    assert np.all(np.diff(lost) > 0.0)
    degrees, metres = errors(estimates[-1].T_world_camera, seen.T[-1])
    assert degrees < 0.4
    assert metres < 0.02
    assert nees(estimates[13], seen.T[13]) < 20.0


def test_a_view_that_never_comes_back_begins_anew_and_says_so(drives: list[Drive]) -> None:
    first, other = drives[3], drives[4]
    grey, depth = first.grey[:6] + other.grey[6:], first.depth[:6] + other.depth[6:]
    _, estimates = run(Drive(first.time_ns, first.T, grey, depth), DirectOdometryConfig(lost_s=0.2))
    statuses = [e.status for e in estimates]
    assert statuses[:6] == ["ok"] * 6
    assert statuses[6:12] == ["lost"] * 6
    assert set(statuses[13:]) == {"weak"}
    assert "is a guess" in estimates[-1].reasons[0]
    assert np.sqrt(estimates[-1].pose_covariance[3, 3]) > 0.2


def test_the_longer_no_keyframe_is_found_the_less_is_known_of_the_pose(drives: list[Drive]) -> None:
    """Without depth nothing can begin: the loss ends where a frame has depth again, not where it was given up."""
    seen = drives[3]
    odometry = DirectOdometry(CAMERA, DirectOdometryConfig(lost_s=0.2))
    times = [k * 100_000_000 for k in range(40)]
    estimates = []
    for k, time_ns in enumerate(times):
        blind = 5 <= k < 35
        grey = np.full(SHAPE, 20.0) if blind else seen.grey[k % 5]
        estimates.append(odometry.push_rgbd(time_ns, grey, np.zeros(SHAPE) if blind else seen.depth[k % 5]))
    assert [e.status for e in estimates] == ["ok"] * 5 + ["lost"] * 30 + ["weak"] * 5
    metres = np.array([np.sqrt(e.pose_covariance[3, 3]) for e in estimates[5:]])
    np.testing.assert_allclose(metres[:31], 0.1 * np.arange(1, 32), rtol=1e-3)  # at 1 m/s, and without a step at the return
    assert np.all(metres[31:] > 3.0)
    assert "for 3.1 s no pose" in estimates[-1].reasons[0]
    assert odometry.gaps == 1
    assert odometry.keyframes == sum(e.is_keyframe for e in estimates)


def test_a_keyframe_after_a_gap_has_depths_of_the_sensor_alone(drives: list[Drive]) -> None:
    """Where the old keyframes are from here is a guess, and depths by it would be too."""
    seen = drives[3]
    odometry = DirectOdometry(CAMERA, DirectOdometryConfig(lost_s=0.2))
    for k in range(6):
        odometry.push_rgbd(seen.time_ns[k], seen.grey[k], seen.depth[k])
    half = seen.depth[8].copy()
    half[:, 80:] = 0.0
    dark = seen.time_ns[5] + 300_000_000
    assert odometry.push_rgbd(dark, np.full(SHAPE, 20.0), np.zeros(SHAPE)).status == "lost"
    assert odometry.gaps == 1
    assert odometry.push_rgbd(dark + 33_000_000, seen.grey[8], half).is_keyframe
    newest = odometry.window.keyframes[-1]
    assert len(newest.patches) > 50
    assert newest.patches.pixels[:, 0].max() < 80
    assert all(level.pixels[:, 0].max() * 2**level.octave < 80 for level in newest.tracker.levels)


def test_a_wall_without_texture_gives_no_pose() -> None:
    seen = drive(30, 8, texture=0.5, noise=1.0)
    _, estimates = run(seen)
    assert all(e.status != "ok" for e in estimates[1:])


def test_texture_along_one_direction_gives_no_pose() -> None:
    stripes = np.tile(120.0 + 40.0 * np.sin(0.3 * np.arange(SHAPE[1])), (SHAPE[0], 1))
    rng = np.random.default_rng(0)
    grey = [np.rint(stripes + rng.normal(0.0, 2.0, SHAPE)) for _ in range(4)]
    seen = Drive([k * 33_000_000 for k in range(4)], np.tile(se3.SE3.identity(), (4, 1)), grey, [np.full(SHAPE, 2.0)] * 4)
    _, estimates = run(seen)
    assert all(e.status != "ok" for e in estimates[1:])


def test_stereo_poses_are_metric() -> None:
    room, seen = Room(40), drive(40, 12)
    T_right_left = np.array([1.0, 0.0, 0.0, 0.0, -0.2, 0.0, 0.0])
    rng = np.random.default_rng(4)
    odometry = DirectOdometry(CAMERA, stereo=StereoPair(CAMERA, T_right_left))
    for k, time_ns in enumerate(seen.time_ns):
        right = room.render(se3.compose(seen.T[k], se3.inverse(T_right_left)))[0] + rng.normal(0.0, 2.0, SHAPE)
        estimate = odometry.push_stereo(time_ns, seen.grey[k], right)
        assert estimate.status == "ok"
    assert np.linalg.norm(seen.T[-1, 4:]) > 0.1
    degrees, metres = errors(estimate.T_world_camera, seen.T[-1])
    assert degrees < 0.5
    assert metres < 0.03


def test_a_frame_that_fits_much_worse_than_others_becomes_a_keyframe() -> None:
    """Depths of a short base are coarse: the farther the camera goes, the worse the keyframe fits, until it is lost."""
    room, T_right_left = Room(0), np.array([1.0, 0.0, 0.0, 0.0, -0.03, 0.0, 0.0])
    rng, odometry = np.random.default_rng(0), DirectOdometry(CAMERA, stereo=StereoPair(CAMERA, T_right_left))
    best: dict[int, float] = {}
    for k in range(12):
        T = se3.exp([0.0, 0.5, 0.0, 0.0, 0.0, 0.0])
        T[4:] = [0.05 * k - 0.6, 0.0, -0.8]
        left, right = (
            room.render(pose)[0] + rng.normal(0.0, 1.0, SHAPE) for pose in (T, se3.compose(T, se3.inverse(T_right_left)))
        )
        estimate = odometry.push_stereo(33_000_000 * k, left, right)
        if k:
            best[estimate.keyframe] = min(best.get(estimate.keyframe, np.inf), estimate.sigma)
            assert estimate.is_keyframe or estimate.sigma <= 2.0 * best[estimate.keyframe]


def test_wrong_input_is_refused() -> None:
    seen = drive(50, 2)
    odometry = DirectOdometry(CAMERA)
    odometry.push_rgbd(10, seen.grey[0], seen.depth[0])
    with pytest.raises(InputError, match="frames in the order of time"):
        odometry.push_rgbd(10, seen.grey[1], seen.depth[1])
    with pytest.raises(InputError, match="the second camera"):
        odometry.push_stereo(20, seen.grey[1], seen.grey[1])


def test_images_of_another_size_are_refused() -> None:
    seen = drive(50, 1)
    odometry = DirectOdometry(CAMERA)
    odometry.push_rgbd(10, seen.grey[0], seen.depth[0])
    with pytest.raises(InputError, match="images of shape"):
        odometry.push_rgbd(20, seen.grey[0][:60], seen.depth[0][:60])


@pytest.mark.parametrize(
    ("mean", "sigma"),
    [(0.0, 0.0), (20.0, 0.3), (8.0, 2.0), (0.5, 1.0), (100.0, 8.0)],
    ids=["black", "flat", "dark", "cut", "rough"],
)
@pytest.mark.parametrize("shape", [SHAPE, (240, 320)], ids=["small", "large"])
def test_a_covered_lens_is_no_keyframe_and_one_gap(mean: float, sigma: float, shape: tuple[int, int]) -> None:
    """Noise has gradients too; what is covered from the first frame on is no start either."""
    rng, scale = np.random.default_rng(3), shape[0] / SHAPE[0]
    camera = Pinhole(150.0 * scale, 150.0 * scale, 80.0 * scale - 0.5, 60.0 * scale - 0.5)
    v, u = np.mgrid[: shape[0], : shape[1]] / scale
    texture = 120.0 + 40.0 * np.sin(0.3 * u + 0.05 * v) * np.cos(0.25 * v)
    odometry, depth = DirectOdometry(camera, DirectOdometryConfig(lost_s=0.2)), np.full(shape, 2.0)
    statuses = []
    for k in range(12):
        covered = np.clip(np.rint(rng.normal(mean, sigma, shape)), 0.0, 255.0)
        is_seen = 2 <= k < 4 or k >= 10
        grey = np.rint(texture + rng.normal(0.0, 2.0, shape)) if is_seen else covered
        statuses.append(odometry.push_rgbd(k * 100_000_000, grey, depth).status)
    assert statuses == ["lost"] * 2 + ["ok"] * 2 + ["lost"] * 6 + ["weak"] * 2
    assert (odometry.gaps, odometry.keyframes) == (1, 2)


def test_without_depth_there_is_nothing_to_track() -> None:
    odometry = DirectOdometry(CAMERA)
    estimate = odometry.push_rgbd(0, np.zeros(SHAPE), np.zeros(SHAPE))
    assert estimate.status == "lost"
    assert "have a depth and a gradient above noise" in estimate.reasons[0]
    seen = drive(51, 1)
    assert odometry.push_rgbd(1, seen.grey[0], seen.depth[0]).status == "ok"


def read_grey(file: Path) -> Matrix:
    from PIL import Image as Picture

    return np.asarray(Picture.open(file).convert("L")).astype(np.float64)


def pose(T: Matrix) -> Matrix:
    return np.concatenate([quaternion.from_matrix(T[:3, :3]), T[:3, 3]])


def test_recorded_rgbd_frames() -> None:
    """Every third of 7-Scenes: the poses given are those of KinectFusion, good to about 5 mm."""
    from PIL import Image as Picture

    folder = SHARED / "rgbd" / "7scenes_60"
    if not folder.is_dir():
        pytest.skip("no recording beside the repository")
    odometry, true = DirectOdometry(Pinhole(585.0, 585.0, 320.0, 240.0)), []
    for k in range(0, 31, 3):
        stem = str(folder / f"frame-{k:06d}")
        depth = np.asarray(Picture.open(stem + ".depth.png")).astype(np.float64) / 1000.0
        depth[depth > 10.0] = 0.0
        true.append(pose(np.loadtxt(stem + ".pose.txt")))
        estimate = odometry.push_rgbd(k * 33_333_333, read_grey(Path(stem + ".color.jpg")), depth)
        assert estimate.status == "ok"
    T_true = se3.compose(se3.inverse(true[0]), true[-1])
    assert np.linalg.norm(T_true[4:]) > 0.04
    degrees, metres = errors(estimate.T_world_camera, T_true)
    assert metres < 0.015
    assert degrees < 0.7


def test_recorded_stereo_frames() -> None:
    """Nine frames of KITTI: 9.6 m."""
    folder = SHARED / "cameras" / "kitti_stereo_36"
    if not folder.is_dir():
        pytest.skip("no recording beside the repository")
    camera = Pinhole(707.0912, 707.0912, 601.8873, 183.1104)
    odometry = DirectOdometry(camera, stereo=StereoPair(camera, (1, 0, 0, 0, -0.53715, 0, 0)))
    true = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)
    left, right = (sorted((folder / f"image_{side}").iterdir()) for side in "lr")
    for k in range(9):
        estimate = odometry.push_stereo(k * 100_000_000, read_grey(left[k]), read_grey(right[k]))
        assert estimate.status == "ok"
    length = np.linalg.norm(true[8][:, 3])
    assert abs(np.linalg.norm(estimate.p_world_camera) - length) < 0.01 * length


@pytest.mark.parametrize("ratio", [1.5, 1.0])
def test_a_frame_whose_view_is_nearly_lost_becomes_a_keyframe(
    drives: list[Drive], monkeypatch: pytest.MonkeyPatch, ratio: float
) -> None:
    """Grey values that differ by as much as a shift of half a pixel: by the next frame it may be a whole one.

    Where they always do, as noise of an image with little texture does, nothing is about to be lost.
    """
    seen, asked = drives[0], []
    plain = DirectOdometry._track

    def nearly_lost(odometry: DirectOdometry, image: Image, T_predicted: Matrix) -> Tracked:
        tracked = plain(odometry, image, T_predicted)
        alignment = replace(tracked.alignment, shift_px=0.6 if len(asked) == 3 else 0.1)
        asked.append(alignment.shift_px)
        return tracked._replace(alignment=alignment, verdict=tracked.verdict._replace(residual_ratio=ratio))

    monkeypatch.setattr(DirectOdometry, "_track", nearly_lost)
    config = DirectOdometryConfig(keyframe_flow=0.5, keyframe_flow_translation=0.5, keyframe_residual=50.0)
    odometry = DirectOdometry(CAMERA, config)
    estimates = [odometry.push_rgbd(t, g, z) for t, g, z in zip(seen.time_ns[:7], seen.grey, seen.depth, strict=False)]
    assert [k for k, estimate in enumerate(estimates) if estimate.is_keyframe] == ([0, 4] if ratio > 1.25 else [0])
