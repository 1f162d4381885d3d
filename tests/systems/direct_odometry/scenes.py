"""A room with painted walls, rendered exactly: every pixel is the paint where its ray ends, without interpolation.

The paint is a sum of waves in space, so that it goes on around the corners: edges sharper than a pixel would be seen as no camera
sees them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.pinhole import Pinhole
from boxplus.manifolds import quaternion, se3

Matrix = NDArray[np.float64]
CAMERA = Pinhole(150.0, 150.0, 79.5, 59.5)
SHAPE = (120, 160)


class Room:
    """Six walls around the origin.

    Args:
        seed: of the paint.
        texture: standard deviation of the paint [grey values].
    """

    def __init__(self, seed: int, texture: float = 35.0) -> None:
        rng = np.random.default_rng(seed)
        self.low, self.high = np.array([-2.0, -1.1, -3.0]), np.array([2.2, 1.0, 3.0])
        directions = rng.normal(size=(20, 3))
        lengths = rng.uniform(5.0, 22.0, size=(20, 1))  # [rad/m]
        self.waves = lengths * directions / np.linalg.norm(directions, axis=1, keepdims=True)
        self.phases = rng.uniform(0.0, 2.0 * np.pi, size=20)
        self.texture = texture * np.sqrt(2.0 / 20.0)

    def render(self, T_world_camera: Matrix, camera: Pinhole = CAMERA) -> tuple[Matrix, Matrix]:
        """Grey values and depths (H, W) [m]."""
        v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
        rays = camera.unproject(np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64))[0]
        R, p = quaternion.to_matrix(T_world_camera[:4]), T_world_camera[4:]
        along = rays @ R.T
        with np.errstate(divide="ignore"):
            ends = np.where(along > 0.0, (self.high - p) / along, (self.low - p) / along)
        depth = ends.min(axis=1)
        where = p + depth[:, None] * along
        grey = 120.0 + self.texture * np.cos(where @ self.waves.T + self.phases).sum(axis=1)
        return grey.reshape(SHAPE), depth.reshape(SHAPE)


@dataclass(frozen=True)
class Drive:
    """A motion and what the camera sees on it.

    Attributes:
        time_ns: of the frames; T: (n, 7) true T_world_camera, the first is the world.
        grey, depth: of each frame.
    """

    time_ns: list[int]
    T: Matrix
    grey: list[Matrix]
    depth: list[Matrix]


def path(seed: int, frames: int, speed: float = 1.0) -> Matrix:
    """A smooth motion (frames, 7) from the identity, about 0.03 m and 0.7 degrees a frame."""
    rng = np.random.default_rng([seed, 1])
    directions, turns = rng.normal(size=(2, 3)), rng.normal(size=(2, 3))
    directions, turns = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (directions, turns))
    t = speed * np.arange(frames) / 10.0
    p = 0.25 * (np.sin(t)[:, None] * directions[0] + np.sin(0.6 * t)[:, None] * directions[1])
    w = 0.1 * (np.sin(0.9 * t)[:, None] * turns[0] + np.sin(0.5 * t)[:, None] * turns[1])
    T: Matrix = se3.exp(np.concatenate([w, np.zeros_like(w)], axis=1))
    T[:, 4:] = p
    return T


def drive(seed: int, frames: int, *, noise: float = 2.0, depth_noise: float = 0.002, texture: float = 35.0) -> Drive:
    """Frames at 30 Hz with noise of grey values, and of depths by a share of them; grey values are rounded as by a camera."""
    rng = np.random.default_rng([seed, 2])
    room, T = Room(seed, texture), path(seed, frames)
    seen = [room.render(pose) for pose in T]
    grey = [np.clip(np.rint(g + rng.normal(0.0, noise, SHAPE)), 0.0, 255.0) for g, _ in seen]
    depth = [z * (1.0 + rng.normal(0.0, depth_noise, SHAPE)) for _, z in seen]
    return Drive([round(k * 1e9 / 30.0) for k in range(frames)], T, grey, depth)


def errors(T: Matrix, T_true: Matrix) -> tuple[float, float]:
    """Degrees and metres."""
    xi = se3.log(se3.compose(se3.inverse(T_true), T))
    return float(np.degrees(np.linalg.norm(xi[:3]))), float(np.linalg.norm(T[4:] - T_true[4:]))
