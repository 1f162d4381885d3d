"""Automatic Jacobians of a user's residual against the analytic ones of the library's, on every manifold."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numba.core import config as numba_config

import boxplus as bp
from boxplus.manifolds.quaternion import multiply_scalars, rotate
from boxplus.manifolds.se3 import between_into, between_scalars, log_scalars
from boxplus.manifolds.tangents.basis import tangent_basis_into
from boxplus.manifolds.tangents.step import tangent_steps
from boxplus.residuals.user.residual import UserResidual

compiles = pytest.mark.skipif(bool(numba_config.DISABLE_JIT), reason="what is not compiled is not differentiated")


def relative_pose(T_i, T_j, z):
    qw, qx, qy, qz, x, y, t = between_scalars(T_i, T_j)
    qw, qx, qy, qz = multiply_scalars(z[0], -z[1], -z[2], -z[3], qw, qx, qy, qz)
    x, y, t = rotate(z[0], -z[1], -z[2], -z[3], x - z[4], y - z[5], t - z[6])
    return log_scalars(qw, qx, qy, qz, x, y, t)


def relative_pose_by_arrays(T_i, T_j, z):
    T = np.empty(7)
    between_into(T_i, T_j, T)
    between_into(z, T, T)
    return log_scalars(T[0], T[1], T[2], T[3], T[4], T[5], T[6])


def relative_pose_2d(T_i, T_j, z):
    c, s = math.cos(T_i[0]), math.sin(T_i[0])
    x, y = T_j[1] - T_i[1], T_j[2] - T_i[2]
    x, y = c * x + s * y - z[1], c * y - s * x - z[2]
    angle = (T_j[0] - T_i[0] - z[0] + math.pi) % (2.0 * math.pi) - math.pi
    c, s = math.cos(z[0]), math.sin(z[0])
    x, y = c * x + s * y, c * y - s * x
    half = 0.5 * angle
    diagonal = half / math.tan(half) if abs(half) > 1e-4 else 1.0 - half * half / 3.0
    return angle, diagonal * x + half * y, diagonal * y - half * x


def point_to_plane(T, p, q, n):
    x, y, z = rotate(T[0], T[1], T[2], T[3], p[0], p[1], p[2])
    d = np.array([x + T[4] - q[0], y + T[5] - q[1], z + T[6] - q[2]])
    return np.dot(n, d)


def reprojection(T, p, pixel):
    x, y, z = rotate(T[0], T[1], T[2], T[3], p[0], p[1], p[2])
    x, y, z = x + T[4], y + T[5], z + T[6]
    if z <= 0.0:
        return None
    return pixel[0] - (500.0 * x / z + 320.0), pixel[1] - (510.0 * y / z + 240.0)


def _unit(rng: np.random.Generator, count: int) -> np.ndarray:
    n = rng.normal(size=(count, 3))
    return np.asarray(n / np.linalg.norm(n, axis=1, keepdims=True))


def _cases() -> dict[str, Callable[[np.random.Generator, int], tuple[Any, ...]]]:
    """Function, the library's residual, the data, and the variables."""
    residuals = bp.residuals

    def pose(function: Callable[..., Any]) -> Callable[[np.random.Generator, int], tuple[Any, ...]]:
        def case(rng: np.random.Generator, n: int) -> tuple[Any, ...]:
            z, T_i, T_j = (bp.SE3.random(rng, n) for _ in range(3))
            return function, residuals.RelativePose(z), (z,), (T_i, T_j)

        return case

    def planar(rng: np.random.Generator, n: int) -> tuple[Any, ...]:
        z, T_i, T_j = (bp.SE2.random(rng, n) for _ in range(3))
        return relative_pose_2d, residuals.RelativePose2D(z), (z,), (T_i, T_j)

    def plane(rng: np.random.Generator, n: int) -> tuple[Any, ...]:
        p, q, normals = rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), _unit(rng, n)
        return point_to_plane, residuals.PointToPlane(p, q, normals), (p, q, normals), (bp.SE3.random(rng, n),)

    def camera(rng: np.random.Generator, n: int) -> tuple[Any, ...]:
        pixels, p = rng.uniform(0.0, 640.0, (n, 2)), rng.normal(size=(n, 3))
        T = bp.SE3.random(rng, n)
        T[:, 6] += np.where(np.arange(n) % 7 == 3, -20.0, 6.0)  # some behind the camera
        pinhole = bp.Pinhole(500.0, 510.0, 320.0, 240.0)
        return reprojection, residuals.Reprojection(pinhole, pixels), (pixels,), (T, p)

    return {
        "relative pose": pose(relative_pose),
        "relative pose by arrays": pose(relative_pose_by_arrays),
        "relative pose in the plane": planar,
        "point to plane": plane,
        "reprojection": camera,
    }


@compiles
@pytest.mark.parametrize("name", _cases())
def test_automatic_jacobians_are_those_of_the_library(name: str) -> None:
    function, built_in, data, x = _cases()[name](np.random.default_rng(3), 60)
    residual = UserResidual(function, dim=built_in.dim, manifolds=built_in.manifolds, data=data)
    assert residual.jacobian_kind == "automatic" and residual.jacobian_note == ""
    ours, theirs = residual.linearize(*x), built_in.linearize(*x)
    assert np.array_equal(ours.valid, theirs.valid)
    for J, expected in zip(ours.jacobians, theirs.jacobians, strict=True):
        scale = np.abs(expected).max(axis=(1, 2), keepdims=True) + (~theirs.valid)[:, None, None]
        assert np.abs((J - expected) / scale).max() < 1e-12


@compiles
def test_residuals_and_validity_are_those_of_the_evaluation() -> None:
    function, built_in, data, x = _cases()["reprojection"](np.random.default_rng(4), 40)
    residual = UserResidual(function, dim=2, manifolds=built_in.manifolds, data=data)
    report = bp.check_jacobian(residual, *x, tolerance=1e-6)
    assert report.evaluate_agrees and report.passed and report.invalid > 0, report


MANIFOLDS = [
    bp.SO3,
    bp.UnitQuaternion,
    bp.UnitQuaternionLeft,
    bp.CameraPose,
    bp.SE2,
    bp.SE3,
    bp.SE3Left,
    bp.Sim3,
    bp.S2,
    bp.Line3D,
    bp.Euclidean(4),
    bp.Product(bp.SE2, bp.Product(bp.S2, bp.Euclidean(1)), bp.SE3Left),
]


@pytest.mark.parametrize("manifold", MANIFOLDS, ids=str)
def test_the_tangent_basis_is_the_derivative_of_boxplus_at_zero(manifold: bp.Manifold) -> None:
    steps, rng, h = tangent_steps(manifold), np.random.default_rng(5), 1e-3
    assert steps is not None
    for x in manifold.check("x", manifold.boxplus(manifold.identity(), 0.4 * rng.normal(size=(3, manifold.dof)))):
        basis = np.zeros((manifold.size + 3, manifold.dof + 2))
        tangent_basis_into(steps, x, basis, 2, 1)
        expected = np.zeros_like(basis)
        for k, e in enumerate(np.eye(manifold.dof)):
            ahead, behind, further, before = (manifold.boxplus(x, step * e) for step in (h, -h, 2 * h, -2 * h))
            expected[2:-1, 1 + k] = (8.0 * (ahead - behind) - (further - before)) / (12.0 * h)
        assert np.allclose(basis, expected, atol=1e-9)


def wave(x, weights):
    first, second = 0.0, 1.0
    for k in range(len(x)):
        first += weights[k] * x[k] + math.sin(x[k] * weights[k])
        second += math.cos(x[k] + weights[k]) * x[k - 1]
    return first, second


@compiles
@pytest.mark.parametrize("manifold", [bp.Product(*MANIFOLDS[:-1]), MANIFOLDS[-1]], ids=["all", "nested"])
def test_automatic_jacobians_on_every_manifold(manifold: bp.Manifold) -> None:
    rng = np.random.default_rng(6)
    x = manifold.boxplus(np.tile(manifold.identity(), (4, 1)), rng.uniform(-1.0, 1.0, (4, manifold.dof)))
    residual = UserResidual(wave, dim=2, manifolds=(manifold,), data=(rng.normal(size=(4, manifold.size)),), jacobian="automatic")
    report = bp.check_jacobian(residual, x, tolerance=1e-8)
    assert report.passed, report


def test_what_is_asked_for_is_what_is_done_or_refused() -> None:
    plain = {"dim": 1, "manifolds": (bp.Euclidean(1),), "count": 2}

    def square(x):
        return x[0] * x[0]

    assert UserResidual(square, **plain, jacobian="differences").jacobian_kind == "numeric"
    with pytest.raises(bp.InputError, match=r"got 'exact' – leave it out"):
        UserResidual(square, **plain, jacobian="exact")
    with pytest.raises(bp.InputError, match="but for a batch function"):
        UserResidual(square, **plain, jacobian="automatic", is_batch=True)


@compiles
def test_a_solution_says_which_residuals_are_differentiated_by_differences() -> None:
    def whole(x):
        return x[0] - int(x[0] + 0.25)

    residual = UserResidual(whole, dim=1, manifolds=(bp.Euclidean(1),), count=1)
    problem = bp.Problem()
    x = problem.add_variables(bp.Euclidean(1), [[2.1]])
    problem.add_residuals(residual, x, name="teeth")
    notes = " ".join(problem.solve().notes)
    assert "teeth: whole is differentiated by differences, not automatically: No implementation of function" in notes


@compiles
def test_automatic_jacobians_are_kept_on_disk(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from boxplus._jit import on_compilation

    monkeypatch.setenv("BOXPLUS_CACHE_DIR", str(tmp_path / "cache"))

    def jacobian_and_compiled(factor: float) -> tuple[float, bool]:
        scope: dict[str, Any] = {"C": factor}
        exec("def f(x):\n    return C * x[0] * x[0]", scope)
        compiled: list[str] = []
        with on_compilation(compiled.append):
            residual = UserResidual(scope["f"], dim=1, manifolds=(bp.Euclidean(1),), count=1, jacobian="automatic")
            J = residual.linearize([3.0]).jacobians[0]
        return float(J[0, 0, 0]), bool(compiled)

    assert jacobian_and_compiled(1.0) == (6.0, True)
    assert jacobian_and_compiled(1.0) == (6.0, False)
    assert jacobian_and_compiled(2.0) == (12.0, True)


def gap(x, z):
    dx, dy = x[0] - z[0], x[1] - z[1]
    n = math.sqrt(dx * dx + dy * dy)
    if n < 1e-9:
        return 0.0, 0.0
    s = math.sin(n) / n
    return dx * s, dy * s


@compiles
@pytest.mark.parametrize("jacobian", [None, "automatic"])
def test_a_branch_at_zero_that_leaves_early_loses_no_derivative(jacobian: Any) -> None:
    z = np.array([[1.0, 2.0], [0.0, 0.0], [1.0, 2.0]])
    residual = UserResidual(gap, dim=2, manifolds=(bp.Euclidean(2),), data=(z,), jacobian=jacobian, sigma=0.1)
    assert residual.jacobian_kind == "automatic"
    report = bp.check_jacobian(residual, [[1.0, 2.0], [0.5, 0.3], [1.1, 2.0]], tolerance=1e-8)
    assert report.passed, report
    problem = bp.Problem()
    point = problem.add_variables(bp.Euclidean(2), [[1.0, 2.0]])
    problem.add_residuals(UserResidual(gap, dim=2, manifolds=(bp.Euclidean(2),), data=(z[:1],), sigma=0.1), point)
    assert np.allclose(problem.solve().covariance(point), 0.01 * np.eye(2))


@compiles
@pytest.mark.parametrize("seed", range(4))
def test_rows_behind_such_a_branch_are_found_beside_others_and_on_manifolds(seed: int) -> None:
    def turned(T_i, T_j, p, z):  # three rows of rotation, lost where it agrees; one of a distance, which is not
        qw, qx, qy, qz, x, y, t = between_scalars(T_i, T_j)
        n = math.sqrt(qx * qx + qy * qy + qz * qz)
        distance = x * x + y * y + t * t + p[0] - z
        if n < 1e-9:
            return 0.0, 0.0, 0.0, distance
        s = 2.0 * math.atan2(n, qw) / n
        return s * qx, s * qy, s * qz, distance

    rng = np.random.default_rng(seed)
    T_i, T_j = (bp.SE3.random(rng, 9) for _ in range(2))
    T_j[::2, :4] = T_i[::2, :4]
    p, z = rng.normal(size=(9, 1)), rng.normal(size=9)
    manifolds = (bp.SE3, bp.SE3, bp.Euclidean(1))
    ours, by_differences = (
        UserResidual(turned, dim=4, manifolds=manifolds, data=(z,), jacobian=kind).linearize(T_i, T_j, p)
        for kind in ("automatic", "differences")
    )
    for J, expected in zip(ours.jacobians, by_differences.jacobians, strict=True):
        assert np.allclose(J, expected, atol=1e-8) and np.abs(expected).max() > 0.1


@compiles
def test_what_is_flat_a_corner_or_curved_keeps_the_derivative_zero() -> None:
    names = ["max(0.0, t)", "7.0", "abs(t)", "t * t", "t * t * t", "np.floor(t)", "np.sign(t)", "max(0.0, t - 1e-6)", "lost"]
    lines = ["t = x[0] + 0.0 * x[1]", "lost = 0.0 if abs(t) < 1e-9 else 3.0 * t", f"return {', '.join(names)}"]
    scope: dict[str, Any] = {"np": np}
    exec("def f(x):\n    " + "\n    ".join(lines), scope)
    residual = UserResidual(scope["f"], dim=9, manifolds=(bp.Euclidean(2),), count=1, jacobian="automatic")
    J = residual.linearize([0.0, 1.0]).jacobians[0][0]
    assert np.array_equal(J[:8], np.zeros((8, 2))) and np.allclose(J[8], [3.0, 0.0])


@compiles
def test_nothing_is_straight_beside_a_singular_residual() -> None:
    def half(x):
        if x[0] < 0.0:
            return None
        return 0.0 if x[0] < 1e-9 else x[0]

    residual = UserResidual(half, dim=1, manifolds=(bp.Euclidean(1),), count=2, jacobian="automatic")
    assert np.array_equal(residual.linearize([[0.0], [0.5]]).jacobians[0][:, 0, 0], [0.0, 1.0])
