"""Pose-graph optimisation: the poses that agree best with the relative poses measured between them (SPEC.md 5).

Two objectives: `logarithm`, Σ eᵀ Ω e with e = Log(Z⁻¹ T_i⁻¹ T_j), the statistically right one; and `chordal`, that of SE-Sync
(Rosen et al., IJRR 2019), κ ‖R_j − R_i R_ij‖² + τ ‖t_j − t_i − R_i t_ij‖², to compare with its certified optima.
"""

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
from boxplus.residuals.chordal_pose import ChordalPose, ChordalPose2D, chordal_weights
from boxplus.residuals.relative_pose import RelativePose
from boxplus.residuals.relative_pose_2d import RelativePose2D
from boxplus.residuals.residual import Residual
from boxplus.systems.pose_graph.start import chordal_start, components, held_poses, spanning_tree_start

Start = Literal["file", "spanning_tree", "chordal"]
Objective = Literal["logarithm", "chordal"]
# Almost Gauss-Newton: long chains are so badly conditioned that more damping than this costs iterations.
_DAMPING = 1e-9
_LISTED = 5  # poses named before the rest is left out


class PoseGraphConfig(BaseModel):
    """Options of `optimize_pose_graph`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    start: Literal["auto", "file", "spanning_tree", "chordal"] = Field(
        "auto", description="where to start; auto: the cheapest of the file's poses and the chordal relaxation"
    )
    objective: Objective = Field(
        "logarithm", description="logarithm: Σ eᵀ Ω e with e = Log(Z⁻¹ T_i⁻¹ T_j); chordal: the objective of SE-Sync"
    )
    solver: SolverOptions = Field(
        SolverOptions(initial_damping=_DAMPING), description="see SolverOptions; Levenberg-Marquardt, hardly damped"
    )


@dataclass(frozen=True, slots=True)
class PoseGraphResult:
    """An optimised pose graph.

    Attributes:
        graph: the input with the optimised poses.
        start: which start was taken, and `start_reason` why, in a sentence.
        poses_start: the poses there.
        start_costs: the cost at every start that was compared, robust loss included.
        chi2_start, chi2: the objective over the edges without any robust loss, twice the cost of a problem without one.
        errors_start, errors: (m,) √ of what every edge adds to chi2: its error in standard deviations.
        held: indices of the poses that were held: those the file fixes, and the first of every component without any.
        notes: what a user should know of the structure, one sentence each.
        solution: with history, covariance, and why it stopped.
        timing_s: seconds of checking and building the problem, of the initialisation, and of the optimisation.
    """

    graph: PoseGraph
    start: Start
    start_reason: str
    poses_start: NDArray[np.float64]
    start_costs: dict[Start, float]
    chi2_start: float
    chi2: float
    errors_start: NDArray[np.float64]
    errors: NDArray[np.float64]
    held: NDArray[np.int64]
    notes: tuple[str, ...]
    solution: Solution
    timing_s: dict[str, float]


def optimize_pose_graph(
    graph: PoseGraph, config: PoseGraphConfig | None = None, *, loss: Loss | None = None, callback: Callback | None = None
) -> PoseGraphResult:
    """Minimise ½ Σ ρ(eᵀ Ω e) with e = Log(Z⁻¹ T_i⁻¹ T_j), or the chordal objective, over the poses.

    Raises:
        InputError: no edges; the start asked for is not in the file.
        SingularProblemError: see `Problem.solve`.
    """
    config = config if config is not None else PoseGraphConfig()
    if not len(graph.edges):
        raise InputError(
            "a graph with edges", f"{len(graph.ids)} poses and none ({graph.source})", "measure relative poses first"
        )
    options = config.solver
    if "initial_damping" not in options.model_fields_set:
        options = options.model_copy(update={"initial_damping": _DAMPING})
    begin = time.perf_counter()
    held = held_poses(graph)
    problem, poses = pose_graph_problem(graph, held=held, loss=loss, objective=config.objective)
    built = time.perf_counter()
    candidates = _starts(graph, config.start)
    costs = {name: problem.cost([start]) for name, start in candidates.items()}
    chosen = min(candidates, key=lambda name: costs[name])
    prepared = time.perf_counter()
    solution = problem.solve(options, start=[candidates[chosen]], callback=callback)
    solved = time.perf_counter()
    residual = problem.groups[0].residual
    squared_start, squared = (_squared_errors(residual, graph, at) for at in (candidates[chosen], solution[poses]))
    return PoseGraphResult(
        graph=replace(graph, poses=solution[poses]),
        start=chosen,
        start_reason=_reason(config.start, chosen, costs),
        poses_start=candidates[chosen],
        start_costs=costs,
        chi2_start=float(squared_start.sum()),
        chi2=float(squared.sum()),
        errors_start=np.sqrt(squared_start),
        errors=np.sqrt(squared),
        held=held,
        notes=_notes(graph, held, solution),
        solution=solution,
        timing_s={"set-up": built - begin, "start": prepared - built, "optimisation": solved - prepared},
    )


def pose_graph_problem(
    graph: PoseGraph,
    *,
    held: NDArray[np.int64] | None = None,
    loss: Loss | None = None,
    objective: Objective = "logarithm",
) -> tuple[Problem, Variables]:
    """The least-squares problem of a graph, with its poses as one block of variables.

    Args:
        held: poses that do not move; `held_poses(graph)` if left out.
    """
    problem = Problem()
    values = graph.poses if graph.poses is not None else spanning_tree_start(graph)
    poses = problem.add_variables(SE3 if graph.dimension == 3 else SE2, values, name="poses")
    i, j = graph.edges.T
    problem.add_residuals(_residual(graph, objective), poses[i], poses[j], loss=loss, name="edges")
    problem.fix(poses[held_poses(graph) if held is None else held])
    return problem, poses


def chi2(graph: PoseGraph, poses: NDArray[np.float64], objective: Objective = "logarithm") -> float:
    """The objective over the edges, for poses laid out as in the graph, without any robust loss and without ½."""
    return float(_squared_errors(_residual(graph, objective), graph, poses).sum())


def positions(graph: PoseGraph, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3) positions of poses laid out as in a graph [m]; z = 0 in the plane."""
    return poses[:, 4:] if graph.dimension == 3 else np.column_stack([poses[:, 1:], np.zeros(len(poses))])


def _squared_errors(residual: Residual, graph: PoseGraph, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """(m,) what every edge adds to chi2."""
    i, j = graph.edges.T
    whitened = np.einsum("nab,nb->na", residual.whitening.factors, residual.evaluate(poses[i], poses[j]))
    return np.asarray((whitened * whitened).sum(axis=1))


def _residual(graph: PoseGraph, objective: Objective) -> Residual:
    if objective == "chordal":
        kappa, tau = chordal_weights(graph.information)
        return (ChordalPose if graph.dimension == 3 else ChordalPose2D)(graph.measurements, kappa=kappa, tau=tau)
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


def _reason(wanted: str, chosen: Start, costs: dict[Start, float]) -> str:
    """Why a start was taken."""
    name = chosen.replace("_", " ")
    if wanted != "auto":
        return f"{name}, as asked for; cost {costs[chosen]:.6g}"
    if len(costs) == 1:
        return f"{name}, as the graph has no poses of its own; cost {costs[chosen]:.6g}"
    others = ", ".join(f"{cost:.6g} ({other})" for other, cost in costs.items() if other != chosen)
    return f"{name}, with cost {costs[chosen]:.6g} cheaper than {others}"


def _notes(graph: PoseGraph, held: NDArray[np.int64], solution: Solution) -> tuple[str, ...]:
    """Sentences on pieces without edges between them, on poses without any edge, and the solver's own."""
    label = components(graph)
    sizes = np.bincount(label)
    notes = []
    if len(sizes) > 1:
        free = np.setdiff1d(held, graph.fixed)
        named = ", ".join(str(graph.ids[pose]) for pose in free[:_LISTED]) + (" …" if len(free) > _LISTED else "")
        notes.append(
            f"the graph falls into {len(sizes)} pieces without edges between them"
            + (f"; poses {named}, the first of those that the file does not fix anywhere, are held" if len(free) else "")
        )
    alone = np.flatnonzero(sizes[label] == 1)
    if len(alone):
        named = ", ".join(str(graph.ids[pose]) for pose in alone[:_LISTED]) + (" …" if len(alone) > _LISTED else "")
        notes.append(f"{len(alone)} poses have no edge and stay where they are: {named}")
    return (*notes, *solution.notes)
