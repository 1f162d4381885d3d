"""Whether information matrices mean something else than they were read as: where residuals are far smaller than they promise.

Covariances in place of their inverses, or information per square degree or square millimetre, weigh the edges wrongly against
each other, and χ² comes out small. Read as they were meant, rotations and translations both fit as promised; where
somebody was only careful, they do not.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import BoxplusError
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.optimization.minimizers.minimize import Callback
from boxplus.optimization.solver_options import SolverOptions
from boxplus.systems.pose_graph.problem import pose_graph_problem, residual_of

_SMALL, _LEAST = 0.7, 30  # χ² of what is promised, below which it is asked, and degrees of freedom for it to mean much
_AS_PROMISED = (0.6, 1.6)  # χ² of rotations and of translations, where a reading is right
_LIKELY = (1e-2, 1e4)  # the same before poses are found anew
_STEPS = 20


def information_doubt(
    graph: PoseGraph,
    poses: NDArray[np.float64],
    held: NDArray[np.int64],
    options: SolverOptions,
    callback: Callback | None = None,
) -> str | None:
    """A sentence where the edges' information fits the errors at `poses` far better in another unit, or inverted.

    Args:
        held: the poses that are held. callback: may stop the search for poses of another reading, which then is not told.
    """
    dof = graph.information.shape[1] * (len(graph.edges) - len(graph.ids) + len(held))
    as_read = _fits(graph, poses, dof) if dof >= _LEAST else None
    if as_read is None or not as_read[2] < _SMALL:
        return None
    for information, meant in _readings(graph.information):
        other = replace(graph, information=information)
        if not all(_LIKELY[0] < fit < _LIKELY[1] for fit in _fits(other, poses, dof)):
            continue
        try:
            problem, _ = pose_graph_problem(other, held=held, loss=None, objective="logarithm")
            found = problem.solve(options.model_copy(update={"max_iterations": _STEPS}), start=[poses], callback=callback)
        except BoxplusError:
            continue
        if found.status == "stopped" and found.limit != "steps":
            return None
        fits = _fits(other, found.values[0], dof)
        if all(_AS_PROMISED[0] < fit < _AS_PROMISED[1] for fit in fits):
            return (
                f"χ² is {as_read[2]:.3g} times what the information matrices promise (rotations {as_read[0]:.3g}, translations "
                f"{as_read[1]:.3g}), and {fits[2]:.3g} times ({fits[0]:.3g}, {fits[1]:.3g}) if {meant}: edges weigh wrongly "
                "against each other, and standard deviations are wrong"
            )
    return None


def _readings(information: NDArray[np.float64]) -> Iterator[tuple[NDArray[np.float64], str]]:
    dim = information.shape[1]
    split = 3 if dim == 6 else 1
    for places, unit, name in (
        (slice(0, split), np.degrees(1.0), "the information of rotations is per square degree"),
        (slice(split, dim), 1e3, "the information of translations is per square millimetre"),
    ):
        scale = np.ones(dim)
        scale[places] = unit
        yield (
            np.asarray(information * np.outer(scale, scale), dtype=np.float64),
            f"{name}: give it per square {'radian' if unit < 1e3 else 'metre'}",
        )
    try:
        yield np.asarray(np.linalg.inv(information), dtype=np.float64), "they are covariances: give their inverses"
    except np.linalg.LinAlgError:
        return


def _fits(graph: PoseGraph, poses: NDArray[np.float64], dof: int) -> tuple[float, float, float]:
    """χ² of rotations, of translations and of both over what is promised."""
    i, j = graph.edges.T
    e = residual_of(graph).evaluate(poses[i], poses[j])
    dim = e.shape[1]
    split = 3 if dim == 6 else 1
    share = dof / e.size
    squares = []
    for part in (slice(0, split), slice(split, dim), slice(0, dim)):
        own = e[:, part]
        chi2 = float(np.einsum("ni,nij,nj->", own, graph.information[:, part, part], own))
        squares.append(chi2 / (own.size * share))
    return squares[0], squares[1], squares[2]
