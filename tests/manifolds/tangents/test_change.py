"""Jacobians carried from one ⊞ of a pose to another, against differences on the other manifold."""

import itertools

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.manifolds.camera_pose import CameraPose
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import UnitQuaternion
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3, SE3Left
from boxplus.manifolds.so3 import SO3
from boxplus.manifolds.tangents.change import tangent_change

POSES = [SE3, SE3Left, Product(UnitQuaternion, Euclidean(3)), CameraPose]


PAIRS = [
    *itertools.permutations(POSES, 2),
    (Product(SE3Left, Euclidean(3)), Product(SE3, Euclidean(3))),
    (Product(SE2, SE3, Product(Euclidean(2), SE3Left)), Product(SE2, SE3Left, Product(Euclidean(2), POSES[2]))),
]


@pytest.mark.parametrize(("native", "actual"), PAIRS, ids=str)
def test_rows_are_those_of_the_other_update(native: Manifold, actual: Manifold) -> None:
    rng = np.random.default_rng(3)
    x = native.random(rng, 5)
    index = rng.integers(0, 5, 8).astype(np.uint32)
    # ∂δ_native/∂δ_actual by central differences: what `actual` does, read off on `native`.
    h = 1e-4
    steps = h * np.eye(native.dof)
    x_of = x[index][:, None]
    numeric = (native.boxminus(actual.boxplus(x_of, steps), x_of) - native.boxminus(actual.boxplus(x_of, -steps), x_of)) / (2 * h)
    J = rng.normal(size=(8, 4, native.dof))
    expected = J @ np.swapaxes(numeric, 1, 2)
    change = tangent_change(native, actual)
    assert change is not None
    changed = J.copy()
    change(2, 7, x, index, changed)
    assert np.array_equal(changed[[0, 1, 7]], J[[0, 1, 7]])
    assert np.allclose(changed[2:7], expected[2:7], atol=1e-6)
    back = tangent_change(actual, native)
    assert back is not None
    back(2, 7, x, index, changed)
    assert np.allclose(changed, J, atol=1e-13)


def test_equal_manifolds_need_no_change() -> None:
    assert tangent_change(SE3, SE3) is None
    assert tangent_change(Euclidean(3), Euclidean(3)) is None
    assert tangent_change(Product(UnitQuaternion, Euclidean(3)), Product(UnitQuaternion, Euclidean(3))) is None


@pytest.mark.parametrize(
    ("native", "actual"),
    [
        (SE3, SE2),
        (UnitQuaternion, SO3),
        (Euclidean(3), Euclidean(2)),
        (SE3Left, Euclidean(7)),
        (Product(SE3, Euclidean(3)), Product(SE3Left, Euclidean(2))),
        (Product(SE3, Euclidean(3)), Product(SE3Left, Euclidean(2), Euclidean(1))),
    ],
    ids=str,
)
def test_other_manifolds_are_refused_by_name(native: Manifold, actual: Manifold) -> None:
    with pytest.raises(InputError) as error:
        tangent_change(native, actual)
    assert f"expected a variable on {native.name}" in str(error.value)
    assert f"got one on {actual.name} – only the updates of a pose change into each other (SE3, SE3Left, " in str(error.value)
