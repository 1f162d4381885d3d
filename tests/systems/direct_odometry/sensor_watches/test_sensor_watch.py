"""What contradicts the calibration is said by whole runs, too: of frames that come slowly, and where every view is lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.cameras.pinhole import Pinhole
from boxplus.manifolds import se3
from boxplus.systems.direct_odometry.config import DirectOdometryConfig
from boxplus.systems.direct_odometry.depth.sensed_depth import StereoPair
from boxplus.systems.direct_odometry.direct_odometry import DirectOdometry
from boxplus.systems.direct_odometry.estimate import Estimate
from tests.systems.direct_odometry.scenes import CAMERA, SHAPE, Matrix, Room

LONG = replace(CAMERA, fx=1.12 * CAMERA.fx, fy=1.12 * CAMERA.fy)
T_RIGHT_LEFT = np.array([1.0, 0.0, 0.0, 0.0, -0.2, 0.0, 0.0])
FRAMES = 26


def looking_around(seed: int) -> Matrix:
    """A motion (FRAMES, 7) that turns by some ten degrees either way."""
    rng = np.random.default_rng([seed, 5])
    phase, frequency = rng.uniform(0.0, 2.0 * np.pi, 6), rng.uniform(0.25, 0.45, 6)
    swing = np.sin(frequency * np.arange(FRAMES)[:, None] + phase) - np.sin(phase)
    T: Matrix = se3.exp(np.concatenate([0.12 * swing[:, :3], np.zeros((FRAMES, 3))], axis=1))
    T[:, 4:] = 0.2 * swing[:, 3:]
    return T


def run(seed: int, step_s: float, camera: Pinhole = CAMERA, too_far: float = 0.0) -> DirectOdometry:
    """Frames of an RGB-D camera with these intrinsics stated, and depths [m] that are so much too far."""
    rng, room, odometry = np.random.default_rng(seed), Room(seed), DirectOdometry(camera)
    for k, T in enumerate(looking_around(seed)):
        grey, depth = room.render(T)
        odometry.push_rgbd(round(k * step_s * 1e9), np.rint(grey + rng.normal(0.0, 2.0, SHAPE)), depth + too_far)
    return odometry


@pytest.mark.slow
@pytest.mark.parametrize("step_s", [0.1, 0.25, 0.5])
def test_frames_are_asked_at_any_rate(step_s: float) -> None:
    assert "contradict the focal length: they ask for -" in run(0, step_s, camera=LONG).contradiction
    assert "% of the median depth off" in run(0, step_s, too_far=0.3).contradiction
    sound = run(0, step_s)
    assert sound.contradiction == "" and sound.remarks == {}


def begin_again_and_again(turn: float) -> tuple[DirectOdometry, list[Estimate]]:
    """Pairs of images that show another room each, with a second camera that is stated turned about the baseline [rad]."""
    T_stated = se3.compose(se3.exp([turn, 0.0, 0.0, 0.0, 0.0, 0.0]), T_RIGHT_LEFT)
    odometry = DirectOdometry(CAMERA, DirectOdometryConfig(lost_s=0.02), stereo=StereoPair(CAMERA, T_stated))
    rng, estimates = np.random.default_rng(0), []
    for k in range(6):
        left, right = (Room(k).render(T)[0] for T in (se3.SE3.identity(), se3.inverse(T_RIGHT_LEFT)))
        left, right = (np.rint(grey + rng.normal(0.0, 1.5, SHAPE)) for grey in (left, right))
        estimates.append(odometry.push_stereo(k * 100_000_000, left, right))
    return odometry, estimates


def test_a_stereo_pair_that_does_not_fit_is_named_where_every_view_is_lost() -> None:
    odometry, estimates = begin_again_and_again(np.radians(0.3))
    assert odometry.gaps == 5
    assert "turned by" in odometry.contradiction and "about the baseline" in odometry.contradiction
    assert estimates[-1].status == "weak" and odometry.contradiction in estimates[-1].reasons
    assert begin_again_and_again(0.0)[0].contradiction == ""
