"""Wrong intrinsics are contradicted by images of a motion with rotation, right ones are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.cameras.pinhole import Pinhole
from boxplus.manifolds import se3
from boxplus.sensors.image import Image
from boxplus.systems.direct_alignment.tracking import track
from boxplus.systems.direct_odometry.calibration_watch import CalibrationWatch
from boxplus.systems.direct_odometry.depth.sensed_depth import rgbd_depth
from boxplus.systems.direct_odometry.direct_odometry import DirectOdometry
from boxplus.systems.direct_odometry.leftover import Leftover
from tests.systems.direct_odometry.scenes import CAMERA, SHAPE, Room


def watched(camera: Pinhole, seed: int) -> CalibrationWatch:
    """Eight frames turned by up to ten degrees, each tracked against a first one with this camera, drawn with CAMERA."""
    rng, room, watch = np.random.default_rng(seed), Room(seed), CalibrationWatch()
    odometry = DirectOdometry(camera)
    for _ in range(8):
        w, v = rng.normal(size=(2, 3))
        T = se3.exp(np.concatenate([np.radians(7.0) * w / np.linalg.norm(w), 0.1 * v / np.linalg.norm(v)]))
        (one, z), (two, _) = room.render(se3.SE3.identity()), room.render(T)
        images = [Image.from_array(grey + rng.normal(0.0, 1.5, SHAPE)) for grey in (one, two)]
        keyframe = odometry._keyframe(0, images[0], rgbd_depth(z, images[0], (0.001, 0.002, 0.4)), se3.SE3.identity(), 0.0)
        assert keyframe is not None
        alignment = track(keyframe.tracker, images[1], T_21=se3.inverse(T))
        assert alignment.status == "converged"
        watch.add(Leftover(keyframe, images[1].grey, alignment), camera, SHAPE[0], (np.zeros(6), np.zeros(6)))
    return watch


@pytest.mark.parametrize("seed", range(3))
def test_right_intrinsics_are_not_contradicted(seed: int) -> None:
    assert watched(CAMERA, seed).contradiction == ""


@pytest.mark.parametrize("seed", range(3))
def test_wrong_focal_length_and_principal_point_are(seed: int) -> None:
    assert (
        "contradict the focal length: they ask for -"
        in watched(replace(CAMERA, fx=1.12 * 150.0, fy=1.12 * 150.0), seed).contradiction
    )
    assert "principal point along u: they ask for -" in watched(replace(CAMERA, cx=79.5 + 12.0), seed).contradiction


def test_one_frame_contradicts_nothing() -> None:
    assert CalibrationWatch().contradiction == ""
