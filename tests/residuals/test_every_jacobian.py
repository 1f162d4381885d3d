"""Every residual the package ships passes `check_jacobian`, far from zero residual, on every update of its poses."""

import inspect
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus import residuals
from boxplus.cameras.distortion import RadialTangential
from boxplus.cameras.pinhole import Pinhole
from boxplus.manifolds import se3
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.lines import from_points
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import UnitQuaternion
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3, SE3Left
from boxplus.optimization.jacobian_check import check_jacobian
from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.residuals.inertial.imu_preintegration import Preintegration
from boxplus.residuals.residual import Residual

COUNT = 30
POSES: tuple[Manifold, ...] = (SE3, SE3Left, Product(UnitQuaternion, Euclidean(3)))
CAMERA = Pinhole(420.0, 430.0, 310.0, 245.0)
LENS = Pinhole(420.0, 430.0, 310.0, 245.0, RadialTangential(0.1, -0.05, 1e-3, 2e-3))

Case = tuple[Residual, list[NDArray[np.float64]]]


def _pixels(rng: np.random.Generator) -> NDArray[np.float64]:
    return rng.uniform([100.0, 100.0], [520.0, 380.0], (COUNT, 2))


def _view(rng: np.random.Generator, depth_sign: float = 1.0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Camera poses anywhere, and a point in front of each."""
    T = SE3.random(rng, COUNT)
    z = rng.uniform(2.0, 8.0, (COUNT, 1))
    p_camera = np.hstack([rng.uniform(-0.5, 0.5, (COUNT, 2)) * z, depth_sign * z])
    return T, se3.act(se3.inverse(T), p_camera)


def _near(rng: np.random.Generator, T: NDArray[np.float64]) -> NDArray[np.float64]:
    return SE3Left.boxplus(T, 0.1 * rng.normal(size=(len(T), 6)))


def _reprojection(rng: np.random.Generator) -> Case:
    return residuals.Reprojection(LENS, _pixels(rng)), list(_view(rng))


def _intrinsics(rng: np.random.Generator) -> Case:
    return residuals.ReprojectionIntrinsics(LENS, _pixels(rng)), [*_view(rng), LENS.parameters]


def _tied_intrinsics(rng: np.random.Generator) -> Case:
    basis = np.zeros((8, 2))
    basis[:2, 0] = basis[4, 1] = 1.0  # one focal length, and k1
    return residuals.ReprojectionTiedIntrinsics(LENS, _pixels(rng), LENS.parameters, basis), [*_view(rng), np.array([5.0, 0.02])]


def _bal(rng: np.random.Generator) -> Case:
    T, p = _view(rng, -1.0)
    intrinsics = np.tile([500.0, -0.1, 0.02], (COUNT, 1))
    return residuals.BalReprojection(_pixels(rng)), [np.hstack([T, intrinsics]), p]


def _inverse_depth(rng: np.random.Generator) -> Case:
    T, point = SE3.random(rng, COUNT), rng.uniform([-0.4, -0.3, 0.1], [0.4, 0.3, 0.5], (COUNT, 3))
    return residuals.InverseDepthReprojection(LENS, _pixels(rng)), [T, _near(rng, T), point]


def _inverse_depth_intrinsics(rng: np.random.Generator) -> Case:
    T, point = SE3.random(rng, COUNT), np.hstack([_pixels(rng), rng.uniform(0.1, 0.5, (COUNT, 1))])
    return residuals.InverseDepthIntrinsics(_pixels(rng)), [T, _near(rng, T), point, CAMERA.parameters]


def _on_body(rng: np.random.Generator) -> Case:
    T, p = _view(rng)
    mounting = SE3.random(rng, COUNT)
    body = se3.inverse(se3.compose(mounting, T))
    seen = residuals.OnBody(residuals.Reprojection(LENS, _pixels(rng)), image_velocity=100.0 * rng.normal(size=(COUNT, 2)))
    return seen, [body, mounting, p, np.array([0.01])]


def _line(rng: np.random.Generator) -> Case:
    T, p = _view(rng)
    q = se3.act(se3.inverse(T), [0.3, 0.2, 4.0])
    return residuals.LineReprojection(CAMERA, np.hstack([_pixels(rng), _pixels(rng)])), [T, from_points(p, q)]


def _photometric(rng: np.random.Generator) -> Case:
    # An image that is bilinear everywhere has no kinks between its pixels; these numbers are exact in float32.
    v, u = np.mgrid[:480, :640]
    first, second = 0.25 * u + 0.125 * v, 10.0 + 0.25 * u - 0.125 * v + u * v / 1024.0
    T = SE3Left.boxplus(SE3.identity(), 0.05 * rng.normal(size=(COUNT, 6)))
    residual = residuals.Photometric(
        CAMERA, first, second, _pixels(rng), pattern=((0, 0), (2, 1)), inverse_depth=True, intrinsics=True, brightness=True
    )
    return residual, [T, rng.uniform(0.1, 0.5, (COUNT, 1)), CAMERA.parameters, np.array([0.1, 3.0])]


def _relative(kind: Callable[..., Residual], manifold: Manifold) -> Callable[[np.random.Generator], Case]:
    def case(rng: np.random.Generator) -> Case:
        T_i = manifold.random(rng, COUNT)
        step = rng.uniform(-1.0, 1.0, (COUNT, manifold.dof))
        return kind(manifold.random(rng, 1).repeat(COUNT, axis=0)), [T_i, manifold.boxplus(T_i, step)]

    return case


def _anchored(rng: np.random.Generator) -> Case:
    A, T = SE3.random(rng, 2), SE3.random(rng, COUNT)
    second = _near(rng, se3.compose(se3.inverse(A[1]), se3.compose(A[0], T)))
    return residuals.AnchoredRelativePose(SE3.random(rng, 1).repeat(COUNT, axis=0)), [A[0], T, A[1], second]


def _prior(rng: np.random.Generator) -> Case:
    mean = SE3.random(rng, COUNT)
    return residuals.Prior(SE3, mean), [SE3.boxplus(mean, rng.uniform(-1.5, 1.5, (COUNT, 6)))]


def _points(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    normals = rng.normal(size=(COUNT, 3))
    return (
        5.0 * rng.normal(size=(COUNT, 3)),
        5.0 * rng.normal(size=(COUNT, 3)),
        normals / np.linalg.norm(normals, axis=1)[:, None],
    )


def _point_to_point(rng: np.random.Generator) -> Case:
    return residuals.PointToPoint(*_points(rng)[:2]), [SE3.random(rng, 1)[0]]


def _point_to_plane(rng: np.random.Generator) -> Case:
    return residuals.PointToPlane(*_points(rng)), [SE3.random(rng, 1)[0]]


def _plane_cluster(rng: np.random.Generator) -> Case:
    points = np.concatenate([rng.normal(size=(COUNT, 12, 3)), np.ones((COUNT, 12, 1))], axis=2)
    clusters = np.swapaxes(points, 1, 2) @ points
    T = POSES[2].random(rng, COUNT)
    return residuals.PlaneCluster(clusters, rng.normal(size=3)), [
        T,
        POSES[2].random(rng, 1)[0],
        residuals.Plane.random(rng, COUNT),
    ]


def _pose_quadratic(rng: np.random.Generator) -> Case:
    roots = rng.normal(size=(COUNT, 5, 13))
    forms = np.swapaxes(roots, 1, 2) @ roots
    return residuals.PoseQuadratic(forms, rng.normal(size=(COUNT, 3))), [POSES[2].random(rng, COUNT)]


def _gicp(rng: np.random.Generator) -> Case:
    covariance = np.tile(np.diag([1.0, 1.0, 0.01]), (COUNT, 1, 1))
    return residuals.Gicp(*_points(rng)[:2], covariance, covariance), [SE3.random(rng, 1)[0]]


def _gravity(rng: np.random.Generator) -> Case:
    return residuals.GravityDirection(_points(rng)[2], _points(rng)[2][0]), [SE3.random(rng, COUNT)]


def _antenna(rng: np.random.Generator) -> Case:
    fixes = residuals.AntennaPosition(_points(rng)[0], SE3.random(rng, COUNT), rng.normal(size=(COUNT, 3)))
    return fixes, [SE3.random(rng, 1)[0], SE3.random(rng, COUNT), np.array([0.3, -0.8, 1.2]), np.array([0.2])]


def _imu(rng: np.random.Generator) -> Case:
    time_ns = 10**18 + 5_000_000 * np.arange(200)
    begin = time_ns[0] + rng.integers(0, 300_000_000, COUNT)
    preintegration = Preintegration.integrate(
        time_ns,
        rng.normal(size=(200, 3)),
        5.0 * rng.normal(size=(200, 3)),
        noise=ImuNoise(gyro=0.02, accel=0.1, gyro_walk=0.003, accel_walk=0.05),
        intervals_ns=np.stack([begin, begin + 200_000_000], axis=1),
    )
    states = [POSES[2].random(rng, COUNT), rng.normal(size=(COUNT, 9)) * np.repeat([2.0, 0.3, 0.1], 3)] * 2
    states[2] = _near(rng, states[0])
    return residuals.ImuPreintegration(preintegration), states


def _marginal(rng: np.random.Generator) -> Case:
    T, b = SE3.random(rng, 1), rng.normal(size=(1, 2))
    prior = residuals.MarginalPrior([SE3, Euclidean(2)], [T[0], b[0]], rng.normal(size=(COUNT, 8)), rng.normal(size=COUNT))
    return prior, [_near(rng, T)[0], rng.normal(size=2)]


CASES: dict[str, Callable[[np.random.Generator], Case]] = {
    "AnchoredRelativePose": _anchored,
    "AntennaPosition": _antenna,
    "BalReprojection": _bal,
    "ChordalPose": _relative(residuals.ChordalPose, SE3),
    "ChordalPose2D": _relative(residuals.ChordalPose2D, SE2),
    "Gicp": _gicp,
    "GravityDirection": _gravity,
    "ImuPreintegration": _imu,
    "InverseDepthIntrinsics": _inverse_depth_intrinsics,
    "InverseDepthReprojection": _inverse_depth,
    "LineReprojection": _line,
    "MarginalPrior": _marginal,
    "OnBody": _on_body,
    "Photometric": _photometric,
    "PlaneCluster": _plane_cluster,
    "PointToPlane": _point_to_plane,
    "PointToPoint": _point_to_point,
    "PoseQuadratic": _pose_quadratic,
    "Prior": _prior,
    "RelativePose": _relative(residuals.RelativePose, SE3),
    "RelativePose2D": _relative(residuals.RelativePose2D, SE2),
    "Reprojection": _reprojection,
    "ReprojectionIntrinsics": _intrinsics,
    "ReprojectionTiedIntrinsics": _tied_intrinsics,
}
# Its Jacobians are the user's: user/test_residual.py.
NOT_SHIPPED = {"UserResidual"}


def _on(pose: Manifold, native: Manifold) -> Manifold:
    """The native manifold with every pose in it moving as `pose` does."""
    if native in POSES:
        return pose
    return Product(*(_on(pose, part) for part in native.components)) if isinstance(native, Product) else native


def test_no_residual_is_forgotten() -> None:
    shipped = {
        name
        for name in residuals.__all__
        if inspect.isclass(kind := getattr(residuals, name)) and issubclass(kind, Residual) and not inspect.isabstract(kind)
    }
    assert shipped - NOT_SHIPPED == set(CASES)


@pytest.mark.parametrize("pose", POSES, ids=str)
@pytest.mark.parametrize("name", CASES)
def test_jacobians_agree_with_differences(name: str, pose: Manifold) -> None:
    residual, x = CASES[name](np.random.default_rng(1))
    manifolds = tuple(_on(pose, native) for native in residual.manifolds)
    report = check_jacobian(residual, *x, manifolds=manifolds)
    assert report.passed, report
    assert report.invalid + report.unsteady <= COUNT // 5, report
    assert report.largest_residual > 0.5
    assert manifolds[0] in (pose, SE2, Product(pose, Euclidean(3)))
