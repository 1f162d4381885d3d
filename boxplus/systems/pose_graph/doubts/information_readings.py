"""Whether information matrices mean something else than they were read as: where residuals are far smaller than they promise.

Covariances in place of their inverses, or information per square degree or square millimetre, weigh the edges wrongly against
each other, and χ² comes out small. Read as they were meant, rotations and translations both fit as promised; where
somebody was only careful, they do not.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_cdf
from boxplus.errors import BoxplusError
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.optimization.minimizers.minimize import Callback
from boxplus.optimization.solution import Iteration, Solution
from boxplus.optimization.solver_options import SolverOptions
from boxplus.optimization.terms.variables import Variables
from boxplus.systems.pose_graph.doubts.reliability import Reliability
from boxplus.systems.pose_graph.named import named
from boxplus.systems.pose_graph.problem import edge_parts, pose_graph_problem, residual_of, squared_errors

_SMALL, _LEAST = 0.7, 30  # χ² of what is promised, below which it is asked, and degrees of freedom for it to mean much
_AS_PROMISED = (0.6, 1.6)  # χ² of rotations and of translations, where a reading is right
_LEAST_SPARE = 10.0  # redundancy from which on either is judged on its own
_LIKELY = (0.1, 3e4)  # the same before poses are found anew
_STEPS = 20
_SOON, _FAR = 8, 100.0  # steps, and χ² over what is promised, that a reading which is right is below by then, by far
_SLACK, _UNLIKE = 0.25, 4.0  # χ² of rotations or translations that is told of, and how many times that the other has
_SURE = 1e-6  # chance that noise as promised makes it as small
_NO_ERROR = 1e-6  # standard deviations, up to which errors along an axis are none, as of a plane in space
_ROTATIONS = {"": 1.0, "square degree": np.degrees(1.0), "square milliradian": 1e3}
_TRANSLATIONS = {"": 1.0, "square millimetre": 1e3}
"""Units, and how many of their roots a radian or a metre has."""


@dataclass(frozen=True, slots=True)
class _Fits:
    """χ² of rotations and of translations, and the redundancy of each: what is promised of it."""

    chi2: tuple[float, float]
    spare: tuple[float, float]

    @classmethod
    def of(cls, known: Reliability) -> _Fits | None:
        """None where either has too little redundancy to tell.

        How much of it each has depends on the weights: precise translations say more of rotations than imprecise rotations do.
        """
        shares = known.factors.any(axis=2) - np.einsum("nii->ni", known.predicted)
        is_told = np.abs(known.errors).max(axis=0) > _NO_ERROR
        parts = [np.flatnonzero(is_told[part]) + part.start for part in edge_parts(len(is_told))]
        chi2 = [float((known.errors[:, axes] ** 2).sum()) for axes in parts]
        spare = [float(shares[:, axes].sum()) for axes in parts]
        return cls((chi2[0], chi2[1]), (spare[0], spare[1])) if min(spare) >= _LEAST_SPARE else None

    @property
    def rotations(self) -> float:
        """χ² over what is promised."""
        return self.chi2[0] / self.spare[0]

    @property
    def translations(self) -> float:
        """χ² over what is promised."""
        return self.chi2[1] / self.spare[1]

    @property
    def off(self) -> float:
        """How far the farther of both is from what is promised, as a logarithm."""
        return max(abs(math.log(max(fit, 1e-300))) for fit in (self.rotations, self.translations))

    @property
    def is_as_promised(self) -> bool:
        """Whether both are."""
        return all(_AS_PROMISED[0] < fit < _AS_PROMISED[1] for fit in (self.rotations, self.translations))

    def is_likely(self, graph: PoseGraph, poses: NDArray[np.float64]) -> bool:
        """Whether it may be with other information, by its χ² at these poses."""
        i, j = graph.edges.T
        residual = residual_of(graph)
        e = np.einsum("nab,nb->na", residual.whitening.factors, residual.evaluate(poses[i], poses[j]))
        fits = [float((e[:, part] ** 2).sum()) / spare for part, spare in zip(edge_parts(e.shape[1]), self.spare, strict=True)]
        return all(_LIKELY[0] < fit < _LIKELY[1] for fit in fits)

    def __str__(self) -> str:
        """χ² of both over what is promised, and of each."""
        both = sum(self.chi2) / sum(self.spare)
        return f"{both:.3g} times (rotations {self.rotations:.3g}, translations {self.translations:.3g})"


def information_doubt(
    graph: PoseGraph,
    solution: Solution,
    variables: Variables,
    held: NDArray[np.int64],
    options: SolverOptions,
    known: Reliability | None = None,
    callback: Callback | None = None,
) -> str | None:
    """A sentence where the edges' information fits the errors at the result far better in another unit, or inverted.

    Of several readings that fit, the one that fits best.

    Args:
        variables: the poses. held: those that are held. known: of all edges, where that has been computed.
        callback: may stop the search for poses of another reading, which then is not told.
    """
    poses = solution[variables]
    dof = graph.information.shape[1] * (len(graph.edges) - len(graph.ids) + len(held))
    if dof < _LEAST or not squared_errors(residual_of(graph), graph, poses).sum() < _SMALL * dof:
        return None
    known = known if known is not None else Reliability.of(graph, solution, variables)
    as_read = None if known is None else _Fits.of(known)
    if as_read is None or as_read.is_as_promised:
        return None
    best: tuple[_Fits, str] | None = None
    told, is_hopeless = named(callback, "information in another unit?"), False

    def watch(step: Iteration) -> bool:
        nonlocal is_hopeless
        is_stopped = told is not None and bool(told(step))
        is_hopeless = not is_stopped and step.number >= _SOON and 2.0 * step.cost > _FAR * dof
        return is_stopped or is_hopeless

    for information, meant in _readings(graph.information):
        other = replace(graph, information=information)
        if not as_read.is_likely(other, poses):
            continue
        try:
            problem, anew = pose_graph_problem(other, held=held, loss=None, objective="logarithm")
            found = problem.solve(options.model_copy(update={"max_iterations": _STEPS}), start=[poses], callback=watch)
            if found.is_broken_off and not is_hopeless:
                return None
            is_near = _AS_PROMISED[0] < 2.0 * found.cost / dof < _AS_PROMISED[1]  # what is known of each part takes longest
            reliability = Reliability.of(other, found, anew) if is_near else None
        except BoxplusError:
            continue
        fits = None if reliability is None else _Fits.of(reliability)
        if fits is not None and fits.is_as_promised and (best is None or fits.off < best[0].off):
            best = fits, meant
    if best is None:
        return None
    return (
        f"χ² is {as_read} what the information matrices promise, and {best[0]} if {best[1]}: edges weigh wrongly against each "
        "other, and standard deviations are wrong"
    )


def slack_part_notes(known: Reliability) -> list[str]:
    """A sentence where rotations, or translations, err by far less than their information promises, and the others do not.

    All together they may well come to what is promised.
    """
    fits = _Fits.of(known)
    if fits is None:
        return []
    is_slack = [
        chi2 < _SLACK * spare and chi_square_cdf(chi2, spare) < _SURE and other > _UNLIKE * chi2 / spare
        for chi2, spare, other in zip(fits.chi2, fits.spare, (fits.translations, fits.rotations), strict=True)
    ]
    if not any(is_slack):
        return []
    name, less = ("rotations", fits.rotations) if is_slack[0] else ("translations", fits.translations)
    return [
        f"χ² of rotations is {fits.rotations:.3g} times what the information matrices promise, of translations "
        f"{fits.translations:.3g} times: the information of {name} is too small, their standard deviations are too large by a "
        f"factor of {1.0 / math.sqrt(max(less, 1e-300)):.2g}, and they count for less than they could"
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
