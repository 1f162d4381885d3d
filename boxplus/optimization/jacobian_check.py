"""Compare a residual's Jacobians with differences on the manifold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._arguments import require
from boxplus.errors import InputError
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.tangents.change import tangent_change
from boxplus.residuals.residual import Residual

TOLERANCE = 1e-7  # of max(1, largest entry of the Jacobian)
_STEP = 1e-3
_OTHER_STEPS = (0.1, 0.01, 10.0)  # tried, as multiples of the step, where the first one disagrees
_NEAR_ZERO = 1e-6  # residuals this small hide mistakes that are proportional to them


@dataclass(frozen=True, slots=True)
class VariableCheck:
    """The Jacobian by one connected variable.

    Attributes:
        role: of the variable, such as `T_world_i`.
        manifold: on which it was moved.
        largest_absolute: largest difference between analytic and numeric entry.
        largest_relative: the same divided by max(1, largest entry of that residual's Jacobian).
        residual, row, column: where the largest relative difference is.
        tangent_name: of that column.
        analytic, numeric: the two entries there.
        passed: every relative difference is within the tolerance.
    """

    role: str
    manifold: Manifold
    largest_absolute: float
    largest_relative: float
    residual: int
    row: int
    column: int
    tangent_name: str
    analytic: float
    numeric: float
    passed: bool

    def __str__(self) -> str:
        verdict = "agrees" if self.passed else "DISAGREES"
        text = f"  by {self.role} on {self.manifold.name}: {verdict}, largest difference {self.largest_absolute:.2g} absolute"
        text += f", {self.largest_relative:.2g} relative"
        if self.passed:
            return text
        return (
            f"{text}\n    worst in residual {self.residual}, row {self.row}, column {self.column} ({self.tangent_name}): "
            f"analytic {self.analytic:.9g}, numeric {self.numeric:.9g}"
        )


@dataclass(frozen=True, slots=True)
class JacobianReport:
    """What `check_jacobian` found; `str()` is meant to be read.

    Attributes:
        residual: name of the residual's class.
        count: residuals in the group.
        variables: one check for each connected variable.
        invalid: residuals that are singular at the point given; not compared.
        unsteady: residuals that become singular within the step; not compared.
        evaluate_agrees: evaluation alone gives the same residuals and validity, bit for bit, as linearisation.
        largest_residual: largest absolute entry of the residuals compared.
        tolerance: largest relative difference that passes.
        passed: everything agrees, and something was compared.
    """

    residual: str
    count: int
    variables: tuple[VariableCheck, ...]
    invalid: int
    unsteady: int
    evaluate_agrees: bool
    largest_residual: float
    tolerance: float

    @property
    def passed(self) -> bool:
        compared = self.count - self.invalid - self.unsteady
        return compared > 0 and self.evaluate_agrees and all(variable.passed for variable in self.variables)

    def __bool__(self) -> bool:
        """`passed`, so that `assert check_jacobian(...)` means what it says."""
        return self.passed

    def __str__(self) -> str:
        compared = self.count - self.invalid - self.unsteady
        verdict = "Jacobians agree with differences" if self.passed else "NOT PASSED"
        lines = [f"{self.residual}: {verdict} ({compared} of {self.count} residuals compared, tolerance {self.tolerance:.0e})"]
        lines += [str(variable) for variable in self.variables]
        if not self.evaluate_agrees:
            lines.append("  evaluate gives other residuals than linearize: the cost would not belong to the step")
        if compared == 0:
            lines.append("  nothing was compared: every residual is invalid here; give another point")
        elif self.invalid or self.unsteady:
            lines.append(f"  left out: {self.invalid} invalid at the point, {self.unsteady} invalid within the step")
        if compared and self.largest_residual < _NEAR_ZERO:
            lines.append(
                f"  residuals are at most {self.largest_residual:.2g}: mistakes proportional to the residual do not show; "
                "check far from zero too"
            )
        return "\n".join(lines)


def check_jacobian(
    residual: Residual,
    *x: ArrayLike,
    manifolds: Sequence[Manifold] | None = None,
    step: float | Sequence[ArrayLike] = _STEP,
    tolerance: float = TOLERANCE,
) -> JacobianReport:
    """Compare every Jacobian of a residual group with fourth-order central differences on the manifold.

    An entry that disagrees at the step given is compared again at other steps, and its smallest difference counts: a wrong
    Jacobian is wrong at every step, while rounding and curvature are not.

    Args:
        x: for every connected variable (N, size), or (size,) for all residuals alike; best far from zero residual.
        manifolds: move the variables on these instead of the residual's own, the Jacobians being carried over as in a
            `Problem`: `(SE3Left, SE3Left)` checks a right-sided residual from the left.
        step: of the differences in tangent units, one number or for every variable a number or (dof,).
        tolerance: largest difference allowed, relative to max(1, largest entry of the residual's Jacobian).

    Raises:
        InputError: wrong number of variables, shapes, manifolds that do not change into each other, a step that is not
            positive.

    Example:
        >>> residual = bp.residuals.RelativePose([[1.0, 0, 0, 0, 1.0, 0, 0]])
        >>> T = bp.SE3.random(np.random.default_rng(0), 2)
        >>> report = bp.check_jacobian(residual, T[:1], T[1:])
        >>> report.passed
        True
    """
    require(residual, Residual, "a residual", "give one of boxplus.residuals, or a subclass of boxplus.residuals.Residual")
    moved = tuple(residual.manifolds if manifolds is None else manifolds)
    if len(moved) != len(residual.manifolds):
        raise InputError(
            f"{len(residual.manifolds)} manifolds ({', '.join(residual.roles)})", f"{len(moved)}", "give one a variable"
        )
    changes = [tangent_change(native, actual) for native, actual in zip(residual.manifolds, moved, strict=True)]
    steps = _steps(step, moved)
    linearization = residual.linearize(*x)
    count = residual.count
    values = [
        np.ascontiguousarray(np.broadcast_to(np.atleast_2d(np.asarray(given, dtype=np.float64)), (count, manifold.size)))
        for given, manifold in zip(x, moved, strict=True)
    ]
    probe = _Probe(residual)
    r, valid = probe.evaluate(values)
    agrees = np.array_equal(r, linearization.residuals, equal_nan=True) and np.array_equal(valid, linearization.valid)

    compared = linearization.valid.copy()
    checks = []
    differences = []
    for slot, manifold in enumerate(moved):
        J = linearization.jacobians[slot].copy()
        change = changes[slot]
        if change is not None:
            change(0, count, values[slot], probe.rows, J)
        numeric, steady = probe.differentiate(values, slot, manifold, steps[slot])
        for factor in _OTHER_STEPS:
            off = ~(_relative(J, numeric) <= tolerance)
            if not (off & (compared & steady)[:, None, None]).any():
                break
            other, still = probe.differentiate(values, slot, manifold, factor * steps[slot])
            closer = (np.abs(J - other) < np.abs(J - numeric)) | ~np.isfinite(numeric) | ~steady[:, None, None]
            numeric = np.where(closer & still[:, None, None], other, numeric)
            steady |= still
        compared &= steady
        differences.append((J, numeric))
    for slot, (J, numeric) in enumerate(differences):
        checks.append(_check(residual.roles[slot], moved[slot], J, numeric, compared, tolerance))
    return JacobianReport(
        residual=type(residual).__name__,
        count=count,
        variables=tuple(checks),
        invalid=int((~linearization.valid).sum()),
        unsteady=int((linearization.valid & ~compared).sum()),
        evaluate_agrees=agrees,
        largest_residual=float(np.abs(r[compared]).max(initial=0.0)),
        tolerance=tolerance,
    )


class _Probe:
    """Evaluates a group anywhere, every residual with variables of its own."""

    def __init__(self, residual: Residual) -> None:
        self.residual = residual
        self.rows = np.arange(residual.count, dtype=np.uint32)

    def evaluate(self, values: Sequence[NDArray[np.float64]]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        count = self.residual.count
        r, valid = np.zeros((count, self.residual.dim)), np.ones(count, dtype=np.bool_)
        self.residual.evaluate_into(0, count, tuple(values), (self.rows,) * len(values), r, valid)
        return r, valid

    def differentiate(
        self, values: Sequence[NDArray[np.float64]], slot: int, manifold: Manifold, step: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Numeric Jacobian (N, dim, dof) by the variable `slot`, and where (N,) all points needed were valid."""
        J = np.zeros((self.residual.count, self.residual.dim, manifold.dof))
        steady = np.ones(self.residual.count, dtype=np.bool_)
        moved = list(values)
        for column, h in enumerate(step):
            for multiple, weight in ((1.0, 8.0), (-1.0, -8.0), (2.0, -1.0), (-2.0, 1.0)):
                delta = np.zeros(manifold.dof)
                delta[column] = multiple * h
                moved[slot] = manifold.boxplus(values[slot], delta)
                r, valid = self.evaluate(moved)
                J[:, :, column] += weight / (12.0 * h) * r
                steady &= valid
        return J, steady


def _steps(step: float | Sequence[ArrayLike], manifolds: Sequence[Manifold]) -> list[NDArray[np.float64]]:
    given = [step] * len(manifolds) if isinstance(step, int | float) else list(step)
    if len(given) != len(manifolds):
        raise InputError(f"one step, or {len(manifolds)}", f"{len(given)}", "give one for each connected variable")
    steps = []
    for manifold, one in zip(manifolds, given, strict=True):
        array = np.asarray(one, dtype=np.float64)
        if array.shape not in ((), (manifold.dof,)) or not (np.isfinite(array) & (array > 0.0)).all():
            raise InputError(
                f"a positive step, or ({manifold.dof},) for {manifold.name}",
                f"{one!r}",
                "take about 1e-3 of the variable's scale",
            )
        steps.append(np.broadcast_to(array, (manifold.dof,)))
    return steps


def _relative(J: NDArray[np.float64], numeric: NDArray[np.float64]) -> NDArray[np.float64]:
    """Differences over max(1, largest entry of each residual's Jacobian); infinite where an entry is not finite."""
    scale = np.maximum(1.0, np.abs(J).max(axis=(1, 2), initial=0.0))
    relative: NDArray[np.float64] = np.abs(J - numeric) / scale[:, None, None]
    relative[~np.isfinite(relative)] = np.inf
    return relative


def _check(
    role: str,
    manifold: Manifold,
    J: NDArray[np.float64],
    numeric: NDArray[np.float64],
    compared: NDArray[np.bool_],
    tolerance: float,
) -> VariableCheck:
    relative = _relative(J, numeric)
    relative[~compared] = 0.0
    n, row, column = (int(i) for i in np.unravel_index(np.argmax(relative), relative.shape))
    return VariableCheck(
        role=role,
        manifold=manifold,
        largest_absolute=float(np.abs(J - numeric)[compared].max(initial=0.0)),
        largest_relative=float(relative[n, row, column]),
        residual=n,
        row=row,
        column=column,
        tangent_name=manifold.tangent_names[column],
        analytic=float(J[n, row, column]),
        numeric=float(numeric[n, row, column]),
        passed=bool(relative[n, row, column] <= tolerance),
    )
