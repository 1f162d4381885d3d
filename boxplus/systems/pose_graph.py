"""Pose-graph optimisation: the poses that agree best with the relative poses measured between them (SPEC.md 5)."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from boxplus.errors import InputError
from boxplus.formats.pose_graph import PoseGraph
from boxplus.manifolds.se2 import SE2
from boxplus.manifolds.se3 import SE3
from boxplus.optimization.losses import Loss
from boxplus.optimization.minimize import Callback
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.optimization.solver_options import SolverOptions
from boxplus.optimization.variables import Variables
from boxplus.residuals.relative_pose import RelativePose
from boxplus.residuals.relative_pose_2d import RelativePose2D
from boxplus.systems.pose_graph_start import chordal_start, held_poses, spanning_tree_start

Start = Literal["file", "spanning_tree", "chordal"]
# Almost Gauss-Newton: long chains are so badly conditioned that more damping than this costs iterations.
_DAMPING = 1e-9


class PoseGraphConfig(BaseModel):
    """Options of `optimize_pose_graph`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    start: Literal["auto", "file", "spanning_tree", "chordal"] = Field(
        "auto", description="where to start; auto: the cheapest of the file's poses and the chordal relaxation"
    )
    solver: SolverOptions = Field(
        SolverOptions(initial_damping=_DAMPING), description="see SolverOptions; Levenberg-Marquardt, hardly damped"
    )


@dataclass(frozen=True, slots=True)
class PoseGraphResult:
    """An optimised pose graph.

    Attributes:
        graph: the input with the optimised poses.
        start: which start was taken.
        chi2_start, chi2: Σ eᵀ Ω e over the edges, twice the cost of a problem without robust loss.
        held: indices of the poses that were held: those the file fixes, and the first of every component without any.
        solution: with history, covariance, and why it stopped.
        timing_s: seconds of the initialisation and of the optimisation.
    """

    graph: PoseGraph
    start: Start
    chi2_start: float
    chi2: float
    held: NDArray[np.int64]
    solution: Solution
    timing_s: dict[str, float]


def optimize_pose_graph(
    graph: PoseGraph, config: PoseGraphConfig | None = None, *, loss: Loss | None = None, callback: Callback | None = None
) -> PoseGraphResult:
    """Minimise ½ Σ ρ(eᵀ Ω e) with e = Log(Z⁻¹ T_i⁻¹ T_j) over the poses.

    Raises:
        InputError: the start asked for is not in the file; an information matrix is only semi-definite.
        SingularProblemError: see `Problem.solve`.
    """
    config = config if config is not None else PoseGraphConfig()
    begin = time.perf_counter()
    held = held_poses(graph)
    problem, poses = pose_graph_problem(graph, held=held, loss=loss)
    candidates = _starts(graph, config.start)
    costs = {name: problem.cost([start]) for name, start in candidates.items()}
    chosen = min(candidates, key=lambda name: costs[name])
    prepared = time.perf_counter()
    solution = problem.solve(config.solver, start=[candidates[chosen]], callback=callback)
    return PoseGraphResult(
        graph=replace(graph, poses=solution[poses]),
        start=chosen,
        chi2_start=chi2(graph, candidates[chosen]),
        chi2=chi2(graph, solution[poses]),
        held=held,
        solution=solution,
        timing_s={"start": prepared - begin, "optimisation": time.perf_counter() - prepared},
    )


def pose_graph_problem(
    graph: PoseGraph, *, held: NDArray[np.int64] | None = None, loss: Loss | None = None
) -> tuple[Problem, Variables]:
    """The least-squares problem of a graph, with its poses as one block of variables.

    Args:
        held: poses that do not move; `held_poses(graph)` if left out.
    """
    problem = Problem()
    values = graph.poses if graph.poses is not None else spanning_tree_start(graph)
    poses = problem.add_variables(SE3 if graph.dimension == 3 else SE2, values, name="poses")
    i, j = graph.edges.T
    problem.add_residuals(_residual(graph), poses[i], poses[j], loss=loss, name="edges")
    problem.fix(poses[held_poses(graph) if held is None else held])
    return problem, poses


def chi2(graph: PoseGraph, poses: NDArray[np.float64]) -> float:
    """Σ eᵀ Ω e over the edges, for poses laid out as in the graph, without any robust loss."""
    i, j = graph.edges.T
    e = _residual(graph).evaluate(poses[i], poses[j])
    return float(np.einsum("na,nab,nb->", e, graph.information, e, optimize=True))


def _residual(graph: PoseGraph) -> RelativePose | RelativePose2D:
    kind = RelativePose if graph.dimension == 3 else RelativePose2D
    return kind(graph.measurements, information=graph.information)


def _starts(graph: PoseGraph, wanted: Literal["auto", "file", "spanning_tree", "chordal"]) -> dict[Start, NDArray[np.float64]]:
    starts: dict[Start, NDArray[np.float64]] = {}
    if wanted == "file" and graph.poses is None:
        raise InputError(
            "poses in the file to start from", f"only edges ({graph.source})", "start with `chordal` or `spanning_tree`"
        )
    if wanted in ("auto", "file") and graph.poses is not None:
        starts["file"] = graph.poses
    if wanted in ("auto", "chordal"):
        starts["chordal"] = chordal_start(graph)
    if wanted == "spanning_tree":
        starts["spanning_tree"] = spanning_tree_start(graph)
    return starts
