"""Direct alignment: a synthetic plane, rendered and recorded image pairs, and what it says when it cannot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import InputError
from boxplus.manifolds import quaternion, se3
from boxplus.optimization.losses import Squared, UserLoss
from boxplus.residuals.camera.photometric import Photometric
from boxplus.sensors.images.image import Image
from boxplus.systems.direct_alignment.direct_alignment import align_rgbd
from tests.systems.direct_alignment.stereo_depth import stereo_depth

CAMERA = Pinhole(100.0, 104.0, 79.5, 59.5)


def read_png(file: Path) -> NDArray[np.float32]:
    from PIL import Image as PngImage

    return np.asarray(PngImage.open(file)).astype(np.float32)


def degrees_and_metres(T: NDArray[np.float64], T_true: NDArray[np.float64]) -> tuple[float, float]:
    turned = se3.log(se3.compose(T, se3.inverse(T_true)))[:3]
    return float(np.degrees(np.linalg.norm(turned))), float(np.linalg.norm(T[4:] - T_true[4:]))


def textured_plane(seed: int, T_21: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float32]]:
    """A textured plane 3 m before camera 1, tilted, with its depth; and how camera 2 sees it."""
    rng = np.random.default_rng(seed)
    texture = gaussian_filter(rng.normal(size=(900, 900)), 6.0)
    texture *= 60.0 / texture.std()
    normal, distance = np.array([0.2, -0.1, 1.0]), 3.0
    v, u = np.mgrid[:120, :160]
    pixels = np.stack([u, v], axis=-1).astype(np.float64)
    rays = CAMERA.unproject(pixels)[0]

    def grey(p_1: NDArray[np.float64]) -> NDArray[np.float32]:
        at = 450.0 + 100.0 * p_1[..., [1, 0]]
        return map_coordinates(texture, np.moveaxis(at, -1, 0), order=3).astype(np.float32)

    depth = distance / (rays @ normal)
    # A ray of camera 2 meets the plane nᵀ p = d of camera 1 where nᵀ(s Rᵀ m − Rᵀ t) = d.
    R, t = quaternion.to_matrix(T_21[:4]), T_21[4:]
    s = (distance + normal @ R.T @ t) / (rays @ R @ normal)
    return grey(depth[..., None] * rays), depth, grey((s[..., None] * rays - t) @ R)


def mean_error(camera: Pinhole, first: Image, depth: NDArray[np.float32], second: Image, T_21: NDArray[np.float64]) -> float:
    """Mean |e| at a pose [grey values], by the residual that bundle adjustments use."""
    rows, columns = np.nonzero(depth > 0.0)
    inner = (columns > 0) & (rows > 0) & (columns < depth.shape[1] - 1) & (rows < depth.shape[0] - 1)
    pixels = np.stack([columns, rows], axis=1)[inner].astype(float)
    residual = Photometric(camera, first.grey, second.grey, pixels, depth[rows[inner], columns[inner]])
    e = residual.evaluate(T_21)
    return float(np.abs(e[e != 0.0]).mean())


@pytest.mark.parametrize("points", [None, 5000], ids=["all", "chosen"])
@pytest.mark.parametrize("loss", [None, Squared()], ids=["Huber", "Squared"])
def test_synthetic_motion_is_found(loss: object, points: int | None) -> None:
    T_21 = se3.exp(np.array([0.03, -0.04, 0.05, 0.08, -0.05, 0.1]))
    first, depth, second = textured_plane(1, T_21)
    found = align_rgbd(first, depth, second, CAMERA, levels=4, points=points, loss=loss)  # type: ignore[arg-type]
    degrees, metres = degrees_and_metres(found.T_21, T_21)
    assert found.status == "converged" and degrees < 0.01 and metres < 5e-4
    assert len(found.iterations) == 4 and found.overlap > 0.8 and found.mean_error < 2.0  # of a texture of 60
    assert found.pixels == round(found.overlap * 120 * 160) if points is None else found.pixels <= points
    # The errors are within a few times what the covariance says: interpolation is not white noise.
    error = se3.log(se3.compose(found.T_21, se3.inverse(T_21)))
    assert (np.abs(error) < 20.0 * np.sqrt(np.diag(found.covariance))).all()


@pytest.mark.parametrize("points", [None, 5000], ids=["all", "chosen"])
def test_covariance_is_that_of_white_noise(points: int | None) -> None:
    """Over noisy copies of a pair, errors have the covariance stated; noise in image 1, as interpolation would smooth it."""
    T_21 = se3.exp(np.array([0.01, 0.005, -0.01, 0.02, 0.01, -0.02]))
    first, depth, second = textured_plane(2, T_21)
    rng, errors, variances = np.random.default_rng(5), [], []
    for _ in range(30):
        noisy = first + rng.normal(size=first.shape).astype(np.float32) * 4.0
        found = align_rgbd(noisy, depth, second, CAMERA, levels=2, points=points)
        errors.append(se3.log(se3.compose(found.T_21, se3.inverse(T_21))))
        variances.append(np.diag(found.covariance))
    ratio = np.var(errors, axis=0) / np.mean(variances, axis=0)
    assert (ratio > 0.4).all() and (ratio < 2.5).all()


def test_outliers_do_not_move_it() -> None:
    T_21 = se3.exp(np.array([0.02, -0.02, 0.01, 0.05, -0.03, 0.04]))
    first, depth, second = textured_plane(3, T_21)
    second[40:75, 50:90] = 255.0  # something came into view
    robust = align_rgbd(first, depth, second, CAMERA, levels=4)
    plain = align_rgbd(first, depth, second, CAMERA, levels=4, loss=Squared())
    assert degrees_and_metres(robust.T_21, T_21)[0] < 0.1 * degrees_and_metres(plain.T_21, T_21)[0]
    assert degrees_and_metres(robust.T_21, T_21)[1] < 5e-3


def test_pixels_without_depth_are_left_out() -> None:
    T_21 = se3.exp(np.array([0.01, -0.02, 0.01, 0.03, -0.03, 0.02]))
    first, depth, second = textured_plane(4, T_21)
    depth[:, :50], depth[:, 50:60] = 0.0, np.nan
    found = align_rgbd(first, depth, second, CAMERA, levels=3)
    assert found.pixels <= 120 * 100 and degrees_and_metres(found.T_21, T_21)[1] < 1e-3


def test_it_says_when_it_cannot() -> None:
    first, depth, second = textured_plane(5, se3.exp(np.zeros(6)))
    flat = align_rgbd(np.full_like(first, 9.0), depth, np.full_like(first, 9.0), CAMERA, levels=2)
    assert flat.status == "unobservable" and np.isnan(flat.covariance).all()
    stripes = np.tile(100.0 * np.sin(0.2 * np.arange(160)), (120, 1))
    assert align_rgbd(stripes, depth, stripes, CAMERA, levels=1).status == "unobservable"  # sliding along them changes nothing
    away = align_rgbd(first, depth, second, CAMERA, T_21=[1.0, 0, 0, 0, 50.0, 0, 0], levels=2)
    assert away.status == "little overlap" and away.overlap == 0.0
    short = align_rgbd(first, depth, textured_plane(5, se3.exp(np.full(6, 0.01)))[2], CAMERA, levels=1, max_iterations=1)
    assert short.status == "iteration limit" and short.iterations == (1,)
    same = align_rgbd(first, depth, first, CAMERA, levels=2)
    assert same.status == "converged" and np.abs(same.T_21 - [1, 0, 0, 0, 0, 0, 0]).max() < 1e-9


def squared(s: float) -> tuple[float, float, float]:
    return s, 1.0, 0.0


def test_refusals() -> None:
    first, depth, second = textured_plane(6, se3.exp(np.zeros(6)))
    with pytest.raises(InputError, match="two images of the same shape"):
        align_rgbd(first, depth, second[:, 1:], CAMERA)
    with pytest.raises(InputError, match=r"depth_1 of shape \(120, 160\)"):
        align_rgbd(first, depth[1:], second, CAMERA)
    with pytest.raises(InputError, match="depth_1 not negative"):
        align_rgbd(first, -depth, second, CAMERA)
    with pytest.raises(InputError, match="at least 100 pixels with depth – got 0"):
        align_rgbd(first, np.zeros_like(depth), second, CAMERA)
    with pytest.raises(InputError, match="1 to 6 levels"):
        align_rgbd(first, depth, second, CAMERA, levels=9)
    with pytest.raises(InputError, match="kernels of direct alignment know – got squared"):
        align_rgbd(first, depth, second, CAMERA, loss=UserLoss(squared))
    with pytest.raises(InputError, match="max_iterations at least 1"):
        align_rgbd(first, depth, second, CAMERA, max_iterations=0)


def test_tum_pair_reaches_the_stated_twist(shared_data: Path) -> None:
    folder = shared_data / "rgbd" / "tum_mvg_pairs"
    found = align_rgbd(
        read_png(folder / "rgb" / "1305031102.275326.png"),
        read_png(folder / "depth" / "1305031102.262886.png") / 5000.0,
        read_png(folder / "rgb" / "1305031102.175304.png"),
        Pinhole(517.3, 516.5, 318.6, 255.3),
    )
    v, w = (-0.0021, 0.0057, 0.0374), (-0.0292, -0.0183, -0.0009)
    degrees, metres = degrees_and_metres(found.T_21, se3.exp(np.array([*w, *v])))
    assert found.status == "converged" and degrees < 0.1 and metres < 0.002


def test_tsukuba_neighbours_reach_the_rendered_poses(shared_data: Path) -> None:
    """Depth from the stereo pair of the first frame; the track is in cm and degrees, y up and z back."""
    folder = shared_data / "rgbd" / "new_tsukuba_5"
    lit = folder / "illumination" / "daylight"

    def image(side: str, number: int) -> Image:
        return Image.from_array(read_png(lit / side / f"tsukuba_daylight_{side[0].upper()}_00{number}.png"))

    left = image("left", 201)
    depth = stereo_depth(left.grey, image("right", 201).grey, 615.0, 0.1)
    assert np.count_nonzero(depth) > 0.4 * depth.size
    track = np.loadtxt(folder / "groundtruth" / "camera_track.txt", delimiter=",")
    flip = np.diag([1.0, -1.0, -1.0])
    R = flip @ Rotation.from_euler("xyz", track[:, 3:], degrees=True).as_matrix() @ flip
    p = 0.01 * track[:, :3] @ flip
    for k in range(1, 5):
        found = align_rgbd(left, depth, image("left", 201 + k), Pinhole(615.0, 615.0, 320.0, 240.0))
        T_true = np.concatenate([quaternion.from_matrix(R[k].T @ R[0]), R[k].T @ (p[0] - p[k])])
        degrees, metres = degrees_and_metres(found.T_21, T_true)
        assert found.status == "converged" and degrees < 0.05 and metres < 0.002, f"201 to {201 + k}: {degrees}, {metres}"


@pytest.mark.slow
def test_slambook_pairs_agree_with_each_other(shared_data: Path) -> None:
    """Turns of 49 and 36 degrees from identity.

    The poses of the file are off by half a degree and more: at them the images differ by 2.6 to 4.4 grey values, at those
    found by about 1, and these close every loop to hundredths of a degree.
    """
    folder = shared_data / "rgbd" / "slambook2_ch12_rgbd"
    rows = np.loadtxt(folder / "pose.txt")
    flip = np.diag([1.0, -1.0, 1.0])  # fy is negative: y points up
    camera = Pinhole(481.2, 480.0, 319.5, 239.5)
    R = flip @ Rotation.from_quat(rows[:, 3:]).as_matrix() @ flip
    p = rows[:, :3] @ flip
    images = {i: Image.from_array(read_png(folder / "color" / f"{i}.png")) for i in (1, 2, 4)}
    depths = {i: read_png(folder / "depth" / f"{i}.png") / 5000.0 for i in (1, 2, 4)}
    found = {}
    for i, j in ((1, 2), (2, 1), (1, 4), (4, 1)):
        found[i, j] = align_rgbd(images[i], depths[i], images[j], camera, points=None, search_deg=50.0)
        assert found[i, j].status == "converged" and found[i, j].mean_error < 1.5
        T_file = np.concatenate([quaternion.from_matrix(R[j - 1].T @ R[i - 1]), R[j - 1].T @ (p[i - 1] - p[j - 1])])
        degrees, metres = degrees_and_metres(found[i, j].T_21, T_file)
        assert degrees < 0.8 and metres < 0.02
        assert mean_error(camera, images[i], depths[i], images[j], T_file) > 1.3 * found[i, j].mean_error
    for i, j in ((1, 2), (1, 4)):
        there_and_back = se3.compose(found[j, i].T_21, found[i, j].T_21)
        degrees, metres = degrees_and_metres(there_and_back, np.array([1.0, 0, 0, 0, 0, 0, 0]))
        assert degrees < 0.05 and metres < 0.002
