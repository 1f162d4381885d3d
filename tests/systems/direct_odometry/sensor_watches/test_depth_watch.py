"""Depths that do not fit the parallax of a motion are contradicted, with what they look like; right ones are not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.manifolds import se3
from boxplus.sensors.images.image import Image
from boxplus.systems.direct_alignment.keyframe import Keyframe
from boxplus.systems.direct_alignment.tracking import track
from boxplus.systems.direct_odometry.depth.sensed_depth import rgbd_depth
from boxplus.systems.direct_odometry.direct_odometry import DirectOdometry
from boxplus.systems.direct_odometry.sensor_watches.depth_watch import DepthWatch, Surfaces
from boxplus.systems.direct_odometry.sensor_watches.leftover import Leftover
from tests.systems.direct_odometry.scenes import CAMERA, SHAPE, Room

Depth = NDArray[np.float64]
Spoil = Callable[[Room, NDArray[np.float64], NDArray[np.float64]], Depth]  # of the room, pose and velocity: depths as measured
V, U = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)


def right(room: Room, T: NDArray[np.float64], velocity: NDArray[np.float64]) -> Depth:
    return room.render(T)[1]


def too_far(room: Room, T: NDArray[np.float64], velocity: NDArray[np.float64]) -> Depth:
    return right(room, T, velocity) + 0.3


def distances(room: Room, T: NDArray[np.float64], velocity: NDArray[np.float64]) -> Depth:
    x, y = (U - CAMERA.cx) / CAMERA.fx, (V - CAMERA.cy) / CAMERA.fy
    return right(room, T, velocity) * np.sqrt(1.0 + x**2 + y**2)


def zoomed(room: Room, T: NDArray[np.float64], velocity: NDArray[np.float64]) -> Depth:
    """Of a camera with a focal length that is 6 % longer: every depth lies farther from the centre."""
    u, v = CAMERA.cx + (U - CAMERA.cx) / 1.06, CAMERA.cy + (V - CAMERA.cy) / 1.06
    return right(room, T, velocity)[np.rint(v).astype(int), np.rint(u).astype(int)]


def late(room: Room, T: NDArray[np.float64], velocity: NDArray[np.float64]) -> Depth:
    """From where the camera was 80 ms before."""
    return right(room, se3.compose(T, se3.exp(-0.08 * velocity)), velocity)


def watched(spoil: Spoil, seed: int, frames: int = 14) -> DepthWatch:
    """Frames that moved by some 20 cm, each tracked against a keyframe of its own, whose depths were spoilt."""
    rng, watch, odometry = np.random.default_rng(seed), DepthWatch(), DirectOdometry(CAMERA)
    for k in range(frames):
        room = Room(1000 * seed + k)
        w, v = (direction / np.linalg.norm(direction) for direction in rng.normal(size=(2, 3)))
        velocity = np.concatenate([0.6 * w, 0.8 * v])
        T, T_moved = se3.SE3.identity(), se3.exp(np.concatenate([np.radians(3.0) * w, 0.2 * v]))
        depth = spoil(room, T, velocity)
        images = [Image.from_array(room.render(at)[0] + rng.normal(0.0, 1.5, SHAPE)) for at in (T, T_moved)]
        sensed = rgbd_depth(depth, images[0], (0.001, 0.002, 0.4))
        keyframe = odometry._keyframe(0, images[0], sensed, T, 0.0)
        assert keyframe is not None
        alignment = track(keyframe.tracker, images[1], T_21=se3.inverse(T_moved))
        leftover = Leftover.of(keyframe, images[1].grey, alignment)
        if alignment.status == "converged" and leftover is not None:
            watch.add(leftover, Surfaces.around(keyframe.tracker, sensed.z, velocity), keyframe.tracker)
    return watch


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_right_depths_are_not_contradicted(seed: int) -> None:
    assert watched(right, seed).contradiction == ""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "looks_like"),
    [
        (too_far, "% of the median depth off, all by the same length"),
        (distances, "distances from the camera in place of depths along its axis"),
        (zoomed, "depths of a camera whose focal length is +"),
        (late, "ms late"),
    ],
)
def test_what_depths_look_like_is_said(spoil: Spoil, looks_like: str) -> None:
    assert looks_like in watched(spoil, 1).contradiction


def test_few_frames_contradict_only_what_is_far_off() -> None:
    """Two say nothing; of four, what by Student's t is as unlikely as six standard deviations of many."""
    assert watched(distances, 1, frames=2).contradiction == ""
    assert "distances from the camera" in watched(distances, 1, frames=4).contradiction
    assert watched(zoomed, 1, frames=4).contradiction == "" and watched(right, 1, frames=4).contradiction == ""


def test_slopes_are_those_of_a_plane_and_nothing_at_its_end() -> None:
    depth = (1.0 / (0.5 + 0.002 * U - 0.001 * V)).astype(np.float32)
    depth[:, U[0] > 110] = 1.0
    tracker = Keyframe.prepare(Room(5).render(se3.SE3.identity())[0], depth, CAMERA)
    level, found = tracker.levels[-1], Surfaces.around(tracker, depth, np.zeros(6))
    u = level.pixels[:, 0]
    assert not found.is_plane[np.abs(u - 110.5) < 2.0].any()
    plane = found.is_plane & (u < 108)
    assert plane.sum() > 500
    expected = np.array([0.002, -0.001]) / level.inverse_depth[plane, None]
    np.testing.assert_allclose(found.slope[plane], expected, rtol=0.02)
