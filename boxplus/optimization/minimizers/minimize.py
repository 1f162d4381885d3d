"""The loop that all methods share: propose a step, try it, take or leave it, and know when to stop."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from boxplus.optimization.linear_systems.least_squares import LeastSquares
from boxplus.optimization.minimizers.dogleg import Dogleg
from boxplus.optimization.minimizers.gauss_newton import GaussNewton
from boxplus.optimization.minimizers.levenberg_marquardt import LevenbergMarquardt
from boxplus.optimization.minimizers.strategy import Strategy
from boxplus.optimization.solution import Iteration
from boxplus.optimization.solver_options import SolverOptions

Status = Literal["converged", "stopped", "stalled"]
Callback = Callable[[Iteration], bool | None]


@dataclass(frozen=True, slots=True)
class Ending:
    """Why a minimisation ended; see `Solution` for `status`, `reason` and `limit`."""

    status: Status
    reason: str
    limit: Literal["steps", "time"] | None = None


def strategy_of(options: SolverOptions) -> Strategy:
    """The strategy that the options name."""
    if options.method == "gauss_newton":
        return GaussNewton()
    if options.method == "dogleg":
        return Dogleg(options.initial_radius)
    return LevenbergMarquardt(options.damping, options.initial_damping)


def minimize(
    problem: LeastSquares, strategy: Strategy, options: SolverOptions, callback: Callback | None, begin: float
) -> tuple[Ending, list[Iteration]]:
    """Lower the cost of `problem` from its accepted point until a tolerance or a limit is met.

    Args:
        callback: called after every iteration, the start included; returns True to stop.
        begin: `time.perf_counter()` when the user called.

    Returns:
        (ending, history); the accepted point is in `problem`.
    """
    history: list[Iteration] = []

    def record(number: int, tried: float, step: float, parameter: float, accepted: bool) -> bool:
        gradient = float(np.abs(problem.system.gradient).max(initial=0.0))
        elapsed = time.perf_counter() - begin
        history.append(Iteration(number, problem.cost.cost, tried, gradient, step, parameter, accepted, elapsed))
        return callback is not None and bool(callback(history[-1]))

    stop = record(0, problem.cost.cost, 0.0, strategy.parameter, True)
    rejected, lost = 0, 0  # steps rejected since the last that was taken, and the most residuals one of them lost
    broken = 0  # of them, those that led to NaN or infinity
    for number in range(1, options.max_iterations + 1):
        last = history[-1]
        if stop:
            return Ending("stopped", f"the callback asked to stop after iteration {last.number}"), history
        if (slope := problem.slope()) <= options.gradient_tolerance:
            return Ending("converged", _flat(slope, options)), history
        if options.time_limit_s is not None and last.time_s >= options.time_limit_s:
            return Ending("stopped", f"time limit of {options.time_limit_s:g} s reached", "time"), history
        before = strategy.parameter
        step = strategy.propose(problem)
        if step is None:
            return Ending("stalled", _stall(strategy, rejected, lost, broken)), history
        parameter, cost = strategy.parameter, problem.cost.cost
        # After rejections, and where damping had to grow for H to be factorised, little is expected because the step was made
        # small, not because the minimum is near.
        made_small = rejected or parameter > before > 0.0
        if not made_small and 0.0 <= step.predicted < options.expected_tolerance * cost:
            return Ending("converged", f"the next step is expected to lower the cost by {step.predicted:.2g} at most"), history
        size = float(np.abs(step.delta).max(initial=0.0))
        values = problem.moved(step.delta)
        tried = problem.linearize(values)
        usable = np.isfinite(tried.cost) and tried.lost == 0
        # Residuals that become valid on the way add cost: the step is judged by those that counted before it.
        decrease = cost - tried.common
        ratio = decrease / step.predicted if usable and step.predicted > 0.0 else None
        # At the bottom of the valley both decreases are rounding: the step is converged whatever their ratio says.
        settled = usable and abs(decrease) <= options.cost_tolerance * cost and step.predicted <= options.cost_tolerance * cost
        small = usable and size <= options.step_tolerance
        accepted = strategy.judge(ratio)
        if accepted:
            problem.accept(values, tried)
        stop = record(number, tried.cost if np.isfinite(tried.cost) else np.inf, size, parameter, accepted)
        if settled or small:
            # After rejections a step is small because it was made so, not because the minimum is near.
            if rejected:
                return Ending("stalled", _stall(strategy, rejected, lost, broken)), history
            if settled:
                told = f"the cost changed by {decrease:.2g}, {options.cost_tolerance:.2g} of it or less"
                return Ending("converged", told), history
            return Ending("converged", f"the step moved nothing by more than {size:.2g}"), history
        broken = 0 if accepted else broken + (not np.isfinite(tried.cost))
        rejected, lost = (0, 0) if accepted else (rejected + 1, max(lost, tried.lost))
    if stop:
        return Ending("stopped", f"the callback asked to stop after iteration {history[-1].number}"), history
    if (slope := problem.slope()) <= options.gradient_tolerance:
        return Ending("converged", _flat(slope, options)), history
    return Ending("stopped", f"iteration limit of {options.max_iterations} reached", "steps"), history


def _flat(slope: float, options: SolverOptions) -> str:
    return f"the residuals are at right angles to every tangent (cosine {slope:.2g} ≤ {options.gradient_tolerance:.2g})"


def _stall(strategy: Strategy, rejected: int, lost: int, broken: int) -> str:
    if broken:
        return (
            f"{broken} of the last {rejected} steps that were tried lead to residuals that are NaN or infinite: the way down is "
            "blocked; let a residual say where it does not exist (return None, or valid = False), or keep variables from there"
        )
    if lost:
        return (
            f"every step of the last {rejected} that were tried makes residuals invalid ({lost} at most): the way down is blocked"
        )
    return (
        f"{rejected} steps in a row were rejected and the next is too small to matter ({strategy.name} at "
        f"{strategy.parameter:.2g}): the cost does not fall where the Jacobians say; check those of your own with check_jacobian"
    )
