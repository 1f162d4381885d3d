"""Clusters of points on planes: their residuals are the sum over points, and one form of a pose is the sum over planes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.manifolds import se3
from boxplus.manifolds.body_pose import BodyPose
from boxplus.residuals import Plane, PlaneCluster, PoseQuadratic, add_plane_forms

RNG = np.random.default_rng(3)


def cluster(points: NDArray[np.float64]) -> NDArray[np.float64]:
    homogeneous = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)
    return np.swapaxes(homogeneous, -1, -2) @ homogeneous


def test_squares_are_those_of_the_distances() -> None:
    T_world_imu, T_imu_lidar, planes = BodyPose.random(RNG, 20), BodyPose.random(RNG, 1)[0], Plane.random(RNG, 20)
    points, centres = 5.0 * RNG.normal(size=(20, 30, 3)), 10.0 * RNG.normal(size=(20, 3))
    T = se3.compose(T_world_imu, np.broadcast_to(T_imu_lidar, (20, 7)))
    world = np.stack([se3.act(T[k], points[k]) for k in range(20)])
    distances = np.einsum("ni,nki->nk", planes[:, :3], world - centres[:, None]) + planes[:, 3:]
    e = PlaneCluster(cluster(points), centres).evaluate(T_world_imu, T_imu_lidar, planes)
    np.testing.assert_allclose((e**2).sum(axis=1), (distances**2).sum(axis=1), rtol=1e-9)


def test_points_on_one_plane_or_line_are_no_special_case() -> None:
    points = np.zeros((2, 10, 3))
    points[0, :, :2], points[1, :, 0] = RNG.normal(size=(10, 2)), RNG.normal(size=10)
    identity = BodyPose.identity()
    e = PlaneCluster(cluster(points)).evaluate(identity, identity, [0.0, 0.0, 1.0, 0.5])
    np.testing.assert_allclose((e**2).sum(axis=1), 10 * 0.25, rtol=1e-9)


def test_a_form_is_the_sum_over_planes_at_every_pose() -> None:
    clusters, planes, centres = cluster(RNG.normal(size=(7, 9, 3))), Plane.random(RNG, 7), RNG.normal(size=(7, 3))
    origin, T = RNG.normal(size=3), BodyPose.random(RNG, 5)
    form = np.zeros((13, 13))
    offsets = np.einsum("ki,ki->k", planes[:, :3], origin - centres) + planes[:, 3]
    add_plane_forms(clusters, planes[:, :3], offsets, form)
    np.testing.assert_allclose(form, form.T, atol=1e-12)
    together = PoseQuadratic(np.tile(form, (5, 1, 1)), np.tile(origin, (5, 1))).evaluate(T)
    for k in range(5):
        each = PlaneCluster(clusters, centres).evaluate(np.tile(T[k], (7, 1)), BodyPose.identity(), planes)
        assert (together[k] ** 2).sum() == pytest.approx((each**2).sum(), rel=1e-9)


def test_what_is_no_sum_over_points_is_refused() -> None:
    with pytest.raises(InputError, match=r"expected clusters that are positive semi-definite – got an eigenvalue of -1 in row 1"):
        PlaneCluster(np.stack([np.eye(4), np.diag([1.0, 1.0, 1.0, -1.0])]))
    with pytest.raises(InputError, match=r"expected clusters \(N, 4, 4\), finite – got shape \(2, 3, 3\)"):
        PlaneCluster(np.zeros((2, 3, 3)))
    with pytest.raises(InputError, match=r"expected centres_world \(2, 3\) or \(3,\), finite"):
        PlaneCluster(np.tile(np.eye(4), (2, 1, 1)), np.zeros((4, 3)))
    with pytest.raises(InputError, match=r"expected forms \(N, 13, 13\), finite"):
        PoseQuadratic(np.zeros((13, 13)), np.zeros((1, 3)))
    with pytest.raises(InputError, match=r"expected origins_world \(2, 3\), finite"):
        PoseQuadratic(np.zeros((2, 13, 13)), np.zeros((1, 3)))
