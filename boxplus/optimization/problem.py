"""A least-squares problem: blocks of variables, groups of residuals, and their minimum."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError

from boxplus._thread_guard import ThreadGuard, changes
from boxplus.errors import InputError, SingularProblemError
from boxplus.manifolds.manifold import Manifold
from boxplus.optimization.connections import check_connections
from boxplus.optimization.elimination import choose_system
from boxplus.optimization.faded import faded_notes, faded_shares
from boxplus.optimization.group import Group
from boxplus.optimization.layout import Layout
from boxplus.optimization.least_squares import LeastSquares
from boxplus.optimization.losses import Loss, Squared
from boxplus.optimization.minimize import Callback, minimize, strategy_of
from boxplus.optimization.observability.singularity import explain_singularity, structural_defects
from boxplus.optimization.solution import Solution
from boxplus.optimization.solver_options import SolverOptions
from boxplus.optimization.variables import VariableRows, Variables
from boxplus.residuals.residual import Residual
from boxplus.sparse.cholesky import NotPositiveDefinite

# Share of a group that may have lost its weight before the problem is analysed anew without it.
_STALE = 0.05


class Problem:
    """Minimises ½ Σ ρ(‖W r(x)‖²) over variables on manifolds.

    The structure (variables, groups, what is fixed) is analysed once, by the first `solve` after it changed. One thread at a
    time may use a problem, its solving included; a second one is refused (InputError).
    """

    def __init__(self) -> None:
        self._guard = ThreadGuard("Problem")
        self.blocks: list[Variables] = []
        self.groups: list[Group] = []
        self._analysed: tuple[tuple[Any, ...], LeastSquares, tuple[str, ...]] | None = None

    @changes
    def add_variables(self, manifold: Manifold, values: ArrayLike, *, name: str | None = None) -> Variables:
        """A block of n variables.

        Args:
            manifold: such as `boxplus.SE3` or `boxplus.Euclidean(3)`.
            values: (n, size) where the search starts; (size,) for a single variable.
            name: for messages; the manifold's name and a number otherwise.

        Raises:
            InputError: wrong shape, not finite, off the manifold; a name that is taken.
        """
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
        if len(connections) != len(residual.manifolds):
            raise InputError(
                f"{len(residual.manifolds)} connections ({', '.join(residual.roles)})",
                f"{len(connections)}",
                f"connect every variable of {type(residual).__name__}",
            )
        rows = [c[:] if isinstance(c, Variables) else c for c in connections]
        for connection in rows:
            self._require_own(connection)
        check_connections(residual, rows, self.groups, carry_over)
        label = name if name is not None else f"{type(residual).__name__}_{len(self.groups)}"
        if any(group.name == label for group in self.groups):
            raise InputError("a new name", f"{label!r}, which another group has", "choose another name")
        self.groups.append(Group(residual, rows, loss if loss is not None else Squared(), label))
        self._analysed = None
        return self.groups[-1]

    @changes
    def fix(self, selected: VariableRows | Variables) -> None:
        """Hold variables at their values: known quantities, or the gauge."""
        self._set_fixed(selected, True)

    @changes
    def free(self, selected: VariableRows | Variables) -> None:
        """Let fixed variables move again."""
        self._set_fixed(selected, False)

    def set_weights(self, group: Group, weights: ArrayLike | None) -> None:
        """Let every residual of a group count `weights` times: ½ Σ ρ(w ‖W r‖²), until other weights are set.

        Args:
            weights: (N,) not negative; None for one each. Residuals of weight zero leave the structure of the problem when they
                are many, so that they cost neither memory nor time.

        Raises:
            InputError: a group of another problem, weights of another shape, negative or not finite.
        """
        if not any(group is own for own in self.groups):
            raise InputError("a group of this problem", f"{group!r}", "give what `add_residuals` returned")
        if weights is None:
            group.set_weights(None)
            none = np.zeros(group.residual.count, dtype=np.bool_)
        else:
            checked = np.asarray(weights, dtype=np.float64)
            if checked.shape != (group.residual.count,) or not (np.isfinite(checked) & (checked >= 0.0)).all():
                expected = f"weights ({group.residual.count},), finite and not negative"
                raise InputError(expected, f"shape {checked.shape}, smallest {checked.min(initial=np.inf):g}", "repair them")
            group.set_weights(checked)
            none = checked == 0.0
        before = group.left_out if group.left_out is not None else np.zeros_like(none)
        fresh, counted = int(np.count_nonzero(none & ~before)), int(np.count_nonzero(~before))
        if (before & ~none).any() or fresh > _STALE * counted:
            group.left_out = none if none.any() else None
            self._analysed = None

    def _set_fixed(self, selected: VariableRows | Variables, fixed: bool) -> None:
        rows = selected[:] if isinstance(selected, Variables) else selected
        self._require_own(rows)
        is_fixed = rows.block.is_fixed.copy()
        is_fixed[rows.rows] = fixed
        is_fixed.flags.writeable = False
        rows.block.is_fixed = is_fixed
        self._analysed = None

    def _require_own(self, rows: VariableRows) -> None:
        if not (isinstance(rows, VariableRows) and any(rows.block is block for block in self.blocks)):
            what = f"{rows.block!r} of another one" if isinstance(rows, VariableRows) else f"{rows!r}"
            raise InputError("variables of this problem", what, "use a block that `add_variables` returned, or rows of it")

    @changes
    def cost(self, values: Solution | Sequence[NDArray[np.float64]] | None = None) -> float:
        """½ Σ ρ(‖W r‖²) at `values`, by default the variables' own."""
        at = self.values_at(values)
        return float(sum(group.evaluate(at, 1).cost for group in self.groups))

    def defects(self) -> list[str]:
        """What is wrong with the structure, a sentence each: variables without residuals, components without gauge."""
        return structural_defects(self.blocks, self.groups)

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
        if options is not None and settings:
            raise InputError("options or single settings", "both", "put the settings into the options")
        options = options if options is not None else _options(settings)
        model, notes, analysis = self._analyse(options)
        for stage in model.timing_s:
            model.timing_s[stage] = 0.0
        model.start(self.values_at(start))
        cost_initial = model.cost.cost
        strategy = strategy_of(options)
        try:
            status, reason, history = minimize(model, strategy, options, callback, begin)
        except NotPositiveDefinite as error:
            raise SingularProblemError(explain_singularity(model, error)) from error
        faded = faded_shares(self.groups, model.values)
        return Solution(
            status=status,
            reason=reason,
            values=tuple(model.values),
            cost_initial=cost_initial,
            cost=model.cost.cost,
            history=tuple(history),
            method=strategy.name,
            linear_solver=model.system.description,
            invalid={group.name: int((~group.counted).sum()) for group in self.groups},
            faded=faded,
            notes=(*notes, *faded_notes(self.groups, faded)),
            timing_s={"analysis": analysis, **model.timing_s, "total": time.perf_counter() - begin},
            _problem=model,
        )

    def values_at(self, given: Solution | Sequence[NDArray[np.float64]] | None = None) -> list[NDArray[np.float64]]:
        """Values (n, size) of every block at a solution or as given, fixed variables too; by default copies of the blocks' own.

        Raises:
            InputError: another number of blocks or variables, points that are not on their manifolds.
        """
        if given is None:
            return [block.values.copy() for block in self.blocks]
        values = given.values if isinstance(given, Solution) else given
        if len(values) != len(self.blocks):
            raise InputError(f"values of {len(self.blocks)} blocks", f"{len(values)}", "give one array for each block")
        if isinstance(given, Solution):
            for block, other in zip(self.blocks, given._problem.layout.blocks, strict=True):
                if block.manifold != other.manifold:
                    got = f"a solution with {other.name!r} on {other.manifold}"
                    raise InputError(f"{block.name} on {block.manifold}", got, "start from a problem of the same blocks")
        checked = []
        for block, array in zip(self.blocks, values, strict=True):
            if np.shape(array) != block.values.shape:
                raise InputError(
                    f"{block.name} of shape {block.values.shape}", f"shape {np.shape(array)}", "keep the block's shape"
                )
            checked.append(block.manifold.check(block.name, array))
        return checked

    def _analyse(self, options: SolverOptions) -> tuple[LeastSquares, tuple[str, ...], float]:
        """The problem as the solvers see it, what is wrong with its structure, and the seconds this took."""
        begin = time.perf_counter()
        key = (options.linear_solver, options.threads)
        if self._analysed is None or self._analysed[0] != key:
            if not self.groups:
                raise InputError("at least one group of residuals", "none", "call `add_residuals` first")
            layout = Layout(self.blocks)
            if layout.dof == 0:
                raise InputError("at least one free variable", "none", "call `add_variables`, or `free` some of them")
            system = choose_system(layout, self.groups, options)
            model = LeastSquares(layout, self.groups, system, options.threads)
            self._analysed = (key, model, tuple(self.defects()))
        return self._analysed[1], self._analysed[2], time.perf_counter() - begin


def _options(settings: dict[str, Any]) -> SolverOptions:
    try:
        return SolverOptions(**settings)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        known = ", ".join(SolverOptions.model_fields)
        raise InputError(f"settings of SolverOptions ({known})", f"{where}: {first['msg']}", "correct that setting") from None
