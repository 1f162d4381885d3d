"""What `Problem.solve` returns: the values, why it stopped, and how it got there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import require
from boxplus.errors import InputError
from boxplus.optimization.covariance import Covariances
from boxplus.optimization.linear_systems.least_squares import LeastSquares
from boxplus.optimization.minimizers.remainder import Remainder, find_remainder, unconverged_sentence
from boxplus.optimization.observability.null_space import find_null_space
from boxplus.optimization.observability.singularity import describe_null_space
from boxplus.optimization.terms.misfit import misfit_notes
from boxplus.optimization.terms.variables import VariableRows, Variables


@dataclass(frozen=True, slots=True)
class Iteration:
    """One step that was tried.

    Attributes:
        number: from 1; 0 is the start.
        cost: at the accepted point after it. It falls from one to the next, but where residuals become valid that were not.
        tried_cost: at the point it led to; infinite where that could not be evaluated.
        gradient: largest entry of the gradient at the accepted point.
        step: largest entry of the step.
        parameter: λ, radius or step length of the method when the step was chosen.
        accepted: whether the step was taken.
        time_s: since `solve` began.
        purpose: what a solve beside the one of the result is for: a question where it examines the result; else empty.
    """

    number: int
    cost: float
    tried_cost: float
    gradient: float
    step: float
    parameter: float
    accepted: bool
    time_s: float
    purpose: str = ""


@dataclass(frozen=True, slots=True)
class Solution:
    """Result of a minimisation.

    Attributes:
        status: `converged`; `stopped` by a limit or the callback; `stalled` where no step lowers the cost any more.
        reason: why it stopped, in a sentence with numbers.
        limit: that stopped it, `steps` or `time`; None where it ended by itself, or the callback stopped it.
        values: (n, size) of every block; also `solution[block]` and `solution[block[rows]]`.
        cost_initial, cost: ½ Σ ρ(‖r‖²) at the start and at the end, whitened.
        history: every step tried.
        descent: where in `history` the descent began that led here; 0 but where several were joined.
        method, linear_solver: what was used, and why.
        invalid: for every group the number of residuals that could not be evaluated at the end, such as points behind a camera.
        faded: for every group with a robust loss the share of its residuals whose weight ρ′ is below 0.1 at the end.
        notes: what a user should know (assumptions, fixed gauge, residuals that hardly count).
        timing_s: seconds by stage: analysis, residuals and Jacobians, normal equations, linear solve, total.

    Example:
        >>> problem = bp.Problem()
        >>> poses = problem.add_variables(bp.SE2, [[0.0, 0.0, 0.0], [0.1, 0.9, 0.0]], name="poses")
        >>> odometry = problem.add_residuals(bp.residuals.RelativePose2D([0.0, 1.0, 0.0], sigma=0.1), poses[0], poses[1])
        >>> problem.fix(poses[0])
        >>> solution = problem.solve()
        >>> solution.status, solution.linear_solver
        ('converged', 'dense Cholesky of 3 degrees of freedom')
        >>> solution.standard_deviations(poses).round(3)
        array([[0. , 0. , 0. ],
               [0.1, 0.1, 0.1]])
    """

    status: Literal["converged", "stopped", "stalled"]
    reason: str
    limit: Literal["steps", "time"] | None
    values: tuple[NDArray[np.float64], ...]
    cost_initial: float
    cost: float
    history: tuple[Iteration, ...]
    method: str
    linear_solver: str
    invalid: dict[str, int]
    faded: dict[str, float]
    notes: tuple[str, ...]
    timing_s: dict[str, float]
    _problem: LeastSquares = field(repr=False)
    descent: int = 0
    _remainder: tuple[object, Remainder | None] | None = field(init=False, repr=False, default=None)
    _covariances: Covariances = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_covariances", Covariances(self._problem, self.values))

    def __getitem__(self, selected: Variables | VariableRows) -> NDArray[np.float64]:
        """Values (n, size) of a block as it was when the problem was solved, or (k, size) of rows of it."""
        rows = self._own(selected)
        values = self.values[rows.block.number]
        return values if isinstance(selected, Variables) else values[self._problem.layout.rows(rows)]

    def is_of(self, blocks: Sequence[Variables]) -> bool:
        """Whether it solved the problem of these blocks, to which others may have been added since."""
        return len(self._problem.layout.blocks) <= len(blocks) and all(
            one is other for one, other in zip(self._problem.layout.blocks, blocks, strict=False)
        )

    def values_of(self, blocks: Sequence[Variables]) -> list[NDArray[np.float64]]:
        """Values (n, size) of the variables that are in `blocks` now; those that were added since have their own."""
        layout = self._problem.layout
        if len(blocks) < len(layout.blocks):
            return list(self.values)  # of another problem: whoever asked for them sees that
        known = []
        for number, block in enumerate(blocks):
            own = number < len(layout.blocks) and layout.blocks[number] is block
            if not own or layout.ids[number] is block.ids:
                known.append(self.values[number] if number < len(self.values) else block.values)
                continue
            x = block.values.copy()
            _, here, there = np.intersect1d(block.ids, layout.ids[number], assume_unique=True, return_indices=True)
            x[here] = self.values[number][there]
            known.append(x)
        return known

    def _own(self, selected: VariableRows | Variables) -> VariableRows:
        rows = selected[:] if isinstance(selected, Variables) else selected
        if not (isinstance(rows, VariableRows) and any(rows.block is block for block in self._problem.layout.blocks)):
            raise InputError(
                "variables of the problem that was solved", f"{selected!r}", "use a block that `add_variables` returned"
            )
        return rows

    @property
    def iterations(self) -> int:
        """Steps tried."""
        return self.history[-1].number

    def covariance(
        self,
        first: VariableRows | Variables,
        second: VariableRows | Variables | None = None,
        *,
        is_determined: bool = False,
    ) -> NDArray[np.float64]:
        """Covariance of variables in their tangents at the solution, in the units of the tangents.

        The first call costs about two factorisations, many variables together about three more; what was computed is kept.

        Args:
            first: k variables.
            second: k variables, for the cross-covariances of first[n] and second[n]; None for `first` itself.
            is_determined: the problem determines all of its variables, which is then not looked into, and saves half of the time.

        Returns:
            (k, dof, dof) blocks of H⁻¹, the losses' weights included. A fixed variable has covariance zero: it is known.

        Raises:
            SingularProblemError: an unobservable direction of the problem moves one of these variables.
            InputError: losses or weights of the problem are others than those it was solved with.
        """
        rows = self._own(first)
        return self._covariances.blocks(rows, rows if second is None else self._own(second), is_determined)

    def joint_covariance(self, *selected: VariableRows | Variables, is_determined: bool = False) -> NDArray[np.float64]:
        """Covariance (D, D) of all selected variables together, their tangents one after the other in the order given.

        Args:
            is_determined: the problem determines all of its variables, which is then not looked into: the search for directions
                that it leaves free takes ten times as long as the rest.

        Raises:
            InputError, SingularProblemError: as for `covariance`; with `is_determined` where H is singular to rounding.
        """
        return self._covariances.joint([self._own(rows) for rows in selected], is_determined)

    def response(self, slopes: Sequence[NDArray[np.float64]], *, is_determined: bool = False) -> list[NDArray[np.float64]]:
        """How far a change of the residuals moves the variables, to first order: H⁻¹ g, in the units of the tangents.

        Args:
            slopes: g for every block (n, dof): Jᵀ Δr of whitened residuals that change by −Δr.
            is_determined: as for `covariance`.

        Raises:
            SingularProblemError: an unobservable direction of the problem moves a variable.

        Example:
            >>> problem = bp.Problem()
            >>> x = problem.add_variables(bp.Euclidean(1), [0.0])
            >>> group = problem.add_residuals(bp.residuals.Prior(bp.Euclidean(1), [2.0], sigma=0.5), x)
            >>> problem.solve().response([np.array([[4.0]])])[0]
            array([[1.]])
        """
        return self._covariances.response(slopes, is_determined)

    def standard_deviations(self, selected: VariableRows | Variables) -> NDArray[np.float64]:
        """Square roots (k, dof) of the diagonals of `covariance`, in the units of the tangents; zero where fixed.

        Raises:
            SingularProblemError: as for `covariance`.
        """
        diagonal = np.einsum("kii->ki", self.covariance(selected))
        return np.asarray(np.sqrt(diagonal))

    @property
    def is_broken_off(self) -> bool:
        """Whether the callback or the time limit stopped it, and not the limit of steps: who does that does not wait for more."""
        return self.status == "stopped" and self.limit != "steps"

    def undetermined(self) -> list[str]:
        """A sentence for every way in which the residuals let variables move freely at the solution.

        Costs about a factorisation where all are determined, and a few more where not.
        """
        self._problem.start(self.values)
        return describe_null_space(self._problem, find_null_space(self._problem))

    def remainder(self, *, apart_from: VariableRows | None = None) -> Remainder | None:
        """How far from the minimum a limit, or steps that led no further down, left every variable and what the residuals see.

        Costs a linearisation, a factorisation (two with `apart_from`), and some twenty to two hundred solves with it, the fewest
        where much is far off; what was asked last is kept.

        Args:
            apart_from: variables that are not asked, nor what residuals see of them. They stay where they are along what their
                own residuals hardly measure, such as the depth of points far away: nothing else is to move for it.

        Returns:
            None where it converged, was stopped by the callback, or all variables together are within a standard deviation.

        Raises:
            InputError: variables or residuals were removed since.

        Example:
            >>> problem = bp.Problem()
            >>> x = problem.add_variables(bp.Euclidean(1), [0.0])
            >>> group = problem.add_residuals(bp.residuals.Prior(bp.Euclidean(1), [1.0], sigma=0.5), x)
            >>> problem.solve(max_iterations=0).remainder().variables[0].round(3)
            array([2.])
        """
        if self.limit is None and self.status != "stalled":
            return None
        self._problem.require_current()
        rows = None if apart_from is None else self._own(apart_from)
        asked = None if rows is None else (rows.block.number, rows.ids.tobytes())
        if self._remainder is None or self._remainder[0] != asked:
            self._problem.start(self.values)
            found = find_remainder(self._problem, [step.cost for step in self.history[self.descent :]], rows)
            object.__setattr__(self, "_remainder", (asked, found))
        return self._remainder[1] if self._remainder is not None else None

    def unconverged(
        self, advice: str = "allow more steps, or start elsewhere", *, apart_from: VariableRows | None = None
    ) -> str | None:
        """A sentence where a variable, or what a residual sees, ended more than a standard deviation of its own from the minimum.

        So it may be where a limit stopped it, or no step led down any more; who stops it by the callback knows. None else. Costs
        what `remainder` does there, and nothing where it converged.

        Args:
            advice: what to do about it.
            apart_from: see `remainder`.

        Raises:
            InputError: variables or residuals were removed since.

        Example:
            >>> problem = bp.Problem()
            >>> x = problem.add_variables(bp.Euclidean(1), [0.0])
            >>> group = problem.add_residuals(bp.residuals.Prior(bp.Euclidean(1), [2.0], sigma=0.5), x)
            >>> problem.solve(max_iterations=0).unconverged()[:60]
            'no minimum was reached (iteration limit of 0 reached): the c'
            >>> problem.solve().unconverged() is None
            True
        """
        remainder = self.remainder(apart_from=apart_from)
        if remainder is None:
            return None
        told = unconverged_sentence(self._problem, self.reason, self.cost, remainder)
        return None if told is None else f"{told}: {advice}"

    def doubts(self) -> tuple[str, ...]:
        """Sentences on what speaks against the values, converged or not.

        Told are residuals under least squares that no noise explains, by the usual ones of their group, and a χ² of nine times
        what the standard deviations promise, where all groups have some and no robust loss. Costs one evaluation.

        Raises:
            InputError: variables or residuals were removed since.

        Example:
            >>> problem = bp.Problem()
            >>> x = problem.add_variables(bp.Euclidean(1), [0.0])
            >>> measured = np.append(np.linspace(1.9, 2.1, 20), 50.0)[:, None]  # the last one is wrong
            >>> prior = bp.residuals.Prior(bp.Euclidean(1), measured, sigma=0.1)
            >>> group = problem.add_residuals(prior, x[np.zeros(21, int)], name="x")
            >>> problem.solve().doubts()[0][:33]
            '1 of the 21 residuals of x (20) i'
        """
        self._problem.require_current()
        return misfit_notes(self._problem.groups, self.values, self._problem.layout.dof)

    def summary(self) -> str:
        """A few lines for a terminal or a log, with what speaks against the values."""
        lines = [
            f"{self.method}, {self.linear_solver}",
            f"cost {self.cost_initial:.6e} → {self.cost:.6e} in {self.iterations} iterations "
            f"({sum(not step.accepted for step in self.history[1:])} rejected), {self.timing_s['total']:.3f} s",
            f"{self.status}: {self.reason}",
        ]
        lines += [f"{count} residuals of group {name!r} could not be evaluated" for name, count in self.invalid.items() if count]
        lines += [text for text in (self.unconverged(),) if text]
        return "\n".join([*lines, *self.notes, *self.doubts()])


def values_at(blocks: Sequence[Variables], given: Solution | Sequence[NDArray[np.float64]] | None) -> list[NDArray[np.float64]]:
    """See `Problem.values_at`."""
    if given is None:
        return [block.values.copy() for block in blocks]
    values = given.values_of(blocks) if isinstance(given, Solution) else given
    require(values, Sequence, "a Solution, or a list with an array for each block", "give what `solve` returned")
    if len(values) != len(blocks):
        raise InputError(f"values of {len(blocks)} blocks", f"{len(values)}", "give one array for each block")
    if isinstance(given, Solution):
        for block, other in zip(blocks, given._problem.layout.blocks, strict=False):  # some may be new
            if block.manifold != other.manifold:
                got = f"a solution with {other.name!r} on {other.manifold}"
                raise InputError(f"{block.name} on {block.manifold}", got, "start from a problem of the same blocks")
    checked = []
    for block, array in zip(blocks, values, strict=True):
        if np.shape(array) != block.values.shape:
            raise InputError(f"{block.name} of shape {block.values.shape}", f"shape {np.shape(array)}", "keep the block's shape")
        checked.append(array.copy() if isinstance(given, Solution) else block.manifold.check(block.name, array))
    return checked
