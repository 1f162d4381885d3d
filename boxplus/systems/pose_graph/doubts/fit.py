"""Whether to believe an optimised pose graph: do its residuals fit their information, and is everything determined?"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_cdf, chi_square_exceeded, chi_square_quantile
from boxplus._jit import kernel
from boxplus._words import counted, either
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.manifolds import se2, se3
from boxplus.optimization.solution import Solution
from boxplus.systems.pose_graph.problem import positions, residual_of, with_edges
from boxplus.systems.pose_graph.start import components
from boxplus.systems.pose_graph.starts import Start

_DOUBTFUL, _POOR, _CONTRADICTION = 2.6, 3.5, 6.0  # standard deviations of χ² above its mean
_SLACK, _SURE = 0.25, 1e-6  # share of its mean up to which standard deviations are twice too large, and the chance of it
_STRANGE = 1e-6  # chance that an edge of a sound graph, the worst of all, stands out
_LEAST = 1.1  # times its mean: noise is never so well known that less contradicts it
_SAME = 1e-3  # relative difference up to which two minima are one
_WEAK = 1e-10  # pivot, as a share of its diagonal entry, below which an information matrix says nothing along some direction
_ROUNDED, _DIGITS = 1e-9, 6  # by which numbers of edges that are there twice differ, and digits that they are sorted by
_LISTED = 5
_DRIFTED = 0.5  # of the median length of an edge, by which half of those without information in a direction may be off there
_NO_LENGTH = 1e-6  # of the extent of the poses: measured lengths up to that say nothing of where poses lie


@dataclass(frozen=True, slots=True)
class Fit:
    """χ² against what the information matrices promise.

    Attributes:
        chi2: of the counted edges.
        dof: their rows less the degrees of freedom that the poses take up; the mean of χ² where the information is right, and no
            whole number of a part of the edges.
        is_partial: whether a robust loss leaves edges uncounted.
    """

    chi2: float
    dof: float
    is_partial: bool = False

    @property
    def excess(self) -> float:
        """How unlikely χ² is, as standard deviations of a Gaussian (Wilson and Hilferty 1931: its cube root is nearly one)."""
        if self.dof == 0:
            return 0.0
        spread = 2.0 / (9.0 * self.dof)
        return float(((self.chi2 / self.dof) ** (1.0 / 3.0) - 1.0 + spread) / math.sqrt(spread))

    @property
    def enough(self) -> float:
        """The largest χ² that is not doubtful."""
        spread = 2.0 / (9.0 * self.dof) if self.dof else 0.0
        return float(self.dof * (1.0 - spread + _DOUBTFUL * math.sqrt(spread)) ** 3)

    @property
    def is_doubtful(self) -> bool:
        """Whether noise alone would come by χ² once in 200 times: further starts are tried."""
        return self.excess > _DOUBTFUL

    @property
    def is_poor(self) -> bool:
        """Whether noise alone does not explain χ², once in 5,000 times: a sentence is due."""
        return self.excess > _POOR

    @property
    def is_slack(self) -> bool:
        """Whether the information promises far more noise than there is."""
        return self.chi2 < _SLACK * self.dof and chi_square_cdf(self.chi2, self.dof) < _SURE

    @property
    def sentence(self) -> str:
        """χ² and what the information promises of it."""
        if self.dof == 0 and self.is_partial:
            return "under this loss too few edges count by half or more to hold χ² against what the information promises"
        if self.dof == 0:
            return "no redundancy: nothing checks the measurements"
        ratio = self.chi2 / self.dof
        return f"χ² {self.chi2:.6g} for {self.dof:,} degrees of freedom, {ratio:.3g} times what the information promises"

    @property
    def is_contradiction(self) -> bool:
        """Whether nothing explains χ² but that edges contradict each other: six standard deviations, and a tenth."""
        return self.excess > _CONTRADICTION and self.chi2 > _LEAST * self.dof

    @classmethod
    def of(cls, graph: PoseGraph, squared: NDArray[np.float64], counted: NDArray[np.bool_], held: int) -> Fit:
        """Of the edges `counted` (m,), of which every one adds `squared` (m,) to χ², with `held` poses held."""
        d = graph.information.shape[1]
        free = len(graph.ids) - held
        return cls(float(squared[counted].sum()), max(d * int(np.count_nonzero(counted)) - d * free, 0), not counted.all())


def misfit(fit: Fit) -> str:
    """`χ² is 3.3 times what the information matrices promise (…)`."""
    promise = f"{fit.chi2:.6g} for {fit.dof:,} degrees of freedom"
    return f"χ² is {fit.chi2 / fit.dof:.3g} times what the information matrices promise ({promise})"


def slack_sentence(fit: Fit) -> str:
    """What a fit that is too good means."""
    return (
        f"{misfit(fit)}: the information is too small, standard deviations computed from it are too large by a factor of "
        f"{math.sqrt(fit.dof / max(fit.chi2, 1e-300)):.2g}, and false edges as large as these stay unnoticed"
    )


def standing_out(squared: NDArray[np.float64], dim: int) -> NDArray[np.bool_]:
    """(k,) which of these squared errors no noise explains, judged by the typical one where that is larger than promised."""
    if not len(squared):
        return np.zeros(0, dtype=np.bool_)
    scale = max(float(np.median(squared)) / chi_square_quantile(0.5, dim), 1.0)
    return np.asarray(squared > scale * chi_square_exceeded(_STRANGE / len(squared), dim))


def disagree(minima: Mapping[Start, float]) -> bool:
    """Whether starts ended in different minima."""
    return max(minima.values()) > (1.0 + _SAME) * min(minima.values())


def poor_fit_sentence(fit: Fit, minima: Mapping[Start, float], fixed: int) -> str:
    """What a poor fit may mean, with the χ² that every start ended at and the number of poses that the file fixes."""
    found = np.array(list(minima.values()))
    ends = ", ".join(f"{name.replace('_', ' ')} {value:.6g}" for name, value in minima.items())
    if disagree(minima):
        why = f"starts end in different minima ({ends}; the lowest is taken), so this one is likely local too"
    elif len(found) > 1:
        why = f"all starts end in the same minimum ({ends}), so the information is likely too optimistic, or edges are false"
    else:
        why = "a local minimum, false edges, or information that is too optimistic; `--start auto` tries further starts"
    if fixed > 1:
        why += f"; or the {fixed} poses that the file fixes contradict the edges"
    return f"{misfit(fit)}: {why}; --robust gnc tells false loop closures from true ones"


def local_notes(fit: Fit, minima: Mapping[Start, float]) -> list[str]:
    """A sentence where the fit is good, and yet the best starts ended in different minima."""
    if fit.is_poor or len(minima) < 2 or fit.dof == 0 or not {"chordal", "chordal_objective"} <= minima.keys():
        return []
    first, smooth = minima["chordal"], minima["chordal_objective"]
    lowest = min(minima.values())
    if not max(first, smooth) - lowest > _SAME * lowest:
        return []
    relaxed = f", a Cauchy loss from the lowest of all starts at {minima['cauchy']:.6g}" if "cauchy" in minima else ""
    return [
        f"the noise in rotation leaves room for local minima that fit: the chordal start ended at χ² {first:.6g}, the minimum of "
        f"the chordal objective at {smooth:.6g}{relaxed}; the lowest is taken, and a lower one may exist"
    ]


def without_information(graph: PoseGraph) -> NDArray[np.bool_]:
    """(m,) edges whose information matrix is zero."""
    return np.asarray(~graph.information.any(axis=(1, 2)))


def silent_notes(graph: PoseGraph, silent: NDArray[np.bool_]) -> list[str]:
    """A sentence on edges without information, `silent` (m,)."""
    edges = np.flatnonzero(silent)
    told = f"{len(edges)} of {len(silent)} edges carry no information and were left out: {edge_names(graph, edges)}"
    return [told] if len(edges) else []


def edge_names(graph: PoseGraph, edges: NDArray[np.int64]) -> str:
    """`0 → 1, 7 → 9 …`."""
    names = ", ".join(f"{a} → {b}" for a, b in graph.ids[graph.edges[edges[:_LISTED]]])
    return names + (" …" if len(edges) > _LISTED else "")


def pose_names(graph: PoseGraph, poses: NDArray[np.int64]) -> str:
    """`0, 1, 2 …`."""
    return ", ".join(str(graph.ids[pose]) for pose in poses[:_LISTED]) + (" …" if len(poses) > _LISTED else "")


def structure_notes(graph: PoseGraph, held: NDArray[np.int64]) -> list[str]:
    """Sentences on pieces without edges between them, and on poses without any edge."""
    label = components(graph)
    sizes = np.bincount(label)
    notes = []
    if len(sizes) > 1:
        free = np.setdiff1d(held, graph.fixed)
        notes.append(
            f"the graph falls into {len(sizes)} pieces without edges between them"
            + (
                f"; poses {pose_names(graph, free)}, the first of those that the file does not fix anywhere, are held"
                if len(free)
                else ""
            )
        )
    alone = np.flatnonzero(sizes[label] == 1)
    if len(alone):
        notes.append(
            f"{counted(len(alone), 'pose')} {either(len(alone), 'has', 'have')} no edge and "
            f"{either(len(alone), 'stays where it is', 'stay where they are')}: {pose_names(graph, alone)}"
        )
    return notes


def repetition_notes(graph: PoseGraph) -> list[str]:
    """A sentence on edges that are there twice, measurement and all, the other way round too."""
    i, j = graph.edges.T
    all_keys = np.minimum(i, j) * len(graph.ids) + np.maximum(i, j)
    ascending = np.sort(all_keys)
    parallel = np.flatnonzero(np.isin(all_keys, ascending[1:][ascending[1:] == ascending[:-1]]))
    if not len(parallel):
        return []
    key, is_back, Z = all_keys[parallel], i[parallel] > j[parallel], graph.measurements[parallel]
    Z[is_back] = (se3 if graph.dimension == 3 else se2).inverse(Z[is_back])
    if graph.dimension == 3:
        Z[:, :4] *= np.where(Z[:, :1] < 0.0, -1.0, 1.0)  # q and -q turn alike
    # Inverting and printing round, and rounding must not part what is next to each other.
    order = np.lexsort((np.arange(len(key)), np.round(Z[:, -1], _DIGITS), key))
    same = key[order][1:] == key[order][:-1]
    same &= (np.abs(Z[order][1:] - Z[order][:-1]) <= _ROUNDED * (1.0 + np.abs(Z[order][1:]))).all(axis=1)
    repeated = np.sort(parallel[order[1:][same]])
    if not len(repeated):
        return []
    turned = np.count_nonzero(is_back[order][1:][same] != is_back[order][:-1][same])
    there, count_again = ("is", "counts") if len(repeated) == 1 else ("are", "count")
    return [
        f"{len(repeated)} of {len(graph.edges)} edges {there} there before with the same measurement"
        + (f" ({turned} of them the other way round)" if turned else "")
        + f" and {count_again} again, as if measured independently; standard deviations come out too small: "
        + edge_names(graph, repeated)
    ]


def undetermined_notes(graph: PoseGraph, solution: Solution) -> list[str]:
    """Sentences on directions that the edges leave free; looked for only where information matrices are singular."""
    weak = np.zeros(len(graph.edges), dtype=np.bool_)
    _mark_singular(graph.information, weak)
    if not weak.any():
        return []
    counted = ""
    if not np.array_equal(graph.ids, np.arange(len(graph.ids))):
        counted = f" (poses are counted from 0 in the order of the file: poses[0] has the id {graph.ids[0]})"
    return [
        f"the edges do not determine all poses; where they do not, the start decides: {told}{counted}"
        for told in solution.undetermined()
    ]


def drifted_doubt(graph: PoseGraph, poses: NDArray[np.float64]) -> str | None:
    """A sentence where poses that the edges leave free ended far from the very numbers that these edges give.

    To be asked where there is something free: what has no information counts as nothing, and yet somebody wrote it down.

    Args:
        poses: at the end.
    """
    axes = slice(-graph.dimension, None)
    weights, directions = np.linalg.eigh(graph.information[:, axes, axes])
    is_free = weights <= _WEAK * weights[:, -1:]
    is_judged = np.asarray(is_free.any(axis=1))
    judged = np.flatnonzero(is_judged)
    if not len(judged):
        return None
    i, j = graph.edges[judged].T
    error = residual_of(with_edges(graph, is_judged)).evaluate(poses[i], poses[j])[:, axes]
    beside = np.einsum("nab,na->nb", directions[judged], error) * is_free[judged]
    off = float(np.median(np.linalg.norm(beside, axis=1)))
    length = float(np.median(np.linalg.norm(positions(graph, graph.measurements[judged]), axis=1)))
    extent = float(np.ptp(positions(graph, poses), axis=0).max())
    if not length > _NO_LENGTH * extent or not off > _DRIFTED * length:
        return None
    return (
        "along what the edges do not determine the poses are anywhere: half of the edges without information there end "
        f"{off:.3g} m and more beside what they say, and are {length:.3g} m long; give every direction some information, or fix "
        "poses"
    )


@kernel
def _mark_singular(matrices: NDArray[np.float64], singular: NDArray[np.bool_]) -> None:
    """Elimination of every matrix; singular where a pivot vanishes against its diagonal entry."""
    dim = matrices.shape[1]
    work = np.empty((dim, dim))
    for m in range(matrices.shape[0]):
        for i in range(dim):
            for j in range(dim):
                work[i, j] = matrices[m, i, j]
        singular[m] = False
        for k in range(dim):
            pivot = work[k, k]
            if not pivot > _WEAK * matrices[m, k, k]:
                singular[m] = True
                break
            for i in range(k + 1, dim):
                if work[i, k] != 0.0:
                    factor = work[i, k] / pivot
                    for j in range(k + 1, i + 1):
                        work[i, j] -= factor * work[j, k]
