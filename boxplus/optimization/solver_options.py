"""How `Problem.solve` minimises: method, limits, tolerances."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from boxplus._settings import Settings

Method = Literal["levenberg_marquardt", "gauss_newton", "dogleg"]
Elimination = Literal["auto", "dense", "sparse", "schur"]


class SolverOptions(Settings):
    """Options of `Problem.solve`.

    Example:
        >>> bp.SolverOptions(method="dogleg", max_iterations=20).threads
        1
    """

    method: Method = Field("levenberg_marquardt", description="how a step is chosen")
    linear_solver: Elimination = Field("auto", description="how a step is computed; auto says what it chose and why")
    max_iterations: int = Field(100, ge=0, description="steps tried at most, rejected ones included")
    time_limit_s: float | None = Field(None, gt=0, description="[s] no further step is begun after this time")
    cost_tolerance: float = Field(1e-9, ge=0, description="converged when a step changes the cost by less than this share of it")
    expected_tolerance: float = Field(
        0.0,
        ge=0,
        description="converged when the next step is expected to lower the cost by less than this share of it: it is not tried, "
        "which saves a linearisation; for a window that is solved again and again",
    )
    step_tolerance: float = Field(1e-10, ge=0, description="converged when no tangent moves by more than this")
    gradient_tolerance: float = Field(
        1e-10, ge=0, description="converged when no column of J encloses an angle with r whose |cos| exceeds this"
    )
    initial_damping: float = Field(1e-5, gt=0, description="λ at the start of Levenberg-Marquardt, relative to the diagonal of H")
    damping: Literal["diagonal", "identity"] = Field(
        "diagonal", description="λ diag(H), which does not depend on units, or λ max(diag H) I at the start"
    )
    initial_radius: float = Field(1e4, gt=0, description="trust region of the dogleg at the start, in tangents scaled by diag(H)")
    examine: bool = Field(
        True,
        description="look beforehand for defects of the structure, and for better conditioned tangents of poses; off for a "
        "window that is solved again and again and known to be sound",
    )
    threads: int = Field(1, ge=1, description="results are the same for any number")
