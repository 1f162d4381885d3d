"""Points tracked from image to image, without images: what a front end delivers, with its noise and its mistakes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from boxplus._settings import Settings
from boxplus.errors import InputError
from boxplus.manifolds import quaternion, se3
from boxplus.simulation.motions.spline import Trajectory
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks

Floats = NDArray[np.float64]
_NEAREST_M = 0.2
_DRIFT_PX = 1.0  # a frame, of a track that slides along an edge
_JUMP_PX = (5.0, 40.0)  # of a track that changes to another point
_OBJECT_SPEED = 0.5  # of what moves on its own [m/s]


class TrackModel(Settings):
    """A front end; the default is one of 752×480 pixels with a focal length of 460."""

    focal_px: float = Field(460.0, gt=0, description="focal length [px]")
    half_size: tuple[float, float] = Field((0.81, 0.51), description="largest |x|, |y| of a seen ray (x, y, 1)")
    wanted: int = Field(100, ge=1, description="tracks kept up in the first camera")
    noise_px: float = Field(0.5, ge=0, description="standard deviation along an axis [px]")
    loss: float = Field(0.02, ge=0, lt=1, description="probability that a track is lost from one image to the next")
    missed: float = Field(0.1, ge=0, lt=1, description="share of points that the other cameras do not find")
    outliers: float = Field(0.0, ge=0, lt=1, description="share of tracks that slide, jump, or lie on something that moves")


def track_points(
    trajectory: Trajectory,
    time_ns: ArrayLike,
    T_imu_camera: ArrayLike,
    room: ArrayLike,
    random: np.random.Generator,
    model: TrackModel | None = None,
) -> list[Tracks]:
    """Track points in a room: on its walls, and before them.

    Pixels are `focal_px` times the rays: there is no lens and no principal point.

    Args:
        trajectory: of the IMU, inside of the room.
        time_ns: (K,) of the images [ns].
        T_imu_camera: (C, 7) wxyz and xyz; tracks begin in the first camera.
        room: (2, 3) lowest and highest corner [m].
        random: source of points, noise and mistakes.
        model: of the front end.

    Raises:
        InputError: another shape; a camera that is not inside of the room.
    """
    front = model if model is not None else TrackModel()
    low, high = np.asarray(room, dtype=np.float64)
    mountings = np.atleast_2d(np.asarray(T_imu_camera, dtype=np.float64))
    times = np.asarray(time_ns, dtype=np.int64)
    motion = trajectory.evaluate(times)
    T_world_imu = np.hstack([quaternion.from_matrix(motion.R_world_imu), motion.p_world_imu])
    size = np.array(front.half_size)

    p, slide, jump, speed = np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 3))
    born, jump_at = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    alive = np.zeros(0, dtype=np.int64)
    found: list[Tracks] = []
    for k in range(len(times)):
        T_world_camera = se3.compose(T_world_imu[k], mountings[0])
        if not ((T_world_camera[4:] > low) & (T_world_camera[4:] < high)).all():
            raise InputError("cameras inside of the room", f"{T_world_camera[4:]} at image {k}", "make the room larger")
        before = len(alive)
        alive = alive[random.random(len(alive)) >= front.loss]
        since = (times[k] - times[born[alive]])[:, None] * 1e-9
        rays, seen = _rays(T_world_camera, p[alive] + speed[alive] * since)
        alive = alive[seen & (np.abs(rays) < size).all(axis=1)]
        lost = before - len(alive)
        missing = front.wanted - len(alive)
        if missing > 0:
            fresh = random.uniform(-size, size, (missing, 2))
            is_bad = random.random(missing) < front.outliers
            kind = random.integers(0, 3, missing)
            angle = random.uniform(0.0, 2.0 * np.pi, missing)
            way = np.stack([np.cos(angle), np.sin(angle)], axis=1) / front.focal_px
            alive = np.concatenate([alive, np.arange(len(p), len(p) + missing)])
            p = np.vstack([p, _cast(T_world_camera, fresh, low, high)])
            p[-missing:] = T_world_camera[4:] + (p[-missing:] - T_world_camera[4:]) * random.uniform(0.4, 1.0, (missing, 1))
            slide = np.vstack([slide, way * (_DRIFT_PX * random.uniform(0.3, 2.0, missing) * (is_bad & (kind == 0)))[:, None]])
            jump = np.vstack([jump, way * (random.uniform(*_JUMP_PX, missing) * (is_bad & (kind == 1)))[:, None]])
            jump_at = np.concatenate([jump_at, k + random.integers(1, 15, missing)])
            moving = random.standard_normal((missing, 3)) * _OBJECT_SPEED * (is_bad & (kind == 2))[:, None]
            speed = np.vstack([speed, moving])
            born = np.concatenate([born, np.full(missing, k)])
        since = (times[k] - times[born[alive]])[:, None] * 1e-9
        seen_by = np.full((len(alive), len(mountings), 3), np.nan)
        for c, mounting in enumerate(mountings):
            rays, seen = _rays(se3.compose(T_world_imu[k], mounting), p[alive] + speed[alive] * since)
            age = k - born[alive]
            rays = rays + slide[alive] * age[:, None] + jump[alive] * (k >= jump_at[alive])[:, None]
            rays = rays + random.standard_normal(rays.shape) * front.noise_px / front.focal_px
            seen &= (np.abs(rays) < 1.05 * size).all(axis=1)
            if c > 0:
                seen &= random.random(len(alive)) >= front.missed
            seen_by[seen, c] = np.hstack([rays[seen], np.ones((np.count_nonzero(seen), 1))])
        found.append(
            Tracks(
                time_ns=int(times[k]),
                ids=alive.astype(np.int64),
                pixels=seen_by[:, :, :2] * front.focal_px,
                rays=seen_by,
                is_new=born[alive] == k,
                rejected={"lost": lost},
                motion_px=np.nan,
                brightness=np.full(len(mountings), 128.0),
                contrast=np.full(len(mountings), 40.0),
            )
        )
    return found


def _rays(T_world_camera: Floats, p_world: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Rays (N, 2) of points, and which of them lie before the camera."""
    p_camera = se3.act(se3.inverse(T_world_camera), p_world)
    before = p_camera[:, 2] > _NEAREST_M
    depth = np.where(before, p_camera[:, 2], 1.0)[:, None]
    return p_camera[:, :2] / depth, before


def _cast(T_world_camera: Floats, rays: Floats, low: Floats, high: Floats) -> Floats:
    """Where rays (N, 2) from inside a room meet its walls (N, 3)."""
    direction = np.hstack([rays, np.ones((len(rays), 1))]) @ quaternion.to_matrix(T_world_camera[:4]).T
    with np.errstate(divide="ignore"):
        way = np.where(direction > 0.0, high - T_world_camera[4:], low - T_world_camera[4:]) / direction
    reached: Floats = T_world_camera[4:] + direction * np.where(direction == 0.0, np.inf, way).min(axis=1)[:, None]
    return reached
