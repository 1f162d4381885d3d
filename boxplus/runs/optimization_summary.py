"""What `run.json` holds after `boxplus ba` and `boxplus pgo`: input, settings, iterations, result."""

from __future__ import annotations

import math
from datetime import datetime
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from boxplus.formats.output import atomic_file
from boxplus.optimization.solution import Solution

PLOTS = ("before_after.png", "errors.png", "cost.png")
"""Pictures that the reports put into the folder `plots`."""


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class IterationFacts(_Part):
    """One step that was tried; see `boxplus.optimization.solution.Iteration`."""

    number: int
    cost: float
    tried_cost: float | None = Field(description="null where the point could not be evaluated")
    gradient: float
    step: float
    parameter: float
    accepted: bool
    time_s: float


class ErrorFacts(_Part):
    """Errors of observations [px] or of edges [standard deviations]."""

    rms: float
    median: float
    p99: float
    largest: float
    invalid: int = Field(description="could not be evaluated, such as points behind their camera")

    @classmethod
    def of(cls, errors: NDArray[np.float64]) -> ErrorFacts:
        """Of (k,) errors, NaN where invalid."""
        valid = errors[np.isfinite(errors)]
        if not len(valid):
            return cls(rms=0.0, median=0.0, p99=0.0, largest=0.0, invalid=len(errors))
        return cls(
            rms=math.sqrt(float(np.mean(valid**2))),
            median=float(np.median(valid)),
            p99=float(np.percentile(valid, 99)),
            largest=float(valid.max()),
            invalid=len(errors) - len(valid),
        )


class OptimizationSummary(_Part):
    """The content of `run.json`."""

    program: Literal["boxplus ba", "boxplus pgo"]
    versions: dict[str, str]
    started: datetime
    state: Literal["finished", "interrupted"] = Field(description="interrupted: stopped by Ctrl-C, results up to there complete")
    input: str
    output: str = Field(description="the result, in the input's format, relative to the folder")
    sizes: dict[str, int]
    settings: dict[str, object] = Field(description="as used")
    status: Literal["converged", "stopped", "stalled"]
    reason: str
    method: str
    linear_solver: str
    convention: str = Field(description="what is summed, and with which weights")
    start: str = Field(description="where it started, and why there")
    cost_initial: float
    cost: float
    chi2_initial: float | None = Field(None, description="of a pose graph: the objective without ½ and without robust loss")
    chi2: float | None = None
    fit: str | None = Field(None, description="of a pose graph: χ² against what the information matrices promise")
    errors_initial: ErrorFacts
    errors: ErrorFacts
    invalid: dict[str, int] = Field(description="residuals that could not be evaluated at the end, by group")
    loops: str | None = Field(None, description="of a pose graph with --robust gnc: loop closures kept, and how clearly")
    certificate: str | None = Field(None, description="of a pose graph with --certify: whether the minimum is the global one")
    notes: list[str]
    doubt: str | None = Field(None, description="why the result is not to be trusted; the exit code is then 3")
    timing_s: dict[str, float]
    is_last_of_several: bool = Field(
        False,
        description="cost_initial, history and timing_s but for its `start` and `optimisation` are of the last of several solves",
    )
    history: list[IterationFacts]

    def write(self, path: Path) -> None:
        """Replace the file in one step.

        Raises:
            OutputError: it cannot be written; the file before stays.
        """
        with atomic_file(path) as file:
            file.write(self.model_dump_json(indent=2).encode())


def iteration_facts(solution: Solution) -> list[IterationFacts]:
    """The history of a solution."""
    return [
        IterationFacts(
            number=i.number,
            cost=i.cost,
            tried_cost=i.tried_cost if math.isfinite(i.tried_cost) else None,
            gradient=i.gradient,
            step=i.step,
            parameter=i.parameter,
            accepted=i.accepted,
            time_s=i.time_s,
        )
        for i in solution.history
    ]
