"""Simulated tracks against the points and poses they come from."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus import InputError
from boxplus.simulation.cameras.feature_tracks import TrackModel, track_points
from boxplus.simulation.motions.manoeuvres import handheld
from boxplus.simulation.motions.spline import Trajectory

ROOM = np.array([[-4.0, -4.0, -3.0], [4.0, 4.0, 3.0]])
T_IMU_CAMERA = np.array([[0.5, -0.5, 0.5, -0.5, 0.05, 0.0, 0.02], [0.5, -0.5, 0.5, -0.5, 0.05, -0.11, 0.02]])


def moving() -> tuple[Trajectory, np.ndarray]:
    trajectory = handheld(3.0, [-1, -1, -1], [1, 1, 1], standstill_s=0.0, seed=4)
    return trajectory, trajectory.start_ns + np.arange(40) * 50_000_000


def seen(model: TrackModel, seed: int = 0, mountings: np.ndarray = T_IMU_CAMERA) -> list:
    trajectory, times = moving()
    return track_points(trajectory, times, mountings, ROOM, np.random.default_rng(seed), model)


def test_rays_of_one_track_meet_in_one_point_of_the_room() -> None:
    frames = seen(TrackModel(noise_px=0.0))
    trajectory, times = moving()
    motion = trajectory.evaluate(times)
    R_imu_camera = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # of the quaternion above
    rays: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    for k, tracks in enumerate(frames):
        for row, name in enumerate(tracks.ids):
            for c in range(2):
                if np.isfinite(tracks.rays[row, c]).all():
                    R = motion.R_world_imu[k] @ R_imu_camera
                    centre = motion.p_world_imu[k] + motion.R_world_imu[k] @ T_IMU_CAMERA[c, 4:]
                    d = R @ tracks.rays[row, c]
                    rays.setdefault(int(name), []).append((centre, d / np.linalg.norm(d)))
    long = [views for views in rays.values() if len(views) > 10]
    assert len(long) > 50
    for views in long:
        P = [np.eye(3) - np.outer(d, d) for _, d in views]
        x = np.linalg.lstsq(sum(P), sum(Q @ c for Q, (c, _) in zip(P, views, strict=True)), rcond=None)[0]
        assert max(np.linalg.norm(Q @ (x - c)) for Q, (c, _) in zip(P, views, strict=True)) < 1e-6
        assert (x > ROOM[0] - 1e-6).all() and (x < ROOM[1] + 1e-6).all()


def test_frames_keep_up_the_number_of_tracks_and_noise_has_its_size() -> None:
    clean, noisy = seen(TrackModel(noise_px=0.0, wanted=80), 1), seen(TrackModel(noise_px=0.7, wanted=80), 1)
    assert {len(tracks) for tracks in clean} == {80}
    assert all(np.array_equal(a.ids, b.ids) for a, b in zip(clean[:1], noisy[:1], strict=True))
    error = noisy[0].pixels[:, 0] - clean[0].pixels[:, 0]
    assert 0.5 < error.std() < 0.9
    assert clean[0].is_new.all() and not clean[5].is_new.all()
    assert np.array_equal(np.sort(clean[-1].ids), clean[-1].ids)


def test_outliers_leave_their_points_and_others_do_not() -> None:
    """One camera at rest: what is right stays where it is."""
    trajectory = handheld(3.0, [-1, -1, -1], [1, 1, 1], speed=1e-9, rate=1e-9, standstill_s=0.0)
    times = trajectory.start_ns + np.arange(40) * 50_000_000
    model = TrackModel(noise_px=0.0, outliers=0.3, loss=0.0)
    frames = track_points(trajectory, times, T_IMU_CAMERA[:1], ROOM, np.random.default_rng(2), model)
    both, i, j = np.intersect1d(frames[0].ids, frames[-1].ids, return_indices=True)
    moved = np.linalg.norm(frames[-1].pixels[j, 0] - frames[0].pixels[i, 0], axis=1)
    assert len(both) > 60 and 0.1 < np.mean(moved > 1.0) < 0.5 and np.mean(moved < 1e-3) > 0.5
    assert len(frames[0]) == len(frames[-1]) == 100


def test_a_camera_outside_of_its_room_is_refused() -> None:
    trajectory, times = moving()
    with pytest.raises(InputError, match="inside of the room"):
        track_points(trajectory, times, T_IMU_CAMERA, [[5, 5, 5], [6, 6, 6]], np.random.default_rng(0))
