"""Options that `boxplus ba` and `boxplus pgo` share: of the solver, and where the results go."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from boxplus.cli.options import RESULTS, default_threads
from boxplus.errors import InputError

if TYPE_CHECKING:
    from boxplus.optimization.losses import Loss
    from boxplus.optimization.solver_options import SolverOptions

_SOLVER = "Solver"
# Scales at which a robust loss is 95 % as good as least squares where all errors are Gaussian.
_LOSS_SCALE = {"huber": 1.345, "cauchy": 2.385, "tukey": 4.685, "geman_mcclure": 3.787, "welsch": 2.985}
_LOSS_NAME = {"huber": "Huber", "cauchy": "Cauchy", "tukey": "Tukey", "geman_mcclure": "GemanMcClure", "welsch": "Welsch"}

_LOSS_HELP = (
    "none, or huber, cauchy, tukey, geman_mcclure or welsch with its scale in standard deviations, as in huber:1.0; without one, "
    "the scale of 95 % efficiency."
)


class MethodChoice(StrEnum):
    """How a step is chosen."""

    levenberg_marquardt = "levenberg_marquardt"
    gauss_newton = "gauss_newton"
    dogleg = "dogleg"


class LinearSolverChoice(StrEnum):
    """How a step is computed."""

    auto = "auto"
    dense = "dense"
    sparse = "sparse"
    schur = "schur"


OutputOption = Annotated[
    Path | None,
    typer.Option("--output", "-o", help="Folder for the results; default: FILE_boxplus here.", rich_help_panel=RESULTS),
]
LossOption = Annotated[str, typer.Option("--loss", help=f"Robust loss: {_LOSS_HELP}")]
MethodOption = Annotated[MethodChoice, typer.Option("--method", help="How a step is chosen.", rich_help_panel=_SOLVER)]
LinearSolverOption = Annotated[
    LinearSolverChoice,
    typer.Option("--linear-solver", help="How a step is computed; auto says what it chose and why.", rich_help_panel=_SOLVER),
]
MaxIterationsOption = Annotated[
    int, typer.Option("--max-iterations", min=0, help="Steps tried at most.", rich_help_panel=_SOLVER)
]
TimeLimitOption = Annotated[
    float | None, typer.Option("--time-limit", min=0.001, help="No step is begun after this time [s].", rich_help_panel=_SOLVER)
]


def parse_loss(text: str) -> Loss | None:
    """The loss of `huber:1.0` and its like; None for `none`.

    Raises:
        InputError: an unknown name, or a scale that is not a positive number.
    """
    from boxplus.optimization import losses

    name, _, scale = text.strip().lower().partition(":")
    name = name.replace("-", "_")
    if name == "none":
        return None
    if name not in _LOSS_NAME:
        raise InputError(f"--loss none or one of {', '.join(_LOSS_NAME)}", repr(text), "write it as in --loss huber:1.0")
    try:
        value = float(scale) if scale else _LOSS_SCALE[name]
    except ValueError:
        raise InputError(f"a number as the scale of {name}", repr(scale), f"write it as in --loss {name}:1.0") from None
    loss: Loss = getattr(losses, _LOSS_NAME[name])(value)
    return loss


def solver_options(
    default: SolverOptions,
    method: MethodChoice,
    linear_solver: LinearSolverChoice,
    max_iterations: int | None,
    time_limit_s: float | None,
    threads: int | None,
) -> SolverOptions:
    """The options with what was given on the command line."""
    given = {
        "method": method.value,
        "linear_solver": linear_solver.value,
        "threads": threads if threads is not None else default_threads(),
        "max_iterations": max_iterations,
        "time_limit_s": time_limit_s,
    }
    return default.model_copy(update={name: value for name, value in given.items() if value is not None})
