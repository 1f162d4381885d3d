"""A least-squares problem: blocks of variables, groups of residuals, and their minimum."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._arguments import as_settings
from boxplus._thread_guard import ThreadGuard, changes
from boxplus.errors import InputError, SingularProblemError
from boxplus.manifolds.manifold import Manifold
from boxplus.optimization.linear_systems.elimination import choose_system
from boxplus.optimization.linear_systems.least_squares import LeastSquares
from boxplus.optimization.linear_systems.linearization import LinearizedProblem, linearize
from boxplus.optimization.losses import Loss, Squared
from boxplus.optimization.minimizers.minimize import Callback, minimize, strategy_of
from boxplus.optimization.observability.singularity import explain_singularity, structural_defects
from boxplus.optimization.solution import Solution, values_at
from boxplus.optimization.solver_options import SolverOptions
from boxplus.optimization.terms.connections import check_connections, require_connections, require_manifold
from boxplus.optimization.terms.faded import faded_notes, faded_shares
from boxplus.optimization.terms.group import Group, ResidualRows
from boxplus.optimization.terms.held_components import component_mask, held_groups
from boxplus.optimization.terms.jacobian_notes import jacobian_notes
from boxplus.optimization.terms.layout import Layout
from boxplus.optimization.terms.removal import Masks, keep_first_estimates, require_forgettable, take_out, touching
from boxplus.optimization.terms.variables import VariableRows, Variables
from boxplus.optimization.terms.weighting import checked_weights
from boxplus.residuals.marginal_prior import MarginalPrior
from boxplus.residuals.residual import Residual
from boxplus.sparse.cholesky import Analyses, Analysis, NotPositiveDefinite

# Share of a group that may have lost its weight before the problem is analysed anew without it.
_STALE = 0.05


class Problem:
    """Minimises ½ Σ ρ(‖W r(x)‖²) over variables on manifolds.

    The structure (variables, groups, what is fixed) is analysed once, by the first `solve` after it changed. Variables and groups
    may come and go (`extend`, `remove`, `boxplus.marginalize`); what stays keeps its name. A second thread at a time is refused.

    Example:
        >>> problem = bp.Problem()
        >>> x = problem.add_variables(bp.Euclidean(1), [0.0], name="x")
        >>> measured = problem.add_residuals(bp.residuals.Prior(bp.Euclidean(1), [2.0], sigma=0.1), x, name="measured")
        >>> problem.solve()[x].round(6)
        array([[2.]])
    """

    def __init__(self) -> None:
        self._guard = ThreadGuard("Problem")
        self.blocks: list[Variables] = []
        self.groups: list[Group] = []
        self._added = 0  # groups, ever: the number in a name is not given twice
        self._analysed: tuple[tuple[Any, ...], LeastSquares, tuple[str, ...]] | None = None
        self._known = Analyses()  # of the last matrices, whose patterns often come again

    @changes
    def add_variables(self, manifold: Manifold, values: ArrayLike, *, name: str | None = None) -> Variables:
        """A block of n variables.

        Args:
            manifold: such as `boxplus.SE3` or `boxplus.Euclidean(3)`.
            values: (n, size) where the search starts; (size,) for a single variable.
            name: for messages; the manifold's name and a number otherwise.

        Raises:
            InputError: no manifold; wrong shape, not finite, off the manifold; a name that is taken.
        """
        require_manifold(manifold)
        label = name if name is not None else f"{manifold.name}_{len(self.blocks)}"
        if any(block.name == label for block in self.blocks):
            raise InputError("a new name", f"{label!r}, which another block has", "choose another name")
        self.blocks.append(Variables(len(self.blocks), label, manifold, manifold.check(label, values)))
        self._analysed = None
        return self.blocks[-1]

    @changes
    def add_residuals(
        self,
        residual: Residual,
        *connections: VariableRows | Variables,
        loss: Loss | None = None,
        name: str | None = None,
        carry_over: bool = False,
    ) -> Group:
        """A group of N residuals, each connected to one variable of every connection.

        Args:
            residual: of `boxplus.residuals`, or one's own.
            connections: for every variable of the residual, in the order of `residual.roles`, N rows of a block (or one for
                all N, or a block of N variables).
            loss: of `boxplus.losses`; least squares if left out.
            name: for messages.
            carry_over: let poses live on another of `SE3`, `SE3Left` and `BodyPose` than the residual is derived for: the
                same transform, moved differently. Jacobians are then carried over.

        Raises:
            InputError: wrong number of connections, wrong length, another manifold than the residual is derived for, a
                block that residuals take for different things (T_world_camera and T_camera_world).
        """
        require_connections(residual, connections)
        rows = [c[:] if isinstance(c, Variables) else c for c in connections]
        for connection in rows:
            self._require_own(connection)
        check_connections(residual, rows, self.groups, carry_over)
        label = name if name is not None else f"{type(residual).__name__}_{self._added}"
        if any(group.name == label for group in self.groups):
            raise InputError("a new name", f"{label!r}, which another group has", "choose another name")
        self.groups.append(Group(residual, rows, loss if loss is not None else Squared(), label))
        self._added += 1
        if isinstance(residual, MarginalPrior):
            keep_first_estimates(self.blocks, self.groups)
        self._analysed = None
        return self.groups[-1]

    @changes
    def extend(self, block: Variables, values: ArrayLike) -> VariableRows:
        """Add variables to a block, `newest = problem.extend(poses, T_world_imu)`; returns them. The ids of the others stay.

        Args:
            values: (n, size) where they start; (size,) for a single one.

        Raises:
            InputError: a block of another problem; wrong shape, not finite, off the manifold.
        """
        self._require_own(block[:])
        self._analysed = None
        return block.extend(block.manifold.check(block.name, values))

    @changes
    def remove(self, *leaving: VariableRows | Variables | Group | ResidualRows) -> dict[str, int]:
        """Take out residuals (`group`, `group[rows]`) and variables (`block`, `block[rows]`) with all residuals that touch them.

        What was known about variables through those that go is lost; `boxplus.marginalize` keeps it. Ids and rows of what
        stays do not change. A group without residuals leaves the problem; solutions from before have values, but no
        covariances any more. `problem.remove(pixels[is_outlier], points[lost])` does both.

        Returns:
            For every group that lost some, by name, how many residuals.

        Raises:
            InputError: something of another problem; a variable that a marginal prior knows, which cannot forget it.
        """
        if all(isinstance(part, Group) for part in leaving):
            return self._remove_groups(leaving)
        gone, chosen = self._selection(leaving)
        require_forgettable(self.groups, gone, chosen)
        for rows, touched in zip(chosen, touching(self.groups, gone), strict=True):
            rows |= touched
        return self.take_out(gone, chosen)

    @changes
    def take_out(self, gone: Masks, chosen: Masks, *, prior_follows: bool = False) -> dict[str, int]:
        """`remove` for what `reach_of` has found; a marginal prior that follows finds the first estimates for both."""
        self.groups, counts = take_out(self.blocks, self.groups, gone, chosen)
        if not prior_follows:
            keep_first_estimates(self.blocks, self.groups)
        self._analysed = None
        return counts

    def _remove_groups(self, leaving: Sequence[Any]) -> dict[str, int]:
        """`remove` for whole groups, which leave the variables and the other groups as they are."""
        numbers = {self._number_of(group) for group in leaving}
        whole = [group for number, group in enumerate(self.groups) if number in numbers]
        self.groups = [group for number, group in enumerate(self.groups) if number not in numbers]
        if any(isinstance(group.residual, MarginalPrior) for group in whole):
            keep_first_estimates(self.blocks, self.groups)
        self._analysed = None
        return {group.name: group.remaining for group in whole if group.remaining}

    def reach_of(self, leaving: Sequence[VariableRows | Variables]) -> tuple[Masks, Masks]:
        """For every block which variables are selected, and for every group which residuals touch them.

        Raises:
            InputError: variables of another problem.
        """
        gone, _ = self._selection(leaving)
        return gone, touching(self.groups, gone)

    def _selection(self, leaving: Sequence[VariableRows | Variables | Group | ResidualRows]) -> tuple[Masks, Masks]:
        """For every block and every group which variables and residuals are selected."""
        gone = [np.zeros(len(block), dtype=np.bool_) for block in self.blocks]
        chosen = [np.zeros(group.residual.count, dtype=np.bool_) for group in self.groups]
        for part in leaving:
            if isinstance(part, (Group, ResidualRows)):
                rows = part if isinstance(part, ResidualRows) else part[:]
                number = self._number_of(rows.group)
                chosen[number] |= rows.chosen
            else:
                selected = part[:] if isinstance(part, Variables) else part
                self._require_own(selected)
                gone[selected.block.number][selected.rows] = True
        return gone, chosen

    def _number_of(self, group: Group) -> int:
        for number, own in enumerate(self.groups):
            if own is group:
                return number
        raise InputError("a group of this problem", f"{group!r}", "give what `add_residuals` returned")

    @changes
    def fix(self, selected: VariableRows | Variables, *, components: ArrayLike | None = None) -> None:
        """Hold variables at their values: known quantities, or the gauge.

        Args:
            components: places in the tangent to hold alone, such as [0, 1, 5] for roll, pitch and height of an SE3 in the body's
                axes; all of them where left out.

        Raises:
            InputError: variables of another problem, components that the manifold does not have.
        """
        rows = selected[:] if isinstance(selected, Variables) else selected
        self._require_own(rows)
        if components is None:
            self._set_fixed(rows, True)
            return
        block, mask = rows.block, component_mask(rows.block, components)
        held = np.zeros((len(block), block.manifold.dof), dtype=np.bool_) if block.is_held is None else block.is_held.copy()
        held[rows.rows] |= mask
        self._set_held(block, held)

    @changes
    def free(self, selected: VariableRows | Variables) -> None:
        """Let fixed variables, and held components of them, move again."""
        rows = selected[:] if isinstance(selected, Variables) else selected
        self._require_own(rows)
        self._set_fixed(rows, False)
        if rows.block.is_held is not None:
            held = rows.block.is_held.copy()
            held[rows.rows] = False
            self._set_held(rows.block, held)

    @changes
    def set_values(self, values: Solution | Sequence[NDArray[np.float64]]) -> None:
        """Take the values of a solution, or one array a block, as the variables' own: where the next search starts.

        Variables that were added since the solution keep theirs.

        Raises:
            InputError: as for `values_at`.
        """
        for block, array in zip(self.blocks, self.values_at(values), strict=True):
            block.values = array

    def set_weights(self, group: Group, weights: ArrayLike | None) -> None:
        """Let every residual of a group count `weights` times: ½ Σ ρ(w ‖W r‖²), until other weights are set.

        Args:
            weights: (N,) not negative; None for one each. Residuals of weight zero leave the structure of the problem when they
                are many, so that they cost neither memory nor time.

        Raises:
            InputError: a group of another problem, weights of another shape, negative or not finite.
        """
        self._number_of(group)
        checked = None if weights is None else checked_weights(weights, group.residual.count)
        group.set_weights(checked)
        none = np.zeros(group.residual.count, dtype=np.bool_) if checked is None else checked == 0.0
        before = group.left_out if group.left_out is not None else np.zeros_like(none)
        fresh, counted = int(np.count_nonzero(none & ~before)), int(np.count_nonzero(~before))
        if (before & ~none).any() or fresh > _STALE * counted:
            group.left_out = none if none.any() else None
            self._analysed = None

    def _set_fixed(self, rows: VariableRows, fixed: bool) -> None:
        is_fixed = rows.block.is_fixed.copy()
        is_fixed[rows.rows] = fixed
        rows.block.set_fixed(is_fixed)
        self._analysed = None

    def _set_held(self, block: Variables, held: NDArray[np.bool_]) -> None:
        block.set_held(held)
        for group in self.groups:
            group.synchronize()
        self._analysed = None

    def _require_own(self, rows: VariableRows) -> None:
        if not (isinstance(rows, VariableRows) and rows.block in self.blocks):
            what = f"{rows.block!r} of another one" if isinstance(rows, VariableRows) else f"{rows!r}"
            raise InputError("variables of this problem", what, "use a block that `add_variables` returned, or rows of it")

    @changes
    def cost(self, values: Solution | Sequence[NDArray[np.float64]] | None = None) -> float:
        """½ Σ ρ(‖W r‖²) at `values`, by default the variables' own."""
        at = self.values_at(values)
        return float(sum(group.evaluate(at, 1).cost for group in self.groups))

    @changes
    def linearize(self, values: Solution | Sequence[NDArray[np.float64]] | None = None) -> LinearizedProblem:
        """Sparse Jacobian, whitened residuals and weights at `values`, by default the variables' own: for solvers of one's own.

        Fixed variables and held components have no columns; what cannot be evaluated is left with zero rows of weight zero.

        Raises:
            InputError: no free variable; values as in `values_at`.
            NotFiniteError: a residual or a Jacobian is NaN or infinite there.

        Example:
            `J, r, w = (at := problem.linearize()).jacobian, at.residuals, at.weights`, and `J.T @ (w * r)` is the gradient.
        """
        return linearize(self.blocks, self.groups, self.values_at(values))

    def defects(self) -> list[str]:
        """What is wrong with the structure, a sentence each: variables without residuals, components without gauge."""
        return structural_defects(self.blocks, [*self.groups, *held_groups(self.blocks)])

    @changes
    def analysis(self, options: SolverOptions) -> Analysis | None:
        """The symbolic factorisation that the next `solve` with these options takes; None where none is sparse."""
        return self._analyse(options)[0].system.analysis

    @changes
    def solve(
        self,
        options: SolverOptions | None = None,
        *,
        start: Solution | Sequence[NDArray[np.float64]] | None = None,
        callback: Callback | None = None,
        **settings: Any,
    ) -> Solution:
        """Minimise.

        Args:
            options: see `SolverOptions`; single settings may be given as keywords instead: `solve(max_iterations=20)`.
            start: where to start, another solution or the values of every block; the variables' own values otherwise. Fixed
                variables are held where it has them.
            callback: called with every `Iteration`; returns True to stop.

        Raises:
            InputError: no free variables or no residuals; unknown settings.
            NotFiniteError: a residual is NaN or infinite at the start.
            SingularProblemError: Gauss-Newton met a problem that does not determine its variables.
        """
        begin = time.perf_counter()
        options = as_settings(SolverOptions, options, settings)
        model, notes, analysis = self._analyse(options)
        model.timing_s = dict.fromkeys(model.timing_s, 0.0)
        began = self.values_at(start)
        model.start(began)
        cost_initial = model.cost.cost
        strategy = strategy_of(options)
        try:
            ending, history = minimize(model, strategy, options, callback, begin)
        except NotPositiveDefinite as error:
            raise SingularProblemError(explain_singularity(model, error)) from error
        faded = faded_shares(self.groups, None if model.is_linearized and callback is None else model.values)
        silenced = faded_notes(self.groups, faded, model.values, options.threads)
        return Solution(
            status=ending.status,
            reason=ending.reason,
            limit=ending.limit,
            values=tuple(model.values),
            cost_initial=cost_initial,
            cost=model.cost.cost,
            history=tuple(history),
            method=strategy.name,
            linear_solver=model.system.description,
            invalid={
                group.name: int((~(group.counted if group.removed is None else group.counted | group.removed)).sum())
                for group in self.groups
            },
            faded=faded,
            notes=(*notes, *jacobian_notes(self.groups, began, model.values), *silenced),
            timing_s={"analysis": analysis, **model.timing_s, "total": time.perf_counter() - begin},
            _problem=model,
        )

    def values_at(self, given: Solution | Sequence[NDArray[np.float64]] | None = None) -> list[NDArray[np.float64]]:
        """Values (n, size) of every block at a solution or as given, fixed variables too; by default copies of the blocks' own.

        Of a solution, variables that were added since have their own values, and those that were removed since are left out.

        Raises:
            InputError: another number of blocks or variables, points that are not on their manifolds.
        """
        return values_at(self.blocks, given)

    def _analyse(self, options: SolverOptions) -> tuple[LeastSquares, tuple[str, ...], float]:
        """The problem as the solvers see it, what is wrong with its structure, and the seconds this took."""
        begin = time.perf_counter()
        key = (options.linear_solver, options.threads, options.examine)
        if self._analysed is None or self._analysed[0] != key:
            if not self.groups:
                raise InputError("at least one group of residuals", "none", "call `add_residuals` first")
            layout = Layout(self.blocks)
            if layout.dof == 0:
                raise InputError("at least one free variable", "none", "call `add_variables`, or `free` some of them")
            groups = [*self.groups, *held_groups(self.blocks)]
            system = choose_system(layout, groups, options, self._known)
            model = LeastSquares(layout, groups, system, options.threads, keeps_tangents=not options.examine)
            self._analysed = (key, model, tuple(self.defects()) if options.examine else ())
        return self._analysed[1], self._analysed[2], time.perf_counter() - begin
