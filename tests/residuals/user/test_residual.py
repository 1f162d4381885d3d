"""Residuals given as Python functions: compiled, in a batch, with and without Jacobians."""

import functools
import itertools
import math

import numba
import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.manifolds import se3
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.lines import Line3D
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import UnitQuaternion, UnitQuaternionLeft, multiply_scalars, rotate
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3, SE3Left, adjoint_into, between_into, between_scalars, log_scalars
from boxplus.manifolds.se3_jacobians import right_jacobian_inverse_into
from boxplus.manifolds.so3 import SO3
from boxplus.optimization.jacobian_check import check_jacobian
from boxplus.optimization.problem import Problem
from boxplus.residuals.relative_pose import RelativePose
from boxplus.residuals.user.residual import UserResidual


def relative_pose(T_i, T_j, z):
    qw, qx, qy, qz, x, y, t = between_scalars(T_i, T_j)
    qw, qx, qy, qz = multiply_scalars(z[0], -z[1], -z[2], -z[3], qw, qx, qy, qz)
    x, y, t = rotate(z[0], -z[1], -z[2], -z[3], x - z[4], y - z[5], t - z[6])
    return log_scalars(qw, qx, qy, qz, x, y, t)


def relative_pose_jacobian(T_i, T_j, z, J_i, J_j):
    T, xi, Ad = np.empty(7), np.empty(6), np.empty((6, 6))
    between_into(T_i, T_j, T)
    between_into(z, T, T)
    se3.log_into(T, xi)
    right_jacobian_inverse_into(xi[0], xi[1], xi[2], xi[3], xi[4], xi[5], J_j)
    between_into(T_j, T_i, T)
    adjoint_into(T, Ad)
    for i, j, k in itertools.product(range(6), range(6), range(6)):
        J_i[i, j] -= J_j[i, k] * Ad[k, j]


# Numba has no itertools; the loop is written out for it.
def relative_pose_jacobian_loops(T_i, T_j, z, J_i, J_j):
    T, xi, Ad = np.empty(7), np.empty(6), np.empty((6, 6))
    between_into(T_i, T_j, T)
    between_into(z, T, T)
    se3.log_into(T, xi)
    right_jacobian_inverse_into(xi[0], xi[1], xi[2], xi[3], xi[4], xi[5], J_j)
    between_into(T_j, T_i, T)
    adjoint_into(T, Ad)
    for i in range(6):
        for j in range(6):
            for k in range(6):
                J_i[i, j] -= J_j[i, k] * Ad[k, j]


def distance(p, anchor):
    """None closer than 1 to the anchor."""
    length = math.sqrt((p[0] - anchor[0]) ** 2 + (p[1] - anchor[1]) ** 2)
    if length < 1.0:
        return None
    return length


def distances(p, anchor):
    length = np.linalg.norm(p - anchor, axis=1)
    return length[:, None], length >= 1.0


def distances_jacobian(p, anchor):
    offset = p - anchor
    return (offset / np.linalg.norm(offset, axis=1, keepdims=True))[:, None, :]


def _poses(count: int = 12) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(5)
    return tuple(SE3.random(rng, count) for _ in range(3))


@pytest.mark.parametrize("sides", [(SE3, SE3), (SE3Left, SE3), (SE3Left, SE3Left)], ids=str)
def test_numeric_jacobians_agree_with_the_built_in_residual(sides: tuple[Manifold, Manifold]) -> None:
    measured, T_i, T_j = _poses()
    residual = UserResidual(relative_pose, dim=6, manifolds=sides, data=(measured,), jacobian="differences")
    assert residual.jacobian_kind == "numeric"
    assert residual.roles == ("T_i", "T_j")
    assert np.allclose(residual.evaluate(T_i, T_j), RelativePose(measured).evaluate(T_i, T_j), atol=1e-14)
    report = check_jacobian(residual, T_i, T_j)
    assert report.passed, report
    # The numeric Jacobian is that of the built-in residual on the same sides.
    assert check_jacobian(RelativePose(measured), T_i, T_j, manifolds=sides).passed


def test_an_analytic_jacobian_is_used() -> None:
    measured, T_i, T_j = _poses()
    residual = UserResidual(
        relative_pose, dim=6, manifolds=(SE3, SE3), data=(measured,), jacobian=relative_pose_jacobian_loops, sigma=0.1
    )
    assert residual.jacobian_kind == "analytic"
    ours, theirs = residual.linearize(T_i, T_j), RelativePose(measured).linearize(T_i, T_j)
    for J, expected in zip(ours.jacobians, theirs.jacobians, strict=True):
        assert np.allclose(J, expected, atol=1e-12)
    assert check_jacobian(residual, T_i, T_j, manifolds=(SE3Left, SE3)).passed
    assert np.allclose(residual.whitening.factors[0], 10.0 * np.eye(6))


def test_rows_and_chunks_are_honoured() -> None:
    measured, T_i, T_j = _poses()
    index = (np.arange(12, dtype=np.uint32)[::-1].copy(), np.arange(12, dtype=np.uint32))
    residual = UserResidual(relative_pose, dim=6, manifolds=(SE3, SE3), data=(measured,))
    r, J, valid = np.full((12, 6), 7.0), (np.full((12, 6, 6), 7.0), np.full((12, 6, 6), 7.0)), np.zeros(12, dtype=bool)
    residual.linearize_into(3, 9, (T_i, T_j), index, r, J, valid)
    expected = residual.linearize(T_i[::-1], T_j)
    assert np.array_equal(r[3:9], expected.residuals[3:9])
    assert np.array_equal(J[0][3:9], expected.jacobians[0][3:9])
    assert (r[:3] == 7.0).all() and (J[1][9:] == 7.0).all()
    assert valid.tolist() == [False] * 3 + [True] * 6 + [False] * 3


EVERYTHING = Product(
    SO3, UnitQuaternion, UnitQuaternionLeft, SE2, SE3, SE3Left, Line3D, Euclidean(4), Product(SE2, UnitQuaternion)
)


def weighted_numbers(x, weights):
    """Smooth in every stored number, so that every direction of every tangent shows."""
    first, second = 0.0, 1.0
    for k in range(len(x)):
        first += weights[k] * x[k] + math.sin(x[k] * weights[k])
        second += math.cos(x[k] + weights[k]) * x[k - 1]
    return np.array([first, second])


def test_numeric_jacobians_on_every_manifold() -> None:
    # Every way to step along a tangent, in one product; angles stored as they are jump at π, so x stays off it.
    rng = np.random.default_rng(6)
    x = EVERYTHING.boxplus(np.tile(EVERYTHING.identity(), (5, 1)), rng.uniform(-1.0, 1.0, (5, EVERYTHING.dof)))
    weights = rng.normal(size=(5, EVERYTHING.size))
    residual = UserResidual(weighted_numbers, dim=2, manifolds=(EVERYTHING,), data=(weights,), jacobian="differences")
    report = check_jacobian(residual, x)
    assert report.passed, report


def test_a_manifold_of_the_users_own_is_differentiated_too() -> None:
    rng = np.random.default_rng(6)
    anchors, p = rng.normal(size=(7, 2)), 5.0 + rng.normal(size=(7, 2))
    plain = UserResidual(distance, dim=1, manifolds=(Euclidean(2),), data=(anchors,)).linearize(p)
    residual = UserResidual(distance, dim=1, manifolds=(_Foreign(),), data=(anchors,))
    assert np.allclose(residual.linearize(p).jacobians[0], 2.0 * plain.jacobians[0], atol=1e-8)


class _Foreign(Manifold):
    """The plane with a δ that counts twice."""

    name, size, dof, tangent_names = "Foreign", 2, 2, ("x", "y")

    def boxplus(self, x, delta):
        return np.asarray(x) + 2.0 * np.asarray(delta)

    def boxminus(self, x, base):
        return 0.5 * (np.asarray(x) - np.asarray(base))

    def boxplus_jacobian(self, x, delta):
        return np.broadcast_to(np.eye(2), (*np.shape(x)[:-1], 2, 2))

    boxminus_jacobian = boxplus_jacobian

    def check(self, name, x):
        return np.array(x, dtype=float, ndmin=2)

    def identity(self):
        return np.zeros(2)

    def random(self, rng, count):
        return rng.normal(size=(count, 2))


@pytest.mark.parametrize("is_batch", [False, True])
@pytest.mark.parametrize("has_jacobian", [False, True])
def test_none_and_masks_mean_singular(is_batch: bool, has_jacobian: bool) -> None:
    def distance_jacobian(p, anchor, J):
        length = math.sqrt((p[0] - anchor[0]) ** 2 + (p[1] - anchor[1]) ** 2)
        J[0, 0], J[0, 1] = (p[0] - anchor[0]) / length, (p[1] - anchor[1]) / length

    anchors = np.random.default_rng(7).normal(size=(9, 2))
    p = anchors + np.array([3.0, 4.0])
    p[4] = anchors[4] + np.array([0.1, 0.2])
    jacobian = (distances_jacobian if is_batch else distance_jacobian) if has_jacobian else None
    residual = UserResidual(
        distances if is_batch else distance,
        dim=1,
        manifolds=(Euclidean(2),),
        data=(anchors,),
        jacobian=jacobian,
        is_batch=is_batch,
    )
    linear = residual.linearize(p)
    assert linear.valid.tolist() == [n != 4 for n in range(9)]
    assert linear.residuals[4] == 0.0 and not linear.jacobians[0][4].any()
    assert np.allclose(np.delete(linear.residuals, 4), 5.0)
    assert np.allclose(np.delete(linear.jacobians[0], 4, axis=0), [[0.6, 0.8]], atol=1e-9)
    report = check_jacobian(residual, p)
    assert report.passed and report.invalid == 1, report
    # Beside a neighbour without residual the difference is one-sided: validity is that of the evaluation.
    if not has_jacobian:
        p[2] = anchors[2] + np.array([1.0, 0.0])
        linear = residual.linearize(p)
        assert linear.valid[2]
        assert np.allclose(linear.jacobians[0][2], [[1.0, 0.0]], atol=1e-5)


@pytest.mark.parametrize("has_jacobian", [False, True])
def test_none_may_stand_for_several_numbers(has_jacobian: bool) -> None:
    def direction(p):
        length = math.sqrt(p[0] ** 2 + p[1] ** 2)
        if length < 1.0:
            return None
        return p[0] / length, p[1] / length

    def direction_jacobian(p, J):
        cube = math.sqrt(p[0] ** 2 + p[1] ** 2) ** 3
        J[0, 0], J[0, 1], J[1, 0], J[1, 1] = p[1] ** 2 / cube, -p[0] * p[1] / cube, -p[0] * p[1] / cube, p[0] ** 2 / cube

    jacobian = direction_jacobian if has_jacobian else None
    residual = UserResidual(direction, dim=2, manifolds=(Euclidean(2),), count=3, jacobian=jacobian)
    p = np.array([[3.0, 4.0], [0.1, 0.2], [0.0, -2.0]])
    assert residual.linearize(p).valid.tolist() == [True, False, True]
    assert np.allclose(residual.evaluate(p), [[0.6, 0.8], [0.0, 0.0], [0.0, -1.0]])
    report = check_jacobian(residual, p)
    assert report.passed and report.invalid == 1, report


def test_data_are_copied() -> None:
    measured = np.ones(4)
    residual = UserResidual(lambda x, z: x[0] - z, dim=1, manifolds=(Euclidean(1),), data=(measured,))
    measured[:] = 5.0
    assert np.array_equal(residual.evaluate([1.0]), np.zeros((4, 1)))


def test_data_come_as_scalars_rows_and_matrices() -> None:
    def affine(x, scale, matrix, which):
        return scale * (matrix[0, 0] * x[0] + matrix[0, 1] * x[1]), x[which]

    rng = np.random.default_rng(8)
    scale, matrix, which = rng.normal(size=6), rng.normal(size=(6, 2, 2)), np.array([0, 1, 0, 1, 1, 0])
    x = rng.normal(size=(6, 2))
    residual = UserResidual(affine, dim=2, manifolds=(Euclidean(2),), data=(scale, matrix, which))
    expected = np.column_stack([scale * (matrix[:, 0] * x).sum(axis=1), x[np.arange(6), which]])
    assert np.allclose(residual.evaluate(x), expected)
    assert check_jacobian(residual, x).passed


@pytest.mark.parametrize("is_batch", [False, True])
def test_what_is_the_same_for_all_is_given_once(is_batch: bool) -> None:
    def stretched(x, measured, scale, offset, matrix):
        return scale * matrix[0, 1] * x[0] + offset[1] - measured

    def stretched_batch(x, measured, scale, offset, matrix):
        assert scale.shape == measured.shape and offset.shape == (len(x), 2) and matrix.shape == (len(x), 2, 2)
        return (scale * matrix[:, 0, 1] * x[:, 0] + offset[:, 1] - measured)[:, None]

    rng = np.random.default_rng(10)
    measured, offset, matrix, x = rng.normal(size=5), rng.normal(size=(1, 2)), rng.normal(size=(1, 2, 2)), rng.normal(size=(5, 1))
    function = stretched_batch if is_batch else stretched
    data = (measured, 3.0, offset, matrix)
    residual = UserResidual(function, dim=1, manifolds=(Euclidean(1),), data=data, is_batch=is_batch)
    expected = 3.0 * matrix[0, 0, 1] * x + offset[0, 1] - measured[:, None]
    assert np.allclose(residual.evaluate(x), expected) and residual.count == 5
    assert check_jacobian(residual, x).passed
    assert UserResidual(lambda x, z: x[0] - z, dim=1, manifolds=(Euclidean(1),), data=(2.0,), count=4).count == 4


def test_a_row_that_could_be_a_column_is_refused() -> None:
    with pytest.raises(InputError, match=r"lengths \[5, 3\] .* \[row\], not row"):
        UserResidual(relative_pose, dim=6, manifolds=(SE3, SE3), data=(np.zeros(5), np.zeros(3)))


def test_batch_jacobian_with_two_variables() -> None:
    def difference(a, b, z):
        return z - (b - a) * np.abs(a)

    anchors = np.random.default_rng(9).normal(size=(4, 3))
    residual = UserResidual(difference, dim=3, manifolds=(Euclidean(3), Euclidean(3)), data=(anchors,), is_batch=True)
    assert check_jacobian(residual, anchors + 1.0, anchors * 2.0).passed


def test_without_data_a_count_is_needed() -> None:
    def norm(x):
        return x[0] * x[0] + x[1] * x[1] - 1.0

    residual = UserResidual(norm, dim=1, manifolds=(Euclidean(2),), count=3)
    assert np.allclose(residual.evaluate([[1.0, 2.0]] * 3), 4.0)
    with pytest.raises(InputError, match=r"expected data arrays of one length N .*, or count – got lengths"):
        UserResidual(norm, dim=1, manifolds=(Euclidean(2),))
    with pytest.raises(InputError, match=r"got lengths \[3, 4\]"):
        UserResidual(relative_pose, dim=6, manifolds=(SE3, SE3), data=(np.zeros(3), np.zeros(4)))


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="without compilation a function's mistakes show when it runs")
def test_wrong_functions_are_explained() -> None:
    measured, T_i, T_j = _poses()

    def wrong_name(T_i, T_j, z):
        return undefined_helper(T_i), 0.0  # noqa: F821

    def five(T_i, T_j, z):
        return z[0], z[1], z[2], z[3], z[4]

    def five_in_an_array(T_i, T_j, z):
        return z[:5] + T_i[:5]

    def text(T_i, T_j, z):
        return "six"

    def foreign(T_i, T_j, z):
        return np.linalg.svd(T_i)[0]

    def attribute(T_i, T_j, z):
        return T_i.rotation

    options = {"dim": 6, "manifolds": (SE3, SE3), "data": (measured,)}
    with pytest.raises(
        InputError,
        match=r"expected a function that Numba can compile – got wrong_name: .*'undefined_helper' is not defined – use scalars",
    ):
        UserResidual(wrong_name, **options)
    with pytest.raises(InputError, match=r"got foreign: No implementation of function .*svd.* found for signature: svd\(array"):
        UserResidual(foreign, **options)
    with pytest.raises(InputError, match=r"Unknown attribute 'rotation' of type .* \(test_residual.py, line \d+\)"):
        UserResidual(attribute, **options)
    with pytest.raises(InputError, match="expected a jacobian that Numba can compile – got relative_pose_jacobian"):
        UserResidual(relative_pose, jacobian=relative_pose_jacobian, **options)
    with pytest.raises(InputError, match="expected 6 numbers from five – got a tuple of 5 – return them as a tuple"):
        UserResidual(five, **options)
    with pytest.raises(InputError, match=r"expected 6 numbers from text – got Literal\[str\]"):
        UserResidual(text, **options)
    with pytest.raises(InputError, match="expected 6 numbers from five_in_an_array – got 5 – return as many as dim says"):
        UserResidual(five_in_an_array, **options).evaluate(T_i, T_j)
    with pytest.raises(InputError, match=r"expected a plain Python function as function – got functools.partial"):
        UserResidual(functools.partial(relative_pose), **options)
    with pytest.raises(InputError, match=r"expected a function of 2 arguments .* – got relative_pose\(T_i, T_j, z\): missing"):
        UserResidual(relative_pose, dim=6, manifolds=(SE3, SE3), count=12)
    with pytest.raises(InputError, match=r"expected a jacobian of 5 arguments .* – got relative_pose\(T_i, T_j, z\): too many"):
        UserResidual(relative_pose, jacobian=relative_pose, **options)


def test_wrong_arguments_are_refused() -> None:
    measured, _, _ = _poses()
    with pytest.raises(InputError, match="expected manifolds as a tuple of manifolds"):
        UserResidual(relative_pose, dim=6, manifolds=(), data=(measured,))
    with pytest.raises(InputError, match=r"expected dim ≥ 1 – got 0"):
        UserResidual(relative_pose, dim=0, manifolds=(SE3, SE3), data=(measured,))
    with pytest.raises(InputError, match=r"expected data\[0\] as numbers \(N, …\), .* – got <U1"):
        UserResidual(relative_pose, dim=6, manifolds=(SE3, SE3), data=(["a"],))
    with pytest.raises(InputError, match="expected a positive step"):
        UserResidual(relative_pose, dim=6, manifolds=(SE3, SE3), data=(measured,), step=-1.0)
    with pytest.raises(InputError, match="expected one step, or 2 – got 1"):
        UserResidual(relative_pose, dim=6, manifolds=(SE3, SE3), data=(measured,), step=[1e-4])


def test_batch_shapes_are_checked() -> None:
    anchors = np.zeros((5, 2))
    residual = UserResidual(lambda p, a: p[:, 0], dim=1, manifolds=(Euclidean(2),), data=(anchors,), is_batch=True)
    with pytest.raises(InputError, match=r"expected residuals \(5, 1\) from <lambda>"):
        residual.evaluate(np.ones((5, 2)))
    residual = UserResidual(
        distances, dim=1, manifolds=(Euclidean(2),), data=(anchors,), is_batch=True, jacobian=lambda p, a: np.zeros((5, 2))
    )
    with pytest.raises(InputError, match=r"expected Jacobians of shapes \[\(5, 1, 2\)\] – got \[\(5, 2\)\]"):
        residual.linearize(np.ones((5, 2)))


TABLE = np.arange(4.0)


@numba.njit
def _looked_up(table, at):
    return table[at]


@pytest.mark.parametrize("with_jacobian", [False, True])
def test_an_index_beyond_an_array_is_refused_and_named(with_jacobian: bool) -> None:
    """Compiled without checks it reads other memory, or ends the process."""

    def entry(x, which):
        return x[which] - 1.0

    def jacobian(x, which, J):
        J[0, which] = 1.0

    good = {"manifolds": (Euclidean(3),), "dim": 1, "jacobian": jacobian if with_jacobian else None}
    within = UserResidual(entry, data=([0, 1, 2, -1, -3],), **good)
    assert check_jacobian(within, np.ones((5, 3))).passed
    beyond = UserResidual(entry, data=([0, 1, 3, 2, 99],), **good)
    text = (
        r"expected indices within the arrays that entry uses – got one beyond the end, in residual 2 of 5, whose arguments are "
        r"x \(3,\), data\[0\] scalar – correct the index"
    )
    for call in (beyond.evaluate, beyond.linearize):
        with pytest.raises(InputError, match=text):
            call(np.ones((5, 3)))
    problem = Problem()
    x = problem.add_variables(Euclidean(3), np.ones((5, 3)))
    problem.add_residuals(beyond, x)
    with pytest.raises(InputError, match=text):
        problem.solve()


def test_an_index_beyond_an_array_in_the_jacobian_is_refused() -> None:
    def first(x):
        return x[0]

    def jacobian(x, J):
        J[0, 5] = 1.0

    residual = UserResidual(first, dim=1, manifolds=(Euclidean(3),), jacobian=jacobian, count=2)
    assert (residual.evaluate(np.ones(3)) == 1.0).all()
    with pytest.raises(InputError, match="in residual 0 of 2, whose arguments are x"):
        residual.linearize(np.ones(3))


@pytest.mark.parametrize("by", ["itself", "a helper", "a helper of a helper"])
def test_an_index_that_leaves_an_array_while_solving_is_refused(by: str) -> None:
    """The index depends on the variable: within the table at the start, beyond it after a step."""

    @numba.njit
    def twice_removed(table, at):
        return _looked_up(table, at)

    look_up = {"itself": None, "a helper": _looked_up, "a helper of a helper": twice_removed}[by]
    if look_up is None:

        def residual(x):
            return TABLE[int(x[0])] + x[0] - 60.0

    else:

        def residual(x):
            return look_up(TABLE, int(x[0])) + x[0] - 60.0

    problem = Problem()
    x = problem.add_variables(Euclidean(1), [[1.5]])
    problem.add_residuals(UserResidual(residual, dim=1, manifolds=(Euclidean(1),), count=1), x)
    with pytest.raises(
        InputError, match="indices within the arrays that residual uses – got one beyond the end, in residual 0 of 1"
    ):
        problem.solve()


def test_a_function_compiled_by_its_user_is_checked_as_well() -> None:
    @numba.njit
    def fifth(x):
        return x[5]

    with pytest.raises(InputError, match="indices within the arrays that fifth uses"):
        UserResidual(fifth, dim=1, manifolds=(Euclidean(3),), count=1).evaluate(np.ones(3))
