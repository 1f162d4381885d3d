"""Residuals are connected to what they are derived for: other manifolds and other meanings are refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import boxplus as bp
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.tangents.change import POSES

CAMERA = bp.Pinhole(500.0, 500.0, 320.0, 240.0)
IDENTITY = np.array([1.0, 0, 0, 0, 0, 0, 0])
MANIFOLDS = [*POSES, bp.SO3, bp.UnitQuaternion, bp.SE2, bp.Line3D, bp.Euclidean(3), bp.Euclidean(7), bp.Product(bp.SE3, bp.SE2)]


def reprojection() -> bp.residuals.Reprojection:
    return bp.residuals.Reprojection(CAMERA, [[320.0, 240.0]])


@pytest.mark.parametrize("actual", MANIFOLDS, ids=str)
@pytest.mark.parametrize("native", MANIFOLDS, ids=str)
def test_only_the_manifold_of_the_residual_is_taken(native: Manifold, actual: Manifold) -> None:
    problem = bp.Problem()
    block = problem.add_variables(actual, actual.identity(), name="given")
    prior = bp.residuals.Prior(native, native.identity())
    if native == actual:
        problem.add_residuals(prior, block)
        return
    with pytest.raises(bp.InputError) as error:
        problem.add_residuals(prior, block)
    assert f"expected x of Prior on {native.name} – got 'given' on {actual.name} – add the variables" in str(error.value)
    poses = native in POSES and actual in POSES
    assert ("carry_over=True" in str(error.value)) == poses and not problem.groups
    if poses:
        problem.add_residuals(prior, block, carry_over=True)
    else:
        with pytest.raises(bp.InputError, match="only the updates of a pose change into each other"):
            problem.add_residuals(prior, block, carry_over=True)


def test_what_is_no_manifold_and_no_loss() -> None:
    problem: Any = bp.Problem()
    with pytest.raises(
        bp.InputError, match=r"a manifold – got Euclidean – give one such as boxplus.SE3 or boxplus.Euclidean\(3\)"
    ):
        problem.add_variables(bp.Euclidean, np.zeros((2, 3)))
    with pytest.raises(bp.InputError, match="a manifold – got 3 "):
        problem.add_variables(3, np.zeros((2, 3)))
    x = problem.add_variables(bp.Euclidean(1), [0.0])
    prior = bp.residuals.Prior(bp.Euclidean(1), [2.0], sigma=0.1)
    for loss in ("huber", bp.losses.Huber):
        with pytest.raises(bp.InputError, match=r"a loss of boxplus.losses – got .*uber.* – write it as loss=bp.losses.Huber"):
            problem.add_residuals(prior, x, loss=loss)
    assert problem.groups == []


def test_poses_of_one_block_have_one_direction() -> None:
    """Even where the update is carried over: a camera pose is no body pose."""
    problem = bp.Problem()
    poses = problem.add_variables(bp.SE3, np.tile(IDENTITY, (4, 1)), name="poses")
    points = problem.add_variables(bp.Euclidean(3), [[0.0, 0, 4]], name="points")
    problem.add_residuals(bp.residuals.RelativePose(IDENTITY[None]), poses[[0]], poses[[1]], name="odometry")
    with pytest.raises(bp.InputError) as error:
        problem.add_residuals(reprojection(), poses[[1]], points, carry_over=True)
    assert str(error.value) == (
        "expected T_camera_world of Reprojection, a pose that maps from the world – got 'poses', which 'odometry' takes for "
        "T_world_j, a pose that maps to the world – add variables for each meaning, or take residuals that agree"
    )
    # Other rows of the block may stand for something else.
    problem.add_residuals(reprojection(), poses[[2]], points, carry_over=True)


def test_a_point_is_no_bearing() -> None:
    problem = bp.Problem()
    poses = problem.add_variables(bp.SE3Left, np.tile(IDENTITY, (2, 1)))
    points = problem.add_variables(bp.Euclidean(3), [[0.0, 0, 4]], name="points")
    problem.add_residuals(reprojection(), poses[[0]], points)
    with pytest.raises(
        bp.InputError, match=r"a bearing and an inverse depth in an anchor – got 'points', which .* takes for p_world"
    ):
        problem.add_residuals(bp.residuals.InverseDepthReprojection(CAMERA, [[320.0, 240.0]]), poses[[0]], poses[[1]], points)


def test_numbers_of_the_same_kind_of_vector_are_told_apart() -> None:
    """Euclidean(9): velocity and biases for the one, intrinsics with distortion for the other."""
    camera = bp.Pinhole(500.0, 500.0, 320.0, 240.0, bp.RadialTangential(0.1, 0.0, 0.0, 0.0, 0.01))
    problem = bp.Problem()
    poses = problem.add_variables(bp.SE3Left, IDENTITY)
    points = problem.add_variables(bp.Euclidean(3), [0.0, 0, 4])
    bodies = problem.add_variables(bp.BodyPose, np.tile(IDENTITY, (2, 1)))
    nine = problem.add_variables(bp.Euclidean(9), np.tile(camera.parameters, (2, 1)), name="nine")
    problem.add_residuals(bp.residuals.ReprojectionIntrinsics(camera, [[320.0, 240.0]]), poses, points, nine[[0]])
    noise = bp.residuals.ImuNoise(gyro=1e-3, accel=1e-2, gyro_walk=1e-5, accel_walk=1e-4)
    samples = np.arange(5) * 10_000_000, np.zeros((5, 3)), np.zeros((5, 3))
    imu = bp.residuals.ImuPreintegration(bp.residuals.Preintegration.integrate(*samples, noise=noise))
    with pytest.raises(bp.InputError, match=r"velocity_bias_i of .*, a velocity and the biases of an IMU – got 'nine', which"):
        problem.add_residuals(imu, bodies[[0]], nine[[0]], bodies[[1]], nine[[1]])


def test_body_and_mounting_are_not_exchanged() -> None:
    """Both are on BodyPose, so that only their meaning tells them apart."""
    problem = bp.Problem()
    bodies = problem.add_variables(bp.BodyPose, IDENTITY, name="bodies")
    mountings = problem.add_variables(bp.BodyPose, IDENTITY, name="mountings")
    points = problem.add_variables(bp.Euclidean(3), [0.0, 0, 4])
    seen = bp.residuals.OnBody(reprojection())
    problem.add_residuals(seen, bodies, mountings, points, name="left")
    with pytest.raises(
        bp.InputError, match=r"T_world_body of OnBody, .* – got 'mountings', which 'left' takes for T_body_camera"
    ):
        problem.add_residuals(seen, mountings, bodies, points)


def test_two_meanings_within_one_residual() -> None:
    problem = bp.Problem()
    poses = problem.add_variables(bp.SE3, np.tile(IDENTITY, (2, 1)), name="poses")

    def mixed(T_world_body, T_camera_world):  # type: ignore[no-untyped-def]
        return T_world_body[4:] - T_camera_world[4:]

    residual = bp.residuals.UserResidual(mixed, manifolds=[bp.SE3, bp.SE3], dim=3, count=1)
    with pytest.raises(bp.InputError, match="T_camera_world of UserResidual, a pose that maps from the world – got 'poses'"):
        problem.add_residuals(residual, poses[[0]], poses[[0]])
    problem.add_residuals(residual, poses[[0]], poses[[1]])


def test_a_start_on_other_manifolds_is_refused() -> None:
    def problem(manifold: Manifold) -> bp.Problem:
        made = bp.Problem()
        made.add_residuals(bp.residuals.Prior(manifold, IDENTITY), made.add_variables(manifold, IDENTITY, name="pose"))
        return made

    solution = problem(bp.SE3).solve()
    assert problem(bp.SE3).cost(solution) == 0.0
    with pytest.raises(bp.InputError, match="expected pose on SE3Left – got a solution with 'pose' on SE3 – start from"):
        problem(bp.SE3Left).solve(start=solution)
