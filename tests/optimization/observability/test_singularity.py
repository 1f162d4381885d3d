"""Singular problems of every kind: what the message says, and that Gauss-Newton never returns one as solved."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus import SE2, SE3, Euclidean, InputError, Line3D, Pinhole, Problem, SE3Left, SingularProblemError
from boxplus.manifolds import lines, quaternion, se2, se3
from boxplus.optimization.observability.variable_names import variable_names
from boxplus.optimization.terms.layout import Layout
from boxplus.residuals import LineReprojection, Prior, RelativePose, RelativePose2D, Reprojection, UserResidual
from tests.optimization.conftest import make_ring, make_scene

CAMERA = Pinhole(400.0, 410.0, 320.0, 240.0)
SOLVERS = ("dense", "sparse")


def message(problem: Problem, **settings) -> str:
    with pytest.raises(SingularProblemError) as caught:
        problem.solve(method="gauss_newton", **settings)
    text = str(caught.value)
    assert text.startswith("the problem does not determine its variables: ") and len(text) < 1500
    return text


def chain(manifold, T, measured, residual, start_noise=0.01, sigma=0.1):
    rng = np.random.default_rng(1)
    problem = Problem()
    start = manifold.boxplus(T, start_noise * rng.standard_normal((len(T), manifold.dof)))
    start[0] = T[0]
    poses = problem.add_variables(manifold, start, name="poses")
    i = np.arange(len(T) - 1)
    problem.add_residuals(residual(measured, sigma=sigma), poses[i], poses[i + 1], name="odometry")
    return problem, poses


def chain_3d(count=8):
    T = SE3.random(np.random.default_rng(0), count)
    return chain(SE3, T, se3.compose(se3.inverse(T[:-1]), T[1:]), RelativePose)


def observe(problem, cameras, points, T_camera_world, p_world, seen):
    """Pixels of (camera, point) pairs."""
    pairs = np.array(seen)
    pixels, valid = CAMERA.project(se3.act(T_camera_world[pairs[:, 0]], p_world[pairs[:, 1]]))
    assert valid.all()
    problem.add_residuals(Reprojection(CAMERA, pixels), cameras[pairs[:, 0]], points[pairs[:, 1]], name="pixels")


@pytest.mark.parametrize("linear_solver", SOLVERS)
@pytest.mark.parametrize("count", [4, 12, 40])
def test_a_pose_graph_without_gauge_is_any_rigid_motion(count, linear_solver):
    text = message(make_ring(count).problem, linear_solver=linear_solver)
    assert text == (
        "the problem does not determine its variables: "
        f"nothing ties poses[0…{count - 1}] to the world, only to each other: any rigid motion of them is unconstrained "
        f"(fix one of them, or add a prior); residuals touching them: edges ({2 * count} RelativePose)"
    )


@pytest.mark.parametrize("linear_solver", SOLVERS)
def test_a_planar_pose_graph_without_gauge_is_any_rigid_motion(linear_solver):
    T = SE2.random(np.random.default_rng(0), 10)
    problem, poses = chain(SE2, T, se2.compose(se2.inverse(T[:-1]), T[1:]), RelativePose2D)
    assert "any rigid motion of them is unconstrained" in message(problem, linear_solver=linear_solver)
    problem.add_residuals(Prior(SE2, T[:1], sigma=0.1), poses[0])
    assert problem.defects() == [] and problem.solve(method="gauss_newton").status == "converged"


def test_several_components_are_told_apart():
    T = SE3.random(np.random.default_rng(0), 9)
    problem = Problem()
    poses = problem.add_variables(SE3, SE3.boxplus(T, np.full(6, 0.01)), name="poses")
    i = np.array([0, 1, 3, 4, 6, 7])
    measured = se3.compose(se3.inverse(T[i]), T[i + 1])
    problem.add_residuals(RelativePose(measured, sigma=0.1), poses[i], poses[i + 1], name="odometry")
    problem.fix(poses[4])
    assert len(problem.defects()) == 2
    text = message(problem)
    assert "poses[0…2] to the world" in text and "poses[6…8] to the world" in text and "poses[3" not in text


@pytest.mark.parametrize("linear_solver", ("dense", "sparse", "schur"))
def test_a_monocular_bundle_adjustment_has_no_scale(linear_solver):
    scene = make_scene()
    scene.problem.free(scene.cameras[1])
    assert scene.problem.defects() == []
    text = message(scene.problem, linear_solver=linear_solver)
    centre = se3.inverse(scene.truth[0][0])[4:]
    assert "the scale about (" in text and "cameras[1…4], points[0…39] is unconstrained" in text
    told = text.split("about (")[1].split(")")[0]
    np.testing.assert_allclose([float(x) for x in told.split(",")], centre, atol=0.006)
    scene.problem.free(scene.cameras[0])
    assert "any rigid motion and the scale of them are unconstrained" in message(scene.problem, linear_solver=linear_solver)


@pytest.mark.parametrize("linear_solver", ("dense", "sparse", "schur"))
def test_points_seen_by_one_camera_move_along_their_rays(linear_solver):
    scene = make_scene(cameras=4, points=30)
    T, p = scene.truth
    problem = Problem()
    cameras = problem.add_variables(SE3Left, T, name="cameras")
    points = problem.add_variables(Euclidean(3), p + 0.01, name="points")
    seen = [(c, k) for k in range(30) for c in range(4) if c == 0 or k not in (7, 8, 9, 20)]
    observe(problem, cameras, points, T, p, seen)
    problem.fix(cameras[:2])
    text = message(problem, linear_solver=linear_solver)
    assert text.endswith(
        "points[7…9], points[20] can move along their viewing rays: each of the 4 is seen from one place only; "
        "residuals touching them: pixels (4 Reprojection)"
    )


def test_a_free_gauge_is_recognised_beside_points_that_are_free_alone():
    scene = make_scene(cameras=4, points=30)
    T, p = scene.truth
    problem = Problem()
    cameras = problem.add_variables(SE3Left, T, name="cameras")
    points = problem.add_variables(Euclidean(3), p + 0.01, name="points")
    seen = [(c, k) for k in range(30) for c in range(4) if k != 7 or c == 1]
    observe(problem, cameras, points, T, p, seen)
    text = message(problem)
    assert "points[7] can move along its viewing ray" in text
    assert "to the world, only to each other: any rigid motion and the scale of them are unconstrained" in text
    assert "can move freely" not in text


def test_one_such_point_is_told_in_the_singular():
    problem = Problem()
    cameras = problem.add_variables(SE3Left, SE3.identity()[None], name="cameras")
    points = problem.add_variables(Euclidean(3), [[0.1, 0.2, 5.01]], name="points")
    observe(problem, cameras, points, SE3.identity()[None], np.array([[0.0, 0.0, 5.0]]), [(0, 0)])
    problem.fix(cameras)
    assert "points[0] can move along its viewing ray: it is seen from one place only" in message(problem)


def test_a_line_seen_by_one_camera_moves_in_a_plane():
    rng = np.random.default_rng(0)
    line = lines.from_points(rng.uniform(-1, 1, (3, 3)) + np.array([0, 0, 5]), rng.uniform(-1, 1, (3, 3)) + np.array([0, 0, 6]))
    T = SE3.boxplus(np.tile(SE3.identity(), (3, 1)), 0.2 * rng.standard_normal((3, 6)))
    problem = Problem()
    cameras = problem.add_variables(SE3Left, T, name="cameras")
    variables = problem.add_variables(Line3D, line, name="lines")
    pairs = np.array([(0, 0), (1, 0), (2, 0), (0, 1), (0, 2), (2, 2)])
    segments = rng.uniform(0, 600, (len(pairs), 4))
    problem.add_residuals(LineReprojection(CAMERA, segments), cameras[pairs[:, 0]], variables[pairs[:, 1]], name="segments")
    problem.fix(cameras)
    text = message(problem)
    assert "lines[1] can move within a plane through the camera: it is seen from one place only" in text
    assert "lines[0]" not in text and "lines[2]" not in text


def test_a_part_that_can_slide_is_named_with_its_direction():
    # Marks 3…5 hang together firmly, but the survey that ties them to the rest does not measure along (3, 4, 0).
    along = np.array([0.6, 0.8, 0.0])
    across = np.array([[0.8, -0.6, 0.0], [0.0, 0.0, 1.0]])
    rng = np.random.default_rng(0)
    p = rng.standard_normal((6, 3))
    problem = Problem()
    marks = problem.add_variables(Euclidean(3), p + 0.1, name="marks")

    def difference(a, b, m):
        return b - a - m

    def seen_across(a, b, m):
        d = b - a
        return np.array([0.8 * d[0] - 0.6 * d[1] - m[0], d[2] - m[1]])

    i, j = np.array([0, 1, 3, 4]), np.array([1, 2, 4, 5])
    space = (Euclidean(3), Euclidean(3))
    problem.add_residuals(UserResidual(difference, manifolds=space, dim=3, data=(p[j] - p[i],)), marks[i], marks[j], name="tape")
    bridge = UserResidual(seen_across, manifolds=space, dim=2, data=((across @ (p[3] - p[2]))[None],))
    problem.add_residuals(bridge, marks[2], marks[3], name="survey")
    problem.add_residuals(Prior(Euclidean(3), p[:1]), marks[0], name="anchor")
    assert problem.defects() == []
    text = message(problem)
    assert f"translation along ({along[0]:.1f}, {along[1]:.1f}, 0) of marks[3…5] is unconstrained" in text
    assert text.endswith("residuals touching them: tape (2 UserResidual), survey (1 UserResidual)")


def test_ranges_in_the_plane_turn_about_a_fixed_mark():
    rng = np.random.default_rng(0)
    p = rng.standard_normal((6, 2))

    def distance(a, b, m):
        return np.array([np.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2) - m])

    i, j = np.triu_indices(6, 1)
    length = np.linalg.norm(p[i] - p[j], axis=1)
    problem = Problem()
    marks = problem.add_variables(Euclidean(2), p + 0.01 * rng.standard_normal(p.shape), name="marks")
    ranges = UserResidual(distance, manifolds=(Euclidean(2), Euclidean(2)), dim=1, data=(length,))
    problem.add_residuals(ranges, marks[i], marks[j], name="ranges")
    problem.fix(marks[2])
    x, y = marks.values[2]
    text = message(problem)
    assert "of marks[0…5] is unconstrained" in text and "rotation through (" in text
    told = text.split("rotation through (")[1].split(")")[0]
    np.testing.assert_allclose([float(v) for v in told.split(",")], [x, y], atol=0.006)


def test_unknown_freedoms_are_given_by_their_tangents():
    # Nothing but the sum of two numbers is known.
    problem = Problem()
    gains = problem.add_variables(Euclidean(1), [[1.0], [2.0]], name="gains")
    problem.add_residuals(
        UserResidual(lambda a, b: a + b, manifolds=(Euclidean(1), Euclidean(1)), dim=1, count=1, fixes_gauge=True),
        gains[0],
        gains[1],
        name="sum",
    )
    text = message(problem)
    assert "gains[0, 1] can move freely along (" in text and "residuals touching them: sum (1 UserResidual)" in text


def test_a_direction_of_few_tangents_is_not_made_a_motion_of_the_world():
    problem = Problem()
    marks = problem.add_variables(Euclidean(3), [[1.0, 2.0, 3.0], [3.0, 1.0, 0.0]], name="marks")
    A = np.random.default_rng(0).standard_normal((5, 3))
    B = np.random.default_rng(1).standard_normal((5, 3))
    mixed = UserResidual(
        lambda a, b, A, B: A @ a + B @ b - 1.0, manifolds=(Euclidean(3), Euclidean(3)), dim=5, data=(A[None], B[None])
    )
    problem.add_residuals(mixed, marks[0], marks[1], name="mixed")
    assert "marks[0, 1] can move freely along (" in message(problem)
    sides = UserResidual(lambda a, b: b - a - 1.0, manifolds=(Euclidean(3), Euclidean(3)), dim=3, count=1)
    other = Problem()
    pair = other.add_variables(Euclidean(3), [[1.0, 2.0, 3.0], [3.0, 1.0, 0.0]], name="pair")
    other.add_residuals(sides, pair[0], pair[1], name="sides")
    assert "translation in any direction of them is unconstrained" in message(other)


def test_variables_without_effect_are_told_from_variables_without_residuals():
    problem = Problem()
    x = problem.add_variables(Euclidean(2), np.ones((3, 2)), name="x")
    problem.add_residuals(Prior(Euclidean(2), np.zeros((1, 2))), x[0])
    problem.add_residuals(UserResidual(lambda a: 0.0 * a, manifolds=(Euclidean(2),), dim=2, count=1), x[1], name="nothing")
    text = message(problem)
    assert "nothing determines x[1]" in text or "nothing determines x[1, 2]" in text


def test_long_lists_are_short():
    problem = Problem()
    x = problem.add_variables(Euclidean(1), np.zeros((100, 1)), name="x")
    problem.fix(x[[5, 50]])
    layout = Layout(problem.blocks)

    def name(rows):
        return variable_names(layout, layout.numbers(x[rows]))

    assert name([3]) == "x[3]" and name([3, 4]) == "x[3, 4]" and name([2, 3, 4, 6, 7]) == "x[2…7]"
    assert name(np.setdiff1d(np.arange(100), [5, 50])) == "x[0…99]"
    assert name([0, 10, 20, 30, 40, 41, 60]) == "x[0], x[10], x[20], x[30] and 3 more"


def test_a_long_odometry_is_not_taken_for_singular():
    count = 2000
    T = np.zeros((count, 7))
    T[:, 0], T[:, 4] = 1.0, np.arange(count)
    step = np.tile([1.0, 0, 0, 0, 1.0, 0, 0], (count - 1, 1))
    problem, poses = chain(SE3, T, step, RelativePose, start_noise=1e-3, sigma=[0.1] * 3 + [0.01] * 3)
    problem.fix(poses[0])
    problem.add_residuals(Prior(SE3, T[-1:], sigma=1.0), poses[count - 1])
    solution = problem.solve(method="gauss_newton")
    np.testing.assert_allclose(solution[poses], T, atol=1e-6)
    assert np.isfinite(solution.standard_deviations(poses[count - 1])).all()


def test_levenberg_marquardt_solves_gauge_free_problems_and_says_so():
    problem, _ = chain_3d()
    solution = problem.solve()
    assert solution.cost < 1e-12 and solution.notes == (
        "nothing ties poses[0…7] to the world: where the whole lies is arbitrary (fix one of them, or add a prior)",
    )


def test_errors_of_other_kinds_keep_theirs():
    with pytest.raises(InputError, match="at least one group"):
        Problem().solve(method="gauss_newton")


def test_cameras_that_only_turn_determine_no_depth():
    """Exact pixels from three cameras in one place, and held poses."""
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-1.0, 1.0, (9, 2)), rng.uniform(4.0, 8.0, 9)])
    poses = np.tile([1.0, 0, 0, 0, 0, 0, 0], (3, 1))
    poses = SE3Left.boxplus(poses, np.hstack([rng.uniform(-0.1, 0.1, (3, 3)), np.zeros((3, 3))]))
    camera_of, point_of = (grid.ravel() for grid in np.mgrid[:3, :9])
    camera = Pinhole(500.0, 500.0, 320.0, 240.0)
    in_camera = np.einsum("nij,nj->ni", quaternion.to_matrix(poses[camera_of, :4]), points[point_of])
    problem = Problem()
    T = problem.add_variables(SE3Left, poses, name="cameras")
    p = problem.add_variables(Euclidean(3), points, name="points")
    residual = Reprojection(camera, camera.project(in_camera)[0])
    problem.add_residuals(residual, T[camera_of], p[point_of], name="pixels")
    problem.fix(T)
    with pytest.raises(SingularProblemError) as error:
        problem.solve().covariance(p[0])
    told = "each of the 9 is seen from one place only, the cameras do not move apart and no depth is determined"
    assert told in str(error.value)
