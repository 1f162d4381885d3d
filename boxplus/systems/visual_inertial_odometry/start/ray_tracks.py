"""What a front end saw: tracks of undistorted rays, over the images of some seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion
from boxplus.systems.visual_inertial_odometry.corners.tracks import Tracks

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True)
class RayTracks:
    """N sightings of tracks in K frames by C cameras on one body.

    Attributes:
        time_ns: (K,) of the frames, in the clock of the IMU [ns].
        frame_of, camera_of, track_of: (N,) int64; names of tracks may be any numbers.
        rays: (N, 2) x, y of the undistorted ray (x, y, 1) in the camera.
        T_imu_camera: (C, 7) wxyz and xyz.
    """

    time_ns: Integers
    frame_of: Integers
    camera_of: Integers
    track_of: Integers
    rays: Floats
    T_imu_camera: Floats

    @classmethod
    def of(cls, seen: Sequence[Tracks], T_imu_camera: Floats) -> RayTracks:
        """The corners of frames in order of time; rays that do not point forward are left out."""
        frame, camera, track, rays = [], [], [], []
        for k, frame_tracks in enumerate(seen):
            row, c = np.nonzero(np.isfinite(frame_tracks.rays).all(axis=2) & (frame_tracks.rays[:, :, 2] > 0.0))
            frame.append(np.full(len(row), k, dtype=np.int64))
            camera.append(c.astype(np.int64))
            track.append(frame_tracks.ids[row])
            rays.append(frame_tracks.rays[row, c, :2] / frame_tracks.rays[row, c, 2:])
        return cls(
            np.array([tracks.time_ns for tracks in seen], dtype=np.int64),
            np.concatenate(frame),
            np.concatenate(camera),
            np.concatenate(track),
            np.concatenate(rays),
            T_imu_camera,
        )

    def of_rows(self, rows: NDArray[np.bool_]) -> RayTracks:
        """The sightings `rows` (N,) holds, of the same frames."""
        return RayTracks(
            self.time_ns, self.frame_of[rows], self.camera_of[rows], self.track_of[rows], self.rays[rows], self.T_imu_camera
        )

    def directions(self) -> Floats:
        """(N, 3) unit rays, turned into the axes of the body."""
        rays = np.hstack([self.rays, np.ones((len(self.rays), 1))])
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        turned: Floats = np.einsum("nij,nj->ni", quaternion.to_matrix(self.T_imu_camera[self.camera_of, :4]), rays)
        return turned

    def pairs(self, step: int) -> tuple[Integers, Integers]:
        """Rows (i, j) of one track in one camera, in frames k and k + `step`."""
        track, track_number = np.unique(self.track_of, return_inverse=True)
        cameras, frames = len(self.T_imu_camera), len(self.time_ns)
        row = np.full((len(track), cameras, frames + step), -1, dtype=np.int64)
        row[track_number, self.camera_of, self.frame_of] = np.arange(len(self.rays))
        first, second = row[:, :, :frames], row[:, :, step:]
        both = (first >= 0) & (second >= 0)
        return first[both], second[both]
