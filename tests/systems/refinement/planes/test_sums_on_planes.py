"""Sums of the points of scans on planes: piece by piece what every scan gives by itself."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.manifolds import quaternion, so3
from boxplus.systems.refinement.config import RefinementConfig
from boxplus.systems.refinement.keyframes import choose_keyframes
from boxplus.systems.refinement.planes.sightings import lidar_poses, planes_of
from boxplus.systems.refinement.planes.sums_on_planes import moved_clusters, points_that, sighted
from tests.systems.refinement.cases import Case


@pytest.mark.parametrize("judge", [False, True])
def test_pieces_are_what_every_scan_sees(case: Case, judge: bool) -> None:
    config = RefinementConfig()  # type: ignore[call-arg]
    run = case.run
    T_lidar = lidar_poses(run.T_world_imu, run.T_imu_lidar)
    keyframes = choose_keyframes(run.time_ns, run.T_world_imu, config)
    planes, _ = planes_of(run, T_lidar, keyframes, config)
    begins = np.flatnonzero(np.diff(keyframes.of_scan, prepend=-1))
    pieces = list(sighted(run.points, T_lidar, planes, 2, begins, judge=judge))
    assert len(pieces) > 1
    of_keyframe = [np.unique(keyframes.of_scan[piece.scan]) for piece in pieces]
    assert len(np.unique(np.concatenate(of_keyframe))) == sum(map(len, of_keyframe))  # none is cut in two
    scan = np.concatenate([piece.scan for piece in pieces])
    plane = np.concatenate([piece.plane for piece in pieces])
    clusters = np.concatenate([piece.clusters for piece in pieces])
    assert (np.diff(scan) >= 0).all()
    R = quaternion.to_matrix(T_lidar[:, :4])
    for k in range(0, len(run), 29):
        found, own = planes.clusters_of(points_that(run.points[k], judge=judge), R[k], T_lidar[k, 4:])
        order = np.argsort(plane[scan == k])
        np.testing.assert_array_equal(plane[scan == k][order], found)
        np.testing.assert_array_equal(clusters[scan == k][order], own)


def test_moved_clusters_are_those_of_moved_points() -> None:
    rng = np.random.default_rng(0)
    R, p, x = so3.exp(rng.normal(size=(5, 3))), rng.normal(size=(5, 3)), rng.normal(size=(5, 40, 3))

    def summed(points: NDArray[np.float64]) -> NDArray[np.float64]:
        ones = np.concatenate([points, np.ones((5, 40, 1))], axis=2)
        return np.asarray(np.einsum("kni,knj->kij", ones, ones))

    np.testing.assert_allclose(moved_clusters(summed(x), R, p), summed(x @ np.swapaxes(R, 1, 2) + p[:, None]), atol=1e-10)
