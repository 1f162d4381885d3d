"""Which starts an optimisation of a pose graph compares, and which it tries when the first one leads nowhere good, or may not."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.optimization.losses import Cauchy, Loss
from boxplus.optimization.minimizers.minimize import Callback
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Iteration, Solution
from boxplus.optimization.solver_options import SolverOptions
from boxplus.systems.pose_graph.bridges import Bridge, bridge_pieces
from boxplus.systems.pose_graph.loops import LoopVerdict, judge_all_together, judge_loops
from boxplus.systems.pose_graph.named import named
from boxplus.systems.pose_graph.problem import pose_graph_problem, with_edges
from boxplus.systems.pose_graph.start import chordal_start, components, spanning_tree_start

Start = Literal["file", "spanning_tree", "chordal", "chordal_objective", "graduated", "cauchy"]
Wanted = Literal["auto", "file", "spanning_tree", "chordal"]
_SAME = 1e-3  # relative difference up to which two minima are one
_CAUCHY, _ROUNDS = 1.0, 8  # width [standard deviations] of the loss that leaves a minimum, and how often it is tried
_FALLS = 1e-4  # relative fall of the objective that makes it worth another round


class Starts:
    """Starts of one graph.

    Attributes:
        is_loop: (m,) edges that graduated non-convexity may refuse: all that do not join successive poses, or all where nothing
            else is there. Bridges, once sought, are none.
        bridges: loop closures that join pieces of odometry, believed for the company they keep.
    """

    def __init__(
        self,
        graph: PoseGraph,
        problem: Problem,
        follow: NDArray[np.bool_],
        held: NDArray[np.int64],
        wanted: Wanted,
        options: SolverOptions,
        callback: Callback | None,
    ) -> None:
        """`problem` is that of the graph, and `follow` (m,) which of its edges are odometry (`consecutive_edges`)."""
        if wanted == "file" and graph.poses is None:
            raise InputError(
                "poses in the file to start from", f"only edges ({graph.source})", "start with `chordal` or `spanning_tree`"
            )
        self.is_loop = ~follow
        self._graph, self._problem, self._held, self._wanted = graph, problem, held, wanted
        self._options, self._callback = options, callback
        self.bridges: list[Bridge] = []
        self.verdict: LoopVerdict | None = None
        self._stopped = False
        self._chordal: NDArray[np.float64] | None = None

    def candidates(self, loss: Loss | None, *, is_robust: bool) -> dict[Start, NDArray[np.float64]]:
        """Poses of every start that is compared.

        Args:
            loss: of the edges; one that forgets starts from what graduated non-convexity finds.
            is_robust: the start is that of graduated non-convexity, which wants odometry that no false loop has bent.
        """
        graph, wanted = self._graph, self._wanted
        forgets = loss is not None and loss.is_redescending
        if is_robust or forgets:
            self._bridge()
        if (is_robust or forgets) and wanted == "auto":
            found: dict[Start, NDArray[np.float64]] = {"spanning_tree": self._dead_reckoning()}
        else:
            found = {}
            if wanted in ("auto", "file") and graph.poses is not None:
                found["file"] = graph.poses
            if wanted in ("auto", "chordal"):
                found["chordal"] = self._chordal_start()
            if wanted == "spanning_tree":
                found["spanning_tree"] = spanning_tree_start(graph)
        if forgets and self.is_loop.any():
            (start,) = found.values()
            return {"graduated": self._graduated(start)}
        return found

    def further(
        self,
        first: Start,
        solution: Solution,
        known: dict[Start, NDArray[np.float64]],
        minima: dict[Start, float],
        enough: float | None,
        *,
        is_loud: bool,
    ) -> tuple[Start, Solution]:
        """The lowest minimum of all starts there are, or the first that is low enough.

        Args:
            first, solution: the start that was followed, and where it led.
            known: starts by name; receives those that are tried.
            minima: the objective at the end of every start; receives those that are tried.
            enough: objective below which nothing further is tried; None where the first one was low enough, and only the
                minimum of the chordal objective is tried.
            is_loud: rotations are so noisy that a local minimum may fit; the lowest is then left by a loss that forgets.
        """
        best = (first, solution)
        names: list[Start] = ["chordal_objective", "file", "chordal", "spanning_tree", "graduated"]
        for name in names if enough is not None else names[:1]:
            if enough is not None and min(minima.values()) <= enough:
                break
            if name in minima or (name == "file" and self._graph.poses is None) or self._stopped:
                continue
            if name == "graduated" and (not self.is_loop.any() or max(minima.values()) <= (1.0 + _SAME) * min(minima.values())):
                continue  # the others agree
            if name not in known:
                try:
                    known[name] = self._make(name)
                except InputError:
                    continue  # the chordal objective has no weights for edges that say nothing along some axis
            watch = named(self._watch, f"from another start, {name.replace('_', ' ')}")
            tried = self._problem.solve(self._options, start=[known[name]], callback=watch)
            minima[name] = 2.0 * tried.cost
            if tried.cost < best[1].cost:
                best = (name, tried)
        # Also where `enough` was reached: of 8 walks of 0.35 and 0.4 rad of noise that had got there, 3 fell by 3 to 10 % more.
        return self._relaxed(*best, known, minima) if is_loud else best

    def all_together(
        self, first: Start, verdict: LoopVerdict, known: dict[Start, NDArray[np.float64]]
    ) -> tuple[Start, LoopVerdict]:
        """The verdict of all loop closures together, from the chordal start, where that is the better one.

        Args:
            first, verdict: the start that was followed, and its verdict.
            known: starts by name; receives the one that is tried.
        """
        known["chordal"] = self._chordal_start()
        other = judge_all_together(self._graph, verdict, known["chordal"], self._options, self._watch)
        return (first, verdict) if other is verdict else ("chordal", other)

    def _relaxed(
        self,
        name: Start,
        solution: Solution,
        known: dict[Start, NDArray[np.float64]],
        minima: dict[Start, float],
    ) -> tuple[Start, Solution]:
        """Least squares again from where a Cauchy loss leads from the lowest minimum and the chordal start, while that falls.

        In a local minimum stretches are wound the wrong way, and hold each other by many edges of which each is off by a little
        more than noise; once large errors count less, those that are right win. The chordal start has wound nothing yet.
        """
        forgetting, _ = pose_graph_problem(self._graph, held=self._held, loss=Cauchy(_CAUCHY), objective="logarithm")
        watch = named(self._watch, "from another start, cauchy")
        for origin, reached in ((solution.values[0], solution.cost), (self._chordal_start(), math.inf)):
            for _ in range(_ROUNDS):
                if self._stopped:
                    break
                left = forgetting.solve(self._options, start=[origin], callback=watch).values[0]
                tried = self._problem.solve(self._options, start=[left], callback=watch)
                if not tried.cost < (1.0 - _FALLS) * reached:
                    break
                origin, reached = tried.values[0], tried.cost
                if reached < (1.0 - _FALLS) * solution.cost:
                    name, solution = "cauchy", tried
                    known[name], minima[name] = left, 2.0 * reached
        return name, solution

    def _make(self, name: Start) -> NDArray[np.float64]:
        if name == "graduated":
            self._bridge()
            return self._graduated(self._dead_reckoning())
        if name == "chordal_objective":
            # Smooth where the logarithm jumps at half a turn, and with far fewer minima.
            smooth, _ = pose_graph_problem(self._graph, held=self._held, loss=None, objective="chordal")
            watch = named(self._watch, "finding another start by the chordal objective")
            return smooth.solve(self._options, start=[self._chordal_start()], callback=watch).values[0]
        return self._chordal_start() if name == "chordal" else spanning_tree_start(self._graph)

    def _chordal_start(self) -> NDArray[np.float64]:
        """Made once, in the order of elimination that the problem itself is going to be solved in."""
        if self._chordal is None:
            analysis = self._problem.analysis(self._options)
            self._chordal = chordal_start(self._graph, None if analysis is None else analysis.fronts.order)
        return self._chordal

    def _bridge(self) -> None:
        if not self.is_loop.all():
            self.bridges = bridge_pieces(self._graph, self.is_loop, self._options, self._watch)
            self.is_loop[[bridge.edge for bridge in self.bridges]] = False

    def _watch(self, iteration: Iteration) -> bool:
        self._stopped = self._stopped or (self._callback is not None and bool(self._callback(iteration)))
        return self._stopped

    def _graduated(self, start: NDArray[np.float64]) -> NDArray[np.float64]:
        self.verdict = judge_loops(self._graph, self.is_loop, start, self._options, self._watch)
        return self.verdict.solution.values[0]

    def _dead_reckoning(self) -> NDArray[np.float64]:
        """Poses along the odometry, where it holds all together; else along a tree of all edges."""
        odometry = with_edges(self._graph, ~self.is_loop)
        same = len(np.unique(components(odometry))) == len(np.unique(components(self._graph)))
        return spanning_tree_start(odometry if same else self._graph)
