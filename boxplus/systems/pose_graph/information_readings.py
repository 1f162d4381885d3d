"""Whether information matrices mean something else than they were read as: where residuals are far smaller than they promise.

Covariances in place of their inverses, or information per square degree or square millimetre, weigh the edges wrongly against
each other, and χ² comes out small. Read as they were meant, rotations and translations both fit as promised; where
somebody was only careful, they do not.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import BoxplusError
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.optimization.minimizers.minimize import Callback
from boxplus.optimization.solver_options import SolverOptions
from boxplus.systems.pose_graph.problem import edge_parts, pose_graph_problem, residual_of

_SMALL, _LEAST = 0.7, 30  # χ² of what is promised, below which it is asked, and degrees of freedom for it to mean much
_AS_PROMISED = (0.6, 1.6)  # χ² of rotations and of translations, where a reading is right
_LIKELY = (0.1, 3e4)  # the same before poses are found anew
_STEPS = 20
_SLACK, _UNLIKE = 0.25, 4.0  # χ² of rotations or translations that is told of, and how many times that the other has
_ROTATIONS = {"": 1.0, "square degree": np.degrees(1.0), "square milliradian": 1e3}
_TRANSLATIONS = {"": 1.0, "square millimetre": 1e3}
"""Units, and how many of their roots a radian or a metre has."""


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
    as_read = _fits(graph, poses, len(held))
    if as_read is None or not as_read[2] < _SMALL:
        return None
    for information, meant in _readings(graph.information):
        other = replace(graph, information=information)
        before = _fits(other, poses, len(held))
        if before is None or not all(_LIKELY[0] < fit < _LIKELY[1] for fit in before):
            continue
        try:
            problem, _ = pose_graph_problem(other, held=held, loss=None, objective="logarithm")
            found = problem.solve(options.model_copy(update={"max_iterations": _STEPS}), start=[poses], callback=callback)
        except BoxplusError:
            continue
        if found.status == "stopped" and found.limit != "steps":
            return None
        fits = _fits(other, found.values[0], len(held))
        if fits is not None and all(_AS_PROMISED[0] < fit < _AS_PROMISED[1] for fit in fits):
            return (
                f"χ² is {as_read[2]:.3g} times what the information matrices promise (rotations {as_read[0]:.3g}, translations "
                f"{as_read[1]:.3g}), and {fits[2]:.3g} times ({fits[0]:.3g}, {fits[1]:.3g}) if {meant}: edges weigh wrongly "
                "against each other, and standard deviations are wrong"
            )
    return None


def slack_part_notes(graph: PoseGraph, poses: NDArray[np.float64], held: int) -> list[str]:
    """A sentence where rotations, or translations, err by far less than their information promises, and the others do not.

    All together they may well come to what is promised.

    Args:
        held: how many poses are held.
    """
    fits = _fits(graph, poses, held)
    if fits is None:
        return []
    rotations, translations, _ = fits
    less, more = sorted((rotations, translations))
    if not (less < _SLACK and more > _UNLIKE * less):
        return []
    name = "rotations" if rotations < translations else "translations"
    return [
        f"χ² of rotations is {rotations:.3g} times what the information matrices promise, of translations {translations:.3g} "
        f"times: the information of {name} is too small, their standard deviations are too large by a factor of "
        f"{1.0 / math.sqrt(max(less, 1e-300)):.2g}, and they count for less than they could"
    ]


def _readings(information: NDArray[np.float64]) -> Iterator[tuple[NDArray[np.float64], str]]:
    """Other information matrices, and what these were meant to be."""
    parts = edge_parts(information.shape[1])
    for is_inverse in (False, True):
        try:
            read = np.linalg.inv(information) if is_inverse else information
        except np.linalg.LinAlgError:
            return
        for units in itertools.product(_ROTATIONS, _TRANSLATIONS):
            if not is_inverse and units == ("", ""):
                continue
            scale = np.ones(information.shape[1])
            scale[parts[0]], scale[parts[1]] = _ROTATIONS[units[0]], _TRANSLATIONS[units[1]]
            meant = _covariances_text(*units) if is_inverse else _units_text(*units)
            yield np.asarray(read * np.outer(scale, scale), dtype=np.float64), meant


def _units_text(rotation: str, translation: str) -> str:
    if rotation and translation:
        return (
            f"the information of rotations is per {rotation} and that of translations per {translation}: give it per square "
            "radian and square metre"
        )
    part, wanted = ("rotations", "radian") if rotation else ("translations", "metre")
    return f"the information of {part} is per {rotation or translation}: give it per square {wanted}"


def _covariances_text(rotation: str, translation: str) -> str:
    named = "".join(f", of {part} in {unit}s" for part, unit in (("rotations", rotation), ("translations", translation)) if unit)
    return f"they are covariances{named}: give their inverses{', in radians and metres' if named else ''}"


def _fits(graph: PoseGraph, poses: NDArray[np.float64], held: int) -> tuple[float, float, float] | None:
    """χ² of rotations, of translations and of both over what is promised; None where either has too little redundancy to tell."""
    i, j = graph.edges.T
    e = residual_of(graph).evaluate(poses[i], poses[j])
    free = len(graph.ids) - held
    found, promised = [], []
    for part in edge_parts(e.shape[1]):
        own, information = e[:, part], graph.information[:, part, part]
        dof = own.shape[1] * (int(np.count_nonzero(information.any(axis=(1, 2)))) - free)
        if dof < _LEAST:
            return None
        found.append(float(np.einsum("ni,nij,nj->", own, information, own)))
        promised.append(dof)
    both = float(np.einsum("ni,nij,nj->", e, graph.information, e))
    return found[0] / promised[0], found[1] / promised[1], both / sum(promised)
