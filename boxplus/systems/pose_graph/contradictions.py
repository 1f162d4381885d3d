"""What speaks against a verdict on loop closures: witnesses refused together, odometry that does not fit, loose ends."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._chi_square import chi_square_quantile, chi_square_sf
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.systems.pose_graph.bridges import Bridge
from boxplus.systems.pose_graph.consensus import Crossings
from boxplus.systems.pose_graph.doubts import pose_names
from boxplus.systems.pose_graph.loops import LoopVerdict
from boxplus.systems.pose_graph.problem import odometry_order, with_edges
from boxplus.systems.pose_graph.start import components

_STRANGE = 1e-6  # chance of noise to bend sound odometry anywhere as far as that
_WIDTHS = (1, 3, 10, 30)  # steps that a slip is spread over
_ALONE = 0.1  # share of the odometry that no kept loop closure checks, from which on that is told
_WITNESSES = 3  # loop closures that agree with each other by more than chance
_OBJECTING = 2  # loop closures that may have been kept by chance, or bent; more of them confirm the odometry


def contradictions(graph: PoseGraph, verdict: LoopVerdict, bridges: list[Bridge]) -> list[str]:
    """A sentence on each; none where nothing speaks against the verdict.

    Args:
        bridges: loop closures that were believed beforehand.
    """
    said = [bridge.sentence(graph) for bridge in bridges if bridge.is_contested]
    if not verdict.is_kept[verdict.is_loop].any() and not bridges:
        said.append(
            f"all {np.count_nonzero(verdict.is_loop)} loop closures were refused, and the result is odometry alone: all are "
            "false, or the odometry claims more than it can"
        )
    label, before = components(with_edges(graph, verdict.is_kept)), components(graph)
    if label.max(initial=0) > before.max(initial=0):
        alone = np.setdiff1d(np.unique(label, return_index=True)[1], np.unique(before, return_index=True)[1]).astype(np.int64)
        said.append(
            f"the edges that were kept leave {len(alone)} pieces tied to nothing, with poses {pose_names(graph, alone)}: where "
            "these lie is not known"
        )
    return [*said, *(text for text in (_bent(graph, verdict), _slip(graph, verdict)) if text)]


def unconfirmed_notes(graph: PoseGraph, verdict: LoopVerdict) -> list[str]:
    """A sentence where a good part of the odometry is spanned by refused loop closures and by none that was kept."""
    rank = odometry_order(graph)
    low, high = np.sort(rank[graph.edges], axis=1).T
    kept, refused = (verdict.is_loop & which for which in (verdict.is_kept, ~verdict.is_kept))
    n = len(graph.ids)
    alone = (_spanned(low[refused], high[refused], n) > 0) & (_spanned(low[kept], high[kept], n) == 0)
    if not alone.sum() > _ALONE * n:
        return []
    of = np.cumsum(alone)[high - 1] > np.where(low > 0, np.cumsum(alone)[low - 1], 0)
    return [
        f"{alone.mean():.0%} of the odometry is confirmed by no loop closure that was kept, refused ones "
        f"that span it: {np.count_nonzero(of & refused)}; whether it slipped there or these are false cannot be told"
    ]


def _bent(graph: PoseGraph, verdict: LoopVerdict) -> str | None:
    """Where the loop closures that were kept bend the odometry, over one step or several, by more than its noise."""
    rank, dim = odometry_order(graph), graph.information.shape[1]
    steps = np.flatnonzero(~verdict.is_loop & (np.abs(np.diff(rank[graph.edges], axis=1))[:, 0] == 1))
    steps = steps[np.argsort(rank[graph.edges[steps]].min(axis=1), kind="stable")]
    squared = verdict.innovations[steps] ** 2
    if not len(steps):
        return None
    scale = max(float(np.median(squared)) / chi_square_quantile(0.5, dim), 1.0)
    total = np.concatenate([[0.0], np.cumsum(squared / scale)])
    best, told = _STRANGE / len(steps), None
    for width in (width for width in _WIDTHS if width <= len(steps)):
        sums = total[width:] - total[:-width]
        most = int(np.argmax(sums))
        chance = chi_square_sf(sums[most], width * dim)
        if chance < best:
            best = chance
            ends = graph.edges[steps[most : most + width]]
            first, last = (graph.ids[ends.reshape(-1)[k(rank[ends].reshape(-1))]] for k in (np.argmin, np.argmax))
            told = (
                f"the odometry from pose {first} to pose {last} is off by {math.sqrt(sums[most] * scale / width):.3g} standard "
                "deviations a step, as the loop closures that were kept demand: it slipped there, or false ones were kept"
            )
    return told


def _slip(graph: PoseGraph, verdict: LoopVerdict) -> str | None:
    """Where refused loop closures agree that all after some step of odometry lies elsewhere, and hardly any kept one objects."""
    refused = np.flatnonzero(verdict.is_loop & ~verdict.is_kept)
    if len(refused) < _WITNESSES:
        return None
    n = len(graph.ids)
    rank = odometry_order(graph)
    i, j = rank[graph.edges].T
    crossings = Crossings.of(graph, verdict.solution.values[0], refused, i[refused] > j[refused], rank, ~verdict.is_loop)
    low, high = np.minimum(i, j), np.maximum(i, j)
    kept = verdict.is_loop & verdict.is_kept
    confirmed = _spanned(low[kept], high[kept], n)
    best, told = 0, None
    for one in crossings.tried:
        witnesses = refused[crossings.agreeing(int(one))[1]]
        if len(witnesses) <= max(best, _WITNESSES - 1):
            continue
        spanned = _spanned(low[witnesses], high[witnesses], n)
        most = int(spanned.max())
        steps = np.flatnonzero(spanned == most)
        objecting = int(confirmed[steps].min())
        if most >= _WITNESSES and most > 2 * (objecting + 1) and objecting <= _OBJECTING and most > best:
            at = np.flatnonzero(confirmed[steps] == objecting)
            order = np.argsort(rank)
            first, last = (graph.ids[order[k]] for k in (steps[at[0]], steps[at[-1]] + 1))
            best = most
            told = (
                f"{most} refused loop closures agree with each other that odometry from pose {first} to pose {last} is wrong, "
                f"and {objecting} of those kept span it: it slipped there, or these are false together; if it slipped, give that "
                "edge less information"
            )
    return told


def _spanned(low: NDArray[np.int64], high: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """(n,) how many of the loop closures from `low` to `high` span the step from every place to the next."""
    change = np.bincount(low, minlength=n + 1) - np.bincount(high, minlength=n + 1)
    return np.asarray(np.cumsum(change)[:n])
