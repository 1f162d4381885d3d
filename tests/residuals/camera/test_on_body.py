"""Camera residuals on the pose of the body: VINS-Mono's formulas in NumPy, differences, shared variables, the time offset."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import boxplus as bp
from boxplus import residuals
from boxplus.cameras.distortion import RadialTangential
from boxplus.manifolds import quaternion, se3, so3
from boxplus.manifolds.lines import from_points
from boxplus.residuals.residual import Residual

COUNT = 25
CAMERA = bp.Pinhole(420.0, 430.0, 310.0, 245.0)
LENS = bp.Pinhole(420.0, 430.0, 310.0, 245.0, RadialTangential(0.1, -0.05, 1e-3, 2e-3))
Values = list[NDArray[np.float64]]


def nearby(rng: np.random.Generator, T: NDArray[np.float64], angle: float, distance: float) -> NDArray[np.float64]:
    return bp.BodyPose.boxplus(T, rng.uniform(-1.0, 1.0, (len(T), 6)) * np.repeat([angle, distance], 3))


def camera_pose(body: NDArray[np.float64], mounting: NDArray[np.float64]) -> NDArray[np.float64]:
    return se3.inverse(se3.compose(body, mounting))


def two_views(rng: np.random.Generator) -> Values:
    """Bodies anywhere, whose cameras look the same way from up to a metre apart; mountings are anything."""
    first, mounting_1 = bp.BodyPose.random(rng, COUNT), bp.BodyPose.random(rng, COUNT)
    body_2 = nearby(rng, first, 1.0, 3.0)
    seen_from = nearby(rng, se3.compose(first, mounting_1), 0.15, 0.5)
    return [first, mounting_1, body_2, se3.compose(se3.inverse(body_2), seen_from)]


def one_view(rng: np.random.Generator) -> tuple[Values, NDArray[np.float64]]:
    """A body with its mounting, and a point in front of each camera."""
    body, mounting = bp.BodyPose.random(rng, COUNT), bp.BodyPose.random(rng, COUNT)
    z = rng.uniform(2.0, 8.0, (COUNT, 1))
    seen = np.hstack([rng.uniform(-0.5, 0.5, (COUNT, 2)) * z, z])
    return [body, mounting], se3.act(se3.compose(body, mounting), seen)


def pixels(rng: np.random.Generator) -> NDArray[np.float64]:
    return rng.uniform([100.0, 100.0], [520.0, 380.0], (COUNT, 2))


def reprojection(rng: np.random.Generator) -> tuple[Residual, Values]:
    pair, p = one_view(rng)
    return residuals.Reprojection(LENS, pixels(rng)), [*pair, p]


def intrinsics(rng: np.random.Generator) -> tuple[Residual, Values]:
    pair, p = one_view(rng)
    return residuals.ReprojectionIntrinsics(LENS, pixels(rng)), [*pair, p, LENS.parameters]


def tied_intrinsics(rng: np.random.Generator) -> tuple[Residual, Values]:
    pair, p = one_view(rng)
    basis = np.zeros((8, 2))
    basis[:2, 0] = basis[4, 1] = 1.0
    residual = residuals.ReprojectionTiedIntrinsics(LENS, pixels(rng), LENS.parameters, basis)
    return residual, [*pair, p, np.array([5.0, 0.02])]


def inverse_depth(rng: np.random.Generator) -> tuple[Residual, Values]:
    point = rng.uniform([-0.4, -0.3, 0.1], [0.4, 0.3, 0.5], (COUNT, 3))
    return residuals.InverseDepthReprojection(LENS, pixels(rng)), [*two_views(rng), point]


def inverse_depth_intrinsics(rng: np.random.Generator) -> tuple[Residual, Values]:
    point = np.hstack([pixels(rng), rng.uniform(0.1, 0.5, (COUNT, 1))])
    return residuals.InverseDepthIntrinsics(pixels(rng)), [*two_views(rng), point, CAMERA.parameters]


def line(rng: np.random.Generator) -> tuple[Residual, Values]:
    pair, p = one_view(rng)
    q = se3.act(se3.compose(*pair), [0.3, 0.2, 4.0])
    return residuals.LineReprojection(CAMERA, np.hstack([pixels(rng), pixels(rng)])), [*pair, from_points(p, q)]


def photometric(rng: np.random.Generator) -> tuple[Residual, Values]:
    # Bilinear everywhere, so that there are no kinks between the pixels.
    v, u = np.mgrid[:480, :640]
    first, second = 0.25 * u + 0.125 * v, 10.0 + 0.25 * u - 0.125 * v + u * v / 1024.0
    residual = residuals.Photometric(
        CAMERA, first, second, rng.uniform([250, 180], [390, 300], (COUNT, 2)), pattern=((0, 0), (2, 1)),
        inverse_depth=True, intrinsics=True, brightness=True,
    )  # fmt: skip
    body_1, mounting_1, body_2, mounting_2 = two_views(rng)
    mounting_2 = se3.compose(se3.inverse(body_2), nearby(rng, se3.compose(body_1, mounting_1), 0.05, 0.1))
    rho = rng.uniform(0.1, 0.5, (COUNT, 1))
    return residual, [body_1, mounting_1, body_2, mounting_2, rho, CAMERA.parameters, np.array([0.1, 3.0])]


KINDS = [reprojection, intrinsics, tied_intrinsics, inverse_depth, inverse_depth_intrinsics, line, photometric]


def on_body(kind: object, seed: int) -> tuple[residuals.OnBody, Values]:
    """The residual of a kind, with a time offset where it measures image coordinates."""
    rng = np.random.default_rng(seed)
    inner, x = kind(rng)  # type: ignore[operator]
    if kind is photometric:
        return residuals.OnBody(inner), x
    velocity = 300.0 * rng.normal(size=(COUNT, 4 if kind is line else 2))
    moving = residuals.OnBody(inner, image_velocity=velocity, time_offset_s=0.02 * rng.normal(size=COUNT))
    return moving, [*x, 0.05 * rng.normal(size=(COUNT, 1))]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
@settings(max_examples=6)
@given(seed=st.integers(0, 10_000))
def test_jacobians(kind: object, seed: int) -> None:
    residual, x = on_body(kind, seed)
    assert len(residual.roles) == len(residual.manifolds) == len(x)
    report = bp.check_jacobian(residual, *x)
    assert report.passed and report.largest_residual > 1.0, str(report)
    assert report.invalid + report.unsteady <= COUNT // 5, str(report)


@pytest.mark.parametrize("kind", [reprojection, inverse_depth, line, photometric], ids=lambda kind: kind.__name__)
def test_residuals_are_those_of_the_camera(kind: object) -> None:
    inner, x = kind(np.random.default_rng(3))  # type: ignore[operator]
    residual = residuals.OnBody(inner)
    poses = [camera_pose(x[0], x[1])]
    if len(x) > 4:
        poses.append(camera_pose(x[2], x[3]))
    if kind is photometric:
        poses = [se3.compose(poses[1], se3.inverse(poses[0]))]
    rest = x[4:] if len(x) > 4 else x[2:]
    np.testing.assert_allclose(residual.evaluate(*x), inner.evaluate(*poses, *rest), atol=1e-9)


def formula(
    x: Values, z: NDArray[np.float64], rho: NDArray[np.float64]
) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """e and its blocks for a point at inverse depth in a camera without distortion, as VINS-Mono has them times ρ."""
    anchor, mounting_a, observer, mounting_j = x[:4]
    R_a, R_j = quaternion.to_matrix(anchor[:, :4]), quaternion.to_matrix(observer[:, :4])
    R_ca, R_cj = quaternion.to_matrix(mounting_a[:, :4]), quaternion.to_matrix(mounting_j[:, :4])
    p_a, p_j, p_ca, p_cj = anchor[:, 4:], observer[:, 4:], mounting_a[:, 4:], mounting_j[:, 4:]
    m = np.hstack([x[4][:, :2], np.ones((COUNT, 1))])

    def on(R: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.einsum("nij,nj->ni", R, v)

    y_a = on(R_ca, m) + rho * p_ca
    y_j = on(R_j.swapaxes(1, 2), on(R_a, y_a) + rho * (p_a - p_j))
    A = R_cj.swapaxes(1, 2)
    Y = on(A, y_j - rho * p_cj)
    B = A @ R_j.swapaxes(1, 2)
    f = np.array([CAMERA.fx, CAMERA.fy])
    e = z - (f * Y[:, :2] / Y[:, 2:] + [CAMERA.cx, CAMERA.cy])
    P = np.zeros((COUNT, 2, 3))
    P[:, [0, 1], [0, 1]] = f / Y[:, 2:]
    P[:, :, 2] = -f * Y[:, :2] / Y[:, 2:] ** 2
    r = rho[:, :, None]
    blocks = {
        "T_world_anchor_body": np.concatenate([-B @ R_a @ so3.hat(y_a), r * B], axis=2),
        "T_world_observer_body": np.concatenate([A @ so3.hat(y_j), -r * B], axis=2),
        "T_body_anchor_camera": np.concatenate([-B @ R_a @ R_ca @ so3.hat(m), r * B @ R_a], axis=2),
        "T_body_observer_camera": np.concatenate([so3.hat(Y), -r * A], axis=2),
        "bearing_rho": np.concatenate(
            [(B @ R_a @ R_ca)[:, :, :2], (on(B, on(R_a, p_ca) + p_a - p_j) - on(A, p_cj))[:, :, None]], axis=2
        ),
    }
    return e, {name: -P @ block for name, block in blocks.items()}


@pytest.mark.parametrize("far", [False, True], ids=["near", "at infinity"])
@settings(max_examples=10)
@given(seed=st.integers(0, 10_000))
def test_inverse_depth_is_the_formula(far: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = [*two_views(rng), rng.uniform([-0.4, -0.3, 0.1], [0.4, 0.3, 0.5], (COUNT, 3))]
    if far:
        x[4][:, 2] = 0.0
    z = pixels(rng)
    e, blocks = formula(x, z, x[4][:, 2:])
    residual = residuals.OnBody(residuals.InverseDepthReprojection(CAMERA, z))
    found = residual.linearize(*x)
    assert found.valid.sum() > COUNT // 2
    np.testing.assert_allclose(found.residuals[found.valid], e[found.valid], atol=1e-8)
    for role, J in zip(residual.roles, found.jacobians, strict=True):
        np.testing.assert_allclose(J[found.valid], blocks[role][found.valid], rtol=1e-9, atol=1e-7)
        if far and role != "bearing_rho":
            assert not J[:, :, 3:].any()


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000))
def test_jacobians_at_infinity(seed: int) -> None:
    """By everything but ρ, whose derivative is one-sided there: that one against the formula, which goes on below zero."""
    rng = np.random.default_rng(seed)
    x = [*two_views(rng), np.hstack([rng.uniform(-0.4, 0.4, (COUNT, 2)), np.zeros((COUNT, 1))])]
    z = pixels(rng)
    residual = residuals.OnBody(residuals.InverseDepthReprojection(CAMERA, z))
    report = bp.check_jacobian(residual, *x)
    assert all(check.passed for check in report.variables[:4]) and report.evaluate_agrees, str(report)
    found = residual.linearize(*x)
    h = 1e-4
    by_rho = (formula(x, z, np.full((COUNT, 1), h))[0] - formula(x, z, np.full((COUNT, 1), -h))[0]) / (2.0 * h)
    scale = np.abs(by_rho).max()
    np.testing.assert_allclose(found.jacobians[4][found.valid][:, :, 2], by_rho[found.valid], atol=1e-5 * scale)


def stacked(problem: bp.Problem) -> tuple[NDArray[np.float64], ...]:
    """Cost and Jacobians by every block of a group of one problem, through the solver's own path."""
    (group,) = problem.groups
    group.linearize(problem.values_at(), 1)
    sums: dict[int, NDArray[np.float64]] = {}
    for connection, J in zip(group.connections, group.jacobians, strict=True):
        sums[connection.block.number] = sums.get(connection.block.number, 0.0) + J
    return tuple(sums[number] for number in sorted(sums))


def test_shared_variables_get_the_sum() -> None:
    """Stereo partner in the anchor's frame: the pose drops out. Anchor and observer in one camera: one extrinsic."""
    rng = np.random.default_rng(8)
    body, mounting = bp.BodyPose.random(rng, 2), bp.BodyPose.random(rng, 1)
    body[1] = nearby(rng, body[:1], 0.1, 0.5)[0]
    other = nearby(rng, mounting, 0.05, 0.2)
    point = np.array([[0.1, -0.2, 0.4]])
    residual = residuals.OnBody(residuals.InverseDepthReprojection(CAMERA, [[250.0, 200.0]]))
    apart = residual.linearize(body[:1], mounting, body[1:], mounting, point).jacobians

    problem = bp.Problem()
    poses = problem.add_variables(bp.BodyPose, body)
    mountings = problem.add_variables(bp.BodyPose, np.vstack([mounting, other]))
    points = problem.add_variables(bp.Euclidean(3), point)
    problem.add_residuals(residual, poses[[0]], mountings[[0]], poses[[1]], mountings[[0]], points)
    by_pose, by_mounting, _ = stacked(problem)
    np.testing.assert_allclose(by_mounting, apart[1] + apart[3], atol=1e-12)
    np.testing.assert_allclose(by_pose, apart[0] + apart[2], atol=1e-12)

    stereo = bp.Problem()
    poses = stereo.add_variables(bp.BodyPose, body[:1])
    mountings = stereo.add_variables(bp.BodyPose, np.vstack([mounting, other]))
    points = stereo.add_variables(bp.Euclidean(3), point)
    stereo.add_residuals(residual, poses[[0]], mountings[[0]], poses[[0]], mountings[[1]], points)
    by_pose, by_mounting, by_point = stacked(stereo)
    np.testing.assert_allclose(by_pose, 0.0, atol=1e-10)
    assert np.abs(by_mounting).max() > 10.0 and np.abs(by_point).max() > 10.0

    # The sum is the derivative of the residual as a function of the one pose.
    def at(h: float, k: int) -> NDArray[np.float64]:
        moved = bp.BodyPose.boxplus(mounting, h * np.eye(6)[k])
        return residual.evaluate(body[:1], moved, body[1:], moved, point)[0]

    for k in range(6):
        difference = (8 * (at(1e-3, k) - at(-1e-3, k)) - (at(2e-3, k) - at(-2e-3, k))) / 12e-3
        np.testing.assert_allclose((apart[1] + apart[3])[0, :, k], difference, atol=1e-5)


def test_poses_shared_by_many_residuals_are_worked_out_once_and_to_the_same_bits() -> None:
    rng = np.random.default_rng(3)
    body, mounting = bp.BodyPose.random(rng, 3), bp.BodyPose.random(rng, 2)
    body[1:] = nearby(rng, np.repeat(body[:1], 2, axis=0), 0.1, 0.5)
    mounting[1:] = nearby(rng, mounting[:1], 0.05, 0.2)
    point = np.column_stack([rng.uniform(-0.3, 0.3, (COUNT, 2)), rng.uniform(0.1, 0.5, COUNT)])
    residual = residuals.OnBody(residuals.InverseDepthReprojection(CAMERA, pixels(rng)))
    of = [rng.integers(0, size, COUNT) for size in (3, 2, 3, 2)]
    problem = bp.Problem()
    bodies, mountings = problem.add_variables(bp.BodyPose, body), problem.add_variables(bp.BodyPose, mounting)
    points = problem.add_variables(bp.Euclidean(3), point)
    group = problem.add_residuals(residual, bodies[of[0]], mountings[of[1]], bodies[of[2]], mountings[of[3]], points)
    group.linearize([body, mounting, point], 1)
    alone = residual.linearize(body[of[0]], mounting[of[1]], body[of[2]], mounting[of[3]], point)
    np.testing.assert_array_equal(group.r, alone.residuals)
    for J, own in zip(group.jacobians, alone.jacobians, strict=True):
        np.testing.assert_array_equal(J, own)


def test_the_time_offset_moves_what_was_measured() -> None:
    rng = np.random.default_rng(4)
    pair, p = one_view(rng)
    z, velocity, cut = pixels(rng), 200.0 * rng.normal(size=(COUNT, 2)), 0.01 * rng.normal(size=COUNT)
    residual = residuals.OnBody(residuals.Reprojection(CAMERA, z), image_velocity=velocity, time_offset_s=cut)
    late = residuals.OnBody(residuals.Reprojection(CAMERA, z - (0.03 - cut)[:, None] * velocity))
    np.testing.assert_allclose(residual.evaluate(*pair, p, [0.03]), late.evaluate(*pair, p), atol=1e-10)
    # Measurements given stay as they were, whatever was evaluated before.
    np.testing.assert_array_equal(
        residual.evaluate(*pair, p, cut[:, None]), residuals.OnBody(residuals.Reprojection(CAMERA, z)).evaluate(*pair, p)
    )


def test_an_offset_far_from_that_of_the_poses_is_told() -> None:
    seen = residuals.Reprojection(CAMERA, [[1.0, 2.0], [3.0, 4.0]])
    residual = residuals.OnBody(seen, image_velocity=[[5.0, 6.0]] * 2, time_offset_s=[0.0, 0.004])
    assert residual.is_stale(0.003).tolist() == [False, False]
    assert residual.is_stale(0.006).tolist() == [True, False]
    with pytest.raises(bp.InputError, match="residuals with a time offset – got no image_velocity"):
        residuals.OnBody(seen).is_stale(0.0)


def test_a_residual_of_ones_own() -> None:
    """By the name of its variable."""

    def depth(T_camera_world, p_world, measured):  # type: ignore[no-untyped-def]
        qw, qx, qy, qz = T_camera_world[0], T_camera_world[1], T_camera_world[2], T_camera_world[3]
        z = 2.0 * (qx * qz - qw * qy) * p_world[0] + 2.0 * (qy * qz + qw * qx) * p_world[1]
        z += (1.0 - 2.0 * (qx * qx + qy * qy)) * p_world[2] + T_camera_world[6]
        return (measured - z,)

    rng = np.random.default_rng(6)
    pair, p = one_view(rng)
    own = residuals.UserResidual(depth, dim=1, manifolds=(bp.SE3Left, bp.Euclidean(3)), data=(rng.uniform(1, 9, COUNT),))
    report = bp.check_jacobian(residuals.OnBody(own), *pair, p)
    assert report.passed and report.largest_residual > 0.5, str(report)


def test_the_sign_of_the_time_offset() -> None:
    """A turning camera whose images are taken 4 ms later, by the IMU's clock, than they are stamped."""
    rng = np.random.default_rng(5)
    rate, speed, t_d = np.array([0.1, 0.8, -0.3]), np.array([0.5, 0.1, 0.2]), 0.004
    points = np.hstack([rng.uniform(-2, 2, (60, 2)), rng.uniform(3, 8, (60, 1))])
    mounting = bp.BodyPose.boxplus(bp.BodyPose.identity(), [0.1, -0.2, 0.05, 0.1, 0.02, -0.03])

    def seen(t: float) -> NDArray[np.float64]:
        body = np.concatenate([quaternion.from_matrix(so3.exp(rate * t)), speed * t])
        return CAMERA.project(se3.act(camera_pose(body, mounting), points))[0]

    stamp = 0.1
    velocity = (seen(stamp + t_d + 0.05) - seen(stamp + t_d - 0.05)) / 0.1  # from neighbouring images
    problem = bp.Problem()
    body = problem.add_variables(bp.BodyPose, np.concatenate([quaternion.from_matrix(so3.exp(rate * stamp)), speed * stamp]))
    mount, offset = problem.add_variables(bp.BodyPose, mounting), problem.add_variables(bp.Euclidean(1), [0.0])
    p = problem.add_variables(bp.Euclidean(3), points)
    residual = residuals.OnBody(residuals.Reprojection(CAMERA, seen(stamp + t_d)), image_velocity=velocity)
    problem.add_residuals(residual, body[[0]], mount[[0]], p, offset[[0]])
    for known in (body, mount, p):
        problem.fix(known)
    assert problem.solve()[offset][0, 0] == pytest.approx(t_d, abs=5e-5)


def test_refusals() -> None:
    seen = residuals.Reprojection(CAMERA, [[1.0, 2.0], [3.0, 4.0]])
    with pytest.raises(
        bp.InputError, match=r"a residual on the pose of a camera \(T_camera_world, .* got RelativePose of T_world_i"
    ):
        residuals.OnBody(residuals.RelativePose(bp.SE3.identity()[None]))
    with pytest.raises(bp.InputError, match=r"on the pose of a camera .* got BalReprojection of camera, p_world"):
        residuals.OnBody(residuals.BalReprojection([[1.0, 2.0]]))
    with pytest.raises(bp.InputError, match=r"image_velocity finite, of shape \(2, 2\) – got shape \(2,\)"):
        residuals.OnBody(seen, image_velocity=[1.0, 2.0])
    with pytest.raises(bp.InputError, match=r"time_offset_s finite, of shape \(\) or \(2,\) – got shape \(3,\)"):
        residuals.OnBody(seen, image_velocity=[[1.0, 2.0]] * 2, time_offset_s=[0.0] * 3)
    with pytest.raises(bp.InputError, match="image_velocity with time_offset_s – got none"):
        residuals.OnBody(seen, time_offset_s=0.01)
    inner, _ = photometric(np.random.default_rng(0))
    with pytest.raises(bp.InputError, match="image coordinates where the time offset is a variable – got Photometric"):
        residuals.OnBody(inner, image_velocity=[[1.0, 2.0]] * COUNT)
