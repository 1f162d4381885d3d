"""What manifolds accept as points: rounding is repaired, mistakes are refused with what to do."""

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.lines import Line3D
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import UnitQuaternion
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3, SE3Left
from boxplus.manifolds.so3 import SO3

MANIFOLDS = [SO3, UnitQuaternion, SE2, SE3, SE3Left, Line3D, Euclidean(3), Product(UnitQuaternion, Euclidean(3))]


@pytest.mark.parametrize("manifold", MANIFOLDS, ids=str)
def test_points_are_copied_and_a_single_one_becomes_a_row(manifold: Manifold) -> None:
    x = manifold.random(np.random.default_rng(1), 4)
    checked = manifold.check("x", x)
    assert checked.flags.c_contiguous and not np.shares_memory(checked, x)
    assert np.allclose(checked, x, atol=1e-15)
    assert manifold.check("x", x[0].tolist()).shape == (1, manifold.size)


@pytest.mark.parametrize("manifold", MANIFOLDS, ids=str)
def test_wrong_shapes_and_numbers_are_refused(manifold: Manifold) -> None:
    x = manifold.random(np.random.default_rng(1), 4)
    with pytest.raises(InputError, match=r"expected poses of shape \(n, \d\) on .* – got shape \(4, \d+\) – give one row"):
        manifold.check("poses", np.column_stack([x, x]))
    with pytest.raises(InputError, match=r"expected poses .* as real numbers"):
        manifold.check("poses", "nothing")
    x[2, 1] = np.nan
    with pytest.raises(InputError, match=r"expected poses finite – got .* in row 2 – remove the variable"):
        manifold.check("poses", x)


@pytest.mark.parametrize("manifold", [UnitQuaternion, SE3, SE3Left, Line3D, Product(UnitQuaternion, Euclidean(3))], ids=str)
def test_quaternions_off_by_rounding_are_normalised_and_others_refused(manifold: Manifold) -> None:
    x = manifold.random(np.random.default_rng(1), 4)
    rounded = x.copy()
    rounded[:, :4] = rounded[:, :4].round(4)
    checked = manifold.check("x", rounded)
    assert np.allclose(np.linalg.norm(checked[:, :4], axis=1), 1.0, atol=1e-15)
    x[3, :4] *= 0.9
    with pytest.raises(
        InputError, match=r"expected x with unit quaternions wxyz first – got length 0\.9 in row 3 – check the order"
    ):
        manifold.check("x", x)


def test_rotation_matrices_are_orthonormalised_and_mirrors_refused() -> None:
    R = SO3.random(np.random.default_rng(1), 3).reshape(3, 3, 3)
    assert np.allclose(SO3.check("R", R), R.reshape(3, 9), atol=1e-15)
    assert np.allclose(SO3.check("R", R[0]), R[:1].reshape(1, 9), atol=1e-15)
    checked = SO3.check("R", R.round(5)).reshape(3, 3, 3)
    assert np.allclose(np.swapaxes(checked, 1, 2) @ checked, np.eye(3), atol=1e-14)
    assert np.allclose(checked, R, atol=2e-5)
    with pytest.raises(InputError, match=r"expected R as rotation matrices – got singular values .* determinant -1 in row 1"):
        SO3.check("R", [np.eye(3), np.diag([1.0, 1.0, -1.0])])
    with pytest.raises(InputError, match="orthonormalise it, or check whether rows and columns are exchanged or mirrored"):
        SO3.check("R", 1.1 * R)


def test_manifolds_refuse_senseless_parameters() -> None:
    with pytest.raises(InputError, match="expected a dimension n ≥ 1 – got 0 – write Euclidean"):
        Euclidean(0)
    with pytest.raises(InputError, match=r"expected a dimension n ≥ 1 – got 2\.5"):
        Euclidean(2.5)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="expected at least one manifold – got none"):
        Product()
    with pytest.raises(InputError, match="expected manifolds – got 3 – write Product"):
        Product(SE3, 3)  # type: ignore[arg-type]


def test_products_name_components_apart() -> None:
    pair = Product(Euclidean(2), Euclidean(2), UnitQuaternion)
    assert pair.tangent_names[:4] == ("x of component 0", "y of component 0", "x of component 1", "y of component 1")
    assert pair.tangent_names[4] == "rotation x [rad]"
    assert pair != Product(UnitQuaternion, Euclidean(2), Euclidean(2))
    assert Euclidean(2) == Euclidean(2) != Euclidean(3)
