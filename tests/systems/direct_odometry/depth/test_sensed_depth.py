"""Depths of an RGB-D camera, and those found along epipolar lines."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.cameras.distortion import RadialTangential
from boxplus.cameras.pinhole import Pinhole
from boxplus.errors import InputError
from boxplus.manifolds import se3
from boxplus.sensors.images.image import Image
from boxplus.systems.direct_odometry.depth.sensed_depth import StereoPair, rgbd_depth
from tests.systems.direct_odometry.scenes import CAMERA, SHAPE, Room

NOISE = (0.0012, 0.0019, 0.4)
IMAGE = Image.from_array(np.zeros(SHAPE))
LENS = Pinhole(150.0, 148.0, 80.5, 58.0, RadialTangential(-0.28, 0.07, 1e-4, 2e-5))


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["rectified", "with lens distortion, turned"])
@pytest.mark.parametrize("seed", [0, 1])
def test_stereo_finds_depths_with_their_standard_deviation(camera: Pinhole, seed: int) -> None:
    T_right_left = np.array([1.0, 0.0, 0.0, 0.0, -0.2, 0.0, 0.0])
    if camera is LENS:
        T_right_left = se3.compose(se3.exp([0.01, -0.02, 0.015, 0.0, 0.0, 0.0]), T_right_left)
    rng, room = np.random.default_rng(seed), Room(seed)
    left, z = room.render(se3.exp([0.1, 0.3 * seed, 0.0, 0.1, 0.0, 0.0]), camera)
    right, _ = room.render(se3.compose(se3.exp([0.1, 0.3 * seed, 0.0, 0.1, 0.0, 0.0]), se3.inverse(T_right_left)), camera)
    noisy = [Image.from_array(grey + rng.normal(0.0, 1.0, SHAPE)) for grey in (left, right)]
    found = StereoPair(camera, T_right_left).depth(*noisy, camera)
    known = found.z > 0.0
    error = (found.z - z)[known] / found.sigma[known]
    assert known.sum() > 1500
    assert np.mean(np.abs(error) > 5.0) < 0.03  # wrong matches
    assert 0.3 < np.median(np.abs(error)) / 0.6745 < 1.2
    assert np.median(np.abs(found.z / z - 1.0)[known]) < 0.02


@pytest.mark.parametrize("seed", range(3))
def test_depths_far_for_the_baseline_are_not_too_near(seed: int) -> None:
    """Disparities of two pixels, known to a fifth one by one: those that come out near are no more welcome than the others."""
    T_right_left, rng = np.array([1.0, 0.0, 0.0, 0.0, -0.03, 0.0, 0.0]), np.random.default_rng(seed)
    (left, z), (right, _) = (Room(seed).render(pose) for pose in (se3.SE3.identity(), se3.inverse(T_right_left)))
    noisy = [Image.from_array(grey + rng.normal(0.0, 2.0, SHAPE)) for grey in (left, right)]
    found = StereoPair(CAMERA, T_right_left).depth(*noisy, CAMERA)
    known = found.z > 0.0
    assert known.sum() > 8000
    assert abs(np.median(found.z[known] / z[known]) - 1.0) < 0.04  # 0.05 to 0.06 too near by single pixels
    assert np.median(found.sigma[known] / found.z[known]) < 0.15


def test_one_colour_has_no_depth() -> None:
    flat = Image.from_array(np.full(SHAPE, 100.0))
    assert not StereoPair(CAMERA, (1, 0, 0, 0, -0.2, 0, 0)).depth(flat, flat, CAMERA).z.any()


def test_repeated_stripes_are_no_match() -> None:
    stripes = Image.from_array(np.tile(100.0 + 50.0 * np.sin(np.arange(SHAPE[1]) * 2.0 * np.pi / 6.0), (SHAPE[0], 1)))
    z = StereoPair(CAMERA, (1, 0, 0, 0, -0.2, 0, 0)).depth(stripes, stripes, CAMERA).z
    assert np.count_nonzero(z) < 50


@pytest.mark.parametrize(
    ("factor", "advice"), [(1000.0, r"are these millimetres\?"), (0.001, r"are these metres that were divided by 1000\?")]
)
def test_depths_that_are_no_metres_are_refused_and_the_unit_is_guessed(factor: float, advice: str) -> None:
    with pytest.raises(InputError, match=f"check the unit of the depth: {advice}"):
        rgbd_depth(np.full(SHAPE, 2.0 * factor), IMAGE, NOISE)


def test_depth_has_its_noise_and_its_borders() -> None:
    depth = np.full(SHAPE, 2.4)
    depth[0, 0], depth[0, 1] = np.nan, np.inf
    sensed = rgbd_depth(depth, IMAGE, NOISE)
    assert sensed.z[0, 0] == sensed.z[0, 1] == 0.0
    assert sensed.sigma[5, 5] == pytest.approx(0.0012 + 0.0019 * 4.0)
    with pytest.raises(InputError, match="register the depth to the image"):
        rgbd_depth(depth[1:], IMAGE, NOISE)
    with pytest.raises(InputError, match="not negative"):
        rgbd_depth(-depth, IMAGE, NOISE)


def test_a_pair_has_a_baseline() -> None:
    with pytest.raises(InputError, match="baseline of 0 m"):
        StereoPair(CAMERA, (1, 0, 0, 0, 0, 0, 0))
