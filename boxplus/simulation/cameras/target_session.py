"""A calibration session, computed: cameras and an IMU moved by hand before a target, and the corners that they see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.model import CameraModel
from boxplus.manifolds import quaternion, se3, so3
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.simulation.imu import ImuModel, SimulatedImu
from boxplus.simulation.motions.spline import SplineTrajectory
from boxplus.systems.camera_calibration.corners import TargetCorners
from boxplus.systems.camera_calibration.target import AprilGrid

Floats = NDArray[np.float64]

_START_NS = 1_700_000_000_000_000_000
_KNOT_S = 0.4
_MARGIN_S = 1.0

R_WORLD_TARGET = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""The target stands upright: its y is up, and it is seen from where the world's x is negative."""


@dataclass(frozen=True, slots=True, eq=False)
class TargetSession:
    """What the sensors say, and the truth.

    Attributes:
        corners: in the images, with noise.
        imu: samples over the whole session.
        T_target_imu: (F, 7) exact pose at every frame.
    """

    corners: TargetCorners
    imu: ImuSamples
    T_target_imu: Floats


def simulate_target_session(
    cameras: Sequence[CameraModel],
    T_imu_camera: Floats,
    size: tuple[int, int],
    target: AprilGrid,
    *,
    frames: int = 40,
    rate_hz: float = 1.0,
    seed: int = 0,
    sigma_px: float = 0.2,
    tilt_deg: float = 35.0,
    turn_deg: float = 25.0,
    time_offset_s: float = 0.0,
    late_s: Sequence[float] = (),
    imu: ImuModel | None = None,
) -> TargetSession:
    """Move the cameras before the target, so that the first sees it well.

    Args:
        cameras: of the rig.
        T_imu_camera: (C, 7) their mountings.
        size: (width, height) of all images [px].
        frames, rate_hz: how many images of each camera, and how often.
        seed: of motion and noise.
        sigma_px: of a coordinate of a corner [px].
        tilt_deg: up to which the target is seen from the side [deg]; 0 for views that all face it.
        turn_deg: up to which the camera turns about its axis [deg].
        time_offset_s: IMU clock minus that of the cameras [s].
        late_s: by how much each camera exposes later than its stamp says [s].
        imu: its errors; those of EuRoC's by default.
    """
    random = np.random.default_rng([seed, 77])
    duration_s = frames / rate_hz + 2.0 * _MARGIN_S
    knots = int(np.ceil(duration_s / _KNOT_S)) + 5
    R, p = _hand(random, knots, cameras[0], size, target, tilt_deg, turn_deg)
    T_world_camera = np.concatenate([quaternion.from_matrix(R_WORLD_TARGET @ R), p @ R_WORLD_TARGET.T], axis=1)
    T_world_imu = se3.compose(T_world_camera, se3.inverse(np.tile(T_imu_camera[0], (knots, 1))))
    path = SplineTrajectory(
        _START_NS, _KNOT_S, quaternion.to_matrix(np.ascontiguousarray(T_world_imu[:, :4])), T_world_imu[:, 4:]
    )
    stamps = _START_NS + np.round((_MARGIN_S + np.arange(frames) / rate_hz) * 1e9).astype(np.int64)
    T_target_world = np.concatenate([quaternion.from_matrix(R_WORLD_TARGET.T), np.zeros(3)])
    late = [*late_s, *[0.0] * (len(cameras) - len(late_s))]
    rows: list[tuple[NDArray[np.intp], ...]] = []
    pixels: list[Floats] = []
    places = target.corners
    poses = np.zeros((frames, 7))
    for camera, model in enumerate(cameras):
        motion = path.evaluate(stamps + round((time_offset_s + late[camera]) * 1e9))
        T = se3.compose(T_target_world, np.concatenate([quaternion.from_matrix(motion.R_world_imu), motion.p_world_imu], axis=1))
        if camera == 0:
            poses = T
        T_camera_target = se3.inverse(se3.compose(T, T_imu_camera[camera]))
        for frame in range(frames):
            seen_at, seen = model.project(se3.act(T_camera_target[frame], places))
            seen_at = seen_at + sigma_px * random.standard_normal(seen_at.shape)
            with np.errstate(invalid="ignore"):
                inside = seen & (seen_at > 0.0).all(axis=1) & (seen_at < np.array(size) - 1.0).all(axis=1)
            corner = np.flatnonzero(inside)
            rows.append((np.full(len(corner), frame), np.full(len(corner), camera), corner))
            pixels.append(seen_at[corner])
    frame_of, camera_of, corner_of = (np.concatenate([row[k] for row in rows]) for k in range(3))
    names = tuple(str(stamp) for stamp in stamps)
    corners = TargetCorners(
        names, frame_of, camera_of, corner_of, np.concatenate(pixels), (size,) * len(cameras), stamps
    )  # fmt: skip
    sensor = SimulatedImu(imu if imu is not None else ImuModel(), path, seed, duration_s)
    samples = sensor.samples(_START_NS, _START_NS + round(duration_s * 1e9), 0)
    return TargetSession(corners, samples, poses)


def _hand(
    random: np.random.Generator,
    knots: int,
    camera: CameraModel,
    size: tuple[int, int],
    target: AprilGrid,
    tilt_deg: float,
    turn_deg: float,
) -> tuple[Floats, Floats]:
    """Control poses of the first camera in the target's frame: rotations (K, 3, 3) and positions (K, 3)."""
    extent = np.ptp(target.corners, axis=0).max()
    middle = target.corners.mean(axis=0)
    tilt = np.radians(tilt_deg) * np.sqrt(random.uniform(0.0, 1.0, knots)) if tilt_deg > 0.0 else np.zeros(knots)
    around = random.uniform(0.0, 2.0 * np.pi, knots)
    away = np.stack([np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around), np.cos(tilt)], axis=1)
    # Where the target fills about half of the image's height, nearer and farther.
    edge, found = camera.bearings([[0.5 * size[0], 0.98 * size[1]]])
    half = float(np.arccos(edge[0, 2])) if found[0] else 0.8
    distance = extent / (2.0 * np.tan(min(half, 1.1))) * random.uniform(0.9, 2.0, knots)
    aim = middle + extent * random.uniform(-0.45, 0.45, (knots, 3)) * [1.0, 1.0, 0.0]
    p = aim + distance[:, None] * away
    forward = -away
    down = np.tile([0.0, -1.0, 0.0], (knots, 1))
    right = np.cross(down, forward)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    R = np.stack([right, np.cross(forward, right), forward], axis=2)
    turn = np.radians(turn_deg) * random.uniform(-1.0, 1.0, knots)
    return R @ so3.exp(turn[:, None] * [0.0, 0.0, 1.0]), p
