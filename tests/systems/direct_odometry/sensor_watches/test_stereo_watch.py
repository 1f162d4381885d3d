"""What both cameras of a stereo pair see lies on epipolar lines, or the calibration is contradicted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.cameras.distortion import RadialTangential
from boxplus.cameras.pinhole import Pinhole
from boxplus.manifolds import se3
from boxplus.sensors.image import Image
from boxplus.systems.direct_odometry.depth.sensed_depth import StereoPair
from boxplus.systems.direct_odometry.sensor_watches.stereo_watch import StereoWatch
from tests.systems.direct_odometry.scenes import CAMERA, SHAPE, Room

T_RIGHT_LEFT = np.array([1.0, 0.0, 0.0, 0.0, -0.2, 0.0, 0.0])
LENS = replace(CAMERA, distortion=RadialTangential(-0.28, 0.07, 1e-4, 2e-5))


def watched(seed: int, camera: Pinhole, stated: Pinhole, turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> StereoWatch:
    """Six pairs of images, with what is stated of the second camera."""
    rng, room = np.random.default_rng(seed), Room(seed)
    pair = StereoPair(stated, se3.compose(se3.exp([*turn, 0.0, 0.0, 0.0]), T_RIGHT_LEFT))
    watch = StereoWatch(pair)
    for _ in range(6):
        T = se3.exp(np.concatenate([0.3 * rng.normal(size=3), 0.2 * rng.normal(size=3)]))
        grey = [room.render(pose, camera)[0] for pose in (T, se3.compose(T, se3.inverse(T_RIGHT_LEFT)))]
        left, right = (Image.from_array(each + rng.normal(0.0, 1.5, SHAPE)) for each in grey)
        watch.add(left, right, pair.depth(left, right, camera), camera)
    return watch


@pytest.mark.slow
@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("seed", range(3))
def test_a_right_calibration_is_not_contradicted(seed: int, camera: Pinhole) -> None:
    watch = watched(seed, camera, camera)
    assert watch.contradiction == ""
    q, sigma = watch._found.estimate()
    assert (np.abs(q) < 5.0 * sigma + 2e-4).all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_what_is_off_is_named(seed: int) -> None:
    assert (
        "focal length of the second camera that is stated +"
        in watched(seed, CAMERA, replace(CAMERA, fx=156.0, fy=156.0)).contradiction
    )
    assert "about the baseline" in watched(seed, CAMERA, CAMERA, (np.radians(0.3), 0.0, 0.0)).contradiction
    assert "about its axis" in watched(seed, CAMERA, CAMERA, (0.0, 0.0, np.radians(0.8))).contradiction


def test_nothing_seen_contradicts_nothing() -> None:
    assert StereoWatch(StereoPair(CAMERA, T_RIGHT_LEFT)).contradiction == ""
