"""The Jacobian check passes what is right, finds what is wrong, and says where."""

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.product import Product
from boxplus.manifolds.quaternion import UnitQuaternion
from boxplus.manifolds.se3 import SE3, SE3Left
from boxplus.optimization.jacobian_check import check_jacobian
from boxplus.residuals.relative_pose import RelativePose
from boxplus.residuals.residual import Residual
from boxplus.residuals.whitening import Whitening

POSE_SIDES = [SE3, SE3Left, Product(UnitQuaternion, Euclidean(3))]


class _Distance(Residual):
    """‖x − a‖ to anchors a in the plane, singular at the anchor; mistakes can be asked for."""

    def __init__(self, anchors: NDArray[np.float64], mistake: str = "", side: float = 0.0) -> None:
        super().__init__(
            dim=1,
            count=len(anchors),
            manifolds=(Euclidean(2),),
            roles=("position",),
            whitening=Whitening.of(1, len(anchors)),
        )
        self.anchors, self.mistake, self.side = anchors, mistake, side

    def linearize_into(self, begin, end, x, index, r, jacobians, valid):
        offset = x[0][index[0][begin:end]] - self.anchors[begin:end]
        self.evaluate_into(begin, end, x, index, r, valid)
        J = offset / np.where(r[begin:end] > 0, r[begin:end], 1.0)
        if self.mistake == "sign":
            J[:, 1] *= -1
        elif self.mistake == "nan":
            J[3, 0] = np.nan
        elif self.mistake == "factor":
            J[5, 0] *= 1 + 1e-5
        jacobians[0][begin:end, 0] = J
        if self.mistake == "evaluate":
            r[begin:end] *= 1.5

    def evaluate_into(self, begin, end, x, index, r, valid):
        distance = np.linalg.norm(x[0][index[0][begin:end]] - self.anchors[begin:end], axis=1)
        valid[begin:end] = distance > self.side
        r[begin:end, 0] = np.where(valid[begin:end], distance, 0.0)


class _MixedSides(RelativePose):
    """Announces the left update and gives the right one's Jacobians: the mistake of the source."""

    def __init__(self, measured: NDArray[np.float64]) -> None:
        super().__init__(measured)
        self.manifolds = (SE3Left, SE3Left)


def _points(count: int = 8) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rng = np.random.default_rng(1)
    return rng.normal(size=(count, 2)) * 3, rng.normal(size=(count, 2))


def test_a_right_jacobian_passes_and_reads_well() -> None:
    anchors, x = _points()
    report = check_jacobian(_Distance(anchors), x)
    assert report.passed and report
    assert report.variables[0].largest_relative < 1e-9
    assert str(report).startswith("_Distance: Jacobians agree with differences (8 of 8 residuals compared, tolerance 1e-07)")
    assert "by position on Euclidean(2): agrees" in str(report)


@pytest.mark.parametrize(("mistake", "residual", "column"), [("nan", 3, 0), ("factor", 5, 0)])
def test_a_single_wrong_entry_is_found_where_it_is(mistake: str, residual: int, column: int) -> None:
    anchors, x = _points()
    report = check_jacobian(_Distance(anchors, mistake), x)
    assert not report.passed and not report
    assert (report.variables[0].residual, report.variables[0].column) == (residual, column)
    assert f"worst in residual {residual}, row 0, column {column} (x)" in str(report)
    assert "NOT PASSED" in str(report)


def test_a_flipped_sign_names_the_direction() -> None:
    anchors, x = _points()
    report = check_jacobian(_Distance(anchors, "sign"), x)
    wrong = report.variables[0]
    assert wrong.tangent_name == "y"
    assert np.isclose(wrong.analytic, -wrong.numeric)
    assert "column 1 (y)" in str(report)


def test_mixed_sides_are_found() -> None:
    rng = np.random.default_rng(2)
    measured, T_i, T_j = (SE3.random(rng, 10) for _ in range(3))
    assert check_jacobian(RelativePose(measured), T_i, T_j).passed
    report = check_jacobian(_MixedSides(measured), T_i, T_j)
    assert not any(variable.passed for variable in report.variables)


def test_an_evaluation_that_differs_is_found() -> None:
    anchors, x = _points()
    report = check_jacobian(_Distance(anchors, "evaluate"), x)
    assert not report.evaluate_agrees and not report.passed
    assert "evaluate gives other residuals than linearize" in str(report)


def test_invalid_residuals_are_counted_and_left_out() -> None:
    anchors, x = _points()
    x[2] = anchors[2]  # invalid here
    x[4] = anchors[4] + np.array([1.0 + 1e-5, 0.0])  # invalid within any step tried
    report = check_jacobian(_Distance(anchors, side=1.0), x, step=0.1)
    near = int((np.linalg.norm(x - anchors, axis=1) <= 1.0).sum())
    assert report.invalid == near >= 1
    assert report.unsteady == 1
    assert f"left out: {near} invalid at the point, 1 invalid within the step" in str(report)
    nothing = check_jacobian(_Distance(anchors, side=100.0), x)
    assert not nothing.passed
    assert "nothing was compared: every residual is invalid here" in str(nothing)


def test_another_step_is_tried_before_a_verdict() -> None:
    # At the anchors' distance of 1e-3 the default step is far too large, a hundredth of it is not.
    anchors, _ = _points()
    report = check_jacobian(_Distance(anchors), anchors + np.array([2e-3, 1e-3]))
    assert report.passed


def test_near_zero_residuals_are_remarked() -> None:
    rng = np.random.default_rng(2)
    T_i, T_j = SE3.random(rng, 3), SE3.random(rng, 3)
    from boxplus.manifolds import se3

    report = check_jacobian(RelativePose(se3.compose(se3.inverse(T_i), T_j)), T_i, T_j)
    assert report.passed
    assert "mistakes proportional to the residual do not show" in str(report)


def test_one_value_serves_all_residuals() -> None:
    anchors, x = _points()
    assert check_jacobian(_Distance(anchors), x[0]).passed


def test_wrong_arguments_say_what_to_give() -> None:
    anchors, x = _points()
    residual = _Distance(anchors)
    with pytest.raises(InputError, match=r"expected 1 variables \(position\) – got 2"):
        check_jacobian(residual, x, x)
    with pytest.raises(InputError, match=r"expected 1 manifolds \(position\) – got 2"):
        check_jacobian(residual, x, manifolds=(SE3, SE3))
    with pytest.raises(InputError, match=r"expected a variable on Euclidean\(2\) – got one on SE3"):
        check_jacobian(residual, x, manifolds=(SE3,))
    with pytest.raises(InputError, match="expected a positive step"):
        check_jacobian(residual, x, step=0.0)
    with pytest.raises(InputError, match="expected one step, or 1 – got 2"):
        check_jacobian(residual, x, step=[1e-3, 1e-3])
