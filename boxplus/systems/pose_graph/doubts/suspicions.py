"""What the redundancy of a graph contradicts: edges that slipped, odometry or loop closures that are off as a whole, and
information that is wrong in parts (`reliability`, `common_errors`)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_cdf, chi_square_exceeded, chi_square_quantile
from boxplus.optimization.solution import Solution
from boxplus.systems.pose_graph.doubts.common_errors import common_errors
from boxplus.systems.pose_graph.doubts.fit import Fit, edge_names
from boxplus.systems.pose_graph.doubts.reliability import STRANGE, Floats, Reliability
from boxplus.systems.pose_graph.problem import odometry_order

_SURE = 1e-6  # chance that a group of edges is told that fits too well
_ALIKE = 9.2  # difference of squares by which one suspect is a hundred times likelier than another
BENT = 4.0  # standard deviations of the result by which it has to be off, for it not to be trusted
_LEAST_SPARE = 10.0  # redundancy from which on a group of edges is judged on its own
_NONE_LEFT = 0.5  # redundancy, which is a whole number but for rounding
_CLEARLY, _WRONG = 1.5, 4.0  # times what the information promises of a group's χ², to be told, and not to be trusted
_SLACK = 0.25


@dataclass(frozen=True, slots=True)
class Suspicion:
    """Something that the redundancy of a graph contradicts.

    Attributes:
        sentence: what.
        is_grave: whether the result is off by more than it claims.
    """

    sentence: str
    is_grave: bool


def suspicions(known: Reliability, solution: Solution, odometry: NDArray[np.bool_]) -> list[Suspicion]:
    """Edges that all others contradict, what odometry or loop closures are off by in common, and groups that do not fit.

    Args:
        odometry: (m,) edges that join successive poses.
    """
    squared, directions, bent = known.against.squared, known.against.directions, known.against.bent
    checked = directions > 0
    if not checked.any():
        return []
    d, total = known.errors.shape[1], float((known.errors**2).sum())
    half = np.array([math.nan, *(chi_square_quantile(0.5, k) for k in range(1, d + 1))])
    usual = max(float(np.median(squared[checked] / half[directions[checked]])), 1.0)

    def noise(explained: float, by: int) -> float:
        """χ² over its mean without what was explained: one cause contradicts many edges where there are few.

        Where nothing is left, as with a single loop, no error speaks of another noise than information promises.
        """
        spare = float(known.redundancy.sum()) - by
        return min(usual, max((total - explained) / spare, 1.0)) if spare > _NONE_LEFT else 1.0

    worst = int(np.argmax(squared))
    common = common_errors(known, solution, odometry)
    best = max((one.squared for one in common), default=0.0)
    said = []
    if common and best >= squared[worst]:
        # What odometry is off by, loop closures that are off the other way explain as well: it comes first. Any of those that
        # are told by themselves may be what bends the result.
        scale = noise(best, 1)
        told = [one for one in common if one.squared > scale * chi_square_exceeded(STRANGE / one.tried, 1)]
        alike = [one for one in told if one.squared > best - _ALIKE]
        if alike:
            other = f"; or {alike[1].name} by {alike[1].told(scale)}" if len(alike) > 1 else ""
            said.append(Suspicion(alike[0].sentence(scale) + other, max(one.bent for one in told) > BENT))
    else:
        scale = noise(float(squared[worst]), int(directions[worst]))
        limits = np.array([math.inf, *(chi_square_exceeded(STRANGE / len(squared), k) for k in range(1, d + 1))])
        found = squared > scale * limits[directions]
        if found.any():
            said.append(_slipped(known, squared, bent, found))
    return [*said, *_groups(known, odometry)]


def _slipped(known: Reliability, squared: Floats, bent: Floats, found: NDArray[np.bool_]) -> Suspicion:
    graph, worst = known.graph, int(np.argmax(np.where(found, squared, -1.0)))
    alike = np.flatnonzero(squared > squared[worst] - _ALIKE)
    alike = alike[alike != worst]
    others = np.count_nonzero(found) - 1 - np.count_nonzero(found[alike])
    name, size = edge_names(graph, np.array([worst])), math.sqrt(squared[worst])
    told = f"all other edges contradict {name} by {size:.3g} standard deviations"
    if len(alike):
        rank = odometry_order(graph)
        ends = np.unique(graph.edges[[worst, *alike]])
        first, last = (graph.ids[ends[k(rank[ends])]] for k in (np.argmin, np.argmax))
        told += f", or one of {len(alike)} that they cannot tell from it, from pose {first} to pose {last}"
    told += f"; kept as it is, it bends the result there by {bent[worst]:.2g} of its own standard deviations"
    if others > 0:
        told += f", and {others} more are contradicted"
    return Suspicion(f"{told}: it slipped, joins the wrong poses, or claims too much", bool(bent[worst] > BENT))


def _groups(known: Reliability, odometry: NDArray[np.bool_]) -> list[Suspicion]:
    """Odometry and loop closures, each against what its information promises of it."""
    squared, spare = (known.errors**2).sum(axis=1), known.redundancy
    fits = {}
    for name, rows in (("odometry", odometry), ("loop closures", ~odometry)):
        if spare[rows].sum() >= _LEAST_SPARE:
            fits[name] = float(squared[rows].sum()), float(spare[rows].sum())
    if len(fits) < 2:
        return []
    said = []
    for name, (chi2, mean) in fits.items():
        ratio = chi2 / mean
        (other,) = (c / m for key, (c, m) in fits.items() if key != name)
        told = f"{name} have {ratio:.3g} times the squared errors that their information promises, the others {other:.3g} times: "
        if ratio > _CLEARLY * max(other, 1.0) and Fit(chi2, mean).is_contradiction:
            told += "the weight between the two is wrong, and with it the result and its standard deviations"
            said.append(Suspicion(told, ratio > _WRONG))
        elif ratio < _SLACK and ratio < _SLACK * other and chi_square_cdf(chi2, mean) < _SURE:
            said.append(Suspicion(told + "they count for less than they could", False))
    return said
