"""Small problems with known answers, shared by the tests of the solver."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus import SE3, Euclidean, Pinhole, Problem, SE3Left
from boxplus.manifolds import se3
from boxplus.optimization.terms.variables import Variables
from boxplus.residuals import RelativePose, Reprojection


@dataclass(frozen=True)
class Ring:
    """Poses on a circle with noisy measurements between neighbours and across."""

    problem: Problem
    poses: Variables
    truth: NDArray[np.float64]
    edges: NDArray[np.int64]


@dataclass(frozen=True)
class Scene:
    """Cameras around a cloud of points, every point seen by several."""

    problem: Problem
    cameras: Variables
    points: Variables
    truth: tuple[NDArray[np.float64], NDArray[np.float64]]


def make_ring(count: int = 12, noise: float = 0.01, start_noise: float = 0.1, seed: int = 0) -> Ring:
    """A ring whose first pose is not held."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    zeros = np.zeros(count)
    turn = se3.exp(np.stack([zeros, zeros, angle, zeros, zeros, zeros], -1))
    truth = SE3.boxplus(turn, np.tile([0.0, 0.0, 0.0, 3.0, 0.0, 0.0], (count, 1)))
    i = np.concatenate([np.arange(count), np.arange(count)])
    j = np.concatenate([(np.arange(count) + 1) % count, (np.arange(count) + 3) % count])
    measured = SE3.boxplus(se3.compose(se3.inverse(truth[i]), truth[j]), noise * rng.standard_normal((len(i), 6)))
    problem = Problem()
    start = SE3.boxplus(truth, start_noise * rng.standard_normal((count, 6)))
    start[0] = truth[0]
    poses = problem.add_variables(SE3, start, name="poses")
    problem.add_residuals(RelativePose(measured, sigma=noise), poses[i], poses[j], name="edges")
    return Ring(problem, poses, truth, np.stack([i, j], 1))


def make_scene(cameras: int = 5, points: int = 40, noise: float = 0.5, start_noise: float = 0.03, seed: int = 0) -> Scene:
    """A bundle adjustment whose first two cameras are held."""
    rng = np.random.default_rng(seed)
    camera = Pinhole(400.0, 410.0, 320.0, 240.0)
    p_world = rng.uniform([-1.0, -1.0, 4.0], [1.0, 1.0, 6.0], (points, 3))
    tangent = np.concatenate([0.1 * rng.standard_normal((cameras, 3)), 0.4 * rng.standard_normal((cameras, 3))], 1)
    T_camera_world = se3.exp(tangent)
    camera_of, point_of = np.nonzero(rng.random((cameras, points)) < 0.8)
    pixels, valid = camera.project(se3.act(T_camera_world[camera_of], p_world[point_of]))
    assert valid.all()
    problem = Problem()
    start = SE3Left.boxplus(T_camera_world, start_noise * rng.standard_normal((cameras, 6)))
    start[:2] = T_camera_world[:2]
    cams = problem.add_variables(SE3Left, start, name="cameras")
    pts = problem.add_variables(Euclidean(3), p_world + 3 * start_noise * rng.standard_normal(p_world.shape), name="points")
    residual = Reprojection(camera, pixels + noise * rng.standard_normal(pixels.shape), sigma=max(noise, 0.1))
    problem.add_residuals(residual, cams[camera_of], pts[point_of], name="pixels")
    problem.fix(cams[:2])
    return Scene(problem, cams, pts, (T_camera_world, p_world))


def dense_normal_equations(problem: Problem) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """H and g over the free variables, from the groups' Jacobians, without any of the solver's own assembly."""
    columns: dict[tuple[int, int], slice] = {}
    at = 0
    for block in problem.blocks:
        for row in np.flatnonzero(~block.is_fixed):
            columns[block.number, int(row)] = slice(at, at + block.manifold.dof)
            at += block.manifold.dof
    H, g = np.zeros((at, at)), np.zeros(at)
    for group in problem.groups:
        for n in range(group.residual.count):
            J = np.zeros((group.residual.dim, at))
            for connection, jacobian in zip(group.connections, group.jacobians, strict=True):
                key = (connection.block.number, int(connection.rows[n]))
                if key in columns:
                    J[:, columns[key]] += jacobian[n]
            H += J.T @ J
            g += J.T @ group.r[n]
    return H, g


@pytest.fixture
def ring() -> Ring:
    """A fresh ring."""
    return make_ring()


@pytest.fixture
def scene() -> Scene:
    """A fresh scene."""
    return make_scene()
