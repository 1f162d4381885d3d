"""A least-squares problem that grows step by step and whose estimate follows: iSAM2 over the house's sparse factor."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._arguments import as_settings
from boxplus._thread_guard import ThreadGuard, changes
from boxplus.errors import InputError, NotFiniteError, SingularProblemError
from boxplus.manifolds.manifold import Manifold
from boxplus.optimization.incremental.bayes_tree import BayesTree, TreeUpdate
from boxplus.optimization.incremental.covariance import blocks, joint
from boxplus.optimization.incremental.factor_store import FactorStore, GroupStore, RelativePoseStore
from boxplus.optimization.incremental.growing import grown
from boxplus.optimization.incremental.options import IncrementalOptions
from boxplus.optimization.incremental.reports import IncrementalSolution, IncrementalUpdate
from boxplus.optimization.incremental.variables import GrowingVariables, gather_points, scatter_points
from boxplus.optimization.losses import Loss, Squared
from boxplus.optimization.problem import Problem
from boxplus.optimization.terms.connections import check_connections, require_connections, require_manifold
from boxplus.optimization.terms.faded import faded_notes, faded_shares
from boxplus.optimization.terms.group import Group, broadcast
from boxplus.optimization.terms.jacobian_notes import wrong_jacobians
from boxplus.optimization.terms.misfit import misfit_notes
from boxplus.optimization.terms.variables import VariableRows, Variables
from boxplus.residuals.relative_pose import RelativePose
from boxplus.residuals.relative_pose_2d import RelativePose2D
from boxplus.residuals.residual import Residual

Indices = NDArray[np.int64]

# Residuals between a variable that is eliminated last and one that is measured now. What is measured next is mostly near: a
# robot that comes by a known place goes on along the known path. 3 leaves a quarter of the arithmetic of 0 on sphere2500.
_NEAR = 3


class IncrementalProblem:
    """Minimises ½ Σ ρ(‖W r(x)‖²) over variables that are added step by step, with their residuals.

    `update` solves for what the new residuals change, and leaves the rest of the factorisation as it is (docs/incremental.md).
    One thread at a time may use a problem; a second one is refused (InputError). Results are the same bits on every run.

    Source: Kaess et al., "iSAM2: Incremental smoothing and mapping using the Bayes tree", Int. J. Robotics Research 31(2), 2012.

    Args:
        options: see `IncrementalOptions`; single settings may be given as keywords instead.

    Example:
        >>> problem = bp.IncrementalProblem()
        >>> poses = problem.add_variables(bp.SE2, [0.0, 0.0, 0.0], fixed=True, name="poses")
        >>> new = problem.extend(poses, [0.0, 1.0, 0.0])
        >>> problem.add_residuals(bp.residuals.RelativePose2D([0.1, 1.0, 0.0], sigma=0.1), poses[0], new)
        >>> problem.update().is_settled
        True
        >>> problem.estimate(new)
        array([[0.1, 1. , 0. ]])
    """

    def __init__(self, options: IncrementalOptions | None = None, **settings: Any) -> None:
        self.options = as_settings(IncrementalOptions, options, settings)
        self.blocks: list[GrowingVariables] = []
        self._guard = ThreadGuard("IncrementalProblem")
        self._tree = BayesTree()
        self._block_of, self._row_of = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self._stores: list[FactorStore] = []
        self._store_of_kind: dict[tuple[Any, ...], int] = {}
        self._factor_store, self._factor_row = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self._names: list[str] = []
        none = np.zeros(0, np.int64)
        self._off, self._last = none, none
        self._linearized, self._solved_variables = 0, 0  # factors and variables that the tree has
        self._is_stale = False  # an update did not come to its end: the tree lacks what it should have

    @changes
    def add_variables(
        self, manifold: Manifold, values: ArrayLike, *, fixed: bool = False, name: str | None = None
    ) -> GrowingVariables:
        """A block of variables on one manifold, to which `extend` adds more.

        Args:
            manifold: such as `boxplus.SE3` or `boxplus.Euclidean(3)`.
            values: (n, size) where they are linearised first, or (size,); as good as they are known.
            fixed: hold these variables at their values: known quantities, or the gauge.
            name: for messages; the manifold's name and a number otherwise.

        Raises:
            InputError: wrong shape, not finite, off the manifold; a name that is taken.
        """
        require_manifold(manifold)
        label = name if name is not None else f"{manifold.name}_{len(self.blocks)}"
        if any(block.name == label for block in self.blocks):
            raise InputError("a new name", f"{label!r}, which another block has", "choose another name, or extend that block")
        checked = manifold.check(label, values)
        self.blocks.append(GrowingVariables(len(self.blocks), label, manifold))
        self._extend(self.blocks[-1], checked, fixed)
        return self.blocks[-1]

    @changes
    def extend(self, block: GrowingVariables, values: ArrayLike, *, fixed: bool = False) -> VariableRows:
        """More variables of a block, which are returned as rows of it.

        Args:
            values: (n, size) or (size,), and
            fixed: as for `add_variables`.

        Raises:
            InputError: a block of another problem; wrong shape, not finite, off the manifold.
        """
        self._require_own(block)
        before = len(block)
        self._extend(block, block.manifold.check(block.name, values), fixed)
        return block[before:]

    def _extend(self, block: GrowingVariables, values: NDArray[np.float64], fixed: bool) -> None:
        if fixed:
            block.append(values, None)
            return
        first = self._tree.add_variables(len(values), block.manifold.dof)
        end = first + len(values)
        self._block_of, self._row_of = grown(self._block_of, end), grown(self._row_of, end)
        self._block_of[first:end], self._row_of[first:end] = block.number, len(block) + np.arange(len(values))
        block.append(values, first)

    @changes
    def add_residuals(
        self,
        residual: Residual,
        *connections: VariableRows | Variables,
        loss: Loss | None = None,
        name: str | None = None,
        carry_over: bool = False,
    ) -> None:
        """N residuals, each connected to one variable of every connection; they count from the next `update` on.

        Relative poses of one kind with one loss are kept together and linearised one by one; residuals of other kinds are
        linearised with all that were added in the same call: add them in the portions in which they arrive.

        Args:
            residual, connections, loss, carry_over: as for `Problem.add_residuals`.
            name: for messages.

        Raises:
            InputError: wrong number of connections, wrong length, another manifold than the residual is derived for.
        """
        require_connections(residual, connections)
        rows = [self._own_rows(connection) for connection in connections]
        loss = loss if loss is not None else Squared()
        blocks = [self.blocks[c.block.number] for c in rows]
        kind = type(residual)
        # The kernels of relative poses know the losses by their codes.
        at_home = all(b.manifold == m for b, m in zip(blocks, residual.manifolds, strict=True))
        if kind in (RelativePose, RelativePose2D) and at_home and loss.function is None:
            self._add_relative_poses(residual, rows, loss, name)
        else:
            check_connections(residual, rows, (), carry_over)
            label = name if name is not None else f"{kind.__name__}_{len(self._stores)}"
            group = Group(residual, rows, loss, label)
            ids = np.stack([self.blocks[c.block.number].numbers[c.rows] for c in group.connections], axis=1)
            self._enter(len(self._stores), 0, ids)
            self._stores.append(GroupStore(group, ids >= 0))

    def _add_relative_poses(self, residual: Any, rows: list[VariableRows], loss: Loss, name: str | None) -> None:
        key = (type(residual), getattr(residual, "jacobian", None), rows[0].block.number, rows[1].block.number, loss, name)
        number = self._store_of_kind.get(key)
        if number is None:
            number = self._store_of_kind[key] = len(self._stores)
            label = name if name is not None else f"{type(residual).__name__}_{number}"
            self._stores.append(RelativePoseStore(residual, key[2], key[3], loss, label))
        both = np.empty((residual.count, 2), np.uint32)
        for slot, selected in enumerate(rows):
            both[:, slot] = broadcast(selected, residual.count).rows
        ids = np.stack([self.blocks[key[2]].numbers[both[:, 0]], self.blocks[key[3]].numbers[both[:, 1]]], axis=1)
        store = self._stores[number]
        self._enter(number, store.append(residual, both, ids >= 0), ids)  # type: ignore[attr-defined]

    def _enter(self, store: int, row: int, ids: Indices) -> None:
        first = self._tree.add_factors(ids)
        end = first + len(ids)
        self._factor_store, self._factor_row = grown(self._factor_store, end), grown(self._factor_row, end)
        self._factor_store[first:end], self._factor_row[first:end] = store, row + np.arange(len(ids))

    @changes
    def update(self) -> IncrementalUpdate:
        """Take in what was added, and bring the estimate to the optimum, up to the thresholds.

        Raises:
            SingularProblemError: the residuals do not determine some variables, which the message names; add what is missing and
                call `update` again. The estimate stays as it was.
            NotFiniteError: a residual or a Jacobian is NaN or infinite.
        """
        self._refuse_untouched()
        options, tree = self.options, self._tree
        rounds, relinearized, eliminated, solved = 0, 0, 0, 0
        while rounds < options.max_rounds:
            off, rebuild = self._off, self._is_stale
            self._is_stale = True  # until the tree has what follows
            if len(off):
                self._move_points(off)
                relinearized += len(off)
            factors, seeds = tree.touched(off, self._linearized)
            if self._linearized < tree.factors:
                self._last = tree.near_factors(self._linearized, _NEAR)
            self._linearize(factors)
            self._off, self._linearized = off[:0], tree.factors
            if rebuild:
                seeds = np.arange(tree.variables)
            if not len(seeds):
                self._is_stale = False
                break
            done = tree.update(seeds, self._last, options.wildfire)
            if done.undetermined >= 0:
                raise self._explained(done)
            self._is_stale = False
            self._solved_variables = tree.variables
            rounds, eliminated, solved = rounds + 1, max(eliminated, done.eliminated), max(solved, done.solved)
            self._follow(done.changed)
            if not len(self._off):
                break
        return IncrementalUpdate(rounds, relinearized, eliminated, solved, len(self._off))

    def _follow(self, changed: Indices) -> None:
        """Bring the estimates to the new δ, and find the variables of residuals that are off their linearisation there."""
        tree = self._tree
        for block, variables in self._by_block(changed):
            x, delta = np.empty((len(variables), block.manifold.size)), np.empty((len(variables), block.manifold.dof))
            gather_points(variables, self._row_of, block.points, tree.start, tree.delta, x, delta)
            scatter_points(variables, self._row_of, block.manifold.boxplus(x, delta), block.estimates)
        factors = tree.factors_of(changed, tree.factors)[0]
        off = []
        for number, own in self._by_store(factors):
            store = self._stores[number]
            is_off = store.check(self._factor_row[own], self.blocks, tree.start, tree.delta, self.options.tolerance)
            if is_off.any():
                off.append(own[is_off])
        if off:
            self._off = np.unique(tree.variables_of(np.concatenate(off)))

    def _refuse_untouched(self) -> None:
        fresh = np.arange(self._solved_variables, self._tree.variables)
        alone = fresh[~self._tree.is_touched(fresh)]
        if len(alone):
            names = ", ".join(self._name(v) for v in alone[:6]) + (f" and {len(alone) - 6} more" if len(alone) > 6 else "")
            raise SingularProblemError(f"no residual touches {names}: fix them, or measure them, and update again")

    def _name(self, variable: int) -> str:
        return f"{self.blocks[self._block_of[variable]].name}[{self._row_of[variable]}]"

    def _by_block(self, variables: Indices) -> Iterator[tuple[GrowingVariables, Indices]]:
        if len(self.blocks) == 1:
            yield self.blocks[0], variables
            return
        for number in np.unique(self._block_of[variables]):
            yield self.blocks[number], variables[self._block_of[variables] == number]

    def _by_store(self, factors: Indices) -> Iterator[tuple[int, Indices]]:
        if not len(factors):
            return
        if len(self._stores) == 1:
            yield 0, factors
            return
        stores = self._factor_store[factors]
        if (stores == stores[0]).all():
            yield int(stores[0]), factors
            return
        for number in np.unique(stores):
            yield int(number), factors[stores == number]

    def _move_points(self, off: Indices) -> None:
        """Linearise variables at the estimate from now on."""
        for block, variables in self._by_block(off):
            rows = self._row_of[variables]
            block.points[rows] = block.estimates[rows]
            self._tree.delta[self._places(variables, block)] = 0.0

    def _places(self, variables: Indices, block: GrowingVariables) -> Indices:
        return np.asarray(self._tree.start[variables][:, None] + np.arange(block.manifold.dof))

    def _linearize(self, factors: Indices) -> None:
        tree = self._tree
        for number, own in self._by_store(factors):
            rows = self._factor_row[own]
            bad = self._stores[number].linearize(rows, self.blocks, tree.contribution_at[own], tree.contributions)
            if bad >= 0:
                residual, connections, _, label = self._stores[number].described(self.blocks)
                where = ", ".join(f"{c.block.name}[{c.rows[bad]}]" for c in connections)
                raise NotFiniteError(
                    "finite residuals and Jacobians",
                    f"NaN or infinity in residual {bad} of {label!r} ({type(residual).__name__}) at {where}",
                    "repair that measurement, or the residual, or start elsewhere",
                )

    def _explained(self, done: TreeUpdate) -> SingularProblemError:
        problem = self.as_problem()
        defects = problem.defects()
        if not defects:
            try:
                problem.solve(method="gauss_newton", max_iterations=1)
            except SingularProblemError as error:
                return error
        name = self._name(done.undetermined)
        sentences = defects or [f"what is left of {name} after the elimination is rounding error"]
        return SingularProblemError("the problem does not determine its variables: " + "; ".join(sentences))

    def estimate(self, selected: VariableRows | Variables) -> NDArray[np.float64]:
        """Values (k, size) of variables after the last update, or as they were added."""
        rows = self._own_rows(selected)
        return self.blocks[rows.block.number].estimates[rows.rows]

    @changes
    def covariance(self, selected: VariableRows | Variables) -> NDArray[np.float64]:
        """Covariance of variables in their tangents at the estimate, in the units of the tangents.

        Each variable costs a walk to the top of the tree and back, however large the problem. Residuals count as they were
        linearised last.

        Returns:
            (k, dof, dof) blocks of H⁻¹, the losses' weights included. A fixed variable has covariance zero: it is known.

        Raises:
            InputError: something was added since the last update.
        """
        self._require_current()
        return blocks(self._tree, self._own_rows(selected))

    @changes
    def joint_covariance(self, *selected: VariableRows | Variables) -> NDArray[np.float64]:
        """Covariance (D, D) of all selected variables together, their tangents one after the other in the order given.

        Raises:
            InputError: as for `covariance`; nothing is selected.
        """
        if not selected:
            raise InputError("at least one selection of variables", "none", "give rows of a block, such as poses[[0, 3]]")
        self._require_current()
        return joint(self._tree, [self._own_rows(one) for one in selected])

    def _require_current(self) -> None:
        if self._is_stale or self._linearized < self._tree.factors or self._solved_variables < self._tree.variables:
            raise InputError("a problem that is up to date", "additions that no update has taken in", "call `update` first")

    @changes
    def solution(self) -> IncrementalSolution:
        """All values and the cost; takes time in proportion to the size of the problem, as opposed to `estimate`."""
        problem = self.as_problem()
        values = tuple(block.values for block in problem.blocks)
        cost = problem.cost() if problem.groups else 0.0
        dof = sum(int(np.count_nonzero(~block.is_fixed)) * block.manifold.dof for block in problem.blocks)
        shares = faded_notes(problem.groups, faded_shares(problem.groups, values), values, 1)
        doubts = (*misfit_notes(problem.groups, values, dof), *shares, *wrong_jacobians(problem.groups, values))
        return IncrementalSolution(values, cost, len(self._off), doubts)

    @changes
    def as_problem(self) -> Problem:
        """The same variables at the estimate, and the same residuals, to be solved as a whole."""
        problem = Problem()
        for block in self.blocks:
            own = problem.add_variables(block.manifold, block.values, name=block.name)
            if block.is_fixed.any():
                problem.fix(own[block.is_fixed])
        for store in self._stores:
            residual, rows, loss, label = store.described(problem.blocks)
            problem.add_residuals(residual, *rows, loss=loss, name=label, carry_over=True)
        return problem

    def _own_rows(self, selected: VariableRows | Variables) -> VariableRows:
        self._require_own(selected.block if isinstance(selected, VariableRows) else selected)
        return selected if isinstance(selected, VariableRows) else selected[:]

    def _require_own(self, block: Any) -> None:
        if not any(block is own for own in self.blocks):
            advice = "use a block that `add_variables` returned, or rows of it"
            raise InputError("variables of this problem", f"{block!r}", advice)
