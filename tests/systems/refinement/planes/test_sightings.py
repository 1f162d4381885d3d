"""What scans see of planes: a surface that is seen from both of its sides is two."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.refinement.config import RefinementConfig
from boxplus.systems.refinement.finished_run import FinishedRun
from boxplus.systems.refinement.keyframes import Keyframes
from boxplus.systems.refinement.planes.sightings import judge, keyframe_clusters, planes_of, scan_forms

STILL = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
SIGMA, FACES = 0.005, (2.20, 2.24)


def slab_from_both_sides(before: int, behind: int) -> FinishedRun:
    """Scans, each a keyframe, of a slab 4 cm thick: first ones at x = 0, which see its face at 2.20 m, then ones at x = 4."""
    rng, count = np.random.default_rng(0), before + behind
    T = np.tile(STILL, (count, 1))
    T[before:, 4] = 4.0
    points: list[NDArray[np.float32]] = []
    for k in range(count):
        world = rng.uniform(0.1, 3.9, (3000, 3))
        world[:, 0] = FACES[k >= before] + SIGMA * rng.normal(size=3000)
        points.append((world - T[k, 4:]).astype(np.float32))
    return FinishedRun(
        time_ns=np.arange(count) * 100_000_000,
        T_world_imu=T,
        velocity_bias=np.zeros((count, 9)),
        gravity_world=np.array([0.0, 0.0, -9.81]),
        T_imu_lidar=STILL,
        points=points,
        imu=ImuSamples.from_arrays(np.arange(2), np.zeros((2, 3)), np.zeros((2, 3))),
        noise=ImuNoise(gyro=1e-3, accel=1e-2, gyro_walk=1e-5, accel_walk=1e-4),
        is_end=np.ones(count, dtype=np.bool_),
        open_steps=np.zeros((count, 3, 3)),
        is_unshown=np.zeros(count, dtype=np.bool_),
        covariance=None,
    )


def test_both_faces_of_a_slab_are_not_one_plane() -> None:
    for before, behind in ((4, 2), (2, 4)):
        run = slab_from_both_sides(before, behind)
        keyframes = Keyframes(np.arange(len(run)), np.arange(len(run)))
        config = RefinementConfig()  # type: ignore[call-arg]
        planes, information = planes_of(run, run.T_world_imu, keyframes, config)
        seen = keyframe_clusters(run, run.T_world_imu, keyframes, planes, information)
        mostly = before > behind
        assert len(planes) and (information > 0.0).all()
        np.testing.assert_allclose(planes.centres[:, 0], FACES[not mostly], atol=0.001)
        np.testing.assert_allclose(planes.thickness, SIGMA, rtol=0.1)
        assert set(seen.keyframe) == set(range(before) if mostly else range(before, len(run)))
        ours, same = judge(run, run.T_world_imu, run.T_world_imu, planes)
        assert ours == same and abs(ours.thickness - SIGMA) < 0.1 * SIGMA


def test_scans_that_see_no_useful_plane_say_nothing() -> None:
    """As stretches between what is curved do; all of them in one piece of the work."""
    run = slab_from_both_sides(4, 2)
    keyframes = Keyframes(np.arange(len(run)), np.arange(len(run)))
    planes, information = planes_of(run, run.T_world_imu, keyframes, RefinementConfig())  # type: ignore[call-arg]
    assert not scan_forms(run, run.T_world_imu, run.T_imu_lidar, planes, 0.0 * information).any()
    assert scan_forms(run, run.T_world_imu, run.T_imu_lidar, planes, information).any()
    assert not len(keyframe_clusters(run, run.T_world_imu, keyframes, planes, 0.0 * information).plane)
