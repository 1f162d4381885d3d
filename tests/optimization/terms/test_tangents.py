"""The tangent in which the solver moves poses: solutions and covariances do not depend on where the world's origin lies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import boxplus as bp
from boxplus.manifolds import quaternion
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import UnitQuaternion
from boxplus.manifolds.tangents.change import POSES
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.optimization.terms.variables import Variables
from tests.small_problems import in_camera, scene

SIGMA = 0.5
TOLERANCE = 1e-7  # of the cost: a million metres away a pixel is a matter of 1e-8
CAMERA = bp.Pinhole(500.0, 500.0, 0.0, 0.0, z_min=0.0)


@dataclass
class Solved:
    problem: Problem
    poses: Variables
    points: Variables
    solution: Solution


def solved(
    manifold: Manifold, scale: float = 1.0, R: NDArray[np.float64] | None = None, shift: object = 0.0, seed: int = 0
) -> Solved:
    """A bundle adjustment whose world is turned by R, scaled and then shifted; two poses are held."""
    rng = np.random.default_rng(seed)
    T, p, camera_of, point_of = scene(seed, 6, 40)
    P = in_camera(T[camera_of], p[point_of])
    pixels = 500.0 * P[:, :2] / P[:, 2:] + SIGMA * rng.standard_normal((len(P), 2))
    T[2:] = bp.SE3Left.boxplus(T[2:], 0.02 * rng.standard_normal((len(T) - 2, 6)))
    p = p + 0.05 * rng.standard_normal(p.shape)
    R = np.eye(3) if R is None else R
    R_before = quaternion.to_matrix(np.ascontiguousarray(T[:, :4]))
    R_camera = R_before @ R.T
    centers = scale * np.einsum("ij,nj->ni", R, -np.einsum("nji,nj->ni", R_before, T[:, 4:]))
    T = np.hstack([quaternion.from_matrix(R_camera), -np.einsum("nij,nj->ni", R_camera, centers + shift)])
    problem = Problem()
    poses = problem.add_variables(manifold, T, name="poses")
    points = problem.add_variables(bp.Euclidean(3), scale * p @ R.T + shift, name="points")
    residual = bp.residuals.Reprojection(CAMERA, pixels, sigma=SIGMA)
    problem.add_residuals(residual, poses[camera_of], points[point_of], name="pixels", carry_over=True)
    problem.fix(poses[:2])
    return Solved(problem, poses, points, problem.solve(cost_tolerance=TOLERANCE))


REFERENCE = {manifold.name: solved(manifold) for manifold in POSES}


def assert_same(got: Solved, manifold: Manifold, scale: float, R: NDArray[np.float64], shift: object, digits: float) -> None:
    """Cost, points, their covariances and that of a rotation, up to a share `digits`."""
    reference = REFERENCE[manifold.name]
    assert got.solution.status == "converged" and got.solution.iterations <= reference.solution.iterations + 3
    assert got.solution.cost == pytest.approx(reference.solution.cost, rel=digits)
    expected = scale * reference.solution[reference.points] @ R.T + shift
    np.testing.assert_allclose((got.solution[got.points] - expected) / scale, 0.0, atol=max(10.0 * digits, 1e-3 * SIGMA / 50.0))
    covariance = reference.solution.covariance(reference.points)
    np.testing.assert_allclose(
        got.solution.covariance(got.points) / scale**2,
        R @ covariance @ R.T,
        atol=1e-3 * np.abs(covariance).max(axis=(1, 2)).min(),
    )
    rotation = [x.solution.covariance(x.poses[[4]])[0, :3, :3] for x in (reference, got)]
    if manifold not in (bp.SE3Left, bp.CameraPose):  # on the right, a rotation is about axes of the world
        rotation[0] = R @ rotation[0] @ R.T
    np.testing.assert_allclose(rotation[1], rotation[0], atol=1e-3 * np.abs(rotation[0]).max())


@pytest.mark.parametrize("manifold", POSES, ids=lambda m: m.name)
@pytest.mark.parametrize("far", [1e3, 1e6])
def test_translation_of_the_world_changes_nothing(manifold: Manifold, far: float) -> None:
    shift = far * np.array([1.0, -0.5, 0.3])
    assert_same(solved(manifold, shift=shift), manifold, 1.0, np.eye(3), shift, 1e-8)


@settings(max_examples=12, deadline=None)
@given(
    manifold=st.sampled_from(POSES),
    power=st.floats(-6.0, 6.0),
    turn=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    far=st.sampled_from([0.0, 10.0, 1e5]),
)
def test_similarities_of_the_world_change_nothing(
    manifold: Manifold, power: float, turn: tuple[float, float, float], far: float
) -> None:
    scale, R = 10.0**power, Rotation.from_rotvec(turn).as_matrix()
    shift = scale * far * np.array([0.2, 1.0, -0.7])
    assert_same(solved(manifold, scale, R, shift), manifold, scale, R, shift, 1e-7)


@pytest.mark.parametrize("manifold", [bp.SE3, Product(UnitQuaternion, bp.Euclidean(3))], ids=lambda m: m.name)
def test_covariances_are_in_the_tangent_of_the_variable(manifold: Manifold) -> None:
    """That of the camera's centre, from all of the pose's covariance, where the solver has chosen another tangent."""
    shift = np.array([1e4, 2e4, -1e4])
    near, far = REFERENCE[manifold.name], solved(manifold, shift=shift)
    assert far.solution._problem.layout.tangents[0] == bp.SE3Left != near.solution._problem.layout.tangents[0]

    def of_center(x: Solved, C: NDArray[np.float64]) -> NDArray[np.float64]:
        T = x.solution[x.poses][4]
        R, t = quaternion.to_matrix(T[None, :4])[0], T[4:]
        x, y, z = -R.T @ t
        # The centre −Rᵀt moves by c × w, and by −v or −Rᵀv.
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        J = np.hstack([cross, -np.eye(3) if manifold == bp.SE3 else -R.T])
        return np.asarray(J @ C @ J.T)

    expected = of_center(near, near.solution.covariance(near.poses[[4]])[0])
    np.testing.assert_allclose(of_center(far, far.solution.covariance(far.poses[[4]])[0]), expected, atol=1e-3 * expected.max())
    joint = far.solution.joint_covariance(far.poses[[3, 4]], far.points[[7]])
    np.testing.assert_allclose(joint[6:12, 6:12], far.solution.covariance(far.poses[[4]])[0], rtol=1e-6)
    np.testing.assert_allclose(joint[:6, 6:12], far.solution.covariance(far.poses[[3]], far.poses[[4]])[0], rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(
        joint[6:12, 12:], far.solution.covariance(far.poses[[4]], far.points[[7]])[0], rtol=1e-5, atol=1e-12
    )


def test_what_is_free_is_told_alike_far_away() -> None:
    """The scale, with one pose held."""
    for manifold in POSES:
        texts = []
        for shift in (0.0, np.array([1e4, 0.0, 0.0])):
            found = solved(manifold, shift=shift)
            found.problem.free(found.poses[1])
            solution = found.problem.solve()
            with pytest.raises(bp.SingularProblemError, match=r"the scale about .* is unconstrained") as error:
                solution.covariance(found.points[[0]])
            texts.append(str(error.value).split("the scale about")[0])
        assert texts[0] == texts[1]


def test_the_tangent_that_was_given_stays_where_it_is_good_enough() -> None:
    for manifold in POSES:
        assert REFERENCE[manifold.name].solution._problem.layout.tangents[0] == manifold


def test_poses_of_bodies_are_moved_about_themselves() -> None:
    """T_world_body on the left, a long way off: relative poses are then best told on the right."""
    poses = np.tile([1.0, 0, 0, 0, 0, 0, 0], (5, 1))
    poses[:, 4] = 1e5 + np.arange(5.0)
    problem = Problem()
    T = problem.add_variables(bp.SE3Left, poses)
    steps = np.tile([1.0, 0, 0, 0, 1.01, 0.02, 0.0], (4, 1))
    problem.add_residuals(bp.residuals.RelativePose(steps, sigma=0.01), T[:4], T[1:], carry_over=True)
    problem.fix(T[0])
    solution = problem.solve()
    assert solution._problem.layout.tangents[0] == bp.SE3 and solution.status == "converged"
    np.testing.assert_allclose(solution[T][:, 4:], poses[0, 4:] + np.arange(5.0)[:, None] * [1.01, 0.02, 0.0], atol=1e-6)
